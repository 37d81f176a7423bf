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

from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import BandwidthBudget
from lidardesign.constraints.origins import mounts_of
from lidardesign.errors import BackgroundNote, ConfigError
from lidardesign.mixture.bounds import bounds_of
from lidardesign.mixture.components import Axes
from lidardesign.numerics import SLACK, TINY, sphere_exp, sphere_log, wrap_angle
from lidardesign.problem.method import API_VERSION, DESIGN
from lidardesign.problem.problem import DesignResult, Problem, ray_design
from lidardesign.problem.world import World
from lidardesign.rays.gates import admitted_gates
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import Positions
from lidardesign.scoring.scene_scores import TrainingScorer
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import boresight_frame, interval_factor
from lidardesign.space import DesignSpace, angles, direction
from lidardesign.task import Metric, random_generator

CMA = "cma"
DEFAULT_SECONDS = 60.0
# More scenes tell candidates no better apart, and cost the search its time.
MOST_SCENES = 40
STEP = 0.3  # the first standard deviation, in units of the vector
# Beyond so many numbers a full covariance takes longer to learn than any search lasts: variances alone are adapted.
MOST_CORRELATED = 250
# Columns of a sensor's numbers.
ORIGIN, AIM, AZIMUTH, ELEVATION, ROLL, FIELD, GATE = slice(0, 3), slice(3, 6), 3, 4, 5, slice(6, 8), slice(8, 10)
# One unit: shares of the box of origins, of the field of view and of the gate, radians of roll, or nats.
BOX_SHARE, FIELD_SHARE, ROLL_RAD, GATE_SHARE, LOG_STEP = 0.05, 0.15, 0.2, 0.1, 0.15
NARROWEST_RAD, STEEPEST_COSINE = 1e-3, 0.1
WIDEST_LOG = 5.0

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


class MovableSensors:
    """The sensors of a design, and its rays as they move with them.

    Arguments:
        design: Whose sensors and constraints.
        start: Its rays, of which all sensors have some or none.
        space: The design space at one condition value.
        bandwidth: The read-out model of the comparison.

    `vector_bounds` are the lowest and the highest vector, shape (2, M).
    """

    def __init__(self, design: DesignSpec, start: Positions, space: DesignSpace, bandwidth: Bandwidth) -> None:
        constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
        every, z = Rays.joined(start), interval_factor(design.level)
        self.start, self.count, self._axes = start, int(every.sensor.max()) + 1, Axes.of(space)
        self._bounds = bounds_of(constraints.rules, space, tuple(range(self.count)), z)
        models = (bandwidth, BandwidthBudget.of(constraints, None).model)
        self._limits = [(model, mean_mbps(start, model)) for model in models]
        sensors = design.sensors[: self.count]
        self._aim = np.array([(one.azimuth_rad, one.elevation_rad, one.roll_rad) for one in sensors])
        spread = np.array([one.field_of_view_rad for one in sensors]) / (2 * z)
        self._frames = np.array([boresight_frame(*aim) for aim in self._aim])
        sides = self._changes(every, spread)
        if any(mounts_of(rules) or rules.origin.exclude for rules in constraints.rules):
            sides[..., ORIGIN] = 0.0
        parts = [index for index, sensor in enumerate(design.sensors[: self.count]) if sensor.part is not None]
        sides[:, parts, FIELD.start :] = 0.0
        sides[:, np.bincount(every.sensor) == 0] = 0.0
        # a start at a bound may lie an ulp beyond it
        self._low, self._high = np.minimum(sides[0], 0.0), np.maximum(sides[1], 0.0)
        self._free = self._high - self._low > SLACK
        self._unit = np.minimum(self._units(every, spread), np.where(self._free, self._high - self._low, 1.0))
        self.vector_bounds = [(side / self._unit)[self._free] for side in (self._low, self._high)]

    def _changes(self, every: Rays, spread: np.ndarray) -> np.ndarray:
        """Lowest and highest change of each parameter, shape (2, G, 10); 0 where it is not free."""
        axes, bounds, sides = self._axes, self._bounds, np.zeros((2, self.count, 10))
        first, last = np.full((self.count, 3), np.inf), np.full((self.count, 3), -np.inf)
        np.minimum.at(first, every.sensor, every.origin_m)
        np.maximum.at(last, every.sensor, every.origin_m)
        for axis in axes.origin:
            sides[..., axis] = (bounds.origin_low - first)[:, axis], (bounds.origin_high - last)[:, axis]
        if axes.horizontal:
            offset = np.where(bounds.azimuth_half < math.pi, wrap_angle(self._aim[:, 0] - bounds.azimuth_centre), 0.0)
            sides[..., AZIMUTH] = -bounds.azimuth_half - offset, bounds.azimuth_half - offset
        if axes.vertical:
            sides[..., ELEVATION] = bounds.elevation_low - self._aim[:, 1], bounds.elevation_high - self._aim[:, 1]
        if axes.angular == 2:
            rolls = np.stack([bounds.roll_low, bounds.roll_high])
            is_bounded = np.ptp(rolls, axis=0) < math.pi / 2
            sides[..., ROLL] = np.where(is_bounded, rolls - self._aim[:, 2], np.array([[-math.pi], [math.pi]]))
        wide = np.array([axes.horizontal, axes.vertical]) & (spread > 0)
        widest = np.minimum(bounds.spread_high * [axes.angle_scale, 1.0], math.pi / 2 / bounds.interval)
        ends = np.stack([bounds.spread_low * [axes.angle_scale, 1.0], widest]) / np.where(wide, spread, 1.0)
        sides[..., FIELD] = np.where(wide, np.log(np.clip(ends, *np.exp([-WIDEST_LOG, WIDEST_LOG]))), 0.0)
        if axes.range:
            reach_m = np.ptp(every.gate_m)
            sides[..., GATE] = np.array([(-reach_m, -WIDEST_LOG), (reach_m, WIDEST_LOG)])[:, None]
        return sides

    def _units(self, every: Rays, spread: np.ndarray) -> np.ndarray:
        """The unit of each parameter, shape (G, 10)."""
        unit = np.full((self.count, 10), LOG_STEP)
        unit[:, ORIGIN] = np.maximum(BOX_SHARE * (self._bounds.origin_high - self._bounds.origin_low), TINY)
        middle = every.direction.mean(axis=0)
        away = (every.direction @ middle).min() / max(np.linalg.norm(middle), TINY)
        even = 2 * math.acos(np.clip(away, -1.0, 1.0)) / self.count ** (1 / max(self._axes.angular, 1))
        field = np.where(spread.max(axis=1) > 0, 2 * self._bounds.interval * spread.max(axis=1), even)
        unit[:, ELEVATION] = FIELD_SHARE * np.maximum(field, NARROWEST_RAD)
        unit[:, AZIMUTH] = unit[:, ELEVATION] / np.maximum(np.cos(self._aim[:, 1]), STEEPEST_COSINE)
        unit[:, ROLL] = ROLL_RAD
        unit[:, GATE.start] = GATE_SHARE * max(float(np.ptp(every.gate_m, axis=1).mean()), TINY)
        return unit

    def rays(self, vector: np.ndarray) -> Positions:
        """The rays of a vector (M,); of the vector 0 those of the design."""
        if not vector.any():
            return self.start
        change = np.zeros(self._unit.shape)
        change[self._free] = vector * self._unit[self._free]
        change = np.clip(change, self._low, self._high)
        return tuple(self._moved(rays, change) for rays in self.start)

    def _moved(self, rays: Rays, change: np.ndarray) -> Rays:
        sensor, own, rows = rays.sensor, change[rays.sensor], self._bounds.take(rays.sensor)
        if self._axes.angular == 2:
            local = np.einsum("nij,nj->ni", self._frames[sensor], rays.direction)
            turned = np.array([boresight_frame(*aim) for aim in self._aim + change[:, AIM]])
            local = sphere_exp(sphere_log(local) * np.exp(own[:, FIELD]))
            azimuth, elevation = angles(np.einsum("nij,ni->nj", turned[sensor], local))
        else:
            # in the plane or on the cone that the design space holds all rays in
            offset = np.stack(angles(rays.direction), axis=1) - self._aim[sensor, :2]
            offset[:, 0] = wrap_angle(offset[:, 0])
            azimuth, elevation = (self._aim[sensor, :2] + own[:, AIM][:, :2] + offset * np.exp(own[:, FIELD])).T
        middle, half = rays.gate_m.mean(axis=1) + own[:, 8], np.ptp(rays.gate_m, axis=1) / 2 * np.exp(own[:, 9])
        gate_m = np.stack([middle - half, middle + half], axis=1)
        varied = own[:, GATE].any(axis=1, keepdims=True)
        gate_m = np.where(varied, admitted_gates(gate_m, rows), rays.gate_m) if varied.any() else rays.gate_m
        looking = direction(azimuth, elevation)
        angles_rad = np.stack([azimuth, elevation], axis=1)
        place_m = rays.origin_m + own[:, ORIGIN]
        return replace(rays, origin_m=place_m, direction=looking, gate_m=gate_m, angles_rad=angles_rad)

    def excess(self, positions: Positions) -> float:
        """The share by which the bandwidth of rays exceeds the design's; 0 where it does not."""
        return max(max(mean_mbps(positions, model) / limit - 1 - SLACK, 0.0) for model, limit in self._limits)


class Cma:
    """The method: see `Method`; every number of rays is a search of its own, whose record is in the provenance."""

    name = CMA
    summary = "direct optimisation of the first design's sensors on training scenes"
    api_version = API_VERSION
    needs = frozenset({DESIGN})
    is_redrawn = False

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
        found = world.known(self.name, lambda: self._search(problem)).found(self._count(problem))
        return DesignResult(found)

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
            return replace(self.design, name=CMA, adaptive=None, provenance=origin)
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
