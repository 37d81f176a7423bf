"""A fit: its request, its result, and the target density that it fits to.

The choices of a user are resolved by the run, an earlier design, constraints and a rig; settings of the task may weight
the run's samples and its target density.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from lidardesign.config import with_task_settings
from lidardesign.constraints.check import ConstraintCheck
from lidardesign.constraints.document import MOST_FITTED, Constraints
from lidardesign.constraints.origins import is_mounted, origin_box, snap_to_space
from lidardesign.errors import MAX_SEED, ConfigError, InfeasibleError, check_choice, check_number
from lidardesign.estimates import Estimate, as_documents
from lidardesign.formats.designs import reach_of, read_design
from lidardesign.formats.rig import moved_notes, rig_constraints, rig_notes
from lidardesign.mixture.fit import FittedSensors
from lidardesign.rays.information import informs_rays
from lidardesign.run.manifest import read_manifest
from lidardesign.run.validation import apply_override, parse_override
from lidardesign.run.yaml import Document, KeyPath, leaves, load_yaml
from lidardesign.run_folder import Notes, RunFolder, log_note, settings_texts
from lidardesign.samples import Samples
from lidardesign.sensors.design import FITTED_LAYOUTS, DesignSpec, Gates, LayoutName
from lidardesign.sensors.pattern import TRAVELLED
from lidardesign.sensors.sensor import LEVELS, MOST_RAYS
from lidardesign.space import DIMENSIONS, DesignSpace
from lidardesign.task import Task

if TYPE_CHECKING:
    from lidardesign.density.objective.target import Target
    from lidardesign.simulate.plan import Planner

BEST = "best"  # as many sensors as score best on training scenes
COUNTS = (1, 2, 3, 4, 6, 8)  # of sensors, that are tried for that
LEAST = ("bandwidth", "rays", "sensors", "parts")  # of what a design for a goal has as little as it can
CHOSEN_LEVEL = 0.999  # rays are chosen inside fields and gates: narrower ones would only leave candidates out
# Of designs: names that a file may have everywhere.
NAME_PATTERN = re.compile(r"[^\W.][\w.+-]{0,99}")
# Keys of tasks for the places of sensors.
PLACE_KEYS = ("origin_m", "origin_box_m")
# In the provenance of designs, and what to do where it cannot be understood.
KEY = "weighting"
WORLD = "world"
FIT_AGAIN = "fit the design again: an earlier version refined it, or its file was changed by hand"


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """A user's choices for a fit; defaults follow from an earlier design, the constraints or the task.

    Arguments:
        sensors: Number of sensors, or "best": as many as score best on training scenes; of parts also "1-4": as
            "best", with a table of these numbers.
        constraints: Constraints, a mapping of them, or a YAML file of them.
        layout: chosen, even or spinning.
        rays: Rays per frame over all sensors.
        channels: Rings of each sensor that spins.
        gates: "sensor" or "ray": one gate per sensor, or one per ray.
        level: The share of rays and returns that fields of view and gates hold.
        at: Values of conditions that the design is for, such as {"x_m": 0.37}.
        weights: Settings of the task towards which the learned density is weighted.
        parts: Real parts that the design is made of: names, `NAME:MODE`, paths of part files, or "catalog".
        like: The file of a rig to be like: as many sensors at its places, none wider, as many rays.
        name: The design's name.
        seed: Seed of all random numbers; the run's by default.
        certify: Whether every number of rays gets a certificate, not the middle one alone.
        detector: The detector under which designs that are tried are judged: a name, or its file; ideal by default.
        settings: Settings of the task for the scenes that designs are chosen and judged in.
        survive: 1: rays are chosen for the loss of any one sensor, too; by default as constraints say.
        goal: The score that the design has to keep on training scenes that were held back, in the metric's unit.
        least: What it then has the least of: bandwidth, rays, sensors or parts.

    Raises:
        ConfigError: An invalid name, layout, choice of gates or of what is least.
    """

    sensors: int | str | None = None
    constraints: Constraints | Mapping[str, Any] | Path | str | None = None
    layout: str | None = None
    rays: int | None = None
    channels: int | None = None
    gates: str | None = None
    level: float | None = None
    at: Mapping[str, float] = field(default_factory=dict)
    weights: Sequence[str] | Mapping[str, Any] = ()
    parts: Sequence[str] | str | None = None
    like: Path | str | None = None
    name: str | None = None
    seed: int | None = None
    certify: bool = False
    detector: Path | str | None = None
    settings: Sequence[str] | Mapping[str, Any] = ()
    survive: int | None = None
    goal: float | None = None
    least: str | None = None

    def __post_init__(self) -> None:
        if self.name is not None and not NAME_PATTERN.fullmatch(self.name):
            allowed = "letters, digits, _, -, + and . (not in front), at most 100"
            raise ConfigError(f"{self.name!r} is not a name for a design", where="--name", allowed=allowed)
        if self.layout is not None:
            check_choice(self.layout, "--layout", FITTED_LAYOUTS)
        if self.gates is not None:
            check_choice(self.gates, "--gates", get_args(Gates))
        if self.least is not None:
            check_choice(self.least, "--least", LEAST)
        if self.sensors not in (None, BEST, *range(1, MOST_FITTED + 1)) and not self.numbers:
            allowed = f"a whole number from 1 to {MOST_FITTED}, best, or with parts numbers such as 1-4"
            raise ConfigError(repr(self.sensors), where="--sensors", allowed=allowed)
        limits = {"rays": (1, MOST_RAYS), "channels": (1, MOST_FITTED), "seed": (0, MAX_SEED)}
        limits["survive"] = (0, 1)
        for name, (low, high) in limits.items():
            if getattr(self, name) is not None:
                check_number(getattr(self, name), f"--{name}", low, high, whole=True)
        if self.level is not None:
            check_number(self.level, "--level", *LEVELS)

    @property
    def numbers(self) -> range | None:
        """The numbers of sensors of a text such as 1-4; None where there is a single one."""
        found = re.fullmatch(r"(\d{1,4})-(\d{1,4})", self.sensors) if isinstance(self.sensors, str) else None
        low, high = (int(text) for text in found.groups()) if found else (0, 0)
        return range(low, high + 1) if 1 <= low < high <= MOST_FITTED else None


@dataclass(frozen=True, eq=False, kw_only=True)
class FitRequest:
    """A fit with nothing left open.

    Arguments:
        run: The run whose samples are fitted to.
        name: The design's name.
        seed: Root of the random streams.
        constraints: The constraints, without any key where the design is free.
        is_constrained: Whether constraints were given, which the design is then checked against.
        at: Condition values that the design is for; without any, one for all of them.
        sensors: How many sensors, or "best"; None where constraints say so. Of parts the largest number.
        fewest: The least number of parts that is tried; None: the largest alone.
        layout: The layout of rays.
        rays: Rays per frame; None takes the task's numbers, or leaves them open.
        gates: Whether chosen rays have their sensor's gate or their own.
        level: The share of each marginal that fields of view and gates hold.
        weighting: Settings of the task to whose scenes the density is weighted.
        channels: Rings of each sensor that spins.
        names: Names of the sensors, where there are as many; none numbers them.
        certify: Whether every number of rays gets a certificate.
        detector: The detector under which designs are judged, by name or file; None: they are in an ideal world.
        settings: Settings of the task for the scenes that designs are chosen and judged in.
        goal: The score that it has to keep, with the least of `least`; None leaves nothing to be sought.
        least: One of `LEAST`.
    """

    run: RunFolder
    name: str
    seed: int
    constraints: Constraints
    is_constrained: bool
    at: Mapping[str, float]
    sensors: int | str | None
    layout: LayoutName
    rays: int | None
    gates: Gates
    level: float
    weighting: Weighting
    channels: int | None
    names: Sequence[str]
    certify: bool
    detector: str | None = None
    settings: tuple[str, ...] = ()
    fewest: int | None = None
    goal: float | None = None
    least: str = LEAST[0]

    @classmethod
    def resolve(
        cls,
        run: RunFolder,
        options: FitOptions,
        base: DesignSpec | None = None,
        *,
        notes: Notes = log_note,
    ) -> FitRequest:
        """The request of a user's choices.

        Arguments:
            run: The run.
            options: The choices.
            base: An earlier design, which says what the user does not.
            notes: Called with every note.

        Raises:
            ConfigError: Choices that do not fit together.
            DataError: The rig cannot be read.
            InfeasibleError: The rig stands where the run's sensors may not.
        """
        for note in run.input_notes():
            notes(note)
        asked = load_constraints(options.constraints, notes=notes)
        if asked is None and base is not None:
            asked = Constraints()
        constraints, names = _with_rig(options, _with_survival(options, _with_parts(options, asked, run)), run, notes)
        rules, moved = snap_to_space(constraints or Constraints(), run.config.space)
        for note in moved:
            notes(note)
        layout = _layout(rules, base, run, options)
        _check_layout(layout, rules, run, options)
        if options.numbers and (rules.parts is None or options.goal is not None):
            fault = "together with a goal" if rules.parts else "without parts"
            raise ConfigError(f"several numbers of sensors {fault}", where="--sensors", allowed=f"N, or {BEST}")
        sensors = _sensors(options.numbers[-1] if options.numbers else options.sensors, rules, base, layout)
        most = sensors if isinstance(sensors, int) else rules.sensors.max or math.inf
        if rules.survive:
            check_several(most)
        _check_goal(layout, rules, run, options)
        at = {**(base.at if base else {}), **options.at}
        space = run.config.space.at(at)
        if layout != "spinning" and rules.parts is None:
            _check_conditions(rules, space)
        weighting = _weighting(settings_texts(options.weights), base)
        if weighting.settings:
            with_task_settings(run.task, run.config, weighting.settings, option=weighting.origin)
        detector, settings = _world(options, base)
        if settings:
            with_task_settings(run.task, run.config, settings)
        if detector is not None:
            # it loads what simulates light, which fits in an ideal world do without
            from lidardesign.simulate.detector.files import load_detector

            load_detector(detector)
            if rules.parts is None and (layout == "spinning" or (sensors != BEST and options.goal is None)):
                notes(f"{detector} judges sets of parts and numbers of sensors, and none are tried here")
        channels = options.channels
        if layout == "spinning" and channels is None and base is not None:
            channels = base.provenance.get("channels")
        return cls(
            run=run,
            name=options.name or ("fit" if asked is None else "constrained"),
            seed=run.config.seed if options.seed is None else options.seed,
            constraints=rules,
            is_constrained=constraints is not None,
            at=at,
            sensors=sensors,
            layout=layout,
            rays=_rays(options.rays, rules, base),
            gates=_gates(options.gates, base, space, layout),
            level=_level(options.level, base, run, layout),
            weighting=weighting,
            channels=channels,
            names=names,
            certify=options.certify,
            detector=detector,
            settings=settings,
            fewest=None if options.numbers is None else options.numbers[0],
            goal=options.goal,
            least=options.least or ("bandwidth" if rules.parts is None else "parts"),
        )

    @property
    def planner(self) -> Planner | None:
        """The detector, and the effects that matter to the metric; None without a detector."""
        if self.detector is None:
            return None
        from lidardesign.simulate.detector.files import load_detector
        from lidardesign.simulate.plan import Planner

        planner = Planner(load_detector(self.detector))
        return replace(planner, tolerance=planner.tolerated.within(self.run.metric))

    @property
    def world(self) -> dict[str, Any]:
        """The detector and settings that designs were judged by, as plain values for a design's provenance."""
        detector = {} if self.detector is None else {"detector": self.detector}
        return {**detector, **({"set": list(self.settings)} if self.settings else {})}

    @property
    def command(self) -> str:
        """The command for the design's provenance: `constrain` or `fit`."""
        return "constrain" if self.is_constrained else "fit"

    @property
    def counts(self) -> list[int]:
        """The numbers of rays that are chosen, ascending."""
        return sorted({self.rays} if self.rays else set(self.run.task.defaults.rays))


@dataclass(frozen=True)
class Weighting:
    """Settings of the task to whose scenes the density of a run is weighted for a design.

    Arguments:
        settings: As KEY=VALUE; none leaves the density as it was learned.
        origin: Their source for messages: an option, or a design.
    """

    settings: tuple[str, ...] = ()
    origin: str = "--weight"

    @classmethod
    def of(cls, design: DesignSpec) -> Weighting:
        """The weighting in a design's provenance.

        Raises:
            ConfigError: It cannot be read.
        """
        document, where = design.provenance.get(KEY), f"{KEY} of design {design.name}"
        if document is None:
            return cls()
        if not isinstance(document, Mapping) or set(document) != {"set"}:
            found = f"keys {', '.join(map(str, document))}" if isinstance(document, Mapping) else repr(document)
            raise ConfigError(f"holds {found}", where=where, allowed="the key set alone", hint=FIT_AGAIN)
        settings = document["set"]
        if not isinstance(settings, list | tuple) or not all(isinstance(text, str) for text in settings):
            raise ConfigError(f"set is {settings!r}", where=where, allowed="a list of KEY=VALUE", hint=FIT_AGAIN)
        return cls(tuple(settings), f"{where}: set")

    def as_document(self) -> dict[str, Any]:
        """Plain values, as they stand in the provenance of a design."""
        return {"set": list(self.settings)}


def _layout(constraints: Constraints, base: DesignSpec | None, run: RunFolder, options: FitOptions) -> LayoutName:
    """The user's layout, else the design's, else `chosen` for tasks with `informs` and `even` for others."""
    if options.layout is not None:
        return options.layout
    if constraints.parts is not None:
        return "even"
    if base is not None and base.layout in FITTED_LAYOUTS:
        return base.layout
    return "chosen" if informs_rays(run.task) and options.like is None else "even"


def _check_layout(layout: LayoutName, constraints: Constraints, run: RunFolder, options: FitOptions) -> None:
    """Refuse choices that a layout cannot have.

    Raises:
        ConfigError: There is one.
    """
    if layout != "even" and not informs_rays(run.task):
        raise ConfigError(
            f"the task {run.task.name} has no method informs",
            where=f"--layout {layout}",
            allowed="tasks with informs",
            hint="--layout even, or give the task a method informs(scene, returns)",
        )
    place = f"the layout {layout}" if constraints.parts is None else "a design of real parts"
    faults = {
        (f"{options.channels} channels in the layout {layout}", "--channels", "--layout spinning"): (
            options.channels is not None and layout != "spinning"
        ),
        (f"a gate per ray in the layout {layout}", "--gates", "--layout chosen"): (
            options.gates == "ray" and layout != "chosen" and constraints.parts is None
        ),
        (f"sensors that may fail in {place}", "survive", "--layout chosen, without parts"): (
            bool(constraints.survive) and place != "the layout chosen"
        ),
        ("spinning sensors with --at or --weight", "--layout", "chosen, even"): (
            layout == "spinning" and (bool(options.at) or bool(options.weights))
        ),
        (f"{options.sensors!r} sensors that spin", "--sensors", "a whole number"): (
            layout == "spinning" and isinstance(options.sensors, str)
        ),
    }
    for (fault, where, allowed), is_found in faults.items():
        if is_found:
            raise ConfigError(fault, where=where, allowed=allowed)


def _check_goal(layout: LayoutName, constraints: Constraints, run: RunFolder, options: FitOptions) -> None:
    """Refuse a goal that no score can be held against, and what cannot be sought for one.

    Raises:
        ConfigError: There is one.
    """
    goal, least, metric, are_parts = options.goal, options.least, run.metric, constraints.parts is not None
    faults = {
        ("no goal", "--least", "--goal SCORE --least WHAT"): goal is None and least is not None,
        ("a goal for sensors that spin", "--goal", "the layouts chosen and even"): (
            goal is not None and layout == "spinning"
        ),
        (f"{least} of a design of parts", "--least", "parts"): are_parts and least not in (None, "parts"),
        ("no parts are named", "--least parts", "--parts NAME,NAME"): not are_parts and least == "parts",
        (f"{options.sensors} sensors, of which the least are sought", "--sensors", "sensors.max, or nothing"): (
            least == "sensors" and isinstance(options.sensors, int)
        ),
    }
    for (fault, where, allowed), is_found in faults.items():
        if is_found:
            raise ConfigError(fault, where=where, allowed=allowed)
    if goal is not None:
        low, high = (0.0 if metric.worst > 0 else -math.inf), metric.worst
        if metric.better == "higher":
            low, high = metric.worst, 100.0 if metric.unit == "%" else math.inf
        is_number = isinstance(goal, Real) and not isinstance(goal, bool)
        if not (is_number and math.isfinite(goal) and low <= goal <= high):
            allowed = f"a number from {low:g} to {high:g} {metric.unit}"
            raise ConfigError(f"{goal!r} as {metric.name}", where="--goal", allowed=allowed)


def _check_conditions(constraints: Constraints, space: DesignSpace) -> None:
    """Refuse open conditions that rays cannot follow: all but one unbounded coordinate of the origin.

    Raises:
        ConfigError: Several conditions, or one that is no coordinate of the origin.
        InfeasibleError: Constraints bound the coordinate.
    """
    names = [DIMENSIONS[axis] for axis in space.conditioned]
    hint = "give " + " ".join(f"--at {name}=VALUE" for name in names)
    if len(names) > 1:
        raise ConfigError(f"{' and '.join(names)} are open, and rays follow one condition", where="--at", hint=hint)
    for name in names:
        if name not in TRAVELLED:
            raise ConfigError(f"rays follow where sensors stand, and {name} says no place", where="--at", hint=hint)
        axis = DIMENSIONS.index(name)
        for rules in constraints.rules:
            low, high = origin_box(rules, space)
            if is_mounted([rules]) or low[axis] > space.low[axis] or high[axis] < space.high[axis]:
                raise InfeasibleError(
                    f"sensors follow {name} from {space.low[axis]:g} to {space.high[axis]:g}, and origin bounds it",
                    conflicts=[rules.path("origin"), name],
                    hint=hint,
                )


def _with_rig(
    options: FitOptions, asked: Constraints | None, run: RunFolder, notes: Notes
) -> tuple[Constraints | None, tuple[str, ...]]:
    """Constraints completed by those of a rig, and the names of its sensors; unchanged without a rig."""
    if options.like is None:
        return asked, ()
    rig = read_design(Path(options.like), notes, reach_of([run]))
    own, space = Constraints() if asked is None else asked, run.config.space
    keys = " / ".join(key for key in PLACE_KEYS if key in type(run.config.task).model_fields)
    keys = keys or "the keys x_m, y_m and z_m of its space"
    hint = f"learn with {keys} for the rig's places: lidardesign tasks show {run.task.name}"
    constraints = rig_constraints(rig, space, own, rays=options.rays, hint=hint)
    for line in (*rig_notes(rig, constraints, own), *moved_notes(rig, space, constraints)):
        notes(line)
    return constraints, tuple(sensor.name for sensor in rig.sensors)


def _with_parts(options: FitOptions, asked: Constraints | None, run: RunFolder) -> Constraints | None:
    """The constraints with the parts that a user named, checked."""
    if options.parts is not None:
        document = {} if asked is None else asked.as_document()
        asked = Constraints.from_mapping({**document, "parts": {**document.get("parts", {}), "names": options.parts}})
    if asked is None or asked.parts is None:
        return asked
    from lidardesign.parts.catalogue import named_parts

    named_parts(asked.parts.names, asked.parts.each)
    lacking = {
        "the number of parts is missing": not isinstance(options.sensors, int)
        and not options.numbers
        and asked.parts.count is None,
        "parts together with --at or --weight": options.at or options.weights,
        "parts together with each, which bounds single sensors": asked.each,
        f"parts in the layout {options.layout}": options.layout,
        "parts with --gates: parts have the gates that they have": options.gates,
        f"the task {run.task.name} has no method informs": not informs_rays(run.task),
    }
    for fault, is_found in lacking.items():
        if is_found:
            raise ConfigError(
                fault, where="--parts", allowed="--parts NAME,NAME --sensors N, or parts.names, parts.count"
            )
    return asked


def _with_survival(options: FitOptions, asked: Constraints | None) -> Constraints | None:
    """The constraints with the user's word on sensors that may fail."""
    if options.survive is None or (asked is None and not options.survive):
        return asked
    document = {} if asked is None else asked.as_document()
    return Constraints.from_mapping({**document, "survive": options.survive})


def check_several(sensors: float) -> None:
    """Refuse a single sensor that may fail.

    Raises:
        ConfigError: Fewer than two sensors.
    """
    if sensors < 2:
        raise ConfigError(
            "a single sensor that may fail", where="survive", allowed="2 sensors or more", hint="--sensors 2"
        )


def _sensors(
    asked: int | str | None, constraints: Constraints, base: DesignSpec | None, layout: LayoutName
) -> int | str | None:
    """The number of sensors: the user's, else that of the constraints, else the design's, else the best."""
    bounds = constraints.sensors
    if asked is not None:
        return asked
    if constraints.parts is not None:
        return constraints.parts.count
    if bounds.count is not None or is_mounted(constraints.rules):  # mounts say how many
        return bounds.count
    if base is None:
        return 1 if layout == "spinning" else BEST
    usual = max(len(base.sensors), len(constraints.each), bounds.min or 1)
    return min(usual, bounds.max or usual)


def _rays(asked: int | None, constraints: Constraints, base: DesignSpec | None) -> int | None:
    """The number of rays: the user's, else that of the constraints, else the design's where it has a single one."""
    if asked is not None or constraints.parts is not None:
        return asked
    if constraints.budget.rays is not None:
        return constraints.budget.rays
    return base.count if base is not None and base.counts in (None, [base.count]) else None


def _gates(asked: str | None, base: DesignSpec | None, space: DesignSpace, layout: LayoutName) -> Gates:
    """The user's choice of gates, else the design's, else one per sensor, or per ray along a condition."""
    if asked is not None:
        return asked
    if base is not None and layout == base.layout == "chosen":
        return "ray" if base.has_gates_per_ray else "sensor"
    return "ray" if layout == "chosen" and space.conditioned else "sensor"


def _level(asked: float | None, base: DesignSpec | None, run: RunFolder, layout: LayoutName) -> float:
    if asked is not None:
        return asked
    if base is not None and base.layout == layout:
        return base.level
    return CHOSEN_LEVEL if layout == "chosen" else run.task.defaults.level


def _weighting(settings: tuple[str, ...], base: DesignSpec | None) -> Weighting:
    """The weighting of the samples: by the user's settings, else as for the design."""
    return Weighting(settings) if settings or base is None else Weighting.of(base)


def _world(options: FitOptions, base: DesignSpec | None) -> tuple[str | None, tuple[str, ...]]:
    """The user's detector and settings of scenes, each else as for the design.

    Raises:
        ConfigError: Those of the design cannot be read.
    """
    known = {} if base is None else base.provenance.get(WORLD, {})
    if not isinstance(known, Mapping) or not isinstance(known.get("set", []), list | tuple):
        raise ConfigError(f"holds {known!r}", where=f"{WORLD} of design {base.name}", hint=FIT_AGAIN)
    detector = known.get("detector") if options.detector is None else options.detector
    settings = settings_texts(options.settings) or tuple(map(str, known.get("set", [])))
    return None if detector is None else str(detector), settings


def split_settings(overrides: Sequence[str], task: Task) -> tuple[list[str], list[str]]:
    """Texts KEY=VALUE that are constraints, and those whose first key is no section of these but a task's own."""
    firsts = [str(parse_override(text).path[0]) for text in overrides]
    own = {key for key in firsts if key in task.Config.model_fields and key not in Constraints.model_fields}
    texts = list(zip(firsts, overrides, strict=True))
    return [text for key, text in texts if key not in own], [text for key, text in texts if key in own]


def load_constraints(
    given: Constraints | Mapping[str, Any] | Path | str | None, overrides: Sequence[str] = (), notes: Notes = log_note
) -> Constraints | None:
    """Constraints of a mapping or a YAML file, with `--set` laid over them; None where nothing is given.

    Raises:
        ConfigError: At file:line:column, or at the `--set` option; also for unknown parts.
    """
    if isinstance(given, Constraints) or (given is None and not overrides):
        return given
    if isinstance(given, Mapping):
        return Constraints.from_mapping(given)
    document = load_yaml(Path(given)) if given else Document({}, "constraints")
    values: dict[str, Any] = document.mapping
    if given and all(value in (None, {}, []) for _, value in leaves(values)):
        notes(f"{document.where} holds no constraints")
    origins: dict[KeyPath, str] = {}
    for text in overrides:
        override = parse_override(text)
        origins[apply_override(values, override)] = override.where

    def locate(path: KeyPath, *, key: bool = False) -> str:
        path = tuple(path)
        for origin, where in origins.items():
            if path[: len(origin)] == origin or origin[: len(path)] == path != ():
                return where
        return document.locate(path, key=key)

    return Constraints.from_mapping(values, where=document.where, locate=locate)


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted design with its quality and checks.

    Arguments:
        design: The design.
        log_likelihood: Weighted mean log density of the samples [nats]; None where it was chosen on scenes alone.
        admissible_mass: The share of the density inside the constraints; None with fixed origins.
        ess: Effective share of the samples that were admitted, 0 to 1.
        seconds: Wall time [s].
        constraints: The independent checks.
        notes: Lines on sensors.
        numbers: By number of parts, where several were asked for: their names, score, power and price.
        error_estimates: Standard errors of log_likelihood, ess and admissible_mass.
        goal: For a goal, what was tried, as plain values.
    """

    design: DesignSpec
    log_likelihood: float | None
    admissible_mass: float | None
    ess: float
    seconds: float
    constraints: tuple[ConstraintCheck, ...] = ()
    notes: tuple[str, ...] = ()
    numbers: tuple[Mapping[str, Any], ...] = ()
    error_estimates: Mapping[str, Estimate] = field(default_factory=dict)
    goal: Mapping[str, Any] | None = None

    @classmethod
    def of_fit(cls, design: DesignSpec, fitted: FittedSensors, samples: Samples, seconds: float) -> FitResult:
        """A design whose sensors were fitted to samples."""
        value, estimates = fitted.log_likelihood.value, fitted.estimates(samples)
        mass = fitted.admissible_mass
        return cls(design, value, mass, fitted.ess, seconds, notes=fitted.notes, error_estimates=estimates)

    @classmethod
    def of_choice(cls, design: DesignSpec, samples: Samples, seconds: float) -> FitResult:
        """A design that was chosen on scenes instead of being fitted to samples."""
        return cls(design, None, None, samples.effective_sample_size, seconds)

    @property
    def satisfied(self) -> bool:
        """True where every constraint holds on the finished design."""
        return all(check.satisfied for check in self.constraints)

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON keys; the path of the design is for the caller to fill."""
        return {
            "design": self.design.name,
            "frame": self.design.mount or "world",
            "sensors": [sensor.as_dict() for sensor in self.design.sensors],
            "log_likelihood": self.log_likelihood,
            "admissible_mass": self.admissible_mass,
            "ess": self.ess,
            "satisfied": self.satisfied,
            "constraints": [check.as_dict() for check in self.constraints],
            "seconds": self.seconds,
            "error_estimates": as_documents(self.error_estimates),
            **({"numbers": [dict(row) for row in self.numbers]} if self.numbers else {}),
            **({} if self.goal is None else {"goal": dict(self.goal)}),
        }


class RunTarget:
    """log p* of a run, prepared at its first call, since few fits need it.

    Arguments:
        run: The run.
        visibility: The visibility, instead of the run's own.
        weighting: Settings of the task for the scenes, instead of the run's own.
    """

    def __init__(self, run: RunFolder, visibility: str | None = None, weighting: Weighting | None = None) -> None:
        self._run, self._visibility, self._weighting = run, visibility, weighting or Weighting()

    @cached_property
    def _target(self) -> Target:
        from lidardesign.density.objective.prepare import prepare_target

        run, weighting = self._run, self._weighting
        if weighting.settings:
            config = with_task_settings(run.task, run.config, weighting.settings, option=weighting.origin)
            run = replace(run, config=config)
        decided = self._visibility or read_manifest(run.folder).get("visibility")
        return prepare_target(run.scenes("train", run.config.seed), run.config, visibility=decided, compiled=False)[0]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """log p* of design points, (N, 6) to (N,)."""
        return self._target.log_density(points)
