"""Designs tried on training scenes that nothing was fitted to or chosen on, and scored there by the task's metric.

The scenes are doubled until what is decided is clear, or as many have judged as a choice of rays may take.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.errors import InfeasibleError
from lidardesign.fitting.request import FitRequest
from lidardesign.rays.information import FEW_SCENES, MOST_SCENES
from lidardesign.rays.selection import SHARE_PER_BANDWIDTH
from lidardesign.rays.training import HELD_BACK, TrainingScenes
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene, group_numbers
from lidardesign.scoring.scene_scores import score_lists
from lidardesign.sensors.bandwidth import Bandwidth, mean_mbps
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.plan import Decision, EffectPlan, Planner
from lidardesign.simulate.returns import build_casters
from lidardesign.task import Metric

# Trials are compared to this share of the best score, or of its distance from the worst value, whichever is less.
CLEAR_SHARE = 0.02


@dataclass(eq=False)
class Trial:
    """A design that is tried.

    Arguments:
        sensors: Its number of sensors.
        fired: Its rays at each value of a condition.
        scores: Its score on each scene so far.
    """

    sensors: int
    fired: tuple[Rays, ...]
    scores: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def mbps(self) -> float:
        """Its bandwidth by the read-out model of evaluations [Mbit/s]."""
        return mean_mbps(self.fired, Bandwidth())


class HeldBackScenes:
    """The training scenes that trials are scored on, drawn as they are needed.

    Arguments:
        training: The scenes.
        planner: The detector; effects are chosen once, on the first scene for what is scored there.
    """

    def __init__(self, training: TrainingScenes, planner: Planner | None = None) -> None:
        self.training, self.planner = training, planner
        self.scenes: list[Scene] = []
        self.plan: EffectPlan | None = None

    @property
    def groups(self) -> np.ndarray:
        """The group of each scene so far."""
        return group_numbers(self.scenes)

    @phase("trials")
    def score(self, trials: Sequence[Trial], count: int) -> None:
        """Score trials on the scenes up to `count` that each was not scored on yet."""
        run, known = self.training.run, len(self.scenes)
        few = self.training.first(HELD_BACK)
        self.scenes += (
            few[known:count]
            if count <= len(few)
            else itertools.islice(self.training.scenes(HELD_BACK, known), max(count - known, 0))
        )
        for number in range(min(len(trial.scores) for trial in trials), count):
            scene, missing = self.scenes[number], [trial for trial in trials if len(trial.scores) <= number]
            casters, fired = build_casters(scene), [trial.fired for trial in missing]
            physics = None
            if self.planner is not None:
                if self.plan is None:
                    plan = self.planner.plan(scene, [rays for one in fired for rays in one], casters)
                    self.plan = replace(plan, decisions=tuple(map(_affordable, plan.decisions)))
                physics = self.planner.physics(self.plan, self.training.seed)
            for trial, (score, _) in zip(
                missing, score_lists(run.task, run.metric, scene, fired, casters, physics), strict=True
            ):
                trial.scores = np.append(trial.scores, score.value)

    @property
    def effects(self) -> list[str]:
        """A line on the effects that were simulated and what skipped ones could change; none without a detector."""
        if self.plan is None:
            return []
        skipped = [one.bound for one in self.plan.decisions if not one.on]
        range_m, lost = sum(one.range_m for one in skipped), min(sum(one.lost for one in skipped), 1.0)
        return [
            f"judged under {self.planner.detector.name} with {', '.join(sorted(self.plan.effects)) or 'no effects'}; "
            f"the skipped ones could change ranges by {1000 * range_m:.3g} mm and {lost:.2%} of the returns at most"
        ]


def _affordable(decision: Decision) -> Decision:
    """An effect that takes a thousand times as long as others is left out; the bound of what it changes is kept."""
    return replace(decision, on=decision.on and decision.name != "multipath")


def trials_of(request: FitRequest, fit: Callable[[FitRequest], DesignSpec], counts: Sequence[int]) -> list[Trial]:
    """Designs of several numbers of sensors, ascending, at the middle number of rays.

    Arguments:
        request: What is asked for, but for the number of sensors.
        fit: Fits the design of a request.
        counts: The numbers, those of which are tried that constraints allow; the least allowed where none is.

    Raises:
        InfeasibleError: No number of sensors keeps the constraints; the message is that of the fewest.
    """
    rays = request.counts[len(request.counts) // 2]
    trials: list[Trial] = []
    refused = None
    for count in allowed_counts(request.constraints, counts):
        try:
            design = fit(replace(request, sensors=count, rays=rays))
        except InfeasibleError as error:
            refused = refused or error
            continue
        trials.append(trial_of(request, design, rays))
    if not trials and refused is not None:
        raise refused
    return trials


def allowed_counts(constraints: Constraints, counts: Sequence[int]) -> list[int]:
    """Those of some numbers of sensors that constraints allow, or the least that they allow."""
    low = max(constraints.sensors.min or 1, len(constraints.each))
    high = constraints.sensors.max or math.inf
    return [count for count in counts if low <= count <= high] or [low]


def trial_of(request: FitRequest, design: DesignSpec, rays: int) -> Trial:
    """A design with so many rays, wherever the request's sensors are."""
    run = request.run
    conditions = [{**request.at, **one} for one in run.conditions(run.config.space.at(request.at))]
    return Trial(len(design.sensors), tuple(design.rays(rays, at=at or None) for at in conditions))


def best_of(
    trials: Sequence[Trial], scenes: HeldBackScenes, metric: Metric, price: float | None = SHARE_PER_BANDWIDTH
) -> Trial:
    """The first trial that is no worse than the best by more than the standard error of the difference.

    Trials that are worse than the best beyond doubt, by two standard errors, are scored on no more scenes.

    Arguments:
        trials: By ascending number of sensors.
        scenes: The scenes.
        metric: The metric of their scores.
        price: The price of bandwidth, as in a choice of rays: ten percent more of it must bring two percent of the best
            score, or of its distance from the worst value, whichever is less. None: bandwidth is free, and the best by
            the mean is taken.
    """
    scenes.score(trials, FEW_SCENES)
    while True:
        count = len(trials[0].scores)
        lost, errors, scale = _losses(trials, scenes.groups[:count], metric, price or 0.0)
        open_trials = [trial for trial, mean, error in zip(trials, lost, errors, strict=True) if mean <= 2 * error]
        is_clear = errors[lost <= 2 * errors].max() <= CLEAR_SHARE * scale
        if len(open_trials) == 1 or is_clear or 2 * count > MOST_SCENES:
            allowed = 0 * errors if price is None else errors
            return next(trial for trial, mean, error in zip(trials, lost, allowed, strict=True) if mean <= error)
        trials = open_trials
        scenes.score(trials, 2 * count)


def _losses(
    trials: Sequence[Trial], groups: np.ndarray, metric: Metric, price: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """By how much each trial is worse than the best, with standard errors, and the scale of what matters."""
    sign = 1.0 if metric.better == "lower" else -1.0
    score = sign * min(sign * trial.scores.mean() for trial in trials)
    scale = min(abs(score), abs(metric.worst - score))
    costs = [sign * trial.scores + price * scale * math.log(trial.mbps) for trial in trials]
    least = min(costs, key=np.mean)
    lost = [np.bincount(groups, cost - least) / np.bincount(groups) for cost in costs]
    errors = [one.std(ddof=1) / math.sqrt(len(one)) if len(one) > 1 else 0.0 for one in lost]
    return np.array([one.mean() for one in lost]), np.array(errors), scale
