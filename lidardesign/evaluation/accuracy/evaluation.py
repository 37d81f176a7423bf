"""Accuracy and cost of every numerical choice, for a task and a run on this machine: sweeps over their settings.

Those of an evaluation are here: rays that stand for a beam, effects of light, and held-out scenes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.estimates import mean_interval
from lidardesign.evaluation.accuracy import fields, training
from lidardesign.evaluation.accuracy.probes import AccuracyRequest
from lidardesign.evaluation.request import EvaluationRequest, numbers_fired
from lidardesign.evaluation.results import Row
from lidardesign.evaluation.sweep import Accuracy, Measurement, Sweep, timed, with_memory
from lidardesign.run.clock import Progress, phase
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import path_windows
from lidardesign.scenes.scene import Scene
from lidardesign.scoring.fired import Positions, fired
from lidardesign.scoring.scene_scores import score_lists
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import EFFECTS, Detector, Physics, check_windows
from lidardesign.simulate.plan import EffectPlan, Planner, predicted_seconds
from lidardesign.simulate.returns import build_casters
from lidardesign.task import random_generator

# The detector for sweeps where the evaluation's own has no effects.
STAND_IN = "single-photon"
FOOTPRINT_RAYS = (1, 4, 16, 64, 256)
# Rays in all frames and positions of a scene: the largest number of rays below this is simulated, else the smallest.
RAYS_PER_SCENE = 20_000
# Scenes that are simulated: as many as these rays are enough for, and no more than these. Differences are paired, so
# that few scenes tell much.
RAYS, MOST_SCENES = 60_000, 20
# Thin rays of all beams in all scenes: seconds, and not minutes, for the finest footprint.
MOST_THIN_RAYS = 6_000_000
# Effects that take longer than this in one pass over the scenes are left out of all passes [s].
MOST_SECONDS = 2.0
# The baseline that numbers of held-out scenes are tried on, and those that are tried where there are more.
BASELINE = "bounding"
COUNTS = (5, 10, 20, 50, 100, 200)
# So many sets of scenes are drawn for each; a mean half-width is then known to a few percent beside the scenes' own.
DRAWS = 32


def physics_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The sweep of the footprint where beams have a width, and that of the effects present in the scenes."""
    asked = request.request
    if not asked.designs:
        return []
    design, planner, own = asked.designs[0], asked.planner, asked.planner.detector
    first_hits = own.photons is None and own.bin_s is None and own.divergence_rad == 0 and own.timing_sigma_s == 0
    if first_hits:
        planner = Planner(load_detector(STAND_IN))
        planner = replace(planner, tolerance=planner.tolerated.within(asked.metric))
    count, positions = _rays(asked, design)
    most = max(RAYS // max(sum(len(rays) for rays in positions) * asked.test[0].frames, 1), 1)
    bench = Bench(asked, planner, positions, asked.test[: min(most, MOST_SCENES)])
    several = len(bench.scenes) > 1
    note = f"{design.name} with {count} rays in {len(bench.scenes)} scene{'s' if several else ''}"
    note += "" if several else ", so that differences between scenes are not known"
    if first_hits:
        note += f", measured by {STAND_IN}: the detector of this evaluation, {own.name}, asks for nothing"
        try:
            for rays in positions:
                check_windows(path_windows(rays, asked.test[0].receiver), planner.detector)
        except ConfigError:
            return []
    footprint = [_footprint(bench, note, own)] if planner.detector.divergence_rad > 0 else []
    return [*footprint, *_effects(bench, note, own)]


@dataclass(frozen=True, eq=False)
class Bench:
    """One design in a few held-out scenes.

    Arguments:
        request: The evaluation's request.
        planner: The detector, and how effects are chosen.
        positions: The design's rays.
        scenes: The scenes.
    """

    request: EvaluationRequest
    planner: Planner
    positions: Positions
    scenes: Sequence[Scene]

    @property
    def rays(self) -> int:
        """The number of rays in all frames and positions of a scene."""
        return sum(len(rays) for rays in self.positions) * self.scenes[0].frames

    @cached_property
    def casters(self) -> list[list[SceneCaster]]:
        """The casters of every scene."""
        return [build_casters(scene) for scene in self.scenes]

    @cached_property
    def plans(self) -> list[EffectPlan]:
        """The effect plan of every scene."""
        return [
            self.planner.plan(scene, list(self.positions), casters)
            for scene, casters in zip(self.scenes, self.casters, strict=True)
        ]

    def score(self, number: int, effects: frozenset[str], detector: Detector) -> float:
        """The score in a scene under some effects; random numbers are the same whatever the effects."""
        physics = Physics(detector, effects, self.request.seed) if effects else None
        scene, casters = self.scenes[number], self.casters[number]
        ((score, _),) = score_lists(
            self.request.task,
            self.request.metric,
            scene,
            [self.positions],
            casters,
            physics,
            self.request.preparation.of([self.positions]),
        )
        return score.value

    def scores(self, effects: frozenset[str], detector: Detector) -> np.ndarray:
        """The scores in all scenes, shape (S,)."""
        return np.array([self.score(number, effects, detector) for number in range(len(self.scenes))])


def _rays(asked: EvaluationRequest, design: DesignSpec) -> tuple[int, Positions]:
    counts = numbers_fired(design, sorted(set(asked.rays))) or [design.count]
    each = len(asked.conditions) * asked.test[0].frames
    count = max([one for one in counts if one * each <= RAYS_PER_SCENE], default=counts[0])
    return count, fired(design, count, asked.conditions, asked.planner)


def _paired(values: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """The absolute mean difference over scenes, and its standard error."""
    mean, error = _mean(values - reference)
    return abs(mean), error


def _mean(values: np.ndarray) -> tuple[float, float]:
    spread = values.std(ddof=1) if len(values) > 1 else 0.0
    return float(values.mean()), float(spread / math.sqrt(len(values)))


def _footprint(bench: Bench, note: str, own: Detector) -> Sweep:
    detector, metric = bench.planner.detector, bench.request.metric
    most = MOST_THIN_RAYS // max(bench.rays * len(bench.scenes), 1)
    counts = sorted({count for count in FOOTPRINT_RAYS if count <= max(most, 1)} | {detector.footprint_rays})
    changed = {count: replace(detector, footprint_rays=count) for count in counts}
    alone = {count: bench.scores(frozenset({"footprint"}), other) for count, other in changed.items()}
    planned = bench.plans[0].effects - {"multipath"} | {"footprint"}
    # what is compiled when it is first called is no part of any setting's time
    bench.score(0, planned, detector)
    measurements = []
    for count, other in changed.items():
        errors = _mean(np.abs(alone[count] - alone[counts[-1]]))
        _, seconds, memory = timed(partial(bench.score, 0, planned, other))
        default, reference = detector is own and count == detector.footprint_rays, count == counts[-1]
        measurements.append(Measurement(str(count), *errors, seconds, memory, default, reference))
    return Sweep(
        knob="footprint_rays",
        error_of=f"change of a scene's {metric.name}, of the beams' width alone, mean over scenes",
        unit=metric.unit,
        against=f"{counts[-1]} rays per beam",
        tolerance=metric.tolerance,
        because="the task's own tolerance: smaller differences do not matter to it",
        work="simulating and scoring one scene with all effects that it calls for",
        measurements=measurements,
        note=note,
    )


def _effects(bench: Bench, note: str, own: Detector) -> list[Sweep]:
    """The sweep over effects: none, each left out in turn, and all present; empty where there are none."""
    present = {one.name for plan in bench.plans for one in plan.decisions if one.bound.range_m or one.bound.lost}
    rays, detector = bench.rays * len(bench.scenes), bench.planner.detector
    dear = {name for name in present if predicted_seconds(name, detector, rays) > MOST_SECONDS}
    there = [name for name in EFFECTS if name in present - dear]
    if not there:
        return []
    if dear:
        note += f"; without {', '.join(sorted(dear))}, which take{'s' if len(dear) == 1 else ''} too long here"
    metric = bench.request.metric
    return [
        Sweep(
            knob="effects",
            error_of=f"change of the mean {metric.name} with an effect left out or alone, whichever is more",
            unit=metric.unit,
            against="all effects that the scenes have",
            tolerance=metric.tolerance / len(there),
            because=f"an equal share of the task's tolerance for each of {len(there)} effects: changes add up",
            work="simulating and scoring one scene",
            measurements=_effect_measurements(bench, there, marks=detector is own),
            note=note,
        )
    ]


@dataclass(frozen=True, eq=False)
class _Pass:
    """Scores in all scenes, the median time of one [s] and the most memory [bytes]."""

    values: np.ndarray
    seconds: float
    memory_bytes: int | None


def _passes(bench: Bench, choices: Mapping[str, Sequence[frozenset[str]]]) -> dict[str, _Pass]:
    """All scenes under each choice of effects per scene.

    Scene by scene under all choices, so that other load of the machine slows all alike.
    """
    measured: dict[str, list[tuple[float, float, int | None]]] = {name: [] for name in choices}
    for number in range(len(bench.scenes)):
        for name, choice in choices.items():
            started = time.perf_counter()
            value, memory = with_memory(partial(bench.score, number, choice[number], bench.planner.detector))
            measured[name].append((value, time.perf_counter() - started, memory))
    passes = {}
    for name, rows in measured.items():
        values, seconds, memories = zip(*rows, strict=True)
        most = max((size for size in memories if size is not None), default=None)
        passes[name] = _Pass(np.array(values), float(np.median(seconds)), most)
    return passes


def _effect_measurements(bench: Bench, there: Sequence[str], *, marks: bool) -> list[Measurement]:
    """Measurements by falling error; with `marks` that of the evaluation's own plan is the default."""
    everything, count = frozenset(there), len(bench.scenes)
    planned = [plan.effects & everything for plan in bench.plans]
    # compiled before anything is timed
    bench.score(0, everything, bench.planner.detector)
    settings = {
        "none": [frozenset()] * count,
        "all": [everything] * count,
        **{f"without {name}": [everything - {name}] * count for name in there},
    }
    if planned not in settings.values():
        settings[bench.planner.choice if isinstance(bench.planner.choice, str) else "those named"] = planned
    passes = _passes(bench, settings | {f"{name} alone": [frozenset({name})] * count for name in there})
    full, none = passes["all"], passes["none"]
    changes = {
        f"without {name}": {
            "left_out": _paired(passes[f"without {name}"].values, full.values),
            "alone": _paired(passes[f"{name} alone"].values, none.values),
        }
        for name in there
    }
    measurements = [_measure(name, passes[name], full, changes.get(name, {})) for name in settings if name != "all"]
    measurements.sort(key=lambda measurement: -measurement.error)
    measurements.append(replace(_measure("all", full, full, {}), reference=True))
    own = next(name for name, choice in settings.items() if choice == planned)
    return [replace(measurement, default=marks and measurement.setting == own) for measurement in measurements]


def _measure(setting: str, found: _Pass, full: _Pass, changes: Mapping[str, tuple[float, float]]) -> Measurement:
    """A measurement of a setting; `changes` of the metric are those of an effect left out and alone."""
    error = max(changes.values(), default=_paired(found.values, full.values))
    values = {f"change_{name}": change for name, (change, _) in changes.items()}
    if changes:
        values["seconds_saved"] = full.seconds - found.seconds
    return Measurement(setting, *error, found.seconds, found.memory_bytes, values=values)


def scenes_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The sweep over scenes: the first design at most rays against `bounding`; empty with fewer than 2 scenes."""
    rows = request.evaluation.rows
    first = next((row.design for row in rows if not row.baseline), None)
    pairs = [
        (row, baseline)
        for row in rows
        for baseline in rows
        if row.design == first and baseline.design == BASELINE and baseline.rays == row.rays
    ]
    if not pairs:
        return []
    # at most rays designs are closest
    design, baseline = max(pairs, key=lambda pair: pair[0].rays)
    differences = np.asarray(design.per_scene, dtype=np.float64) - np.asarray(baseline.per_scene, dtype=np.float64)
    if design.groups is not None:  # scenes of one group stand for each other
        differences = np.bincount(design.groups, differences) / np.bincount(design.groups)
    return [_scenes_sweep(differences, design, request)] if len(differences) > 1 else []


def _scenes_sweep(differences: np.ndarray, design: Row, request: AccuracyRequest) -> Sweep:
    metric, total = request.evaluation.metric, len(differences)
    # of all rows in all scenes [s]; rows that fire the same rays have one time, to the last bit
    row_seconds = {row.seconds for row in (*request.evaluation.rows, *request.evaluation.equal_bandwidth)}
    seconds = (request.evaluation.planning_seconds + sum(row_seconds)) / total
    units = "scenes" if total == len(design.per_scene) else "groups of scenes"
    counts = [*(count for count in COUNTS if count < total), total]
    measurements = [_measure_scenes(differences, count, seconds, request.request.seed) for count in counts]
    # half-widths fall with the root of the number of scenes
    half_width, tolerance = measurements[-1].error, metric.tolerance
    note = ""
    if half_width > tolerance > 0:
        needed = math.ceil(total * (half_width / tolerance) ** 2)
        note = f"{needed:,} {units} would tell differences of {tolerance:g} {metric.unit} apart"
    return Sweep(
        knob=f"held-out {units}",
        error_of=f"half-width of the 95 % interval of {design.design} minus {BASELINE} at {design.rays} rays",
        unit=metric.unit,
        against=f"all {units} that there could be",
        tolerance=tolerance,
        because="the task's own tolerance: smaller differences do not matter to it",
        work=f"simulating and scoring all rows in so many {units}",
        measurements=measurements,
        note=note,
    )


def _measure_scenes(differences: np.ndarray, count: int, seconds: float, seed: int) -> Measurement:
    """The mean half-width of intervals over random sets of `count` scenes, or over the set of all."""
    total = len(differences)
    generator = random_generator(seed, "held-out ladder", count)
    draws = DRAWS if count < total else 1
    sets = [generator.permutation(total)[:count] for _ in range(draws)] if count < total else [np.arange(total)]
    intervals = [mean_interval(differences[chosen]) for chosen in sets]
    halves = np.array([(one.high - one.low) / 2 for one in intervals])
    sign = np.sign(differences.mean())
    agree = np.mean([sign * one.low > 0 and sign * one.high > 0 for one in intervals])
    drawn = halves.std(ddof=1) / math.sqrt(draws) if draws > 1 else 0.0
    return Measurement(
        setting=str(count),
        error=float(halves.mean()),
        uncertainty=math.hypot(float(halves.mean()) * relative_error_of_spread(differences), float(drawn)),
        seconds=seconds * count,
        default=count == total,
        values={"told_apart_share": float(agree)},
    )


def relative_error_of_spread(values: np.ndarray) -> float:
    r"""The relative standard error of a sample's standard deviation, $\sqrt{(m_4 / m_2^2 - 1) / 4 n}$ (Cramer 1946).

    Every half-width is in proportion to it. 0 where all values are equal.
    """
    centred = values - values.mean()
    second = float(np.mean(centred**2))
    if second == 0:
        return 0.0
    return math.sqrt(max(float(np.mean(centred**4)) / second**2 - 1, 0.0) / (4 * len(values)))


# In the order of the pipeline: the phase, its name for progress, and what gives the sweeps, none where the choice does
# not arise.
SWEEPS = (
    ("visibility", "visibility", fields.visibility_sweeps),
    ("fields", "distance fields", fields.field_sweeps),
    ("precision", "arithmetic", training.dtype_sweeps),
    ("scenes", "scenes per step", training.frames_sweeps),
    ("training", "training", training.steps_sweeps),
    ("physics", "effects of light", physics_sweeps),
    ("held_out", "held-out scenes", scenes_sweeps),
)


def measure_accuracy(request: AccuracyRequest, progress: Progress | None = None) -> Accuracy:
    """Measure every sweep that applies.

    Arguments:
        request: The run and evaluation to measure on.
        progress: Called with the label of the next kind of sweeps, the kinds done, and all kinds.
    """
    measured: list[Sweep] = []
    seconds: dict[str, float] = {}
    for done, (name, label, sweeps) in enumerate(SWEEPS):
        if progress:
            progress(label, done, len(SWEEPS))
        started = time.perf_counter()
        with phase(name):
            measured += sweeps(request)
        seconds[name] = round(time.perf_counter() - started, 3)
    if progress:
        progress("", len(SWEEPS), len(SWEEPS))
    return Accuracy(measured, seconds)
