"""Scores of designs and baselines on held-out scenes, at equal rays and at equal bandwidth.

Honest by construction: every design and baseline sees the same scenes; a scene where the returns are too few
to score counts as a failure at the metric's worst value and is never dropped; baselines are built from
training scenes alone. In each scene the rays of all rows are traced together, frame by frame, and rows that fire the
same rays are scored once. All rows of a scene meet the same effects: those that the scene calls for with any of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lidardesign.design.compare import outside_notes
from lidardesign.evaluate.baselines.catalog import part_notes
from lidardesign.evaluate.cma.candidate import Record
from lidardesign.evaluate.entries import Entry, entries_of
from lidardesign.evaluate.request import EvaluationRequest, left_out
from lidardesign.evaluate.results import (
    Audit,
    Evaluation,
    Paired,
    Row,
    audit_rows,
    effect_notes,
    summaries,
    worse_than_threshold,
)
from lidardesign.evaluate.scene_scores import Progress, ScenePass, score_scene
from lidardesign.evaluate.statistics import bootstrap_interval, paired_difference
from lidardesign.geometry.triangles import SecondCasts
from lidardesign.registry import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.simulate.plan import EffectPlan, Planner
from lidardesign.task import notes_of

__all__ = [
    "Evaluation",
    "EvaluationRequest",
    "Paired",
    "Row",
    "evaluate",
    "score_scene",
    "worse_than_threshold",
]


# A second cast from beside also finds what a ray just passes: of rays in all directions, 2 in a million (measured).
OUTLINE_SHARE = 1e-5


@dataclass(eq=False)
class _Tally:
    """What one set of rays scored so far."""

    values: list[float] = field(default_factory=list)
    details: list[Mapping[str, float]] = field(default_factory=list)
    failures: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class _Scored:
    """All entries under a planner's effects: their tallies, a plan per scene, and the time to plan [s]."""

    tallies: Mapping[tuple[Any, ...], _Tally]
    plans: Sequence[EffectPlan]
    planning_seconds: float
    second_casts: SecondCasts


def evaluate(request: EvaluationRequest, progress: Progress | None = None) -> Evaluation:
    """Score every design and baseline on every held-out scene.

    Arguments:
        request: What to evaluate.
        progress: Called with the scenes done, all scenes, and the name of the scene.

    Raises:
        ConfigError: No scenes, designs of one name, an unknown baseline, a layout that cannot be had, or an effect that
            was named and cannot be simulated here.
        PluginError: The task's score raised, or returned something that is no finite score.
    """
    request.check()
    entries = entries_of(request)
    passes = 1 + request.audit
    scored = _score_all(request, entries, request.planner, _part(progress, 0, passes))
    rows = _rows(request, entries, scored)
    effects = summaries(scored.plans)
    audit = _audit(request, entries, rows, scored.plans, _part(progress, 1, passes)) if request.audit else None
    searches = [entry.search for entry in entries if entry.search is not None]
    plain = [row for row in rows if row.matched_to is None]
    matched = [row for row in rows if row.matched_to is not None]
    return Evaluation(
        metric=request.task.metric,
        scenes=len(request.test),
        rows=plain,
        paired=_pairs(plain, request.seed),
        equal_bandwidth=matched,
        paired_bandwidth=_bandwidth_pairs(plain, matched, request.seed),
        notes=[
            *_notes(request, entries, matched),
            *search_notes(searches, request),
            *part_notes([(entry.name, entry.positions) for entry in entries if entry.matched_to is None]),
            *slipped_notes(scored.second_casts),
            *effect_notes(effects, request.planner.choice),
        ],
        detector=request.planner.detector.name,
        effects=effects,
        planning_seconds=scored.planning_seconds,
        audit=audit,
        searches=searches,
    )


def _part(progress: Progress | None, number: int, passes: int) -> Progress | None:
    """Progress of one of several passes over the scenes."""
    if progress is None:
        return None
    return lambda done, total, name: progress(number * total + done, passes * total, name)


@phase("audit")
def _audit(
    request: EvaluationRequest,
    entries: Sequence[Entry],
    rows: Sequence[Row],
    plans: Sequence[EffectPlan],
    progress: Progress | None,
) -> Audit:
    """The same entries under all effects that there are, with the same random numbers."""
    planner = replace(request.planner, choice="all")
    scored = _score_all(request, entries, planner, progress, [planner.chosen_from(plan) for plan in plans])
    paired = zip(summaries(plans), summaries(scored.plans), strict=True)
    skipped = [planned.name for planned, every in paired if every.scenes_on > planned.scenes_on]
    unavailable = [effect.name for effect in summaries(scored.plans) if effect.missing is not None]
    metric = request.task.metric
    found = audit_rows(rows, _rows(request, entries, scored), request.seed)
    return Audit(metric.tolerance, metric.unit, found, skipped, unavailable)


@phase("held-out scenes")
def _score_all(
    request: EvaluationRequest,
    entries: Sequence[Entry],
    planner: Planner,
    progress: Progress | None,
    known: Sequence[EffectPlan] = (),
) -> _Scored:
    """All scenes, here or by workers; plans that are known are not made again."""
    jobs = {entry.key: entry for entry in entries}
    tallies = {key: _Tally() for key in jobs}
    scene_pass = ScenePass(lambda number: [entry.drawn(number) for entry in jobs.values()], planner, known)
    scenes = request.scorer(request, scene_pass, progress)
    for scene in scenes:
        for tally, (score, seconds) in zip(tallies.values(), scene.scores, strict=True):
            tally.seconds += seconds
            tally.values.append(score.value)
            tally.details.append(score.details)
            tally.failures += score.failed
    return _Scored(
        tallies,
        [scene.plan for scene in scenes],
        sum(scene.planning_seconds for scene in scenes),
        sum((scene.second_casts for scene in scenes), SecondCasts()),
    )


@phase("intervals")
def _rows(request: EvaluationRequest, entries: Sequence[Entry], scored: _Scored) -> list[Row]:
    return [_row(request, entry, scored.tallies[entry.key]) for entry in entries]


def _row(request: EvaluationRequest, entry: Entry, tally: _Tally) -> Row:
    values = np.array(tally.values)
    mean, low, high = bootstrap_interval(values, request.seed)
    return Row(
        design=entry.name,
        rays=entry.rays,
        value=mean,
        ci_low=low,
        ci_high=high,
        failures=tally.failures,
        bandwidth_mbps=entry.mbps(request.bandwidth),
        seconds=tally.seconds,
        per_scene=values,
        details=_mean_details(tally.details),
        baseline=entry.baseline,
        matched_to=entry.matched_to,
        matched_rays=entry.matched_rays,
    )


def _mean_details(scenes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each further figure over the scenes that give it; figures that are not finite are left out."""
    names = dict.fromkeys(name for details in scenes for name in details)
    given = {name: [float(details[name]) for details in scenes if name in details] for name in names}
    finite = {name: [value for value in values if math.isfinite(value)] for name, values in given.items()}
    return {name: float(np.mean(values)) for name, values in finite.items() if values}


def _pair(first: Row, second: Row, seed: int, rays_b: int | None = None) -> Paired:
    mean, low, high = paired_difference(first.per_scene, second.per_scene, seed)
    return Paired(first.design, second.design, first.rays, mean, low, high, rays_b)


@phase("intervals")
def _pairs(rows: Sequence[Row], seed: int) -> list[Paired]:
    """Every design against every baseline and every later design, at equal numbers of rays."""
    return [
        _pair(row, other, seed)
        for index, row in enumerate(rows)
        if not row.baseline
        for other in rows[index + 1 :]
        if other.rays == row.rays and other.design != row.design
    ]


@phase("intervals")
def _bandwidth_pairs(rows: Sequence[Row], matched: Sequence[Row], seed: int) -> list[Paired]:
    designs = {(row.design, row.rays): row for row in rows if not row.baseline}
    return [_pair(designs[row.matched_to, row.matched_rays], row, seed, row.rays) for row in matched]


def _notes(request: EvaluationRequest, entries: Sequence[Entry], matched: Sequence[Row]) -> list[str]:
    notes = left_out(request.designs, request.rays)
    positions = max(len(entry.positions) for entry in entries)
    if positions > 1:
        notes.append(f"rays and bandwidth count per position; every scene is seen from {positions} positions")
    if len(request.test) == 1:
        notes.append("one held-out scene: intervals have no width and say nothing about other scenes")
    with plugin_guard(request.task.name):
        notes += notes_of(request.task, request.config, request.space)
    for design in request.designs:
        notes += outside_notes(design, request.space)
    empty = [row for row in matched if row.rays == 0]
    if empty:
        names = ", ".join(sorted({row.design for row in empty}))
        notes.append(
            f"at equal bandwidth not one ray of {names} fits in {len(empty)} rows, which fail in every scene"
        )
    return notes


def search_notes(searches: Sequence[Record], request: EvaluationRequest) -> list[str]:
    """How the rows of `cma` were found."""
    return [record.note(request.designs[0].name, request.task.metric) for record in searches]


def slipped_notes(casts: SecondCasts) -> list[str]:
    """How many rays slipped between the triangles of meshes, where that are more than pass their outlines."""
    if casts.found <= OUTLINE_SHARE * casts.rays:
        return []
    return [
        f"{casts.found:,} of {casts.rays:,} rays ({casts.found / casts.rays:.2%}) had slipped between triangles, as "
        "happens at the vertices of a mesh; a second cast from beside found what they meet"
    ]
