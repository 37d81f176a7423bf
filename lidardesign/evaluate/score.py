"""Scores of designs and baselines on held-out scenes, at equal rays and at equal bandwidth.

Honest by construction: every design and baseline sees the same scenes; a scene where the returns are too few
to score counts as a failure at the metric's worst value and is never dropped; baselines are built from
training scenes alone. Each scene's casters are built once and shared by all rows, and rows that fire the same
rays are scored once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.rays import lay_out
from lidardesign.design.samples import Samples
from lidardesign.design.sensor import Design
from lidardesign.errors import ConfigError, PluginError
from lidardesign.evaluate.baselines import BASELINES, Baselines, random_rays
from lidardesign.evaluate.results import Evaluation, Paired, Row, worse_than_threshold
from lidardesign.evaluate.statistics import bootstrap_interval, paired_difference
from lidardesign.registry import plugin_guard
from lidardesign.scene import Scene
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.simulate.returns import Rays
from lidardesign.simulate.simulate import build_casters, simulate
from lidardesign.space import DesignSpace
from lidardesign.task import Score, Task

__all__ = [
    "Evaluation",
    "EvaluationRequest",
    "Paired",
    "Row",
    "evaluate",
    "score_scene",
    "worse_than_threshold",
]

# Candidates of `bounding` with free origins are compared on this many training scenes: enough to tell a good
# layout from a bad one, at a fraction of the held-out scenes' cost.
JUDGED_SCENES = 8

Progress = Callable[[int, int, str], None]
LayOut = Callable[[Design, int, Samples | None], Rays]


@dataclass(frozen=True, eq=False)
class EvaluationRequest:
    """What to evaluate.

    Arguments:
        task: The task whose score is taken.
        config: The task's configuration, for the record.
        space: The design space that baselines fill.
        seed: Root of the random baseline and the bootstrap.
        designs: The designs, by distinct names that are no baseline's.
        rays: Numbers of rays per frame.
        baselines: Names of baselines.
        bandwidth: The read-out model.
        samples: Samples of the learned density by design name, for layouts that need them.
        equal_bandwidth: Whether baselines are also given each design's bandwidth.
        train, test: Training scenes (for baselines) and held-out scenes.
        lay_out: How a design becomes a ray list of a given length.
    """

    task: Task
    config: Any
    space: DesignSpace
    seed: int
    designs: Sequence[Design]
    rays: Sequence[int]
    baselines: Sequence[str] = ("uniform", "random", "bounding")
    bandwidth: Bandwidth = field(default_factory=Bandwidth)
    samples: Mapping[str, Samples] = field(default_factory=dict)
    equal_bandwidth: bool = True
    train: Sequence[Scene] = ()
    test: Sequence[Scene] = ()
    lay_out: LayOut = lay_out


@dataclass(frozen=True, eq=False)
class _Entry:
    """One row to be: who fires which rays, matched to whose bandwidth."""

    name: str
    rays: Rays
    baseline: bool
    matched_to: str | None = None
    matched_rays: int | None = None


@dataclass(eq=False)
class _Tally:
    """What one list of rays scored so far."""

    values: list[float] = field(default_factory=list)
    failures: int = 0
    seconds: float = 0.0


def evaluate(request: EvaluationRequest, progress: Progress | None = None) -> Evaluation:
    """Score every design and baseline on every held-out scene.

    Arguments:
        request: What to evaluate.
        progress: Called with the scenes done, all scenes, and the name of the scene.

    Raises:
        ConfigError: No scenes, designs of one name, an unknown baseline, or a layout that cannot be had.
        PluginError: The task's score raised, or returned something that is no finite score.
    """
    _check(request)
    entries = _entries(request)
    tallies = _score_all(request, entries, progress)
    rows = [_row(request, entry, tallies[_rays_key(entry)]) for entry in entries]
    plain = [row for row in rows if row.matched_to is None]
    matched = [row for row in rows if row.matched_to is not None]
    return Evaluation(
        metric=request.task.metric,
        scenes=len(request.test),
        rows=plain,
        paired=_pairs(plain, request.seed),
        equal_bandwidth=matched,
        paired_bandwidth=_bandwidth_pairs(plain, matched, request.seed),
        notes=_notes(request, matched),
    )


def score_scene(task: Task, scene: Scene, rays: Rays, casters: Sequence[SceneCaster]) -> Score:
    """The checked score of one list of rays in one scene; a failure has the metric's worst value.

    A value beyond the worst one counts as the worst, so that failing is never the better choice.

    Raises:
        PluginError: The task's score raised, or returned something that is no finite score.
    """
    returns = simulate(scene, rays, casters=casters)
    where = f"task {task.name}, metric {task.metric.name}, scene {scene.name}"
    try:
        with plugin_guard(task.name):
            score = task.score(scene, returns)
    except PluginError as error:
        raise PluginError(f"scoring failed: {error.message}", where=where, hint=error.hint) from error
    if not isinstance(score, Score):
        raise PluginError(
            f"score returned {type(score).__name__}", where=where, allowed="lidardesign.task.Score"
        )
    if score.failed:
        return Score(float(task.metric.worst), failed=True, details=score.details)
    number = isinstance(score.value, int | float | np.integer | np.floating) and not isinstance(
        score.value, bool
    )
    if not number or not math.isfinite(score.value):
        raise PluginError(
            f"score returned {score.value!r}",
            where=where,
            allowed="a finite number",
            hint="where there are too few returns, return Score(metric.worst, failed=True)",
        )
    clip = min if task.metric.better == "lower" else max
    return Score(clip(float(score.value), float(task.metric.worst)), details=score.details)


def _check(request: EvaluationRequest) -> None:
    if not request.test:
        raise ConfigError(
            "there are no held-out scenes", where=f"task {request.task.name}", allowed="1 or more"
        )
    if not math.isfinite(request.task.metric.worst):
        raise PluginError(
            f"the worst value is {request.task.metric.worst}",
            where=f"task {request.task.name}",
            allowed="finite",
        )
    names = [design.name for design in request.designs]
    for name in names:
        if names.count(name) > 1 or name in BASELINES:
            other = "a baseline" if name in BASELINES else "another design"
            raise ConfigError(f"a design has the name of {other}: {name!r}", hint="rename its file")
    unknown = [name for name in request.baselines if name not in BASELINES]
    if unknown:
        raise ConfigError(
            f"unknown baseline {unknown[0]!r}", where="--baseline", allowed=", ".join(BASELINES)
        )
    if any(count < 1 for count in request.rays):
        raise ConfigError(f"{min(request.rays)} rays", where="--rays", allowed="1 or more")


def _entries(request: EvaluationRequest) -> list[_Entry]:
    """All rows to be: designs, baselines, then baselines at each design's bandwidth."""
    baselines = Baselines(request.space, request.train, request.seed, judge=_judge(request))
    counts = list(dict.fromkeys(request.rays))
    designs = [
        _Entry(design.name, request.lay_out(design, count, request.samples.get(design.name)), baseline=False)
        for design in request.designs
        for count in counts
    ]
    plain = [
        _Entry(name, baselines.rays(name, count), baseline=True)
        for name in request.baselines
        for count in counts
    ]
    if not request.equal_bandwidth:
        return designs + plain
    matched = [
        _Entry(
            name,
            baselines.rays_within(name, request.bandwidth.mbps(entry.rays), request.bandwidth),
            baseline=True,
            matched_to=entry.name,
            matched_rays=len(entry.rays),
        )
        for entry in designs
        for name in request.baselines
    ]
    return designs + plain + matched


def _judge(request: EvaluationRequest) -> Callable[[Rays], float]:
    """The mean score of a ray list on a few training scenes, turned so that lower is better."""
    sign = 1.0 if request.task.metric.better == "lower" else -1.0
    casters: dict[int, list[SceneCaster]] = {}
    chosen = request.train[:JUDGED_SCENES]

    def judge(rays: Rays) -> float:
        for index, scene in enumerate(chosen):
            casters.setdefault(index, build_casters(scene))
        values = [score_scene(request.task, scene, rays, casters[i]).value for i, scene in enumerate(chosen)]
        return sign * float(np.mean(values)) if values else 0.0

    return judge


def _rays_key(entry: _Entry) -> tuple[Any, ...]:
    """Equal for entries that fire the same rays: a baseline's rays follow from its name, number and gate."""
    if not entry.baseline:
        return ("design", entry.name, len(entry.rays))
    rays = entry.rays
    return (entry.name, rays.origin_m.tobytes(), rays.direction.tobytes(), rays.gate_m.tobytes())


def _score_all(
    request: EvaluationRequest, entries: Sequence[_Entry], progress: Progress | None
) -> dict[tuple[Any, ...], _Tally]:
    """Scene by scene, so that only one scene's casters are held at a time."""
    jobs = {_rays_key(entry): entry.rays for entry in entries}
    tallies = {key: _Tally() for key in jobs}
    for done, scene in enumerate(request.test):
        if progress:
            progress(done, len(request.test), scene.name)
        casters = build_casters(scene)
        for key, rays in jobs.items():
            started = time.perf_counter()
            fired = random_rays(request.space, len(rays), request.seed, done) if key[0] == "random" else rays
            score = score_scene(request.task, scene, fired, casters)
            tally = tallies[key]
            tally.seconds += time.perf_counter() - started
            tally.values.append(score.value)
            tally.failures += score.failed
    if progress:
        progress(len(request.test), len(request.test), "")
    return tallies


def _row(request: EvaluationRequest, entry: _Entry, tally: _Tally) -> Row:
    values = np.array(tally.values)
    mean, low, high = bootstrap_interval(values, request.seed)
    return Row(
        design=entry.name,
        rays=len(entry.rays),
        value=mean,
        ci_low=low,
        ci_high=high,
        failures=tally.failures,
        bandwidth_mbps=request.bandwidth.mbps(entry.rays),
        seconds=tally.seconds,
        per_scene=values,
        baseline=entry.baseline,
        matched_to=entry.matched_to,
        matched_rays=entry.matched_rays,
    )


def _pair(first: Row, second: Row, seed: int, rays_b: int | None = None) -> Paired:
    mean, low, high = paired_difference(first.per_scene, second.per_scene, seed)
    return Paired(first.design, second.design, first.rays, mean, low, high, rays_b)


def _pairs(rows: Sequence[Row], seed: int) -> list[Paired]:
    """Every design against every baseline and every later design, at equal numbers of rays."""
    return [
        _pair(row, other, seed)
        for index, row in enumerate(rows)
        if not row.baseline
        for other in rows[index + 1 :]
        if other.rays == row.rays and other.design != row.design
    ]


def _bandwidth_pairs(rows: Sequence[Row], matched: Sequence[Row], seed: int) -> list[Paired]:
    designs = {(row.design, row.rays): row for row in rows if not row.baseline}
    return [_pair(designs[row.matched_to, row.matched_rays], row, seed, row.rays) for row in matched]


def _notes(request: EvaluationRequest, matched: Sequence[Row]) -> list[str]:
    notes = []
    if len(request.test) == 1:
        notes.append("one held-out scene: intervals have no width and say nothing about other scenes")
    empty = [row for row in matched if row.rays == 0]
    if empty:
        names = ", ".join(sorted({row.design for row in empty}))
        notes.append(
            f"at equal bandwidth not one ray of {names} fits in {len(empty)} rows, which fail in every scene"
        )
    return notes
