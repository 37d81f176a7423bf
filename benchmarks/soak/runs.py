"""Random whole runs, `make soak-runs`: no fault, every constraint kept, the same bytes when done again.

Each learns, fits, constrains and evaluates through the program's own command line, in this process, twice; loose
bounds must be kept, tight ones kept or refused with what stands against them, contradictions refused. A density may be
too rough to fit to, also within bounds or for a baseline (exit 3, or 4 for so many sensors), and a design space may see
no target (exit 3).
`pytest -m long -s -p benchmarks.soak.long_runs benchmarks/soak/runs.py --amount 520 -k '[SEED]'` does one again and
shows its configuration.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import re
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.docs_session import in_process

from benchmarks.soak.attempts import not_finite
from benchmarks.soak.limits import Rules, bounds_around, contradictions
from benchmarks.soak.long_runs import amount, ended_after
from benchmarks.soak.plans import RunPlan, random_plan, share_in_targets
from benchmarks.soak.scaled_flatland import NAME, offer
from lidardesign.constraints.check import check_design
from lidardesign.run.yaml import dump_yaml, load_yaml
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator

# Minutes on a busy machine; a run that takes this long hangs.
LONGEST_RUN_S = 900.0
# Exit codes (docs): a design was made; the density is too rough to fit to; no design keeps the constraints.
DONE, TOO_ROUGH, INFEASIBLE = 0, 3, 4
# It was the soak that somebody wanted to end.
INTERRUPTED = (130, 143)
TOLD_NOTHING = "tells anything"
TOO_ROUGH_WORDS = re.compile(f"the density is too rough|samples count as only|effective samples|{TOLD_NOTHING}")
NOTHING_SEEN_WORDS = "no ray of the design space reaches a target surface"
# Outcomes: all four commands did their work; the two refusals that learning may end with.
WHOLE, ROUGH, BLIND = "whole", "density too rough", "nothing in sight"
# A run may say that it sees nothing where less of its space than this lies in a target.
MOST_REACHED = 1e-3
# What differs between two runs of one seed: times (also `planning_seconds`) and memory.
UNREPEATABLE = ("seconds", "timings", "peak_memory_bytes")
FILES = ("flow.safetensors", "samples.npz")
CONTRADICTORY_SHARE = 0.5


@dataclass
class Record:
    """What one run did: how it ended, bounds read back and how constraints ended, and digests of what repeats."""

    outcome: str = WHOLE
    counts: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)

    def differences(self, other: Record) -> list[str]:
        """What two runs of one seed did not repeat: commands whose document, and files whose bytes differ."""
        names = dict.fromkeys([*self.digests, *other.digests])
        return [name for name in names if self.digests.get(name) != other.digests.get(name)]


class StoppedError(Exception):
    """A command that later ones need did not make what they need."""


def whole_run(plan: RunPlan, folder: Path) -> Record:
    """Do a run in a new folder of its own; the task of `scaled_flatland` has to be on offer."""
    record = Record()
    folder.mkdir(parents=True)
    with contextlib.chdir(folder), contextlib.suppress(StoppedError):
        _Doing(plan, record).everything()
    return record


class _Doing:
    """The commands of one run, in its folder."""

    def __init__(self, plan: RunPlan, record: Record) -> None:
        self.plan, self.record = plan, record
        self.space = DesignSpace.from_dict({"condition": (), **plan.config["space"]})
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
            share = share_in_targets(self.plan)
            self._expect(share < MOST_REACHED, f"learn: nothing is seen, but {share:.2%} of the space is in a target")
            self._stop(BLIND)
        self._expect(code == DONE, f"learn ended with {code}: {_message(found)}", stop=True)
        for key in ("ess", "coverage", "misplaced"):
            self._expect(0 <= found[key] <= 1, f"learn: {key} is {found[key]}")
        self._expect(None not in (found["kl_nats"], found["log_z"]), "learn: the KL or log Z is not estimated")
        with np.load("run/samples.npz", allow_pickle=False) as samples:
            for name in ("points", "log_prob", "log_target"):
                self._expect(bool(np.isfinite(samples[name]).all()), f"learn: {name} of samples.npz is not finite")

    def _fit(self) -> None:
        code, found = self._call("fit", "", "run", *self.plan.fit)
        if code in (TOO_ROUGH, INFEASIBLE) and TOO_ROUGH_WORDS.search(_message(found)):
            self._stop(ROUGH)
        self._expect(code == DONE, f"fit ended with {code}: {_message(found)}", stop=True)
        self._check_design("fit", {})

    def _constrain(self) -> None:
        is_loose = self.generator.random() < 0.5
        room, design = 1.0 if is_loose else self.generator.uniform(-1, 1), _read("fit")
        rules = bounds_around(design, self.space, self.generator, room, is_moving=self.plan.is_moving)
        code, found = self._constrain_with(rules, "held", "loose" if is_loose else "tight")
        if code == DONE:
            self._expect(found["satisfied"] is True, "constrain: satisfied is not true")
            self._check_design("held", rules)
            return
        self._check_refusal(code, found, "held")
        few_are_left = TOO_ROUGH_WORDS.search(_message(found)) is not None
        self._expect(
            not is_loose or few_are_left,
            f"constrain: bounds that the fit keeps were refused: {_message(found)}; {rules}",
        )

    def _contradict(self) -> None:
        options = contradictions(self.space, self.plan.sensors)
        what = list(options)[int(self.generator.integers(len(options)))]
        code, found = self._constrain_with(options[what], "impossible", "contradictions")
        self._check_refusal(code, found, "impossible")
        self._expect(bool(found.get("error", {}).get("conflicts")), f"constrain: {what}: no conflict is named")

    def _constrain_with(self, rules: Rules, name: str, asked: str) -> tuple[int, dict[str, Any]]:
        Path(f"{name}.yaml").write_text(dump_yaml(rules))
        options = ["run/designs/fit.yaml"]
        if self.generator.random() < 0.5:  # a design hands on its layout and its rays, a run does not
            at = self.plan.fit[-2:] if "--at" in self.plan.fit else ()
            options = ["run", "--layout", self.plan.layout, *at]
        return self._call("constrain", asked, *options, "--constraints", f"{name}.yaml", "--name", name)

    def _check_refusal(self, code: int, found: dict[str, Any], name: str) -> None:
        error = found.get("error", {})
        self._expect(code == INFEASIBLE, f"constrain ended with {code}: {_message(found)}")
        if TOLD_NOTHING in _message(found):
            return  # constraints let sensors look past all targets
        # a pinned origin has no mass: then the samples that are left are told
        mass = error.get("admissible_mass") is not None or "effective samples" in _message(found)
        told = bool(error.get("conflicts")) or mass
        self._expect(told, f"constrain: refused without a conflict or a mass: {_message(found)}")
        self._expect(not Path(f"run/designs/{name}.yaml").exists(), "constrain: refused, but there is a file")

    def _check_design(self, name: str, rules: Rules) -> None:
        """The written file by the independent checker: bounds, shares and numbers."""
        design = _read(name)
        checks = check_design(design, rules, self.space)
        self.record.counts["bounds read back"] += len(checks)
        for check in checks:
            self._expect(check.satisfied, f"{name}.yaml breaks {check.name} {check.bound}: found {check.value}")
        self._expect(not not_finite(design), f"{name}.yaml: {not_finite(design)}")
        total = sum(sensor["weight"] for sensor in design["sensors"])
        # weights are shares in float64, some written with seventeen digits
        self._expect(math.isclose(total, 1.0, rel_tol=1e-9), f"{name}.yaml: the weights sum to {total}")

    def _evaluate(self) -> None:
        code, found = self._call("evaluate", "", "run", *self.plan.evaluate)
        if code in (TOO_ROUGH, INFEASIBLE) and found["error"]["where"] == "--baseline no-visibility":
            self.record.counts["baselines refused"] += 1
            return
        self._expect(code == DONE, f"evaluate ended with {code}: {_message(found)}", stop=True)
        worst = found["metric"]["worst"]
        slack = 1e-9 * worst
        for row in found["rows"] + found["equal_bandwidth"]:
            what, value = f"{row['design']} at {row['rays']} rays", row["value"]
            self._expect(row["bandwidth_mbps"] is not None, f"evaluate: {what} has no bandwidth")
            self._expect(value is not None and -slack <= value <= worst + slack, f"evaluate: {what} has {value}")
            # a single group of scenes has no interval, and that of a few is not cut at the worst value
            if found["groups"] > 1 and value is not None:
                low, high = row["ci_low"], row["ci_high"]
                self._expect(low <= value + slack <= high + 2 * slack, f"evaluate: {what}: {value}, {low} to {high}")

    def _call(self, command: str, asked: str, *arguments: str) -> tuple[int, dict[str, Any]]:
        """A command's exit code and document; what it warned of is a fault."""
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            ran = in_process([command, *arguments, "--json"])
        if ran.code in INTERRUPTED:
            raise KeyboardInterrupt
        if command == "constrain":
            self.record.counts[f"{asked} {'kept' if ran.code == DONE else f'refused with {ran.code}'}"] += 1
        for warning in warned:
            if issubclass(warning.category, RuntimeWarning):
                line = f"{Path(warning.filename).name}:{warning.lineno}"
                self._expect(False, f"{command}: {warning.message} ({line})")
        try:
            document = json.loads(ran.out, parse_constant=_not_json)
        except ValueError as error:
            self._expect(False, f"{command}: exit {ran.code}, no JSON ({error}): {ran.err[-2000:]}", stop=True)
        told = json.dumps(_repeatable(document), sort_keys=True).encode()
        self.record.digests[f"{command} {asked}".strip()] = hashlib.sha256(told).hexdigest()
        return ran.code, document

    def _expect(self, kept: bool, fault: str, *, stop: bool = False) -> None:
        if not kept and fault not in self.record.faults:
            self.record.faults.append(fault)
        if not kept and stop:
            raise StoppedError

    def _stop(self, outcome: str) -> None:
        self.record.outcome = outcome
        raise StoppedError


def _not_json(name: str) -> float:
    raise ValueError(f"{name} is no JSON")


def _message(found: Mapping[str, Any]) -> str:
    return found.get("error", {}).get("message", "no message")


def _read(name: str) -> dict[str, Any]:
    return load_yaml(Path("run/designs") / f"{name}.yaml").value


def _repeatable(document: Any) -> Any:
    """A document without times and memory."""
    if isinstance(document, Mapping):
        return {key: _repeatable(value) for key, value in document.items() if not key.endswith(UNREPEATABLE)}
    return [_repeatable(value) for value in document] if isinstance(document, list) else document


def pytest_generate_tests(metafunc):
    metafunc.parametrize("seed", range(amount(metafunc.config)))


@pytest.mark.long
def test_a_random_run_is_without_fault_and_repeats(tmp_path, monkeypatch, piece, seed):
    monkeypatch.syspath_prepend(offer(tmp_path / "offered"))
    plan = random_plan(seed)
    print(f"{dump_yaml(plan.config)}fit: {' '.join(plan.fit)}\nevaluate: {' '.join(plan.evaluate)}")

    def work():
        with ended_after(LONGEST_RUN_S):
            record, again = (whole_run(plan, tmp_path / name) for name in ("run", "again"))
        record.faults += [f"a second run did not repeat {name}" for name in record.differences(again)]
        figures = {"width [m]": plan.size_m, "sigma by width": plan.sigma_share, "free dimensions": len(plan.free)}
        figures["sensors"] = plan.sensors
        return {"case": record.outcome, "counts": record.counts, "figures": figures, "faults": record.faults}

    piece(work)
