"""A fit: its request, and the target density that it fits to.

The choices of a user are resolved by the run, an earlier design, constraints and a rig; settings of the task may weight
the run's samples and its target density.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.choices.fit import BEST, LEAST
from lidardesign.config import with_task_settings
from lidardesign.constraints.document import Constraints, load_constraints
from lidardesign.constraints.feasibility import unit_notes
from lidardesign.constraints.origins import is_mounted, origin_box, snap_to_space
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.fitting.options import (
    DesignChoices,
    check_goal,
    check_layout,
    fit_choices,
    refuse_first,
    sensor_numbers,
)
from lidardesign.formats.designs import reach_of, read_design
from lidardesign.formats.rig import moved_notes, rig_constraints, rig_notes
from lidardesign.rays.information import informs_rays
from lidardesign.run.manifest import read_manifest
from lidardesign.run_folder import Notes, RunFolder, log_note, settings_texts
from lidardesign.sensors.design import FITTED_LAYOUTS, DesignSpec, Gates, LayoutName
from lidardesign.sensors.pattern import TRAVELLED
from lidardesign.space import DIMENSIONS, DesignSpace

if TYPE_CHECKING:
    from lidardesign.density.objective.target import Target
    from lidardesign.simulate.plan import Planner

COUNTS = (1, 2, 3, 4, 6, 8)  # of sensors, that are tried for that
CHOSEN_LEVEL = 0.999  # rays are chosen inside fields and gates: narrower ones would only leave candidates out
# Keys of tasks for the places of sensors.
PLACE_KEYS = ("origin_m", "origin_box_m")
# In the provenance of designs, and what to do where it cannot be understood.
KEY = "weighting"
WORLD = "world"
FIT_AGAIN = "fit the design again: an earlier version refined it, or its file was changed by hand"


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
        adaptive: At most so many patterns follow what they see; 1: none do.
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
    adaptive: int = 1

    @classmethod
    def resolve(
        cls,
        run: RunFolder,
        given: DesignChoices,
        base: DesignSpec | None = None,
        *,
        notes: Notes = log_note,
    ) -> FitRequest:
        """The request of a user's choices.

        Arguments:
            run: The run.
            given: The choices that are given.
            base: An earlier design, which says what the user does not.
            notes: Called with every note.

        Raises:
            ConfigError: Choices that do not fit together.
            DataError: The rig cannot be read.
            InfeasibleError: The rig stands where the run's sensors may not.
        """
        choices = fit_choices(given)
        numbers = sensor_numbers(choices["sensors"])
        for note in run.input_notes():
            notes(note)
        asked = load_constraints(choices["constraints"], notes=notes)
        if asked is None and base is not None:
            asked = Constraints()
        named = None if asked is None or asked.parts is None else asked.parts.names
        if choices["parts"] is not None and named not in (None, "catalog", choices["parts"]):
            notes(f"--parts takes the place of parts.names: {', '.join(named)}")
        constraints, names = _with_rig(choices, _with_survival(choices, _with_parts(choices, asked, run)), run, notes)
        rules, moved = snap_to_space(constraints or Constraints(), run.config.space)
        for note in (*moved, *unit_notes(asked or Constraints(), run.config.space)):
            notes(note)
        layout = _layout(rules, base, run, choices)
        check_layout(layout, rules, run, choices)
        if numbers and (rules.parts is None or choices["goal"] is not None):
            fault = "together with a goal" if rules.parts else "without parts"
            raise ConfigError(f"several numbers of sensors {fault}", where="--sensors", allowed=f"N, or {BEST}")
        sensors = _sensors(numbers[-1] if numbers else choices["sensors"], rules, base, layout)
        most = sensors if isinstance(sensors, int) else rules.sensors.max or math.inf
        if rules.survive:
            check_several(most)
        check_goal(layout, rules, run, choices)
        at = {**(base.at if base else {}), **choices["at"]}
        space = run.config.space.at(at)
        if layout != "spinning" and rules.parts is None:
            _check_conditions(rules, space)
        weights = settings_texts(choices["weights"])
        weighting = Weighting(weights) if weights or base is None else Weighting.of(base)
        if weighting.settings:
            with_task_settings(run.task, run.config, weighting.settings, option=weighting.origin)
        detector, settings = _world(choices, base)
        if settings:
            with_task_settings(run.task, run.config, settings)
        if detector is not None:
            # it loads what simulates light, which fits in an ideal world do without
            from lidardesign.simulate.detector.files import load_detector

            load_detector(detector)
            if rules.parts is None and (layout == "spinning" or (sensors != BEST and choices["goal"] is None)):
                notes(f"{detector} judges sets of parts and numbers of sensors, and none are tried here")
        channels = choices["channels"]
        if layout == "spinning" and channels is None and base is not None:
            channels = base.provenance.get("channels")
        return cls(
            run=run,
            name=choices["name"] or ("fit" if asked is None else "constrained"),
            seed=run.config.seed if choices["seed"] is None else choices["seed"],
            constraints=rules,
            is_constrained=constraints is not None,
            at=at,
            sensors=sensors,
            layout=layout,
            rays=_rays(choices["rays"], rules, base),
            gates=_gates(choices["gates"], base, space, layout),
            level=_level(choices["level"], base, run, layout),
            weighting=weighting,
            channels=channels,
            names=names,
            certify=choices["certify"],
            detector=detector,
            settings=settings,
            fewest=None if numbers is None else numbers[0],
            goal=choices["goal"],
            least=choices["least"] or ("bandwidth" if rules.parts is None else "parts"),
            adaptive=_patterns(choices, base, run, layout, rules),
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
        """The numbers of rays that are chosen, ascending; patterns that follow what they see have one."""
        every = sorted({self.rays} if self.rays else set(self.run.task.defaults.rays))
        return every[len(every) // 2 :][:1] if self.adaptive > 1 else every


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
        settings = document["set"] if isinstance(document, Mapping) and set(document) == {"set"} else None
        if not isinstance(settings, list | tuple) or not all(isinstance(text, str) for text in settings):
            allowed = "the key set alone, a list of KEY=VALUE"
            raise ConfigError(f"holds {document!r}", where=where, allowed=allowed, hint=FIT_AGAIN)
        return cls(tuple(settings), f"{where}: set")


def _layout(constraints: Constraints, base: DesignSpec | None, run: RunFolder, choices: DesignChoices) -> LayoutName:
    """The user's layout, else the design's, else `chosen` for tasks with `informs` and `even` for others."""
    if choices["layout"] is not None:
        return choices["layout"]
    if constraints.parts is not None:
        return "even"
    if base is not None and base.layout in FITTED_LAYOUTS:
        return base.layout
    return "chosen" if informs_rays(run.task) and choices["like"] is None else "even"


def _patterns(
    choices: DesignChoices, base: DesignSpec | None, run: RunFolder, layout: LayoutName, rules: Constraints
) -> int:
    """The user's largest number of patterns that follow what they see, else the design's; 1 for none.

    Raises:
        ConfigError: The rays follow a condition already.
    """
    most = choices["adaptive"]
    if most is None:
        adaptive = None if base is None or layout != "chosen" or rules.survive or choices["goal"] else base.adaptive
        most = 1 if adaptive is None else len(adaptive.patterns) - 1
    if most > 1 and run.config.space.conditioned:
        names = " and ".join(DIMENSIONS[axis] for axis in run.config.space.conditioned)
        raise ConfigError(f"rays follow {names} already", where="--adaptive", allowed="tasks without conditions")
    return most


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
            raise ConfigError(f"rays follow where sensors stand, but {name} is not a place", where="--at", hint=hint)
        axis = DIMENSIONS.index(name)
        for rules in constraints.rules:
            low, high = origin_box(rules, space)
            if is_mounted([rules]) or low[axis] > space.low[axis] or high[axis] < space.high[axis]:
                raise InfeasibleError(
                    f"sensors follow {name} from {space.low[axis]:g} to {space.high[axis]:g}, but origin bounds it",
                    conflicts=[rules.path("origin"), name],
                    hint=hint,
                )


def _with_rig(
    choices: DesignChoices, asked: Constraints | None, run: RunFolder, notes: Notes
) -> tuple[Constraints | None, tuple[str, ...]]:
    """Constraints completed by those of a rig, and the names of its sensors; unchanged without a rig."""
    if choices["like"] is None:
        return asked, ()
    rig = read_design(Path(choices["like"]), notes, reach_of([run]))
    own, space = Constraints() if asked is None else asked, run.config.space
    keys = " / ".join(key for key in PLACE_KEYS if key in type(run.config.task).model_fields)
    keys = keys or "the keys x_m, y_m and z_m of its space"
    hint = f"learn with {keys} for the rig's places: lidardesign tasks show {run.task.name}"
    constraints = rig_constraints(rig, space, own, rays=choices["rays"], hint=hint)
    for line in (*rig_notes(rig, constraints, own), *moved_notes(rig, space, constraints)):
        notes(line)
    return constraints, tuple(sensor.name for sensor in rig.sensors)


def _with_parts(choices: DesignChoices, asked: Constraints | None, run: RunFolder) -> Constraints | None:
    """The constraints with the parts that a user named, checked."""
    if choices["parts"] is not None:
        document = {} if asked is None else asked.as_document()
        asked = Constraints.from_mapping(
            {**document, "parts": {**document.get("parts", {}), "names": choices["parts"]}}
        )
    if asked is None or asked.parts is None:
        return asked
    from lidardesign.parts.catalogue import named_parts

    named_parts(asked.parts.names, asked.parts.each)
    lacking = {
        "the number of parts is missing": not isinstance(choices["sensors"], int)
        and not sensor_numbers(choices["sensors"])
        and asked.parts.count is None,
        "parts together with --at or --weight": choices["at"] or choices["weights"],
        f"parts in the layout {choices['layout']}": choices["layout"],
        "parts with --gates: a part's gates are fixed": choices["gates"],
        f"the task {run.task.name} has no method informs": not informs_rays(run.task),
    }
    allowed = "--parts NAME,NAME --sensors N, or parts.names, parts.count; without --layout or --gates"
    refuse_first({(fault, "--parts", allowed): is_found for fault, is_found in lacking.items()})
    return asked


def _with_survival(choices: DesignChoices, asked: Constraints | None) -> Constraints | None:
    """The constraints with the user's word on sensors that may fail."""
    if choices["survive"] is None or (asked is None and not choices["survive"]):
        return asked
    document = {} if asked is None else asked.as_document()
    return Constraints.from_mapping({**document, "survive": choices["survive"]})


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
    # a level that somebody asked for is kept in another layout too
    if base is not None and (base.layout == layout or base.level != _usual_level(run, base.layout)):
        return base.level
    return _usual_level(run, layout)


def _usual_level(run: RunFolder, layout: LayoutName) -> float:
    return CHOSEN_LEVEL if layout == "chosen" else run.task.defaults.level


def _world(choices: DesignChoices, base: DesignSpec | None) -> tuple[str | None, tuple[str, ...]]:
    """The user's detector and settings of scenes, each else as for the design.

    Raises:
        ConfigError: Those of the design cannot be read.
    """
    known = {} if base is None else base.provenance.get(WORLD, {})
    if not isinstance(known, Mapping) or not isinstance(known.get("set", []), list | tuple):
        raise ConfigError(f"holds {known!r}", where=f"{WORLD} of design {base.name}", hint=FIT_AGAIN)
    detector = known.get("detector") if choices["detector"] is None else choices["detector"]
    settings = settings_texts(choices["settings"]) or tuple(map(str, known.get("set", [])))
    return None if detector is None else str(detector), settings


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
