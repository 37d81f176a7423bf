"""The rows of an evaluation to be: who fires which rays, at how many and in whose bandwidth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.layouts.track import travels
from lidardesign.errors import ConfigError
from lidardesign.evaluate.baselines.candidates import Candidate, Positions, mean_mbps
from lidardesign.evaluate.baselines.no_visibility import TwinCandidate
from lidardesign.evaluate.baselines.observed import TrainingViews
from lidardesign.evaluate.baselines.simple import CMA, Baselines, Judge, Option
from lidardesign.evaluate.cma.candidate import CmaCandidate, Record
from lidardesign.evaluate.cma.objective import TrainingObjective
from lidardesign.evaluate.request import EvaluationRequest, can_fire, fired_numbers
from lidardesign.evaluate.scene_scores import score_lists
from lidardesign.registry import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.simulate.simulate import build_casters
from lidardesign.task import conditions_of

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
    positions: Positions
    baseline: bool
    redraw: Callable[[int], Positions] | None = None
    matched_to: str | None = None
    matched_rays: int | None = None
    search: Record | None = None

    @property
    def rays(self) -> int:
        """Rays per condition value."""
        return len(self.positions[0])

    def mbps(self, bandwidth: Bandwidth) -> float:
        """What its rays cost to read out, averaged over condition values [Mbit/s]."""
        return mean_mbps(self.positions, bandwidth)

    def drawn(self, scene: int) -> Positions:
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
    _check_tracks(request)
    baselines = _baselines(request)
    counts = fired_numbers(request.designs, request.rays)
    designs = [
        Entry(design.name, _laid_out(request, design, count), baseline=False)
        for design in request.designs
        for count in counts
        if can_fire(design, count)
    ]
    wanted = [
        _Wanted(name, baselines.options(name, count), None) for name in request.baselines for count in counts
    ]
    if request.equal_bandwidth:
        wanted += [
            _Wanted(name, baselines.options_within(name, entry.mbps(request.bandwidth), request.bandwidth), entry)
            for entry in designs
            for name in request.baselines
            if name != CMA or entry.name == request.designs[0].name
        ]
    chosen = baselines.best([(one.name, one.options) for one in wanted])
    return designs + [_entry(baselines, one, option) for one, option in zip(wanted, chosen, strict=True)]


def _check_tracks(request: EvaluationRequest) -> None:
    """Refuse a track that ends before a place where designs are evaluated."""
    for design in request.designs:
        if design.track is None:
            continue
        name, (first, last) = design.track.dimension, travels(design.track)
        beyond = [one[name] for one in _conditions(request) if name in one and not first <= one[name] <= last]
        if beyond:
            raise ConfigError(
                f"its track goes from {name}={first:g} to {last:g}, but designs are evaluated at {beyond[0]:g} too",
                where=f"design {design.name}",
                hint="fit a track of the whole way: lidardesign fit RUN",
            )


@dataclass(frozen=True, eq=False)
class _Wanted:
    """A baseline that is asked for, maybe in the bandwidth of a design."""

    name: str
    options: list[Option]
    matched: Entry | None


def _entry(baselines: Baselines, wanted: _Wanted, option: Option) -> Entry:
    candidate, count = option.candidate, len(option.positions[0])
    redraw = None
    if candidate.drawn_anew:

        def redraw(scene: int) -> Positions:
            return candidate.positions(baselines.spaces, count, scene)

    search = candidate.record_of(option.positions) if isinstance(candidate, CmaCandidate) else None
    made = Entry(wanted.name, option.positions, True, redraw, search=search)
    matched = wanted.matched
    return made if matched is None else replace(made, matched_to=matched.name, matched_rays=matched.rays)


def _baselines(request: EvaluationRequest) -> Baselines:
    return Baselines(
        request.space,
        request.train,
        request.seed,
        _judge(request),
        conditions=_conditions(request),
        without_visibility=_twin(request),
        density=request.density,
        optimised=_optimised(request),
    )


def _conditions(request: EvaluationRequest) -> list[dict[str, float]]:
    with plugin_guard(request.task.name):
        return conditions_of(request.task, request.config, request.space)


def ordered_conditions(request: EvaluationRequest) -> list[dict[str, float]]:
    """The condition values that are evaluated at, ascending; one empty entry without conditions."""
    return sorted(_conditions(request), key=lambda condition: tuple(condition.values()))


def middle_condition(request: EvaluationRequest) -> dict[str, float]:
    """The condition value in the middle of those that are evaluated at, for drawings; empty without conditions."""
    ordered = ordered_conditions(request)
    return ordered[len(ordered) // 2]


def _laid_out(request: EvaluationRequest, design: Any, count: int) -> Positions:
    samples = request.samples.get(design.name)
    return tuple(request.lay_out(design, count, samples, at=condition) for condition in _conditions(request))


def _twin(request: EvaluationRequest) -> Callable[[], Candidate] | None:
    make = request.without_visibility
    if make is None:
        return None

    def candidate() -> Candidate:
        design, samples = make()
        return TwinCandidate(design, samples, _conditions(request), request.lay_out)

    return candidate


def _optimised(request: EvaluationRequest) -> Callable[[TrainingViews], Candidate] | None:
    """What makes the layout of `cma`, about the first design."""
    if not request.designs:
        return None

    def candidate(views: TrainingViews) -> Candidate:
        return CmaCandidate(
            followed=request.designs[0],
            space=request.space,
            conditions=_conditions(request),
            views=views,
            objective=TrainingObjective(request.task, request.train, request.planner, request.seed),
            settings=request.cma,
            seed=request.seed,
        )

    return candidate


def _judge(request: EvaluationRequest) -> Judge:
    """The mean score of sets of rays on a few training scenes, turned so that lower is better."""
    sign = 1.0 if request.task.metric.better == "lower" else -1.0

    def judge(lists: Sequence[Positions]) -> Sequence[float]:
        values = [_values(request, scene, lists) for scene in request.train[:JUDGED_SCENES]]
        return [float(value) for value in sign * np.mean(values, axis=0)] if values else [0.0] * len(lists)

    return judge


def _values(request: EvaluationRequest, scene: Scene, lists: Sequence[Positions]) -> list[float]:
    """Scores in a training scene, with the physics that it calls for."""
    casters, planner = build_casters(scene), request.planner
    physics = planner.physics(planner.plan(scene, [rays for one in lists for rays in one], casters), request.seed)
    return [score.value for score, _ in score_lists(request.task, scene, lists, casters, physics)]
