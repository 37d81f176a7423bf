"""One whole random run: learn, fit, constrain, evaluate, through the program's own command line, in this process."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import re
import shutil
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lidardesign.cli.main import run as run_program
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.task import random_generator
from soak.keeping import checked_bounds
from soak.limits import Bounds, Rules, contradictions, drawn, kept_already
from soak.plans import RunPlan, random_plan, share_near_targets
from soak.scaled_flatland import NAME

# Exit codes (docs): a design was made; the density is too rough to fit to; no design keeps the constraints.
DONE, TOO_ROUGH, INFEASIBLE = 0, 3, 4
# It was the soak that somebody wanted to end.
INTERRUPTED = (130, 143)
TOLD_NOTHING = "tells anything"
TOO_ROUGH_WORDS = re.compile(f"the density is too rough|samples count as only|effective samples|{TOLD_NOTHING}")
NOTHING_SEEN_WORDS = "no ray of the design space reaches a target surface"
# Outcomes: all four commands did their work; the two refusals that learning may end with.
WHOLE, ROUGH, BLIND = "whole", "density too rough", "nothing in sight"
LEFT = "effective samples"
# A run may say that it sees nothing where less of its space than this is near any target.
MOST_NEAR = 1e-3
# What differs between two runs of one seed: times (also `planning_seconds`) and memory.
UNREPEATABLE = ("seconds", "timings", "peak_memory_bytes")
FILES = ("flow.safetensors", "samples.npz")
CONTRADICTORY_SHARE = 0.5


@dataclass
class Record:
    """What one run was about and what it did."""

    seed: int
    size_m: float
    sigma_share: float
    free: int
    sensors: int
    layout: str
    ess: float | None = None  # None where learning failed
    steps: list[tuple[str, str, int, float]] = field(default_factory=list)  # command, asked, exit code, seconds
    bounds: int = 0  # that the second reader checked on written files
    faults: list[str] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)  # of what a second run has to repeat: documents and files
    seconds: float = 0.0  # of the processor

    @classmethod
    def of(cls, plan: RunPlan) -> Record:
        """Of a run that is about to be done."""
        return cls(plan.seed, plan.size_m, plan.sigma_share, len(plan.free), plan.sensors, plan.layout)

    def differences(self, other: Record) -> list[str]:
        """What two runs of one seed did not repeat: commands whose document, and files whose bytes differ."""
        names = dict.fromkeys([*self.digests, *other.digests])
        return [name for name in names if self.digests.get(name) != other.digests.get(name)]

    @property
    def outcome(self) -> str:
        """In some words, for tables."""
        if self.faults:
            return "fault"
        if self.ess is None:
            return BLIND
        if any(command == "fit" and code != DONE for command, _, code, _ in self.steps):
            return ROUGH
        return WHOLE


class StoppedError(Exception):
    """A command that later ones need did not make what they need."""


def whole_run(plan: RunPlan, folder: Path) -> Record:
    """Do a run in a folder of its own, which is made anew.

    The task of `scaled_flatland` has to be on offer.
    """
    record = Record.of(plan)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    started = time.process_time()
    with contextlib.chdir(folder), contextlib.suppress(StoppedError):
        _Doing(plan, record).everything()
    record.seconds = round(time.process_time() - started, 2)
    return record


class _Doing:
    """The commands of one run, in its folder."""

    def __init__(self, plan: RunPlan, record: Record) -> None:
        self.plan, self.record = plan, record
        self.bounds = Bounds.of(plan.config["space"])
        self.generator = random_generator(plan.seed, "soak", "constraints")

    def everything(self) -> None:
        """Learn, fit, constrain twice at most, evaluate."""
        Path("asked.yaml").write_text(dump_yaml(self.plan.config))
        try:
            self._learn()
            self._fit()
            self._constrain()
            if self.generator.random() < CONTRADICTORY_SHARE:
                self._contradict()
            self._evaluate()
        finally:
            for path in [*(Path("run") / name for name in FILES), *sorted(Path("run/designs").glob("*.yaml"))]:
                if path.exists():
                    self.record.digests[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()

    def _learn(self) -> None:
        options = ("--config", "asked.yaml", "--preset", "draft", "--out", "run", "--seed", str(self.plan.seed))
        code, found = self._call("learn", "", NAME, *options)
        if NOTHING_SEEN_WORDS in _message(found):
            share = share_near_targets(self.plan)
            self._expect(share < MOST_NEAR, f"learn: nothing is seen, but {share:.2%} of the space is near a target")
            raise StoppedError
        self._expect(code == DONE, f"learn ended with {code}: {_message(found)}", stop=True)
        self.record.ess = found["ess"]
        for key, low, high in (("ess", 0, 1), ("coverage", 0, 1), ("misplaced", 0, 1), ("log_z", -math.inf, math.inf)):
            value = found[key]
            kept = value is not None and math.isfinite(value) and low <= value <= high
            self._expect(kept, f"learn: {key} is {value}")
        self._expect(found["kl_nats"] is not None, f"learn: the KL estimate is {found['kl_nats']}")
        with np.load("run/samples.npz", allow_pickle=False) as samples:
            for name in ("points", "log_prob", "log_target"):
                self._expect(bool(np.isfinite(samples[name]).all()), f"learn: {name} of samples.npz is not finite")

    def _fit(self) -> None:
        code, found = self._call("fit", "", "run", *self.plan.fit)
        if code in (TOO_ROUGH, INFEASIBLE) and TOO_ROUGH_WORDS.search(_message(found)):
            raise StoppedError
        self._expect(code == DONE, f"fit ended with {code}: {_message(found)}", stop=True)
        self._check_design("fit", {})

    def _constrain(self) -> None:
        kept = self.generator.random() < 0.5
        if kept:
            rules = kept_already(_read("fit"), self.bounds, self.generator, is_moving=self.plan.is_moving)
        else:
            rules = drawn(self.bounds, self.plan.sensors, self.generator)
        code, found = self._constrain_with(rules, "held", "kept already" if kept else "drawn")
        if code == DONE:
            self._expect(found["satisfied"] is True, "constrain: satisfied is not true")
            self._check_design("held", rules)
            return
        self._check_refusal(code, found, "held")
        self._expect(not kept, f"constrain: bounds that the fit keeps were refused: {_message(found)}; {rules}")

    def _contradict(self) -> None:
        options = contradictions(self.bounds, self.plan.sensors)
        what = list(options)[int(self.generator.integers(len(options)))]
        code, found = self._constrain_with(options[what], "impossible", what)
        self._expect(code == INFEASIBLE, f"constrain: {what}: ended with {code}: {_message(found)}")
        self._check_refusal(code, found, "impossible")
        self._expect(bool(found.get("error", {}).get("conflicts")), f"constrain: {what}: no conflict is named")

    def _constrain_with(self, rules: Rules, name: str, asked: str) -> tuple[int, dict[str, Any]]:
        Path(f"{name}.yaml").write_text(dump_yaml(rules))
        options = ["run/designs/fit.yaml"]
        if self.generator.random() < 0.5:  # a design hands on its layout and its rays, a run does not
            at = self.plan.fit[-2:] if "--at" in self.plan.fit else ()
            options = ["run", "--layout", self.record.layout, *at]
        return self._call("constrain", asked, *options, "--constraints", f"{name}.yaml", "--name", name)

    def _check_refusal(self, code: int, found: dict[str, Any], name: str) -> None:
        error = found.get("error", {})
        if code == TOO_ROUGH and TOLD_NOTHING in _message(found):
            return  # constraints let sensors look past all targets
        self._expect(code == INFEASIBLE, f"constrain ended with {code}: {_message(found)}")
        # a pinned origin has no mass: then the samples that are left are told
        told = bool(error.get("conflicts")) or error.get("admissible_mass") is not None or LEFT in _message(found)
        self._expect(told, f"constrain: refused without a conflict or a mass: {_message(found)}")
        self._expect(not Path(f"run/designs/{name}.yaml").exists(), "constrain: refused, but there is a file")

    def _check_design(self, name: str, rules: Rules) -> None:
        """The written file by the second reader: bounds, shares and numbers."""
        design = _read(name)
        checks = checked_bounds(design, rules, self.plan.config["space"])
        self.record.bounds += len(checks)
        for bound, kept, found in checks:
            self._expect(kept, f"{name}.yaml breaks {bound}: found {found}")
        self._expect(_all_finite(design), f"{name}.yaml holds a number that is not finite")
        total = sum(sensor["weight"] for sensor in design["sensors"])
        # weights are shares in float64, some written with seventeen digits
        self._expect(math.isclose(total, 1.0, rel_tol=1e-9), f"{name}.yaml: the weights sum to {total}")

    def _evaluate(self) -> None:
        code, found = self._call("evaluate", "", "run", *self.plan.evaluate)
        self._expect(code == DONE, f"evaluate ended with {code}: {_message(found)}", stop=True)
        for row in found["rows"] + found["equal_bandwidth"]:
            # a single group of scenes has no interval, and that of a few is not cut at the worst value
            ends = ("ci_low", "ci_high") if found["groups"] > 1 else ()
            values = {key: row[key] for key in ("value", "bandwidth_mbps", *ends)}
            finite = all(value is not None and math.isfinite(value) for value in values.values())
            self._expect(finite, f"evaluate: {row['design']} at {row['rays']} rays has {values}")
            if finite:
                value, worst = row["value"], found["metric"]["worst"]
                slack = 1e-9 * worst
                self._expect(-slack <= value <= worst + slack, f"evaluate: {row['design']} has {value}")
                low, high = (values.get(end, value) for end in ("ci_low", "ci_high"))
                ordered = low <= value + slack <= high + 2 * slack
                self._expect(ordered, f"evaluate: {row['design']}: {low} to {high} does not hold {value}")

    def _call(self, command: str, asked: str, *arguments: str) -> tuple[int, dict[str, Any]]:
        """A command's exit code and document; what it warned of is a fault."""
        started = time.process_time()
        output, errors = io.StringIO(), io.StringIO()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
                code = _exit_code([command, *arguments, "--json"])
        self.record.steps.append((command, asked, code, round(time.process_time() - started, 2)))
        for warning in warned:
            if issubclass(warning.category, RuntimeWarning):
                line = f"{Path(warning.filename).name}:{warning.lineno}"
                self._expect(False, f"{command}: {warning.message} ({line})")
        try:
            document = json.loads(output.getvalue(), parse_constant=_not_json)
        except ValueError as error:
            text = errors.getvalue()[-2000:]
            self._expect(False, f"{command}: exit {code}, no JSON document ({error}): {text}", stop=True)
        told = json.dumps(_repeatable(document), sort_keys=True).encode()
        self.record.digests[f"{command} {asked}".strip()] = hashlib.sha256(told).hexdigest()
        return code, document

    def _expect(self, kept: bool, fault: str, *, stop: bool = False) -> None:
        if kept:
            return
        if fault not in self.record.faults:
            self.record.faults.append(fault)
        if stop:
            raise StoppedError


def _exit_code(arguments: list[str]) -> int:
    try:
        run_program(arguments)
    except SystemExit as ended:
        if ended.code in INTERRUPTED:
            raise KeyboardInterrupt from ended
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except KeyboardInterrupt:
        raise
    except BaseException:
        traceback.print_exc()
        return -1
    return 0


def _not_json(name: str) -> float:
    raise ValueError(f"{name} is no JSON")


def _message(found: Mapping[str, Any]) -> str:
    return found.get("error", {}).get("message", "no message")


def _read(name: str) -> dict[str, Any]:
    path = Path("run/designs") / f"{name}.yaml"
    yaml.safe_load(path.read_text())
    return parse_yaml(path.read_text(), where=str(path)).value


def _all_finite(values: Any) -> bool:
    if isinstance(values, Mapping):
        return all(_all_finite(value) for value in values.values())
    if isinstance(values, list | tuple):
        return all(_all_finite(value) for value in values)
    return not isinstance(values, float) or math.isfinite(values)


def _repeatable(document: Any) -> Any:
    """A document without times and memory."""
    if isinstance(document, Mapping):
        return {key: _repeatable(value) for key, value in document.items() if not key.endswith(UNREPEATABLE)}
    if isinstance(document, list):
        return [_repeatable(value) for value in document]
    return document


def plan_lines(seed: int) -> Iterator[str]:
    """The configuration and the options of a run, for people."""
    plan = random_plan(seed)
    yield dump_yaml(plan.config).rstrip()
    yield f"fit: {' '.join(plan.fit)}"
    yield f"evaluate: {' '.join(plan.evaluate)}"
