"""Scores of designs and baselines on held-out scenes, at equal rays and at equal bandwidth.

Honest by construction: every design and baseline sees the same scenes; a scene where the returns are too few
to score counts as a failure at the metric's worst value and is never dropped; baselines are built from
training scenes alone. In each scene the rays of all rows are traced together, frame by frame, and rows that fire the
same rays are scored once. All rows of a scene meet the same effects: those that the scene calls for with any of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lidardesign.constraints.check import check_design
from lidardesign.constraints.slack import broken_notes
from lidardesign.errors import BackgroundNote
from lidardesign.estimates import (
    FEW_GROUPS,
    mean_interval,
    paired_difference,
    relative_difference,
    worst_tenth,
)
from lidardesign.evaluation.entries import Entry, design_entries, effect_notes, effect_summaries, strongest_baseline
from lidardesign.evaluation.mounting import MountError
from lidardesign.evaluation.request import EvaluationRequest, fired_numbers, missing_row_notes
from lidardesign.evaluation.results import Audit, AuditRow, Evaluation, Mounting, Paired, Row, middle_rays
from lidardesign.evaluation.rivals import Rivals, rivals_of
from lidardesign.limits import MOST_RAYS
from lidardesign.numerics import ROUNDING
from lidardesign.plugins import plugin_guard
from lidardesign.run.clock import Progress, phase
from lidardesign.scenes.scene import Scene, group_numbers
from lidardesign.scenes.triangles import SecondCasts
from lidardesign.scoring.fired import Positions, assign_devices, without_each
from lidardesign.scoring.scene_scores import score_scenes, silent_notes
from lidardesign.sensors.adaptive import AdaptiveRays
from lidardesign.sensors.compare import outside_notes
from lidardesign.sensors.design_file import design_document
from lidardesign.simulate.calibration import light_notes
from lidardesign.simulate.plan import EffectPlan, Planner
from lidardesign.task import Metric, Score, notes_of

# A second cast from beside also finds what a ray just passes: of rays in all directions, 2 in a million (measured).
OUTLINE_SHARE = 1e-5


@dataclass(frozen=True, eq=False)
class _Scored:
    """Scores of all entries by key and scene, each with its time [s]; a plan per scene, and the time to plan [s]."""

    scores: Mapping[tuple[Any, ...], Sequence[tuple[Score, float]]]
    plans: Sequence[EffectPlan]
    planning_seconds: float
    second_casts: SecondCasts


def evaluate(request: EvaluationRequest, progress: Progress | None = None) -> Evaluation:
    """Score every design and baseline on every held-out scene.

    Arguments:
        request: The request.
        progress: Called with the name of the scene, the scenes done, and all scenes.

    Raises:
        ConfigError: No scenes, designs of one name, an unknown baseline, a layout that cannot be had, or an effect that
            was named and cannot be simulated here.
        PluginError: The task's score raised, or returned something that is no finite score.
    """
    request.check()
    counts = fired_numbers(request.designs, request.rays)
    designs = design_entries(request, counts)
    rivals = rivals_of(request, designs, [count for count in counts if count not in request.alone])
    entries = [*designs, *rivals.entries]
    passes = 1 + request.audit + bool(request.sensors_to_lose) + (request.mount_error is not None)
    scored = _score_all(request, entries, request.planner, progress_of_part(progress, 0, passes))
    losses = (
        _losses(request, entries, scored.plans, progress_of_part(progress, 1, passes))
        if request.sensors_to_lose
        else {}
    )
    rows = [replace(row, lost=losses.get(n, ())) for n, row in enumerate(_rows(request, entries, scored))]
    effects = effect_summaries(scored.plans)
    audit = (
        _audit(request, entries, rows, scored.plans, progress_of_part(progress, passes - 2, passes))
        if request.audit
        else None
    )
    last = progress_of_part(progress, passes - 1, passes)
    mounting = request.mount_error and _mounting(request, request.mount_error, entries, rows, scored.plans, last)
    searches = [entry.search for entry in entries if entry.search is not None]
    plain = [row for row in rows if row.matched_to is None]
    matched = [row for row in rows if row.matched_to is not None]
    return Evaluation(
        metric=request.metric,
        scenes=len(request.test),
        rows=plain,
        paired=_pairs(plain, request.metric),
        equal_bandwidth=matched,
        paired_bandwidth=_bandwidth_pairs(plain, matched, request.metric),
        notes=[
            *_notes(request, entries, rivals, matched),
            *worst_notes([*plain, *matched], request.metric),
            *(search.note(request.designs[0].name, request.metric) for search in searches),
            *slipped_notes(scored.second_casts),
            *effect_notes(effects, request.planner.choice),
        ],
        detector=request.planner.detector.name,
        effects=effects,
        planning_seconds=scored.planning_seconds,
        audit=audit,
        mounting=mounting,
        searches=searches,
        strongest_baseline=strongest_baseline(request, entries, middle_rays(plain)),
        named=request.named,
    )


def progress_of_part(progress: Progress | None, number: int, parts: int) -> Progress | None:
    """Progress within one of several parts of a work, as progress within all of it."""
    if progress is None:
        return None
    return lambda name, done, total: progress(name, number * total + done, parts * total)


@phase("audit")
def _audit(
    request: EvaluationRequest,
    entries: Sequence[Entry],
    rows: Sequence[Row],
    plans: Sequence[EffectPlan],
    progress: Progress | None,
) -> Audit:
    """The audit: the same entries under all effects, with the same random numbers."""
    scored = _score_all(request, entries, replace(request.planner, choice="all"), progress)
    paired = list(zip(effect_summaries(plans), effect_summaries(scored.plans), strict=True))
    metric = request.metric
    return Audit(
        metric.tolerance,
        metric.unit,
        [
            AuditRow(row, other, *paired_difference(row.per_scene, other.per_scene, row.groups, limits=metric.limits))
            for row, other in zip(rows, _rows(request, entries, scored), strict=True)
        ],
        skipped=[planned.name for planned, every in paired if every.scenes_on > planned.scenes_on],
        unavailable=[every.name for _, every in paired if every.missing is not None],
    )


@phase("losses")
def _losses(
    request: EvaluationRequest, entries: Sequence[Entry], plans: Sequence[EffectPlan], progress: Progress | None
) -> dict[int, tuple[float, ...]]:
    """The mean score of entries without each of their sensors, by the entry's number, under the same effects."""
    sensors = request.sensors_to_lose
    lost = {
        (number, sensor): replace(entry, name=f"{entry.name}/{sensor}", positions=left)
        for number, entry in enumerate(entries)
        if not entry.baseline and entry.name in sensors and not isinstance(entry.positions, AdaptiveRays)
        for sensor, left in enumerate(without_each(entry.positions, sensors[entry.name]))
    }
    scored = _score_all(request, list(lost.values()), request.planner, progress, plans)
    means = [
        (number, float(np.mean([score.value for score, _ in scored.scores[entry.key]])))
        for (number, _), entry in lost.items()
    ]
    return {own: tuple(mean for number, mean in means if number == own) for own, _ in means}


@phase("mounting")
def _mounting(
    request: EvaluationRequest,
    error: MountError,
    entries: Sequence[Entry],
    rows: Sequence[Row],
    plans: Sequence[EffectPlan],
    progress: Progress | None,
) -> Mounting:
    """The entries at equal rays with mounting errors, under the same effects, and their cost."""
    misplaced = [
        replace(entry, name=str(number), redraw=partial(_misplaced, error, entry, request.seed))
        for number, entry in enumerate(entries)
        if entry.matched_to is None
    ]
    scored = _score_all(request, misplaced, request.planner, progress, plans)
    exact = [row for row in rows if row.matched_to is None]
    found = [replace(row, design=own.design) for row, own in zip(_rows(request, misplaced, scored), exact, strict=True)]
    return Mounting(error, found, [_pair(row, own, request.metric) for row, own in zip(found, exact, strict=True)])


def _misplaced(error: MountError, entry: Entry, seed: int, scene: int) -> Positions:
    return error.misplaced(entry.rays_in(scene), seed, scene)


@phase("held-out scenes")
def _score_all(
    request: EvaluationRequest,
    entries: Sequence[Entry],
    planner: Planner,
    progress: Progress | None,
    known: Sequence[EffectPlan] = (),
) -> _Scored:
    """Score all entries in all scenes, here or by workers; `known` plans are not made again."""
    jobs = {entry.key: entry for entry in entries}
    is_own = planner is request.planner
    preparation = request.preparation if is_own else replace(request.world, planner=planner).new_preparation()
    # for misplaced rays as for those in their place
    lists = [assign_devices(entry.positions, entry.devices) for entry in jobs.values()]
    scenes = score_scenes(
        request.task,
        request.metric,
        request.seed,
        request.test,
        lambda number: [entry.lit_in(number) for entry in jobs.values()],
        planner,
        known,
        progress,
        request.starmap,
        preparation.of(lists, starmap=request.starmap),
    )
    of_entries = zip(*(scene.scores for scene in scenes), strict=True)
    return _Scored(
        dict(zip(jobs, of_entries, strict=True)),
        [scene.plan for scene in scenes],
        sum(scene.planning_seconds for scene in scenes),
        sum((scene.second_casts for scene in scenes), SecondCasts()),
    )


@phase("intervals")
def _rows(request: EvaluationRequest, entries: Sequence[Entry], scored: _Scored) -> list[Row]:
    return [_row(request, entry, scored.scores[entry.key]) for entry in entries]


def _row(request: EvaluationRequest, entry: Entry, scores: Sequence[tuple[Score, float]]) -> Row:
    values = np.array([score.value for score, _ in scores])
    groups = group_numbers(request.test)
    mean, low, high = mean_interval(values, groups, limits=request.metric.limits)
    # the mean of each further figure over the scenes that give it; figures that are not finite are left out
    finite: dict[str, list[float]] = {}
    for name, value in (item for score, _ in scores for item in score.details.items()):
        finite.setdefault(name, []).extend([float(value)] * math.isfinite(value))
    return Row(
        design=entry.name,
        rays=entry.rays,
        value=mean,
        ci_low=low,
        ci_high=high,
        failures=sum(score.failed for score, _ in scores),
        bandwidth_mbps=entry.mbps(request.bandwidth),
        seconds=sum(seconds for _, seconds in scores),
        per_scene=values,
        details={name: float(np.mean(values)) for name, values in finite.items() if values},
        baseline=entry.baseline,
        matched_to=entry.matched_to,
        matched_rays=entry.matched_rays,
        groups=groups,
        worst_decile=worst_tenth(values, request.metric.better),
        better=request.metric.better,
        gates=entry.gates,
    )


def _pair(first: Row, second: Row, metric: Metric, rays_b: int | None = None) -> Paired:
    values = first.per_scene, second.per_scene, first.groups
    apart, percent = paired_difference(*values, limits=metric.limits), relative_difference(*values)
    return Paired(first.design, second.design, first.rays, *apart, rays_b, percent)


@phase("intervals")
def _pairs(rows: Sequence[Row], metric: Metric) -> list[Paired]:
    """Every design against every baseline and every later design, at equal numbers of rays."""
    return [
        _pair(row, other, metric)
        for index, row in enumerate(rows)
        if not row.baseline
        for other in rows[index + 1 :]
        if other.rays == row.rays and other.design != row.design
    ]


@phase("intervals")
def _bandwidth_pairs(rows: Sequence[Row], matched: Sequence[Row], metric: Metric) -> list[Paired]:
    designs = {(row.design, row.rays): row for row in rows if not row.baseline}
    return [_pair(designs[row.matched_to, row.matched_rays], row, metric, row.rays) for row in matched]


def _notes(request: EvaluationRequest, entries: Sequence[Entry], rivals: Rivals, matched: Sequence[Row]) -> list[str]:
    positions = max(len(entry.positions) for entry in entries if not isinstance(entry.positions, AdaptiveRays))
    notes = missing_row_notes(request.designs, request.rays, request.alone)
    if positions > 1:
        counted = f"rays and bandwidth are per position; every scene is seen from {positions} positions"
        notes.append(BackgroundNote(counted))
    notes += group_notes(request.test)
    notes += rivals.notes
    with plugin_guard(request.task.name):
        notes += notes_of(request.task, request.config, request.space)
    for design in request.designs:
        notes += outside_notes(design, request.space) + light_notes(design, request.planner.detector)
        notes += broken_notes(design.name, check_design(design_document(design), design.constraints, request.space))
    own = sorted((entry for entry in entries if not entry.baseline), key=lambda entry: entry.rays)
    # of each design the most rays, which come last
    notes += silent_notes(request.test, {f"{entry.name!r}": entry.positions for entry in own})
    if rivals.unbounded:
        designs, names = (", ".join(sorted(set(column))) for column in zip(*rivals.unbounded, strict=True))
        notes.append(
            f"more than {MOST_RAYS:,} rays of {names} fit in the bandwidth of {designs}: they are not compared at "
            "equal bandwidth; the gates are far longer than what scenes return"
        )
    empty = [row for row in matched if row.rays == 0]
    if empty:
        names = ", ".join(sorted({row.design for row in empty}))
        notes.append(f"at equal bandwidth not one ray of {names} fits in {len(empty)} rows, which fail in every scene")
    return notes


def group_notes(scenes: Sequence[Scene]) -> list[str]:
    """Lines on missing intervals and on intervals over groups of scenes."""
    groups = int(group_numbers(scenes).max()) + 1
    if len(scenes) == 1:
        return ["only one held-out scene, so there are no intervals"]
    if groups == 1:
        return [f"all {len(scenes)} held-out scenes are of one group, {scenes[0].group!r}: there are no intervals"]
    of = f"the {len(scenes)} held-out scenes are of {groups} groups" if groups < len(scenes) else ""
    if groups < FEW_GROUPS:
        return [f"{of or f'{groups} held-out scenes'}: few groups, so intervals are wide and rough"]
    return [BackgroundNote(f"{of}, and intervals are over groups")] if of else []


def worst_notes(rows: Sequence[Row], metric: Metric) -> list[str]:
    """A line on scenes that score the worst value, which hides any differences beyond it.

    It names the row with the most such scenes, a design if any has them; rows without rays have a note of their own.
    """
    counts = [int(np.isclose(row.per_scene, metric.worst, rtol=ROUNDING, atol=0.0).sum()) for row in rows]
    some = [(row, count) for row, count in zip(rows, counts, strict=True) if count and row.rays]
    if not some:
        return []
    row, count = max(some, key=lambda one: (not one[0].baseline, one[1]))
    note = f"{count} of {len(row.per_scene)} scenes of {row.design!r} at {row.rays} rays score the worst value, "
    note += f"{metric.worst:g} {metric.unit}".rstrip()
    if row.failures:
        note += f" ({row.failures} failed)"
    others = len(some) - 1
    further = f"{others} other rows" if others > 1 else "another row"
    note = f"{note}; so do some of {further}" if others else note
    return [BackgroundNote(note) if row.baseline else note]


def slipped_notes(casts: SecondCasts) -> list[str]:
    """A line on rays that slipped between the triangles of meshes, where they are more than outlines explain."""
    if casts.found <= OUTLINE_SHARE * casts.rays:
        return []
    return [
        BackgroundNote(
            f"{casts.found:,} of {casts.rays:,} rays ({casts.found / casts.rays:.2%}) had slipped between triangles, "
            "as happens at the vertices of a mesh; a second cast, slightly shifted, found what they meet"
        )
    ]
