"""The rows of an evaluation: the rays of every design and baseline, at equal rays and at equal bandwidth.

Baselines are built from training scenes alone. Designs are compared with the strongest of them there. The
effects of all rows, with their reasons, are summed up over scenes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.plugins import plugin_guard
from lidardesign.rays.proposals import CANDIDATES_PER_RAY
from lidardesign.rays.training_scenes import HELD_BACK
from lidardesign.run.clock import phase
from lidardesign.scoring.baselines import cma
from lidardesign.scoring.baselines.candidates import Candidate
from lidardesign.scoring.baselines.greedy import GREEDY, USUAL_SCENES, Fired, GreedyCandidate, greedy_rays
from lidardesign.scoring.baselines.simple import Baselines, Option, TwinCandidate
from lidardesign.scoring.baselines.views import TrainingObjective, TrainingViews
from lidardesign.scoring.evaluation.request import EvaluationRequest, fired_numbers, numbers_fired
from lidardesign.scoring.scene_scores import ONE_DEVICE, Devices, RaysPerCondition, score_scenes
from lidardesign.sensors.adaptive import AdaptiveRays, mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.detector.physics import EFFECTS
from lidardesign.simulate.plan import Choice, EffectPlan, Tolerance
from lidardesign.task import conditions_of

# Candidates of a baseline are compared on this many training scenes: enough to tell a good layout from a bad one,
# at a fraction of the held-out scenes' cost.
JUDGED_SCENES = 8
# The strongest baseline is found on training scenes that no baseline's rays were chosen on: picking the best
# of several by their scores on held-out scenes would favour a lucky one.
MOST_BASELINE_SCENES = 20
FEWEST_BASELINE_SCENES = 5
LARGEST_BASELINE_SHARE = 0.1  # of the rays that an evaluation fires may be fired to find it
MILLIMETRES = 1000.0
SINGLE = "-single"  # ends the name of the best single pattern of a design whose patterns follow what they see


@dataclass(frozen=True, eq=False)
class Entry:
    """A row of an evaluation before it is scored.

    Arguments:
        name: The design's or baseline's.
        positions: The rays per condition value.
        baseline: Whether it is a baseline.
        redraw: Gives the rays of a scene, for layouts drawn anew in each.
        matched_to, matched_rays: The design and its number of rays whose bandwidth this baseline was given.
        search: The record of a direct search for its rays.
        devices: Devices of a baseline, those of the design that it stands beside.
    """

    name: str
    positions: RaysPerCondition
    baseline: bool
    redraw: Callable[[int], RaysPerCondition] | None = None
    matched_to: str | None = None
    matched_rays: int | None = None
    search: cma.SearchRecord | None = None
    devices: Devices = ONE_DEVICE

    @property
    def rays(self) -> int:
        """Rays per condition value."""
        return len(self.positions[0])

    @property
    def gates(self) -> int:
        """Different gates of its sensors, at the condition value where they are most."""
        return max(len(np.unique(np.column_stack([rays.sensor, rays.gate_m]), axis=0)) for rays in self.positions)

    def mbps(self, bandwidth: Bandwidth) -> float:
        """The bandwidth of its rays, averaged over condition values [Mbit/s]."""
        return mean_mbps(self.positions, bandwidth)

    def rays_in(self, scene: int) -> RaysPerCondition:
        """The rays that it fires in a held-out scene."""
        return self.positions if self.redraw is None else self.redraw(scene)

    def lit_in(self, scene: int) -> RaysPerCondition:
        """The rays that it fires in a held-out scene, each with its device's light."""
        return self.devices.firing(self.rays_in(scene))

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """A key that is equal for entries that fire the same rays."""
        if not self.baseline:
            return ("design", self.name, self.rays)
        arrays = (array for rays in self.positions for array in (rays.origin_m, rays.direction, rays.gate_m))
        return (self.name, self.devices, *(array.tobytes() for array in arrays))


@phase("rays")
def entries_of(request: EvaluationRequest) -> list[Entry]:
    """All entries: designs at the numbers of rays that they can fire, baselines, then those at each one's bandwidth.

    Raises:
        ConfigError: No design can fire any of the numbers of rays, or its rays end before where it is evaluated.
    """
    conditions = _conditions(request)
    _check_ends(request, conditions)
    counts = fired_numbers(request.designs, request.rays)
    designs = [
        entry
        for design in request.designs
        for count in numbers_fired(design, counts, request.alone)
        for entry in _of_design(request, conditions, design, count)
    ]
    shared = [count for count in counts if count not in request.alone]
    choosable = [] if request.training is None else greedy_rays(request.task, len(conditions), shared)[0]
    # a search starts from single patterns of the first design
    named = (request.designs[0].name, f"{request.designs[0].name}{SINGLE}") if request.designs else ()
    searched = [one for one in designs if one.name in named and not isinstance(one.positions, AdaptiveRays)]
    starts = {one.rays: one.positions for one in searched}
    # beside several designs a baseline has as many devices as the one with the most
    devices = max((Devices.of(one.positions) for one in designs), key=lambda one: one.number, default=ONE_DEVICE)
    fired = [Fired(entry.rays, entry.mbps(request.bandwidth)) for entry in designs]
    refit = request.without_visibility
    baselines = Baselines(
        request.space,
        request.train,
        request.seed,
        partial(_judge, request, devices),
        conditions=conditions,
        gates_per_ray=any(design.has_gates_per_ray for design in request.designs),
        without_visibility=refit and partial(TwinCandidate, refit, conditions, fired),
        optimised=partial(_optimised, request, conditions, starts) if request.designs else None,
        chosen=partial(_chosen, request, conditions, fired, max(choosable, default=0)),
    )
    wanted: list[tuple[str, list[Option], Entry | None]] = [
        (name, baselines.options(name, count), None)
        for name in request.baselines
        for count in shared
        if name != GREEDY or count in choosable
        if name != cma.CMA or count in starts or not starts
    ]
    if request.equal_bandwidth:
        wanted += [
            (name, baselines.options_within(name, entry.mbps(request.bandwidth), request.bandwidth), entry)
            for entry in designs
            if entry.rays in shared
            for name in request.baselines
            if name != cma.CMA or entry in searched
            if name != GREEDY or entry.rays in choosable
        ]
    wanted = [one for one in wanted if one[1]]
    chosen = baselines.best([(name, options) for name, options, _ in wanted])
    return designs + [
        _entry(baselines, name, option, matched, devices if matched is None else Devices.of(matched.positions))
        for (name, _, matched), option in zip(wanted, chosen, strict=True)
    ]


def _check_ends(request: EvaluationRequest, conditions: Sequence[Mapping[str, float]]) -> None:
    for design in request.designs:
        name = design.condition
        if name is None:
            continue
        first, last = design.patterns[-1].ends
        beyond = [one[name] for one in conditions if name in one and not first <= one[name] <= last]
        if beyond:
            raise ConfigError(
                f"its rays go from {name}={first:g} to {last:g}, but designs are evaluated at {beyond[0]:g} too",
                where=f"design {design.name}",
                hint="fit a design of the whole way: lidardesign fit RUN",
            )


def _entry(baselines: Baselines, name: str, option: Option, matched: Entry | None, devices: Devices) -> Entry:
    candidate, count = option.candidate, len(option.positions[0])
    searched = matched is None and isinstance(candidate, cma.CmaCandidate)
    return Entry(
        name,
        option.positions,
        baseline=True,
        redraw=partial(candidate.positions, baselines.spaces, count) if candidate.drawn_anew else None,
        matched_to=None if matched is None else matched.name,
        matched_rays=None if matched is None else matched.rays,
        search=candidate.searches[count][1] if searched else None,
        devices=devices,
    )


def _conditions(request: EvaluationRequest) -> list[dict[str, float]]:
    with plugin_guard(request.task.name):
        return conditions_of(request.task, request.config, request.space)


def ordered_conditions(request: EvaluationRequest) -> list[dict[str, float]]:
    """The condition values that are evaluated at, ascending; one empty entry without conditions."""
    return sorted(_conditions(request), key=lambda condition: tuple(condition.values()))


def _of_design(
    request: EvaluationRequest, conditions: Sequence[Mapping[str, float]], design: DesignSpec, count: int
) -> list[Entry]:
    """The entry of a design; where its patterns follow what they see, with the best single one beside it."""
    positions = tuple(request.fired(design, count, condition) for condition in conditions)
    fixed = Entry(design.name, positions, baseline=False)
    adaptive = design.following(count)
    if adaptive is None:
        return [fixed]
    return [
        replace(fixed, positions=request.following(design, adaptive)),
        replace(fixed, name=f"{design.name}{SINGLE}"),
    ]


def _optimised(
    request: EvaluationRequest, conditions: Sequence[Mapping[str, float]], starts: Mapping[int, RaysPerCondition]
) -> Candidate:
    design, space, scenes = request.designs[0], request.space, request.train[: cma.MOST_SCENES]
    middle = conditions[len(conditions) // 2]
    return cma.CmaCandidate(
        design=design,
        starts=starts,
        space=space.at({**middle, **design.at}) if space.conditioned else space,
        objective=TrainingObjective(request.task, request.metric, scenes, request.planner, request.seed),
        settings=request.cma,
        seed=request.seed,
        bandwidth=request.bandwidth,
    )


def _chosen(
    request: EvaluationRequest,
    conditions: Sequence[Mapping[str, float]],
    fired: Sequence[Fired],
    most: int,
    views: TrainingViews,
) -> Candidate:
    numbers = [one["scenes"] for design in request.designs for one in design.certificates]
    return GreedyCandidate(
        views=views,
        spaces=[request.space.at(condition) for condition in conditions],
        training=request.training,
        scenes=max(numbers, default=USUAL_SCENES),
        gates_per_ray=any(design.has_gates_per_ray for design in request.designs),
        candidates=CANDIDATES_PER_RAY * most,
        fired=fired,
        bandwidth=request.bandwidth,
    )


def _judge(request: EvaluationRequest, devices: Devices, lists: Sequence[RaysPerCondition]) -> list[float]:
    """The mean score of sets of rays on a few training scenes, turned so that lower is better."""
    scenes = request.train[:JUDGED_SCENES]
    objective = TrainingObjective(request.task, request.metric, scenes, request.planner, request.seed)
    if not objective.scenes:
        return [0.0] * len(lists)
    return objective.values(list(map(devices.firing, lists))).mean(axis=0).tolist()


@phase("strongest baseline")
def strongest_baseline(request: EvaluationRequest, entries: Sequence[Entry], rays: int) -> StrongestBaseline | None:
    """The best of all baselines at a number of rays, under the effects of the evaluation; None without baselines.

    Arguments:
        request: The evaluation.
        entries: All its entries.
        rays: The number of rays.
    """
    baselines = [entry for entry in entries if entry.baseline and entry.matched_to is None and entry.rays == rays]
    if not baselines or not request.train:
        return None
    fired = sum(entry.rays for entry in entries) * len(request.test)
    affordable = int(LARGEST_BASELINE_SHARE * fired / (rays * len(baselines)))
    # the first ones where a request has no others
    held_back = request.train if request.training is None else request.training.scenes(HELD_BACK)
    count = min(max(affordable, FEWEST_BASELINE_SCENES), MOST_BASELINE_SCENES)
    scenes = list(itertools.islice(held_back, count))
    found = score_scenes(
        request.task,
        request.metric,
        request.seed,
        scenes,
        lambda number: [entry.lit_in(number) for entry in baselines],
        request.planner,
    )
    means = np.mean([[score.value for score, _ in scene.scores] for scene in found], axis=0).tolist()
    values = dict(zip((entry.name for entry in baselines), means, strict=True))
    return StrongestBaseline.best_of(values, request.metric.better, rays, len(scenes))


@dataclass(frozen=True)
class StrongestBaseline:
    """The best of all baselines at one number of rays.

    Arguments:
        name: Its name.
        rays: Rays per frame.
        scenes: The number of training scenes that it was found on.
        values: The mean score of every baseline on them.
    """

    name: str
    rays: int
    scenes: int
    values: Mapping[str, float]

    @classmethod
    def best_of(cls, values: Mapping[str, float], better: str, rays: int, scenes: int) -> StrongestBaseline:
        """The best of mean scores by name; the first of equal ones."""
        choose = min if better == "lower" else max
        return cls(choose(values, key=lambda name: values[name]), rays, scenes, dict(values))


def mean_baseline(found: Iterable[StrongestBaseline | None], better: str) -> StrongestBaseline | None:
    """The strongest baseline of several seeds, by its mean score over them; None where one seed has none."""
    each = list(found)
    known = [one for one in each if one is not None]
    if not known or len(known) < len(each):
        return None
    names = [name for name in known[0].values if all(name in one.values for one in known)]
    values = {name: float(np.mean([one.values[name] for one in known])) for name in names}
    return StrongestBaseline.best_of(values, better, known[0].rays, sum(one.scenes for one in known))


def effect_summaries(plans: Sequence[EffectPlan]) -> list[EffectSummary]:
    """A summary per effect, in the order of the simulation."""
    tolerance, summaries = plans[0].tolerance, []
    for name in EFFECTS:
        decisions = [decision for plan in plans for decision in plan.decisions if decision.name == name]
        worst = max(decisions, key=lambda decision: decision.bound.relative(tolerance))
        summaries.append(
            EffectSummary(
                worst.name,
                sum(decision.on for decision in decisions) / len(decisions),
                max(decision.bound.range_m for decision in decisions),
                max(decision.bound.lost for decision in decisions),
                tolerance,
                worst.bound.reason,
                sum(decision.seconds for decision in decisions),
                worst.missing,
            )
        )
    return summaries


@dataclass(frozen=True)
class EffectSummary:
    """An effect over all scenes.

    Arguments:
        name: Of the effect.
        scenes_on: The share of scenes in which it was simulated.
        range_m: Its largest bound on ranges, in any scene [m].
        lost: Its largest bound on the share of returns.
        tolerance: Of all skipped effects together.
        reason: The reason, in the scene where it could change most.
        seconds: Predicted time to simulate it in all scenes [s].
        missing: A missing requirement of its simulation.
    """

    name: str
    scenes_on: float
    range_m: float
    lost: float
    tolerance: Tolerance
    reason: str
    seconds: float
    missing: str | None = None

    @property
    def on(self) -> bool:
        """True where it was simulated in any scene."""
        return self.scenes_on > 0

    @property
    def exceeds(self) -> bool:
        """True where its bound exceeds the tolerance."""
        return self.range_m > self.tolerance.range_m or self.lost > self.tolerance.lost

    def as_dict(self) -> dict[str, Any]:
        """The contract's keys for ranges; the same for returns, and what it costs."""
        return {
            "name": self.name,
            "on": self.on,
            "bound": self.range_m,
            "tolerance": self.tolerance.range_m,
            "unit": "m",
            "reason": self.reason,
            "lost": self.lost,
            "lost_tolerance": self.tolerance.lost,
            "scenes_on": self.scenes_on,
            "seconds": self.seconds,
            "missing": self.missing,
        }


def effect_notes(effects: Sequence[EffectSummary], choice: Choice) -> list[str]:
    """Lines on effects that were not simulated although they matter."""
    notes = [
        f"{effect.name} is not simulated ({effect.missing}): it may move ranges by up to "
        f"{MILLIMETRES * effect.range_m:.3g} mm and change {effect.lost:.2g} of the returns"
        for effect in effects
        if effect.missing is not None and effect.exceeds
    ]
    left_out = [effect.name for effect in effects if effect.exceeds and not effect.on and effect.missing is None]
    if left_out and choice != "auto":
        notes.append(f"not simulated, as requested, though beyond the tolerance: {', '.join(left_out)}")
    return notes
