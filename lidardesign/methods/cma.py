"""The method `cma`: the first design with its sensors optimised directly, by N. Hansen's `cma`.

A vector holds, sensor by sensor, the shift of its origin, of its boresight (azimuth, elevation, roll) and of its gates,
and the logarithms by which its field of view and its gates are wider, as far as they are free, in steps that change a
score about equally. The design's own rays move with their sensors, so the vector 0 is the design in any layout, and
the result is no worse than it on the scenes of the search. Constraints bound the vector and clip gates; rays with more
bandwidth than the design's rank behind all others.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from lidardesign.errors import BackgroundNote, ConfigError
from lidardesign.methods.movable import MovableSensors
from lidardesign.problem.method import DESIGN, Method
from lidardesign.problem.problem import DesignResult, Problem, ray_design
from lidardesign.problem.world import World
from lidardesign.run.clock import phase
from lidardesign.run.yaml import merged
from lidardesign.scoring.fired import Positions
from lidardesign.scoring.scene_scores import TrainingScorer
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import DesignSpace
from lidardesign.task import Metric, random_generator

CMA = "cma"
DEFAULT_SECONDS = 60.0
# More scenes tell candidates no better apart, and cost the search its time.
MOST_SCENES = 40
STEP = 0.3  # the first standard deviation, in units of the vector
# Beyond so many numbers a full covariance takes longer to learn than any search lasts: variances alone are adapted.
MOST_CORRELATED = 250
# Told what a search is for, the share of its time that is used up, and its best score so far.
Show = Callable[[str, float, float], None]


@dataclass(frozen=True)
class CmaSettings:
    """Limits of the search of the baseline `cma` at each number of rays; the first that is reached ends it.

    Arguments:
        seconds: Wall time [s].
        evaluations: Scores of one candidate in one scene.
        show: Called with the progress of each search.
    """

    seconds: float = DEFAULT_SECONDS
    evaluations: float = math.inf
    show: Show | None = None


@dataclass(frozen=True)
class SearchRecord:
    """A search and its result.

    Arguments:
        rays: The number of rays.
        sensors, parameters: Numbers of sensors and of parameters that it varied.
        seconds: Wall time [s].
        candidates: Number of candidates scored.
        training_scenes: Number of scenes that each was scored in.
        start_value, value: Mean scores of the design and of the best candidate there.
    """

    rays: int
    sensors: int
    parameters: int
    seconds: float
    candidates: int
    training_scenes: int
    start_value: float
    value: float

    def note(self, followed: str, metric: Metric) -> str:
        """One line for people, of a search that began at a design of this name."""
        return BackgroundNote(
            f"{CMA} at {self.rays} rays: {self.parameters} numbers of the sensors of {followed} varied for "
            f"{self.seconds:.0f} s, {self.candidates} candidates, {self.start_value:.4g} to {self.value:.4g} "
            f"{metric.unit} on {self.training_scenes} training scenes"
        )


class Cma(Method):
    """The method: see `Method`; every number of rays is a search of its own, whose record is in the provenance."""

    name = CMA
    summary = "direct optimisation of the first design's sensors on training scenes"
    needs = frozenset({DESIGN})

    def refuses(self, problem: Problem) -> str | None:
        """See `Method`: a search starts from single patterns of the first design."""
        starts = problem.compared.starts
        return "" if starts and self._count(problem) not in starts else None

    def design(self, problem: Problem) -> DesignResult | None:
        """See `Method`.

        Raises:
            ConfigError: There is no design to begin with.
        """
        world, compared = problem.world, problem.compared
        if not compared.designs:
            raise ConfigError(
                "there is no design whose sensors can be varied",
                where=f"--baseline {CMA}",
                allowed="at least one design",
            )
        search = world.known(self.name, lambda: self._search(problem))
        return DesignResult(search.found(self._count(problem)))

    def _count(self, problem: Problem) -> int:
        limit, readout = problem.limit_mbps, problem.readout
        within = [n for n, start in problem.compared.starts.items() if mean_mbps(start, readout) == limit]
        return max(within, default=0) if problem.rays is None else problem.rays

    def _search(self, problem: Problem) -> CmaSearch:
        world, design = problem.world, problem.compared.designs[0]
        middle = world.conditions[len(world.conditions) // 2]
        return CmaSearch(
            design=design,
            starts=problem.compared.starts,
            space=world.space.at({**middle, **design.at}) if world.space.conditioned else world.space,
            world=world,
            scorer=world.scorer(keeps_casters=True),
            settings=problem.config or CmaSettings(),
            seed=world.seed,
            bandwidth=problem.readout,
        )


METHOD = Cma()


@dataclass(eq=False)
class CmaSearch:
    """Searches for the sensors of a design, one for every number of rays.

    Arguments:
        design: Whose sensors are moved.
        starts: Its rays by their number.
        space: The design space at one condition value.
        world: The world, whose conditions rays are fired at.
        scorer: Scores on training scenes.
        settings: Limits of each search.
        seed: Root of the random numbers.
        bandwidth: The read-out model.

    `searches` has the rays that were found, and how, by their number.
    """

    design: DesignSpec
    starts: Mapping[int, Positions]
    space: DesignSpace
    world: World
    scorer: TrainingScorer
    settings: CmaSettings
    seed: int
    bandwidth: Bandwidth
    searches: dict[int, tuple[Positions, SearchRecord]] = field(default_factory=dict, init=False)

    def positions(self, count: int) -> Positions:
        """The best rays that a search found, of this number."""
        if count not in self.searches:
            self.searches[count] = self._searched(count)
        return self.searches[count][0]

    def found(self, count: int) -> DesignSpec:
        """The design of these rays, with the parts of the one that it began with."""
        lists = self.positions(count)
        origin = {"search": asdict(self.searches[count][1])}
        if lists is self.starts[count]:
            constraints = merged(self.design.constraints, {"budget": {"rays": count}})
            return replace(self.design, name=CMA, adaptive=None, constraints=constraints, provenance=origin)
        made = ray_design(CMA, lists, self.world, origin)
        used = np.unique(lists[0].sensor)
        sensors = [
            replace(sensor, name=own.name, part=own.part)
            for sensor, own in zip(made.sensors, (self.design.sensors[number] for number in used), strict=True)
        ]
        return replace(made, sensors=tuple(sensors))

    @phase("cma")
    def _searched(self, count: int) -> tuple[Positions, SearchRecord]:
        # loaded here: it takes a second, and few evaluations ask for it
        import cma

        began, settings, sign = time.perf_counter(), self.settings, self.scorer.metric.sign
        generator = random_generator(self.seed, CMA, count)
        sensors = MovableSensors(self.design, self.starts[count], self.space, self.bandwidth)
        low, high = sensors.vector_bounds
        best = np.zeros(len(low))
        value = start_value = float(sign * self.scorer.scores([sensors.start], MOST_SCENES).mean())
        candidates, scenes = 1, len(self.scorer.scenes(MOST_SCENES))

        def share() -> float:
            return max((time.perf_counter() - began) / settings.seconds, candidates * scenes / settings.evaluations)

        options = {
            "bounds": [low.tolist(), high.tolist()],
            "maxstd_boundrange": math.inf,
            "CMA_diagonal": len(best) > MOST_CORRELATED,
            "seed": math.nan,  # the generator is the only source of random numbers
            "randn": lambda *shape: generator.standard_normal(shape),
            "verbose": -9,
        }
        strategy = None
        while len(best) and share() < 1.0:
            if strategy is None or strategy.stop():
                # one that has converged begins anew at the best found so far
                strategy = cma.CMAEvolutionStrategy(best, STEP, options)
            asked = strategy.ask()
            values = self._values(sensors, asked, lambda: share() >= 1.0)
            if values is None:
                break
            strategy.tell(asked, values.tolist())
            candidates += len(asked)
            first = int(values.argmin())
            if values[first] < value:
                best, value = np.array(asked[first]), float(values[first])
            if settings.show is not None:
                settings.show(f"{CMA}, {count} rays", min(share(), 1.0), sign * value)
        values = sign * start_value, sign * value
        seconds = time.perf_counter() - began
        return sensors.rays(best), SearchRecord(count, sensors.count, len(best), seconds, candidates, scenes, *values)

    def _values(
        self, sensors: MovableSensors, vectors: Sequence[np.ndarray], stop: Callable[[], bool]
    ) -> np.ndarray | None:
        """Scores of vectors, lower is better, shape (L,); None where the time is up before the last scene."""
        lists = [sensors.rays(vector) for vector in vectors]
        excess = np.array([sensors.excess(positions) for positions in lists])
        metric, scores = self.scorer.metric, []
        values = metric.sign * metric.worst + excess
        fits = np.flatnonzero(excess == 0)
        for number in range(len(self.scorer.scenes(MOST_SCENES)) if len(fits) else 0):
            if number and stop():
                return None
            scores.append(self.scorer.scores_in(number, [lists[index] for index in fits]))
        if scores:
            values[fits] = metric.sign * np.mean(scores, axis=0)
        return values
