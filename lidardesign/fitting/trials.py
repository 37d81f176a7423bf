"""Designs tried on training scenes that nothing was fitted to or chosen on, and scored there by the task's metric.

The scenes are doubled until what is decided is clear, or as many have judged as a choice of rays may take. So the best
number of sensors is found, and the least that keeps a goal.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.errors import BackgroundNote, InfeasibleError
from lidardesign.estimates import Interval, mean_interval
from lidardesign.fitting.request import FitRequest
from lidardesign.rays.information import FEW_SCENES, MOST_SCENES
from lidardesign.rays.selection import SHARE_PER_BANDWIDTH
from lidardesign.rays.training_scenes import HELD_BACK, TrainingScenes
from lidardesign.run.yaml import merged
from lidardesign.scenes.scene import group_numbers
from lidardesign.scoring.fired import Positions, fired, without_each
from lidardesign.scoring.scene_scores import Preparation, TrainingScorer
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.plan import Planner
from lidardesign.task import Metric, Task

# Trials are compared to this share of the best score, or of its distance from the worst value, whichever is less.
CLEAR_SHARE = 0.02
# What is least for a goal is found to this share, and limits of bandwidth have so many digits, which a user can type.
FINENESS, DIGITS = 0.03, 4


@dataclass(eq=False)
class Trial:
    """A design that is tried.

    Arguments:
        sensors: Its number of sensors.
        fired: What it fires.
        survives: Whether the mean score over the loss of each sensor counts as much as that of all sensors.
        scores: Its score on each scene so far.
    """

    sensors: int
    fired: Positions
    survives: bool = False
    scores: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def lists(self) -> list[Positions]:
        """What is scored: all its rays and, where losses count, those that are left by the loss of each sensor."""
        return [self.fired, *(without_each(self.fired, self.sensors) if self.survives else [])]

    @property
    def mbps(self) -> float:
        """Its bandwidth by the read-out model of evaluations [Mbit/s]."""
        return mean_mbps(self.fired, Bandwidth())

    def has_same_rays(self, other: Trial) -> bool:
        """True where another design fires the same rays."""
        names = ("origin_m", "direction", "gate_m", "sensor")
        mine, its = ([getattr(rays, name) for rays in one.fired for name in names] for one in (self, other))
        return all(map(np.array_equal, mine, its))


def held_back_scorer(training: TrainingScenes, planner: Planner | None = None) -> TrainingScorer:
    """The scorer of trials, on training scenes that were held back, under the effects that the first ones call for."""
    run, first = training.run, training.first(HELD_BACK)
    return TrainingScorer(
        run.task,
        run.metric,
        training.seed,
        itertools.chain(first, training.scenes(HELD_BACK, len(first))),
        planner,
        plans_once=True,
        preparation=Preparation.of_run(training, planner),
    )


def score_trials(trials: Sequence[Trial], scorer: TrainingScorer, count: int) -> None:
    """Score trials on the scenes up to `count` that each was not scored on yet."""
    for number in range(min(len(trial.scores) for trial in trials), count):
        missing = [trial for trial in trials if len(trial.scores) <= number]
        lists = [trial.lists for trial in missing]
        found = iter(scorer.scores_in(number, [*itertools.chain(*lists)], [trial.fired for trial in missing]))
        for trial, own in zip(missing, lists, strict=True):
            values = [next(found) for _ in own]
            trial.scores = np.append(trial.scores, (values[0] + np.mean(values[1:] or values)) / 2)


def effects_line(scorer: TrainingScorer) -> list[str]:
    """A line on the effects that trials met and what skipped ones could change; none without a detector."""
    if not scorer.plans:
        return []
    plan = scorer.plans[0]
    skipped = [one.bound for one in plan.decisions if not one.on]
    range_m, lost = sum(one.range_m for one in skipped), min(sum(one.lost for one in skipped), 1.0)
    return [
        f"judged under {scorer.planner.detector.name} with {', '.join(sorted(plan.effects)) or 'no effects'}; "
        f"the skipped ones could change ranges by {1000 * range_m:.3g} mm and {lost:.2%} of the returns at most"
    ]


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
        trials[-1].survives = request.constraints.survive > 0
    if not trials and refused is not None:
        raise refused
    return trials


def allowed_counts(constraints: Constraints, counts: Sequence[int]) -> list[int]:
    """Those of some numbers of sensors that constraints allow, or the least that they allow."""
    bounds = constraints.sensors
    low, high = bounds.count or constraints.least_sensors, bounds.count or bounds.max or math.inf
    return [count for count in counts if low <= count <= high] or [low]


def trial_of(request: FitRequest, design: DesignSpec, rays: int | None, task: Task | None = None) -> Trial:
    """A design with so many rays, or its own, wherever the request's sensors are; the rest as for `fired`."""
    run = request.run
    conditions = [{**request.at, **one} for one in run.conditions(run.config.space.at(request.at))]
    return Trial(len(design.sensors), fired(design, rays, conditions, request.planner, task))


def best_of(
    trials: Sequence[Trial],
    scorer: TrainingScorer,
    metric: Metric,
    price: float | None = SHARE_PER_BANDWIDTH,
    few: int | None = None,
    most: int | None = None,
) -> Trial:
    """The first trial that is no worse than the best by more than the standard error of the difference.

    Trials that are worse than the best beyond doubt, by two standard errors, are scored on no more scenes.

    Arguments:
        trials: By ascending number of sensors.
        scorer: Scores them on training scenes.
        metric: The metric of their scores.
        price: The price of bandwidth, as in a choice of rays: ten percent more of it must bring two percent of the best
            score, or of its distance from the worst value, whichever is less. None: bandwidth is free, and the best by
            the mean is taken.
        few, most: On how many scenes all trials are scored, and the last ones at most; else as in a choice of rays.
    """
    score_trials(trials, scorer, few or FEW_SCENES)
    while True:
        count = len(trials[0].scores)
        lost, errors, scale = _losses(trials, group_numbers(scorer.scenes(count)), metric, price or 0.0)
        open_trials = [trial for trial, mean, error in zip(trials, lost, errors, strict=True) if mean <= 2 * error]
        is_clear = errors[lost <= 2 * errors].max() <= CLEAR_SHARE * scale
        if len(open_trials) == 1 or is_clear or 2 * count > (most or MOST_SCENES):
            allowed = 0 * errors if price is None else errors
            return next(trial for trial, mean, error in zip(trials, lost, allowed, strict=True) if mean <= error)
        trials = open_trials
        score_trials(trials, scorer, 2 * count)


def _losses(
    trials: Sequence[Trial], groups: np.ndarray, metric: Metric, price: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """By how much each trial is worse than the best, with standard errors, and the scale of what matters."""
    sign = metric.sign
    score = sign * min(sign * trial.scores.mean() for trial in trials)
    scale = min(abs(score), abs(metric.worst - score))
    costs = [sign * trial.scores + price * scale * math.log(trial.mbps) for trial in trials]
    least = min(costs, key=np.mean)
    lost = [np.bincount(groups, cost - least) / np.bincount(groups) for cost in costs]
    errors = [one.std(ddof=1) / math.sqrt(len(one)) if len(one) > 1 else 0.0 for one in lost]
    return np.array([one.mean() for one in lost]), np.array(errors), scale


@dataclass(frozen=True, eq=False)
class GoalTrial:
    """A design that was tried for a goal.

    Arguments:
        request: The request that it is the design of.
        cost: How much it has of what is to be least.
        trial: The design, with its scores.
        score: Their mean with its interval.
        keeps: Whether the interval keeps the goal.
    """

    request: FitRequest
    cost: float
    trial: Trial
    score: Interval
    keeps: bool

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "sensors": self.trial.sensors,
            "rays": len(self.trial.fired[0]),
            "bandwidth_mbps": self.trial.mbps,
            "limit_mbps": self.request.constraints.budget.bandwidth_mbps,
            "value": self.score.mean,
            "ci_low": self.score.low,
            "ci_high": self.score.high,
            "scenes": len(self.trial.scores),
            "keeps": self.keeps,
        }

    def text(self, metric: Metric) -> str:
        """What it is and scores, as `196 rays of 2 sensors in 0.52 Mbit/s: 5.8 mm (5.6 to 6)`."""
        sensors = f"{self.trial.sensors} sensor{'s' * (self.trial.sensors > 1)}"
        design = f"{len(self.trial.fired[0])} rays of {sensors} in {self.trial.mbps:.4g} Mbit/s"
        ends = "" if self.score.low is None else f" ({self.score.low:.4g} to {self.score.high:.4g})"
        return f"{design}: {self.score.mean:.4g} {metric.unit}{ends}"


class GoalSearch:
    """The search for the least of something that keeps a goal on training scenes that were held back.

    A design keeps it where the 95 % interval of its mean score does. What is least is found to `FINENESS`.

    Arguments:
        request: What is asked for, with a goal; the number of sensors is known where it is not what is sought.
        fit: Fits the design of a request.
        scorer: Scores all designs.
    """

    def __init__(self, request: FitRequest, fit: Callable[[FitRequest], DesignSpec], scorer: TrainingScorer) -> None:
        self.request, self.metric, self.scorer, self._fit = request, request.run.metric, scorer, fit
        self._model = request.constraints.budget.readout
        self.tried: list[GoalTrial] = []
        self._refused: InfeasibleError | None = None

    def found(self, counts: Sequence[int]) -> GoalTrial:
        """The design with the least that keeps the goal, of these numbers of sensors where they are sought.

        Raises:
            InfeasibleError: None keeps it, or none can be fitted.
        """
        request, rays = self.request, self.request.counts
        number = request.sensors if isinstance(request.sensors, int) else 1
        if request.least == "sensors":
            middle, numbers = self._with_rays(rays[len(rays) // 2]), allowed_counts(request.constraints, counts)
            any(self._reached(replace(middle, sensors=number)) for number in numbers)
        elif request.least == "parts":
            any(self._reached(replace(request, sensors=fewer)) for fewer in range(1, number + 1))
        elif request.least == "rays":
            least_keeping(lambda many: self._reached(self._with_rays(int(many))), max(number - 1, 0.5), rays[-1], round)
        else:
            limit = math.inf
            for number in sorted(rays, key=lambda number: number != rays[len(rays) // 2]):
                limit = self._least_bandwidth(number, limit)
        keeping = [one for one in self.tried if one.keeps]
        if not keeping:
            raise self._missed()
        return min(keeping, key=lambda one: one.cost)

    def notes(self, found: GoalTrial) -> list[str]:
        """Lines on what was found, the next cheaper one, and all that was tried."""
        metric = self.metric
        text = (
            f"goal {self.request.goal:g} {metric.unit}, least {self.request.least}: {found.text(metric)} on "
            f"{len(found.trial.scores)} training scenes held back"
        )
        cheaper = [one for one in self.tried if one.cost < found.cost]
        if cheaper:
            text += f"; the next cheaper one tried: {max(cheaper, key=lambda one: one.cost).text(metric)}"
        tried = dict.fromkeys(one.text(metric) for one in self.tried)
        return [text, BackgroundNote(f"tried: {'; '.join(tried)}")]

    def as_dict(self, found: GoalTrial) -> dict[str, Any]:
        """Plain values of the goal, of what was found and of all that was tried."""
        return {
            "value": self.request.goal,
            "unit": self.metric.unit,
            "least": self.request.least,
            "found": found.as_dict(),
            "tried": [one.as_dict() for one in self.tried],
        }

    def _fitted(self, request: FitRequest) -> Trial | None:
        """The design of a request; None where there is none, and the first refusal is remembered."""
        try:
            return trial_of(request, self._fit(request), request.rays)
        except InfeasibleError as error:
            self._refused = self._refused or error
            return None

    def _reached(self, request: FitRequest) -> float | None:
        """How much the design of a request has of what is to be least; None where it does not keep the goal."""
        trial = self._fitted(request)
        if trial is None:
            return None
        same = next((one for one in self.tried if one.trial.has_same_rays(trial)), None)
        cost = {"bandwidth": self._mbps(trial), "rays": len(trial.fired[0])}.get(request.least, trial.sensors)
        tried = replace(same, request=request) if same else GoalTrial(request, cost, trial, *self._judged(trial))
        self.tried.append(tried)
        return tried.cost if tried.keeps else None

    def _judged(self, trial: Trial) -> tuple[Interval, bool]:
        """The mean score of a design with its interval, and whether that keeps the goal."""
        goal, count = self.request.goal or 0.0, FEW_SCENES
        while True:
            score_trials([trial], self.scorer, count)
            groups = group_numbers(self.scorer.scenes(count))
            score = mean_interval(trial.scores, groups, limits=self.metric.limits)
            low, high = (score.mean if end is None else end for end in score[1:])
            if not low <= goal <= high or 2 * count > MOST_SCENES:
                return score, high <= goal if self.metric.better == "lower" else low >= goal
            count *= 2

    def _with_rays(self, rays: int) -> FitRequest:
        """The request with a number of rays, whatever number its constraints name."""
        request = replace(self.request, rays=rays)
        return request if request.constraints.budget.rays is None else _with_budget(request, {"rays": rays})

    def _least_bandwidth(self, rays: int, limit: float) -> float:
        """The least bandwidth below a limit in which so many rays keep the goal; the limit where there is none."""
        request, low = self._with_rays(rays), self._model.mbps_of_widths(np.zeros(1), rays)
        free = self._fitted(request) if low <= limit else None
        if free is None:
            return limit
        high, bounded = rounded_up(min(limit, self._mbps(free))), replace(request, is_constrained=True)

        def reached(mbps: float) -> float | None:
            return self._reached(_with_budget(bounded, {"bandwidth_mbps": mbps}))

        return least_keeping(reached, low, high, rounded_up) or limit

    def _mbps(self, trial: Trial) -> float:
        """The largest bandwidth of a design at any condition, by the model of its constraints [Mbit/s]."""
        return max(map(self._model.mbps, trial.fired))

    def _missed(self) -> InfeasibleError:
        """The error where nothing keeps the goal, which says what is best, or why nothing can be fitted."""
        if self._refused is not None and not self.tried:
            return self._refused
        metric, is_lower = self.metric, self.metric.better == "lower"
        best = (min if is_lower else max)(self.tried, key=lambda one: one.score.mean)
        end = best.score.high if is_lower else best.score.low
        return InfeasibleError(
            f"no design keeps {metric.name} {self.request.goal:g} {metric.unit} on training scenes held back; the best "
            f"that was tried is {best.text(metric)}",
            conflicts=["--goal"],
            hint=f"--goal {best.score.mean if end is None else end:.4g}, more --rays, or fewer constraints",
        )


def least_keeping(
    reached: Callable[[float], float | None], low: float, high: float, rounded: Callable[[float], float]
) -> float | None:
    """The least value, to `FINENESS`, that keeps a goal which all above it keep, by bisection of its logarithm.

    Arguments:
        reached: The value that a design has for which at most some value is asked; None where it misses the goal.
        low: A value above 0 that is taken to miss it.
        high: The largest value.
        rounded: Rounds values to those that may be asked about.

    Returns:
        The value; None where `high` does not keep the goal.
    """
    least = reached(high)
    while least is not None and least > (1 + FINENESS) * low:
        middle = rounded(math.sqrt(low * least))
        if not low < middle < least:
            break
        found = reached(middle)
        low, least = (middle, least) if found is None else (low, found)
    return least


def rounded_up(mbps: float) -> float:
    """A bandwidth rounded up to `DIGITS` digits [Mbit/s]."""
    decimals = DIGITS - 1 - math.floor(math.log10(mbps))
    return round(math.ceil(mbps * 10**decimals) / 10**decimals, max(decimals, 0))


def _with_budget(request: FitRequest, budget: dict[str, float]) -> FitRequest:
    document = merged(request.constraints.as_document(), {"budget": budget})
    return replace(request, constraints=Constraints.from_mapping(document))
