"""Direct optimisation of a metric by CMA-ES (N. Hansen's `cma`), within a budget of time.

The best of some starts, by the metric on a few training scenes, is where the search begins. All candidates of a step
are scored in the same scenes; their number doubles as the budget is used up until it takes in all that there are,
and the last share is kept to compare the finalists (every start that a search began from, the best of every stage, and
the mean of the last distribution) on all of them. A search that has converged begins anew at the best found so far,
with twice the population. Vectors beyond the constraints are ranked behind what they stand for by how far they lie
beyond.

All candidates of a step see the same scenes and the same chance (common random numbers), so that what tells them apart
is what they are. Casters, and what a scene calls for, are worked out once per scene and kept.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lidardesign.evaluate.baselines.candidates import RaysPerCondition
from lidardesign.evaluate.cma.model import DesignModel, RayAllowance
from lidardesign.evaluate.scene_scores import score_lists
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.numerics import TINY
from lidardesign.scene import Scene
from lidardesign.simulate.detector.detector import Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.simulate import build_casters, simulate_many
from lidardesign.task import Metric, Task

# Scenes that the first steps see; as many as baselines are compared on. With 4, tracks of an arm that were best there
# were more than twice as far off on 16.
FIRST_SCENES = 8
# More training scenes than these tell finalists no better apart, and cost the search its time.
MOST_SCENES = 40
# The share of the budget in which finalists are compared, at most.
FINAL_SHARE = 0.2
# Stages end after shares of 1 - 2^(-n / pace) of the budget: 0.37, 0.6, 0.75, ... of it.
STAGE_PACE = 1.5
STEP = 0.3  # the first standard deviation, in units of the parameters' own steps
# Beyond so many numbers a full covariance takes longer to learn than any budget lasts: variances alone are adapted.
MOST_CORRELATED = 250
MOST_POPULATION = 4  # times the usual one
STARTS_AT_ONCE = 8
# Of more starts than that, the best in so many scenes are looked at in more.
START_SCENES = 2


class OutOfTimeError(Exception):
    """The budget ended in the middle of a step; what was scored of it is dropped."""


@dataclass(frozen=True, eq=False)
class TrainingObjective:
    """The task's metric on training scenes, turned so that lower is better.

    Arguments:
        task: Whose score is taken.
        metric: What it means.
        scenes: Training scenes; the first ones are asked first.
        planner: The detector, and how effects are chosen.
        seed: Root of the effects' random streams.
    """

    task: Task
    metric: Metric
    scenes: Sequence[Scene]
    planner: Planner
    seed: int
    _prepared: dict[int, tuple[list[SceneCaster], Physics | None]] = field(default_factory=dict)

    @property
    def sign(self) -> float:
        """What turns the metric so that lower is better."""
        return 1.0 if self.metric.better == "lower" else -1.0

    def values(
        self, lists: Sequence[RaysPerCondition], scenes: Sequence[int], stop: Callable[[], bool] = lambda: False
    ) -> np.ndarray:
        """The score of every set of rays in some scenes, lower is better, shape (sets, scenes).

        Arguments:
            lists: The sets of rays; one without rays has the metric's worst value everywhere.
            scenes: Numbers of the scenes.
            stop: Asked after every scene whether the time is up.

        Raises:
            OutOfTimeError: The time was up before all scenes were asked.
        """
        found = np.empty((len(lists), len(scenes)))
        for column, number in enumerate(scenes):
            casters, physics = self._of_scene(number, lists)
            scores = score_lists(self.task, self.metric, self.scenes[number], lists, casters, physics)
            found[:, column] = [self.sign * score.value for score, _ in scores]
            if column + 1 < len(scenes) and stop():
                raise OutOfTimeError
        return found

    def returned(self, positions: RaysPerCondition, scenes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """The sensor (R,) and the range (R,) [m] of every return of a set of rays in some scenes."""
        sensors, ranges_m = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
        for number in scenes:
            casters, physics = self._of_scene(number, [positions])
            frames = simulate_many(
                self.scenes[number], positions, casters=casters, physics=physics, repeats=list(range(len(positions)))
            )
            for returns in (one for of_list in frames for one in of_list):
                sensors.append(np.asarray(returns.rays.sensor)[returns.returned])
                ranges_m.append(returns.range_m[returns.returned])
        return np.concatenate(sensors), np.concatenate(ranges_m)

    def _of_scene(self, number: int, lists: Sequence[RaysPerCondition]) -> tuple[list[SceneCaster], Physics | None]:
        """Casters and effects of a scene; the rays that are fired first say which effects it calls for."""
        if number not in self._prepared:
            scene = self.scenes[number]
            casters = build_casters(scene)
            plan = self.planner.plan(scene, [rays for positions in lists for rays in positions], casters)
            self._prepared[number] = casters, self.planner.physics(plan, self.seed)
        return self._prepared[number]


@dataclass(frozen=True)
class SearchBudget:
    """When a search ends: after some seconds, or so many evaluations, whichever comes first.

    Arguments:
        seconds: Wall time [s].
        evaluations: Scores of one candidate in one scene.
        clock: Tells the time [s].
    """

    seconds: float
    evaluations: float = math.inf
    clock: Callable[[], float] = time.perf_counter


@dataclass(frozen=True)
class Progress:
    """Where a search stands.

    Arguments:
        share: Of the budget that is used up.
        evaluations: Scores of one candidate in one scene so far.
        best: The best score so far in the scenes of this stage, in the metric's own direction.
    """

    share: float
    evaluations: int
    best: float


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search found.

    Arguments:
        model: Of the parameters that were best.
        vector: The best parameters.
        start_value, value: Of the start and the best, on all scenes that finalists are compared on; in the metric's
            own direction.
        seconds, cpu_seconds: What it took, and what the processor worked for it: less where others use it too [s].
        candidates, evaluations: Candidates that were scored, and scores of one candidate in one scene.
        scenes: The number of training scenes that the finalists were compared on.
        restarts: Searches that converged before the end.
    """

    model: DesignModel
    vector: np.ndarray
    start_value: float
    value: float
    seconds: float
    cpu_seconds: float
    candidates: int
    evaluations: int
    scenes: int
    restarts: int


@dataclass(frozen=True, eq=False)
class _Scored:
    """Parameters, and their score in the scenes of the stage, lower is better."""

    model: DesignModel
    vector: np.ndarray
    value: float = math.inf


class Search:
    """One search; `run` it once.

    Arguments:
        starts: Models whose vector 0 is a start, the likeliest to be good first.
        rays: The number of rays, or the bandwidth.
        objective: The metric on training scenes.
        budget: When to end.
        generator: Of all its random numbers.
        show: Told where the search stands after every step.
        began: When the budget's clock showed that work began, as on the starts; None: now.
    """

    def __init__(
        self,
        starts: Sequence[DesignModel],
        rays: RayAllowance,
        objective: TrainingObjective,
        budget: SearchBudget,
        generator: np.random.Generator,
        show: Callable[[Progress], None] | None = None,
        began: float | None = None,
    ) -> None:
        self._starts, self._rays, self._objective, self._budget = starts, rays, objective, budget
        self._generator, self._show = generator, show
        self._began, self._worked = budget.clock() if began is None else began, time.process_time()
        self._candidates = self._evaluations = self._restarts = 0
        self._last = min(len(objective.scenes), MOST_SCENES)
        self._per_evaluation = 0.0
        self._finalists: list[_Scored] = []

    def run(self) -> SearchResult:
        """Search until the budget is used up."""
        stages = _stages(self._last)
        start = best = self._best_start(stages[0])
        self._finalists = [start]
        strategy = _Strategy(start.model, start.vector, self._generator)
        with contextlib.suppress(OutOfTimeError):
            for number, scenes in enumerate(stages, start=1):
                until = 1.0 if scenes == self._last else 1.0 - 2.0 ** (-number / STAGE_PACE)
                if number > 1 and self._share() < until:
                    best = replace(best, value=float(self._values([best], scenes)[0]))
                while start.model.size and self._share() < until and self._share(len(strategy) * scenes) < 1.0:
                    best = self._step(strategy, best, scenes)
                    if strategy.evolution.stop():
                        self._restarts += 1
                        strategy = _Strategy(best.model, best.vector, self._generator, self._restarts)
                    # what was best so far stands for its stage
                    self._finalists[number:] = [best]
        return self._chosen([*self._finalists, replace(start, vector=np.asarray(strategy.evolution.mean))])

    def _best_start(self, scenes: int) -> _Scored:
        """The best of all starts: of many, the best on few scenes are compared on more.

        The first one where the time ends before they are scored.
        """
        starts = [_Scored(model, model.zero) for model in self._starts]
        if len(starts) > STARTS_AT_ONCE:
            starts = self._ranked(starts, min(START_SCENES, scenes))[:STARTS_AT_ONCE]
        best = self._ranked(starts, scenes)[0]
        self._tell(best)
        return best

    def _ranked(self, starts: Sequence[_Scored], scenes: int) -> list[_Scored]:
        """Starts by their scores in the first scenes, the best first; those that are not scored come last."""
        values = np.full(len(starts), math.inf)
        with contextlib.suppress(OutOfTimeError):
            for first in range(0, len(starts), STARTS_AT_ONCE):
                group = slice(first, first + STARTS_AT_ONCE)
                values[group] = self._values(starts[group], scenes)
        order = np.argsort(values, kind="stable")
        return [replace(starts[index], value=float(values[index])) for index in order]

    def _step(self, strategy: _Strategy, best: _Scored, scenes: int) -> _Scored:
        """One population: asked, scored, told; the best so far.

        Raises:
            OutOfTimeError: The budget ended before all were scored.
        """
        asked = [_Scored(strategy.model, vector) for vector in strategy.evolution.ask()]
        values = self._values(asked, scenes)
        strategy.tell([one.vector for one in asked], values)
        first = int(values.argmin())
        if values[first] < best.value:
            best = replace(asked[first], value=float(values[first]))
        self._tell(best)
        return best

    def _values(self, scored: Sequence[_Scored], scenes: int) -> np.ndarray:
        """Mean scores over the first scenes, lower is better, one each."""
        lists = [one.model.positions(one.vector, self._rays) for one in scored]
        began = self._budget.clock()
        values = self._objective.values(lists, range(scenes), lambda: self._share() >= 1.0)
        self._candidates += len(lists)
        self._evaluations += values.size
        spent = (self._budget.clock() - began) / values.size
        # a running mean: the first scenes also build what is kept of them
        self._per_evaluation = spent if not self._per_evaluation else 0.7 * self._per_evaluation + 0.3 * spent
        return values.mean(axis=1)

    def _share(self, ahead: int = 0) -> float:
        """The share of the budget that is used up with so many evaluations more, and those of the finalists."""
        finalists = (len(self._finalists) + 1) * self._last
        # more than that, and they are compared on fewer scenes
        kept = min(finalists * self._per_evaluation, FINAL_SHARE * self._budget.seconds)
        finalists = min(finalists, FINAL_SHARE * self._budget.evaluations)
        elapsed = (self._budget.clock() - self._began + kept + ahead * self._per_evaluation) / self._budget.seconds
        return max(elapsed, (self._evaluations + finalists + ahead) / self._budget.evaluations)

    def _chosen(self, finalists: Sequence[_Scored]) -> SearchResult:
        """The best of the finalists, of which the first is the start, on all scenes or as many as there is time for."""
        left = self._budget.seconds - (self._budget.clock() - self._began)
        in_time = left / max(len(finalists) * self._per_evaluation, TINY)
        affordable = min(in_time, (self._budget.evaluations - self._evaluations) / len(finalists))
        scenes = int(np.clip(affordable, min(FIRST_SCENES, self._last), self._last))
        lists = [one.model.positions(one.vector, self._rays) for one in finalists]
        values = self._objective.values(lists, range(scenes)).mean(axis=1)
        self._evaluations += len(lists) * scenes
        best, sign = int(values.argmin()), self._objective.sign
        return SearchResult(
            model=finalists[best].model,
            vector=finalists[best].vector,
            start_value=sign * float(values[0]),
            value=sign * float(values[best]),
            seconds=self._budget.clock() - self._began,
            cpu_seconds=time.process_time() - self._worked,
            candidates=self._candidates,
            evaluations=self._evaluations,
            scenes=scenes,
            restarts=self._restarts,
        )

    def _tell(self, best: _Scored) -> None:
        if self._show is not None:
            self._show(Progress(min(self._share(), 1.0), self._evaluations, self._objective.sign * best.value))


def _stages(scenes: int) -> list[int]:
    """Numbers of scenes, doubling up to all."""
    found = [min(FIRST_SCENES, scenes)]
    while found[-1] < scenes:
        found.append(min(2 * found[-1], scenes))
    return found


class _Strategy:
    """The evolution strategy about a vector of one model.

    Arguments:
        model: Whose vectors it varies.
        mean: The first mean.
        generator: Of its random numbers.
        restart: How often a search has begun anew; each time the population doubles, up to a limit.
    """

    def __init__(self, model: DesignModel, mean: np.ndarray, generator: np.random.Generator, restart: int = 0) -> None:
        # loaded here: it takes a second, and few evaluations ask for it
        import cma

        usual = 4 + int(3 * math.log(max(model.size, 2)))
        options = {
            "popsize": usual * min(2**restart, MOST_POPULATION),
            "CMA_diagonal": model.size > MOST_CORRELATED,
            "seed": math.nan,  # the generator below is the only source of random numbers
            "randn": lambda *shape: generator.standard_normal(shape),
            "verbose": -9,
        }
        self.model, self.evolution = model, cma.CMAEvolutionStrategy(mean, STEP, options)

    def __len__(self) -> int:
        return self.evolution.popsize

    def tell(self, vectors: Sequence[np.ndarray], values: np.ndarray) -> None:
        """Scores of vectors; those beyond the constraints are ranked behind by how far they lie beyond.

        The distance is in units of the distribution, the penalty in those of the scores' own spread.
        """
        spread = float(np.subtract(*np.percentile(values, [75, 25])))
        penalty = np.array([self.model.excess(vector) for vector in vectors]) / self.evolution.sigma**2
        self.evolution.tell(vectors, (values + spread * penalty).tolist())
