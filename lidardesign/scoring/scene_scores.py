"""Scores of many sets of rays in every scene, each scene under the effects that it calls for.

A scene is the unit of work: all its rays are planned and traced together, and its scores depend on nothing else. So
scenes can be scored one after the other here, or by workers (`lidardesign.workers`), to the same numbers.

On training scenes sets of rays come one after the other; the effects are those that the first of them called for.
"""

from __future__ import annotations

import itertools
import math
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from lidardesign.errors import PluginError
from lidardesign.plugins import plugin_guard, plugin_method
from lidardesign.rays.information import FEW_SCENES
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.run.clock import Progress, phase
from lidardesign.run.content import fingerprint
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.scenes.triangles import SecondCasts
from lidardesign.scoring.fired import Positions
from lidardesign.sensors.adaptive import AdaptiveRays, returns_of
from lidardesign.simulate.detector.physics import Physics
from lidardesign.simulate.plan import EffectPlan, Planner
from lidardesign.simulate.returns import build_casters, simulate_many
from lidardesign.task import Metric, Score, Task, prepares, random_generator
from lidardesign.workers import Starmap

# Rays times frames that are traced together: their returns take 24 bytes each.
MOST_RETURNS = 4_000_000
# Frames that are checked for returns from targets; a larger share without any is noted.
WATCHED, MOST_SILENT = 16, 0.5
PREPARE = "prepare"  # the purpose of training scenes
# Sets of rays, beside the present ones, whose preparation is kept: a search tries thousands.
MOST_KEPT = 200


def score_lists(
    task: Task,
    metric: Metric,
    scene: Scene,
    jobs: Sequence[Positions],
    casters: Sequence[SceneCaster],
    physics: Physics | None = None,
    prepared: Sequence[Any] | None = None,
) -> Iterator[tuple[Score, float]]:
    """Scores of many sets of rays in one scene, in their order, each with its share of the time [s].

    As many are traced together as a bounded memory allows. Random numbers are the same for all sets and differ between
    positions.

    Arguments:
        task: The task that scores.
        metric: Its metric.
        scene: The scene.
        jobs: The sets of rays.
        casters: One per frame.
        physics: The detector and the effects that are on; None: geometry alone.
        prepared: What the task prepared for each set of rays; None: nothing.
    """
    made = iter(prepared or [None] * len(jobs))
    for group in _groups(jobs, scene.frames):
        started = time.perf_counter()
        lists = [rays for positions in group for rays in positions]
        found = iter(
            simulate_many(
                scene,
                lists,
                casters=casters,
                physics=physics,
                repeats=[number for positions in group for number in _repeats(positions)],
            )
        )
        per_ray = (time.perf_counter() - started) / max(sum(map(_count, group)), 1)
        for positions in group:
            returns = returns_of(positions, scene, [next(found) for _ in positions])
            started = time.perf_counter()
            score = checked_score(task, metric, scene, returns, next(made))
            yield score, time.perf_counter() - started + per_ray * _count(positions)


def returns_in_scene(
    scene: Scene, positions: Positions, casters: Sequence[SceneCaster], physics: Physics | None
) -> list[Returns]:
    """The returns by which `score_lists` scores one set of rays."""
    found = simulate_many(scene, positions, casters=casters, physics=physics, repeats=_repeats(positions))
    return returns_of(positions, scene, found)


def _repeats(positions: Positions) -> Sequence[int]:
    """The random draw of each list of rays: another at every condition value, the same for patterns of one frame."""
    return [0] * len(positions) if isinstance(positions, AdaptiveRays) else range(len(positions))


def _count(positions: Positions) -> int:
    return sum(len(rays) for rays in positions)


def _groups(jobs: Sequence[Positions], frames: int) -> Iterator[list[Positions]]:
    group: list[Positions] = []
    size = 0
    for positions in jobs:
        returns = _count(positions) * frames
        if group and size + returns > MOST_RETURNS:
            yield group
            group, size = [], 0
        group.append(positions)
        size += returns
    if group:
        yield group


@phase("metric")
def checked_score(task: Task, metric: Metric, scene: Scene, returns: Sequence[Returns], prepared: Any = None) -> Score:
    """The score that a task gives to returns in a scene, by what it prepared; a failure has the metric's worst value.

    A value beyond the worst one counts as the worst, so that failing is never better.

    Raises:
        PluginError: The task's score raised, changed the truth, or returned something that is no finite score, or
            better than the best.
    """
    where = f"task {task.name}, metric {metric.name}, scene {scene.name}"
    with called_on(task, "score", where, [scene]):
        score = task.score(scene, returns, **({"prepared": prepared} if prepares(task) else {}))
    if not isinstance(score, Score):
        raise PluginError(f"score returned {type(score).__name__}", where=where, allowed="lidardesign.task.Score")
    items = score.details.items() if isinstance(score.details, Mapping) else [(None, None)]
    if not all(isinstance(name, str) and _is_number(value) for name, value in items):
        raise PluginError(
            f"score returned the details {score.details!r}", where=where, allowed="numbers by name, as {'seen': 3.0}"
        )
    if score.failed:
        return Score(float(metric.worst), failed=True, details=dict(score.details))
    if not _is_number(score.value) or not math.isfinite(score.value):
        raise PluginError(
            f"score returned {score.value!r}",
            where=where,
            allowed="a finite number",
            hint="where there are too few returns, return Score(metric.worst, failed=True)",
        )
    best = metric.limits[metric.better == "higher"]
    beyond = best - score.value if metric.better == "lower" else score.value - best
    if beyond > metric.tolerance:
        raise PluginError(
            f"score returned {score.value:g}",
            where=where,
            allowed=f"{best:g}, the best there can be, or worse",
            hint="give the metric another best=",
        )
    clip = min if metric.better == "lower" else max
    return Score(clip(float(score.value), float(metric.worst)), details=dict(score.details))


@contextmanager
def called_on(task: Task, method: str, where: str, scenes: Sequence[Scene]) -> Iterator[None]:
    """Run a method of a task on scenes, whose truth it has to leave as it is.

    Raises:
        PluginError: It raised, or changed the truth.
    """
    truths = [dict(scene.truth) for scene in scenes]
    for value in (value for truth in truths for value in truth.values() if isinstance(value, np.ndarray)):
        value.setflags(write=False)
    with plugin_method(task.name, method, where):
        yield
    for scene, truth in zip(scenes, truths, strict=True):
        if len(truth) != len(scene.truth) or any(scene.truth.get(name) is not value for name, value in truth.items()):
            raise PluginError(
                f"{method} changed scene.truth", where=where, hint="the next design is scored by it: copy it first"
            )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def silent_notes(scenes: Sequence[Scene], fired: Mapping[str, Positions]) -> list[str]:
    """Lines on sets of rays that have no return from any target in most of a few scenes and frames.

    Arguments:
        scenes: The scenes, of which some are checked, without effects.
        fired: The rays of each set, from all its positions, by its name.
    """
    frames = [(scene, frame) for scene in scenes for frame in range(scene.frames)]
    watched = [frames[number] for number in np.unique(np.linspace(0, len(frames) - 1, WATCHED).astype(int))]
    casters = [SceneCaster(scene, frame) for scene, frame in watched]
    notes = []
    for name, positions in fired.items():
        rays = Rays.joined(positions)
        silent = 0
        for (scene, _), caster in zip(watched, casters, strict=True):
            hits = caster.first_hit(rays.origin_m, rays.direction)
            is_target = np.array([body.is_target for body in scene.bodies])
            in_gate = (rays.gate_m[:, 0] <= hits.range_m) & (hits.range_m < rays.gate_m[:, 1])
            silent += not (in_gate & (hits.body >= 0) & is_target[hits.body]).any()
        if silent > MOST_SILENT * len(watched):
            notes.append(
                f"in {silent} of {len(watched)} frames that were checked, no ray of {name} returns from a target; "
                "if that is unexpected, check that its places, directions and gates are right, and in metres"
            )
    return notes


@dataclass(frozen=True, eq=False)
class SceneScores:
    """Scores of all sets of rays in a scene, and the effects that it was simulated with.

    Arguments:
        plan: The effects that were simulated.
        planning_seconds: Time to plan them [s].
        scores: Of every set of rays, in their order, each with its share of the time [s].
        second_casts: Counts of second casts at meshes, those of planning included.
    """

    plan: EffectPlan
    planning_seconds: float
    scores: Sequence[tuple[Score, float]]
    second_casts: SecondCasts = field(default_factory=SecondCasts)


def score_scenes(
    task: Task,
    metric: Metric,
    seed: int,
    scenes: Sequence[Scene],
    fired: Callable[[int], Sequence[Positions]],
    planner: Planner,
    plans: Sequence[EffectPlan] = (),
    progress: Progress | None = None,
    starmap: Starmap = itertools.starmap,
    prepared: Sequence[Any] | None = None,
) -> list[SceneScores]:
    """Score scene by scene, so that only one scene's casters are held at a time; or by workers, to the same numbers.

    Arguments:
        task: The task that scores.
        metric: Its metric.
        seed: Root of the effects' random streams.
        scenes: The scenes.
        fired: The sets of rays that are fired in a scene, by its number.
        planner: How their effects are chosen.
        plans: The plan of every scene where it is known already; empty: they are made.
        progress: Called with the name of the scene, the scenes done, and all scenes.
        starmap: Map over scenes.
        prepared: What the task prepared for each set of rays; None: nothing.
    """
    found, total = [], len(scenes)
    asked = (
        (task, metric, scene, list(fired(number)), planner, plan, seed, prepared)
        for number, (scene, plan) in enumerate(zip(scenes, plans or [None] * total, strict=True))
    )
    results = iter(starmap(score_in_scene, asked))
    for number, scene in enumerate(scenes):
        if progress:
            progress(scene.name, number, total)
        found.append(next(results))
    if progress:
        progress("", total, total)
    return found


def score_in_scene(
    task: Task,
    metric: Metric,
    scene: Scene,
    lists: Sequence[Positions],
    planner: Planner,
    known: EffectPlan | None,
    seed: int,
    prepared: Sequence[Any] | None = None,
) -> SceneScores:
    """Score sets of rays in one scene.

    Arguments:
        task: The task that scores.
        metric: Its metric.
        scene: The scene.
        lists: The sets of rays.
        planner: How effects are chosen.
        known: The plan; None makes it for all the rays together.
        seed: Root of the effects' random streams.
        prepared: What the task prepared for each of them; None: nothing.

    Raises:
        ConfigError: An effect that was named cannot be simulated here, or a gate lies outside the histogram.
        PluginError: The task's score raised, or returned something that is no finite score.
    """
    casters = build_casters(scene)
    started = time.perf_counter()
    plan = known or planner.plan(scene, [rays for positions in lists for rays in positions], casters)
    seconds = time.perf_counter() - started
    return SceneScores(
        plan,
        seconds,
        list(score_lists(task, metric, scene, lists, casters, planner.physics(plan, seed), prepared)),
        sum((caster.second_casts for caster in casters), SecondCasts()),
    )


class Preparation:
    """What a task prepares for sets of rays on training scenes, once for each, and kept by content.

    It is kept in memory, never in a file: it may be any object, and reading a file of any object may run code.

    Arguments:
        task: The task.
        seed: Root of its random numbers, and of the effects'.
        scenes: Training scenes, of which it gets the first `FEW_SCENES`.
        planner: The detector, and how effects are chosen, by the rays that come first; None: geometry alone.
    """

    def __init__(self, task: Task, seed: int, scenes: Iterable[Scene], planner: Planner | None) -> None:
        self.task, self.seed, self.planner, self._stream = task, seed, planner, scenes
        self._plans: list[EffectPlan | None] = []
        self._known: dict[str, Any] = {}

    @classmethod
    def of_run(cls, training: TrainingScenes, planner: Planner | None) -> Preparation:
        """What the task of a run prepares, on scenes that nothing else is made or tried on."""
        return cls(training.run.task, training.seed, training.scenes(PREPARE), planner)

    @cached_property
    def scenes(self) -> tuple[Scene, ...]:
        """The scenes that the task gets."""
        return tuple(itertools.islice(self._stream, FEW_SCENES))

    def of(
        self, lists: Sequence[Positions], plan: EffectPlan | None = None, starmap: Starmap = itertools.starmap
    ) -> list[Any]:
        """What is prepared for each set of rays, in their order; None where the task prepares nothing.

        Arguments:
            lists: The sets of rays.
            plan: The effects in all scenes; None: those that each calls for.
            starmap: Map over scenes, and over sets of rays.

        Raises:
            PluginError: The task's `prepare` raised, changed the truth, or returned nothing, or what cannot be pickled.
        """
        if not prepares(self.task):
            return [None] * len(lists)
        if not self._plans:
            sensed = ((scene, [rays for one in lists for rays in one]) for scene in self.scenes)
            is_known = plan is not None or self.planner is None
            self._plans = [plan] * len(self.scenes) if is_known else [*starmap(self.planner.plan, sensed)]
        # a tuple of patterns counts by its rays alone
        keys = [fingerprint([[*one], getattr(one, "rule", None)]) for one in lists]
        missing = {key: one for key, one in zip(keys, lists, strict=True) if key not in self._known}
        asked = ((self.task, self.scenes, self._plans, one, self.seed, self.planner) for one in missing.values())
        self._known |= zip(missing, starmap(prepare_for, asked), strict=True)
        found = {key: self._known.pop(key) for key in dict.fromkeys(keys)}
        self._known = dict([*self._known.items()][-MOST_KEPT:]) | found
        return [found[key] for key in keys]


@phase("prepare")
def prepare_for(
    task: Task,
    scenes: Sequence[Scene],
    plans: Sequence[EffectPlan | None],
    positions: Positions,
    seed: int,
    planner: Planner | None,
) -> Any:
    """What a task prepares for one set of rays, as another process gets it: scores by workers are the same.

    Arguments are the plan of each scene, and the rest as of `Preparation`.
    """
    returns = []
    for number, (scene, plan) in enumerate(zip(scenes, plans, strict=True)):
        # names of scenes may repeat, also those of held-out ones, and noise follows them
        noise = int(random_generator(seed, PREPARE, number).integers(2**63))
        physics = planner.physics(plan, noise) if planner and plan else None
        returns.append(returns_in_scene(scene, positions, build_casters(scene), physics))
    where = f"task {task.name}"
    with called_on(task, "prepare", where, scenes):
        made = task.prepare(scenes, returns, seed)
    if made is None:
        raise PluginError("prepare returned nothing", where=where, hint="return what score() gets as `prepared`")
    try:
        with plugin_guard(task.name):
            return pickle.loads(pickle.dumps(made))
    except PluginError as error:
        raise PluginError(
            f"prepare returned a {type(made).__name__} that cannot be pickled: {error.message}",
            where=where,
            hint="workers get it: return arrays, or objects of classes at the top of a module",
        ) from error


class TrainingScorer:
    """Scores sets of rays on training scenes, which are drawn as they are needed.

    The rays that are scored first in a scene say which effects it calls for; all that come later meet the same ones.

    Arguments:
        task: The task that scores.
        metric: Its metric.
        seed: Root of the effects' random streams.
        scenes: The scenes.
        planner: The detector, and how effects are chosen; None: geometry alone.
        plans_once: Whether the first scene says so for all, and multipath light, which takes a thousand times as long
            as other effects, is left out.
        keeps_casters: Whether the casters of all scenes are kept, for many sets one after the other.
        preparation: What the task prepares for sets of rays; None: nothing.

    `plans` has the effects by the number of the scene.
    """

    def __init__(
        self,
        task: Task,
        metric: Metric,
        seed: int,
        scenes: Iterable[Scene],
        planner: Planner | None,
        *,
        plans_once: bool = False,
        keeps_casters: bool = False,
        preparation: Preparation | None = None,
    ) -> None:
        self.task, self.metric, self.seed, self.planner = task, metric, seed, planner
        self.plans: dict[int, EffectPlan] = {}
        self._drawn: list[Scene] = []
        self._further = iter(scenes)
        self._plans_once, self._preparation = plans_once, preparation
        self._casters = cache(build_casters) if keeps_casters else build_casters

    def scenes(self, count: int) -> list[Scene]:
        """The first scenes, all where there are no more."""
        self._drawn += itertools.islice(self._further, max(count - len(self._drawn), 0))
        return self._drawn[:count]

    def scores(self, lists: Sequence[Positions], count: int) -> np.ndarray:
        """The score of every set of rays in each of the first scenes, shape (scenes, sets)."""
        return np.array([self.scores_in(number, lists) for number in range(len(self.scenes(count)))])

    def scores_in(
        self, number: int, lists: Sequence[Positions], planned: Sequence[Positions] | None = None
    ) -> list[float]:
        """The score of every set of rays in a scene.

        Arguments:
            number: The number of the scene.
            lists: The sets of rays.
            planned: Those that say which effects the scene calls for; None: all of them.
        """
        scene = self.scenes(number + 1)[number]
        casters = self._casters(scene)
        physics = self._physics(number, planned or lists, casters)
        plan = self.plans.get(0) if self._plans_once else None
        prepared = None if self._preparation is None else self._preparation.of(lists, plan)
        return [
            score.value for score, _ in score_lists(self.task, self.metric, scene, lists, casters, physics, prepared)
        ]

    def _physics(self, number: int, lists: Sequence[Positions], casters: Sequence[SceneCaster]) -> Physics | None:
        """The effects that a scene calls for, which sets of rays say where they are the first."""
        if self.planner is None:
            return None
        planned = 0 if self._plans_once else number
        if planned not in self.plans:
            plan = self.planner.plan(self._drawn[number], [rays for one in lists for rays in one], casters)
            if self._plans_once:
                # the bound is kept
                plan = replace(
                    plan,
                    decisions=tuple(replace(one, on=one.on and one.name != "multipath") for one in plan.decisions),
                )
            self.plans[planned] = plan
        return self.planner.physics(self.plans[planned], self.seed)
