"""Scores of designs and baselines on held-out scenes, at equal rays and at equal bandwidth.

Honest by construction: every design and baseline sees the same scenes; a scene where the returns are too few
to score counts as a failure at the metric's worst value and is never dropped; baselines are built from
training scenes alone. In each scene the rays of all rows are traced together, frame by frame, and rows that fire the
same rays are scored once. All rows of a scene meet the same effects: those that the scene calls for with any of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.compare import outside_notes
from lidardesign.design.layouts.rays import gates_of, layout_of
from lidardesign.design.layouts.track import travels
from lidardesign.design.sensor import CERTIFICATES, DesignSpec
from lidardesign.errors import BackgroundNote, ConfigError
from lidardesign.evaluate.baselines.candidates import Candidate, RaysPerCondition, mean_mbps
from lidardesign.evaluate.baselines.catalog import part_notes
from lidardesign.evaluate.baselines.greedy import GREEDY, USUAL_SCENES, Fired, GreedyCandidate, greedy_rays
from lidardesign.evaluate.baselines.simple import CMA, Baselines, Option, TwinCandidate
from lidardesign.evaluate.baselines.views import TrainingViews
from lidardesign.evaluate.cma.candidate import CmaCandidate, SearchRecord
from lidardesign.evaluate.cma.search import TrainingObjective
from lidardesign.evaluate.effects import effect_notes, effect_summaries
from lidardesign.evaluate.mounting import MountError
from lidardesign.evaluate.request import EvaluationRequest, can_fire, fired_numbers, left_out
from lidardesign.evaluate.results import (
    Audit,
    Evaluation,
    Mounting,
    Paired,
    Row,
    audit_rows,
    middle_rays,
)
from lidardesign.evaluate.rivals import StrongestRival, strongest_rival
from lidardesign.evaluate.scene_scores import Progress, silent_notes
from lidardesign.evaluate.statistics import FEWEST_RESAMPLED, mean_interval, paired_difference
from lidardesign.geometry.triangles import SecondCasts
from lidardesign.numerics import ROUNDING
from lidardesign.registry import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.scene import Scene, group_numbers
from lidardesign.selection.candidates import CANDIDATES_PER_RAY
from lidardesign.simulate.plan import EffectPlan, Planner
from lidardesign.task import Metric, Score, conditions_of, notes_of

# Candidates of a baseline are compared on this many training scenes: enough to tell a good layout from a bad one,
# at a fraction of the held-out scenes' cost.
JUDGED_SCENES = 8


@dataclass(frozen=True, eq=False)
class Entry:
    """One row to be.

    Arguments:
        name: The design's or baseline's.
        positions: The rays per condition value.
        baseline: Whether it is a baseline.
        redraw: Rays of a scene, for what is drawn anew in each.
        matched_to, matched_rays: The design and its number of rays whose bandwidth this baseline was given.
        search: How a direct search found its rays.
    """

    name: str
    positions: RaysPerCondition
    baseline: bool
    redraw: Callable[[int], RaysPerCondition] | None = None
    matched_to: str | None = None
    matched_rays: int | None = None
    search: SearchRecord | None = None

    @property
    def rays(self) -> int:
        """Rays per condition value."""
        return len(self.positions[0])

    def mbps(self, bandwidth: Bandwidth) -> float:
        """What its rays cost to read out, averaged over condition values [Mbit/s]."""
        return mean_mbps(self.positions, bandwidth)

    def drawn(self, scene: int) -> RaysPerCondition:
        """The rays that it fires in a held-out scene."""
        return self.positions if self.redraw is None else self.redraw(scene)

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """Equal for entries that fire the same rays."""
        if not self.baseline:
            return ("design", self.name, self.rays)
        arrays = (array for rays in self.positions for array in (rays.origin_m, rays.direction, rays.gate_m))
        return (self.name, *(array.tobytes() for array in arrays))


@phase("rays")
def entries_of(request: EvaluationRequest) -> list[Entry]:
    """All rows to be: designs at the numbers of rays that they can fire, baselines, then those at each one's bandwidth.

    Raises:
        ConfigError: No design can fire any of the numbers of rays, or a track ends before where it is evaluated.
    """
    conditions = _conditions(request)
    _check_tracks(request, conditions)
    counts = fired_numbers(request.designs, request.rays)
    designs = [
        Entry(design.name, _laid_out(request, conditions, design, count), baseline=False)
        for design in request.designs
        for count in counts
        if can_fire(design, count)
    ]
    choosable = [] if request.greedy is None else greedy_rays(request.task, len(conditions), counts)[0]
    baselines = Baselines(
        request.space,
        request.train,
        request.seed,
        partial(_judge, request),
        conditions=conditions,
        gates_per_ray=any(has_gates_per_ray(design) for design in request.designs),
        without_visibility=partial(_twin, request, conditions) if request.without_visibility else None,
        density=request.density,
        optimised=partial(_optimised, request, conditions) if request.designs else None,
        chosen=partial(_chosen, request, conditions, designs, max(choosable, default=0)),
    )
    wanted: list[tuple[str, list[Option], Entry | None]] = [
        (name, baselines.options(name, count), None)
        for name in request.baselines
        for count in counts
        if name != GREEDY or count in choosable
    ]
    if request.equal_bandwidth:
        wanted += [
            (name, baselines.options_within(name, entry.mbps(request.bandwidth), request.bandwidth), entry)
            for entry in designs
            for name in request.baselines
            if name != CMA or entry.name == request.designs[0].name
            if name != GREEDY or entry.rays in choosable
        ]
    chosen = baselines.best([(name, options) for name, options, _ in wanted])
    return designs + [
        _entry(baselines, name, option, matched) for (name, _, matched), option in zip(wanted, chosen, strict=True)
    ]


def has_gates_per_ray(design: DesignSpec) -> bool:
    """Whether a design's rays have gates of their own, be it that each is a sensor."""
    return gates_of(design) == "ray" or layout_of(design).one_sensor_per_ray


def _check_tracks(request: EvaluationRequest, conditions: Sequence[Mapping[str, float]]) -> None:
    for design in request.designs:
        if design.track is None:
            continue
        name, (first, last) = design.track.dimension, travels(design.track)
        if any(name not in one for one in conditions):
            raise ConfigError(
                f"its rays follow {name}, which the task {request.task.name} does not have as a condition",
                where=f"design {design.name}",
                hint="fit a design at one value: lidardesign fit RUN --at",
            )
        beyond = [one[name] for one in conditions if not first <= one[name] <= last]
        if beyond:
            raise ConfigError(
                f"its track goes from {name}={first:g} to {last:g}, but designs are evaluated at {beyond[0]:g} too",
                where=f"design {design.name}",
                hint="fit a track of the whole way: lidardesign fit RUN",
            )


def _entry(baselines: Baselines, name: str, option: Option, matched: Entry | None) -> Entry:
    candidate, count = option.candidate, len(option.positions[0])
    return Entry(
        name,
        option.positions,
        baseline=True,
        redraw=partial(candidate.positions, baselines.spaces, count) if candidate.drawn_anew else None,
        matched_to=None if matched is None else matched.name,
        matched_rays=None if matched is None else matched.rays,
        search=candidate.record_of(option.positions) if isinstance(candidate, CmaCandidate) else None,
    )


def _conditions(request: EvaluationRequest) -> list[dict[str, float]]:
    with plugin_guard(request.task.name):
        return conditions_of(request.task, request.config, request.space)


def ordered_conditions(request: EvaluationRequest) -> list[dict[str, float]]:
    """The condition values that are evaluated at, ascending; one empty entry without conditions."""
    return sorted(_conditions(request), key=lambda condition: tuple(condition.values()))


def _laid_out(
    request: EvaluationRequest, conditions: Sequence[Mapping[str, float]], design: DesignSpec, count: int
) -> RaysPerCondition:
    samples = request.samples.get(design.name)
    return tuple(request.lay_out(design, count, samples, at=condition) for condition in conditions)


def _twin(request: EvaluationRequest, conditions: Sequence[Mapping[str, float]]) -> Candidate:
    return TwinCandidate(*request.without_visibility(), conditions, request.lay_out)


def _optimised(
    request: EvaluationRequest, conditions: Sequence[Mapping[str, float]], views: TrainingViews
) -> Candidate:
    return CmaCandidate(
        followed=request.designs[0],
        space=request.space,
        conditions=conditions,
        views=views,
        objective=TrainingObjective(request.task, request.metric, request.train, request.planner, request.seed),
        settings=request.cma,
        seed=request.seed,
    )


def _chosen(
    request: EvaluationRequest,
    conditions: Sequence[Mapping[str, float]],
    designs: Sequence[Entry],
    most: int,
    views: TrainingViews,
) -> Candidate:
    numbers = [one["scenes"] for design in request.designs for one in design.provenance.get(CERTIFICATES, ())]
    return GreedyCandidate(
        task=request.task,
        views=views,
        spaces=[request.space.at(condition) for condition in conditions],
        source=request.greedy,
        scenes=max(numbers, default=USUAL_SCENES),
        gates_per_ray=any(has_gates_per_ray(design) for design in request.designs),
        candidates=CANDIDATES_PER_RAY * most,
        fired=[Fired(entry.rays, entry.mbps(request.bandwidth)) for entry in designs],
        bandwidth=request.bandwidth,
    )


def _judge(request: EvaluationRequest, lists: Sequence[RaysPerCondition]) -> list[float]:
    """The mean score of sets of rays on a few training scenes, turned so that lower is better."""
    scenes = request.train[:JUDGED_SCENES]
    objective = TrainingObjective(request.task, request.metric, scenes, request.planner, request.seed)
    if not objective.scenes:
        return [0.0] * len(lists)
    # one row per scene, whose rows are added one after the other
    return np.array(objective.values(lists, range(len(objective.scenes))).T, order="C").mean(axis=0).tolist()


# A second cast from beside also finds what a ray just passes: of rays in all directions, 2 in a million (measured).
OUTLINE_SHARE = 1e-5


@dataclass(frozen=True, eq=False)
class _Scored:
    """All entries under a planner's effects: by key their score in every scene, each with the time that it took [s];
    a plan per scene, and the time to plan [s]."""

    scores: Mapping[tuple[Any, ...], Sequence[tuple[Score, float]]]
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
    passes = 1 + request.audit + (request.mount_error is not None)
    scored = _score_all(request, entries, request.planner, _part(progress, 0, passes))
    rows = _rows(request, entries, scored)
    effects = effect_summaries(scored.plans)
    audit = _audit(request, entries, rows, scored.plans, _part(progress, 1, passes)) if request.audit else None
    last = _part(progress, passes - 1, passes)
    mounting = request.mount_error and _mounting(request, request.mount_error, entries, rows, scored.plans, last)
    searches = [entry.search for entry in entries if entry.search is not None]
    plain = [row for row in rows if row.matched_to is None]
    matched = [row for row in rows if row.matched_to is not None]
    return Evaluation(
        metric=request.metric,
        scenes=len(request.test),
        rows=plain,
        paired=_pairs(plain, request.seed),
        equal_bandwidth=matched,
        paired_bandwidth=_bandwidth_pairs(plain, matched, request.seed),
        notes=[
            *_notes(request, entries, matched),
            *worst_notes([*plain, *matched], request.metric),
            *(search.note(request.designs[0].name, request.metric) for search in searches),
            *part_notes([(entry.name, entry.positions) for entry in entries if entry.matched_to is None]),
            *slipped_notes(scored.second_casts),
            *effect_notes(effects, request.planner.choice),
        ],
        detector=request.planner.detector.name,
        effects=effects,
        planning_seconds=scored.planning_seconds,
        audit=audit,
        mounting=mounting,
        searches=searches,
        strongest_rival=_strongest_rival(request, entries, middle_rays(plain)),
    )


def _strongest_rival(request: EvaluationRequest, entries: Sequence[Entry], rays: int) -> StrongestRival | None:
    rivals = [entry for entry in entries if entry.baseline and entry.matched_to is None and entry.rays == rays]
    fired = sum(entry.rays for entry in entries) * len(request.test)
    return strongest_rival(request, {entry.name: entry.drawn for entry in rivals}, rays, fired)


def _part(progress: Progress | None, number: int, passes: int) -> Progress | None:
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
    paired = list(zip(effect_summaries(plans), effect_summaries(scored.plans), strict=True))
    metric = request.metric
    return Audit(
        metric.tolerance,
        metric.unit,
        audit_rows(rows, _rows(request, entries, scored), request.seed),
        skipped=[planned.name for planned, every in paired if every.scenes_on > planned.scenes_on],
        unavailable=[every.name for _, every in paired if every.missing is not None],
    )


@phase("mounting")
def _mounting(
    request: EvaluationRequest,
    error: MountError,
    entries: Sequence[Entry],
    rows: Sequence[Row],
    plans: Sequence[EffectPlan],
    progress: Progress | None,
) -> Mounting:
    """The entries at equal rays with misplaced sensors, under the same effects, and what that costs them."""
    careless = [
        replace(entry, name=str(number), redraw=partial(_misplaced, error, entry, request.seed))
        for number, entry in enumerate(entries)
        if entry.matched_to is None
    ]
    scored = _score_all(request, careless, request.planner, progress, plans)
    exact = [row for row in rows if row.matched_to is None]
    found = [replace(row, design=own.design) for row, own in zip(_rows(request, careless, scored), exact, strict=True)]
    return Mounting(error, found, [_pair(row, own, request.seed) for row, own in zip(found, exact, strict=True)])


def _misplaced(error: MountError, entry: Entry, seed: int, scene: int) -> RaysPerCondition:
    return error.misplaced(entry.drawn(scene), seed, scene)


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
    scene_pass = request.scene_pass(lambda number: [entry.drawn(number) for entry in jobs.values()], planner, known)
    scenes = request.scorer(scene_pass, progress)
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
    mean, low, high = mean_interval(values, request.seed, groups)
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
    )


def _pair(first: Row, second: Row, seed: int, rays_b: int | None = None) -> Paired:
    mean, low, high = paired_difference(first.per_scene, second.per_scene, seed, first.groups)
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
    notes, positions = left_out(request.designs, request.rays), max(len(entry.positions) for entry in entries)
    if positions > 1:
        counted = f"rays and bandwidth count per position; every scene is seen from {positions} positions"
        notes.append(BackgroundNote(counted))
    notes += group_notes(request.test)
    if GREEDY in request.baselines and request.greedy is not None:
        notes += greedy_rays(request.task, positions, request.rays)[1]
    with plugin_guard(request.task.name):
        notes += notes_of(request.task, request.config, request.space)
    for design in request.designs:
        notes += outside_notes(design, request.space)
    own = sorted((entry for entry in entries if not entry.baseline), key=lambda entry: entry.rays)
    # of each design the most rays, which come last
    fired = {f"{entry.name!r}": entry.positions for entry in own}
    notes += silent_notes(request.test, fired)
    empty = [row for row in matched if row.rays == 0]
    if empty:
        names = ", ".join(sorted({row.design for row in empty}))
        notes.append(f"at equal bandwidth not one ray of {names} fits in {len(empty)} rows, which fail in every scene")
    return notes


def group_notes(scenes: Sequence[Scene]) -> list[str]:
    """What intervals are over, where that are not just the held-out scenes."""
    groups = int(group_numbers(scenes).max()) + 1
    if len(scenes) == 1:
        return ["one held-out scene: it says nothing about others, so there are no intervals"]
    if groups == 1:
        return [f"all {len(scenes)} held-out scenes are of one group, {scenes[0].group!r}: there are no intervals"]
    if groups == len(scenes):
        return []
    kind = "intervals" if groups >= FEWEST_RESAMPLED else "Student's t intervals"
    return [BackgroundNote(f"the {len(scenes)} held-out scenes are of {groups} groups, and {kind} are over groups")]


def worst_notes(rows: Sequence[Row], metric: Metric) -> list[str]:
    """How many scenes score the worst value: what they differ in beyond it is not seen.

    The row that is named is a design's, if one of them has such scenes, and has the most of them; rows without rays
    have a note of their own.
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
    """How many rays slipped between the triangles of meshes, where that are more than pass their outlines."""
    if casts.found <= OUTLINE_SHARE * casts.rays:
        return []
    note = f"{casts.found:,} of {casts.rays:,} rays ({casts.found / casts.rays:.2%}) had slipped between triangles, as "
    return [BackgroundNote(f"{note}happens at the vertices of a mesh; a second cast from beside found what they meet")]
