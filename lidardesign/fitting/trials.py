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
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene, group_numbers
from lidardesign.scoring.scene_scores import score_lists, without_each
from lidardesign.sensors.bandwidth import Bandwidth, mean_mbps
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.plan import Planner
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
        survives: Whether the mean score over the loss of each sensor counts as much as that of all sensors.
        scores: Its score on each scene so far.
    """

    sensors: int
    fired: tuple[Rays, ...]
    survives: bool = False
    scores: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def lists(self) -> list[tuple[Rays, ...]]:
        """What is scored: all its rays and, where losses count, those that are left by the loss of each sensor."""
        return [self.fired, *(without_each(self.fired, self.sensors) if self.survives else [])]

    @property
    def mbps(self) -> float:
        """Its bandwidth by the read-out model of evaluations [Mbit/s]."""
        return mean_mbps(self.fired, Bandwidth())


class HeldBackScenes:
    """The training scenes that trials are scored on, drawn as they are needed.

    Arguments:
        training: The scenes.
        planner: The detector; effects are chosen once, on the first scene.
    """

    def __init__(self, training: TrainingScenes, planner: Planner | None = None) -> None:
        self.training, self.planner = training, planner
        self.scenes: list[Scene] = []
        self._physics = None

    @property
    def groups(self) -> np.ndarray:
        """The group of each scene so far."""
        return group_numbers(self.scenes)

    def score(self, trials: Sequence[Trial], count: int) -> None:
        """Score trials, which were scored on all scenes so far, on as many further scenes as are missing to `count`."""
        run, known = self.training.run, len(self.scenes)
        few = self.training.first(HELD_BACK)
        new = (
            few[known:count]
            if count <= len(few)
            else itertools.islice(self.training.scenes(HELD_BACK, known), count - known)
        )
        rows = []
        for scene in new:
            casters, lists = build_casters(scene), [trial.lists for trial in trials]
            if self.planner is not None and not self.scenes:
                plan = self.planner.plan(scene, [rays for trial in trials for rays in trial.fired], casters)
                self._physics = self.planner.physics(plan, self.training.seed)
            jobs = list(itertools.chain(*lists))
            found = iter(score_lists(run.task, run.metric, scene, jobs, casters, self._physics))
            values = [[next(found)[0].value for _ in own] for own in lists]
            rows.append([(one[0] + np.mean(one[1:] or one)) / 2 for one in values])
            self.scenes.append(scene)
        for trial, column in zip(trials, np.array(rows).T, strict=True):
            trial.scores = np.append(trial.scores, column)


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
    low, high = constraints.least_sensors, constraints.sensors.max or math.inf
    return [count for count in counts if low <= count <= high] or [low]


def trial_of(request: FitRequest, design: DesignSpec, rays: int) -> Trial:
    """A design with so many rays, wherever the request's sensors are."""
    run = request.run
    conditions = [{**request.at, **one} for one in run.conditions(run.config.space.at(request.at))]
    fired = tuple(design.rays(rays, at=at or None) for at in conditions)
    return Trial(len(design.sensors), fired, request.constraints.survive > 0)


def best_of(trials: Sequence[Trial], scenes: HeldBackScenes, metric: Metric) -> Trial:
    """The fewest sensors that are no worse than the best by more than the standard error of the difference.

    Bandwidth costs what it does in a choice of rays: ten percent more of it must bring two percent of the best score,
    or of its distance from the worst value, whichever is less. Trials that are worse than the best beyond doubt, by
    two standard errors, are scored on no more scenes.
    """
    scenes.score(trials, FEW_SCENES)
    while True:
        lost, errors, scale = _losses(trials, scenes.groups, metric)
        open_trials = [trial for trial, mean, error in zip(trials, lost, errors, strict=True) if mean <= 2 * error]
        is_clear = errors[lost <= 2 * errors].max() <= CLEAR_SHARE * scale
        if len(open_trials) == 1 or is_clear or 2 * len(scenes.scenes) > MOST_SCENES:
            return next(trial for trial, mean, error in zip(trials, lost, errors, strict=True) if mean <= error)
        trials = open_trials
        scenes.score(trials, 2 * len(scenes.scenes))


def _losses(trials: Sequence[Trial], groups: np.ndarray, metric: Metric) -> tuple[np.ndarray, np.ndarray, float]:
    """By how much each trial is worse than the best, with standard errors, and the scale of what matters."""
    sign = 1.0 if metric.better == "lower" else -1.0
    score = sign * min(sign * trial.scores.mean() for trial in trials)
    scale = min(abs(score), abs(metric.worst - score))
    costs = [sign * trial.scores + SHARE_PER_BANDWIDTH * scale * math.log(trial.mbps) for trial in trials]
    least = min(costs, key=np.mean)
    lost = [np.bincount(groups, cost - least) / np.bincount(groups) for cost in costs]
    errors = [one.std(ddof=1) / math.sqrt(len(one)) if len(one) > 1 else 0.0 for one in lost]
    return np.array([one.mean() for one in lost]), np.array(errors), scale
