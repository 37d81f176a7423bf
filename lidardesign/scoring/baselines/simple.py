"""The baselines that stand beside every design, by name.

Each is built for exactly N rays, alone from the design space and from the training scenes. A baseline is one or
more candidate layouts; where there are several, the best on training scenes is taken at each number of rays.

- `uniform`: rays even on the sphere over the whole design space, with the whole range as their gate. Free origin axes
  join the layout: two free axes in all give a grid, more a low-discrepancy set.
- `random`: rays uniform in the measure of the design space, with the whole range as their gate, drawn anew for
  every scene.
- `bounding`: one even layout over where the training returns are, see `lidardesign.scoring.baselines.even`.
- `silhouette` and `lloyd`: rays and gates by what training scenes return, see
  `lidardesign.scoring.baselines.silhouette`.
- `greedy`: rays chosen on training scenes without a density, see `lidardesign.scoring.baselines.greedy`.
- `occupancy`: rays towards the cells of a grid that targets occupy, by how often they do, see `occupancy`.
- `no-visibility`: the first design fitted anew to the density without its occlusion term; the number of sensors, the
  layout, the constraints, the level and the seed stay. It is not weighted, even where the design is.
- `cma`: see `lidardesign.scoring.baselines.cma`.

Where the density has conditions, every baseline is laid out at each of their values, in what is left free there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.numerics import TINY
from lidardesign.run.clock import phase
from lidardesign.scenes.scene import Scene
from lidardesign.scenes.surface import sample_body
from lidardesign.scoring.baselines.candidates import BaselineLayout, Candidate, LayoutSite, opened_gate, whole_range
from lidardesign.scoring.baselines.cma import CMA
from lidardesign.scoring.baselines.even import bounding, central_interval, even_placement
from lidardesign.scoring.baselines.greedy import GREEDY, Fired
from lidardesign.scoring.baselines.silhouette import lloyd, silhouette
from lidardesign.scoring.baselines.views import RAY_AXES, TrainingViews, spread_frames
from lidardesign.scoring.fired import Positions, fired
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, observed_point
from lidardesign.task import random_generator

Judge = Callable[[Sequence[Positions]], Sequence[float]]
NO_VISIBILITY = "no-visibility"
# In the place of names: no baselines at all.
NONE = "none"
# What stands beside every design, asked for or not.
ALWAYS = ("uniform", "random", "bounding", "silhouette", GREEDY)
FEWER_RAYS = 0.9  # of those that did not fit in a bandwidth
# Of `occupancy`: cells along the longest side of the box round all surface points.
CELLS = 64
MOST_VIEWS = 4096  # scenes times frames that enter the grid, evenly spread where there are more
SURFACE_POINTS = 400_000  # over all views, between these numbers in each
FEWEST_POINTS, MOST_POINTS = 256, 4096
BLOCK = 16_384  # draws at a time
HOPELESS_BLOCKS = 32  # without one aimed point
# Rays are drawn from so many times as many weighted points as there are rays, so that few are drawn twice.
POINTS_PER_RAY = 16
GATE_POINTS = 4096


class Option(NamedTuple):
    """A candidate at a number of rays."""

    candidate: Candidate
    positions: Positions


class Baselines:
    """Builds baselines for one design space and one set of training scenes, which it traces once.

    Arguments:
        space: The design space.
        train: Training scenes.
        seed: Root of the baselines that are drawn.
        judge: Scores lists of rays on training scenes, lower is better.
        conditions: The condition values that rays are laid out at.
        gates_per_ray: Whether the rays of `bounding` may have gates of their own.
        without_visibility: Makes the layout of `no-visibility`, when that is asked for.
        optimised: Makes the layout of `cma`, when that is asked for.
        chosen: Makes the layout of `greedy`, when that is asked for.
    """

    def __init__(
        self,
        space: DesignSpace,
        train: Sequence[Scene],
        seed: int,
        judge: Judge,
        *,
        conditions: Sequence[Mapping[str, float]] = ({},),
        gates_per_ray: bool = False,
        without_visibility: Callable[[], Candidate] | None = None,
        optimised: Callable[[], Candidate] | None = None,
        chosen: Callable[[TrainingViews], Candidate],
    ) -> None:
        self.space, self.train, self.seed = space, train, seed
        self.spaces = [space.at(condition) for condition in conditions]
        self.views = TrainingViews(space, train)
        self.gates_per_ray = gates_per_ray
        self.without_visibility, self.optimised, self.chosen = without_visibility, optimised, chosen
        self._judge = judge
        # laid out once
        self.candidates = cache(self._candidates)
        self._scores: dict[tuple[str, str, int], float] = {}

    def options(self, name: str, count: int) -> list[Option]:
        """All candidates of a baseline at a number of rays."""
        return [Option(one, one.positions(self.spaces, count)) for one in self.candidates(name)]

    def options_within(self, name: str, limit_mbps: float, bandwidth: Bandwidth) -> list[Option]:
        """All candidates of a baseline with as many rays as fit in a bandwidth [Mbit/s].

        Empty where more than `MOST_RAYS` fit for one of them, since the baseline would be weaker without it.
        """
        options = []
        for one in self.candidates(name):
            positions = one.positions_within(self.spaces, limit_mbps, bandwidth)
            if positions is None:
                return []
            options.append(Option(one, positions))
        return options

    def _candidates(self, name: str) -> Sequence[Candidate]:
        """The layouts that a baseline chooses from; those of `uniform` where no training scene returns anything.

        Raises:
            ConfigError: There is no such baseline.
        """
        check_baseline(name)
        return BASELINES[name](self) or _uniform(self)

    @phase("baselines")
    def best(self, choices: Sequence[tuple[str, list[Option]]]) -> list[Option]:
        """The option of each baseline that scores best on training scenes, the first of equals.

        All options that were not scored before are scored together.
        """
        unknown = {
            key: option.positions
            for name, options in choices
            for key, option in _keyed(name, options)
            if len(options) > 1 and key not in self._scores
        }
        if unknown:
            self._scores.update(zip(unknown, self._judge(list(unknown.values())), strict=True))
        return [
            min(_keyed(name, options), key=lambda one: self._scores.get(one[0], 0.0))[1] for name, options in choices
        ]


def _keyed(name: str, options: Sequence[Option]) -> list[tuple[tuple[str, str, int], Option]]:
    return [((name, one.candidate.name, len(one.positions[0])), one) for one in options]


def _uniform(source: Baselines) -> list[Candidate]:
    def lay_out(count: int, site: LayoutSite) -> tuple[np.ndarray, np.ndarray]:
        points = even_placement(site.space.low[:RAY_AXES], site.space.high[:RAY_AXES], count)
        return points, whole_range(source.space)

    return [BaselineLayout("even", lay_out)]


def _random(source: Baselines) -> list[Candidate]:
    def lay_out(count: int, site: LayoutSite) -> tuple[np.ndarray, np.ndarray]:
        # the first position draws what a space without conditions draws
        later = [site.number] if site.number else []
        generator = random_generator(source.seed, "random baseline", count, site.scene, *later)
        return site.space.sample(count, generator), whole_range(source.space)

    return [BaselineLayout("random", lay_out, drawn_anew=True)]


def _greedy(source: Baselines) -> list[Candidate]:
    return [source.chosen(source.views)] if len(source.views.observed(source.space)) else []


def _occupancy(source: Baselines) -> list[Candidate]:
    layout = occupancy(source.space, source.train, source.seed)
    return _random(source) if layout is None else [layout]


def _no_visibility(source: Baselines) -> list[Candidate]:
    if source.without_visibility is None:
        raise ConfigError(
            "there is no design to refit without occlusion",
            where=f"--baseline {NO_VISIBILITY}",
            allowed="at least one design whose run can be found",
            hint="evaluate the run, or a design in its folder",
        )
    return [source.without_visibility()]


def _cma(source: Baselines) -> list[Candidate]:
    if source.optimised is None:
        raise ConfigError(
            "there is no design whose sensors can be varied",
            where=f"--baseline {CMA}",
            allowed="at least one design",
        )
    return [source.optimised()]


BASELINES: dict[str, Callable[[Baselines], Sequence[Candidate]]] = {
    "uniform": _uniform,
    "random": _random,
    "bounding": lambda source: bounding(source.views, gates_per_ray=source.gates_per_ray),
    "silhouette": lambda source: silhouette(source.views),
    "lloyd": lambda source: lloyd(source.views),
    GREEDY: _greedy,
    "occupancy": _occupancy,
    NO_VISIBILITY: _no_visibility,
    CMA: _cma,
}


def check_baseline(name: str, *, where: str = "baselines") -> None:
    """Refuse a name that is no baseline's.

    Raises:
        ConfigError: There is no such baseline.
    """
    if name not in BASELINES:
        raise ConfigError(f"unknown baseline {name!r}", where=where, allowed=", ".join(BASELINES))


class TwinCandidate:
    """A design that is fitted anew for each number of rays, as a baseline's layout.

    Arguments:
        fit: The design with so many rays, within a bandwidth [Mbit/s] or without a limit.
        conditions: The condition values.
        fired: Rays and bandwidth of the designs compared with.
    """

    drawn_anew = False
    name = NO_VISIBILITY

    def __init__(
        self,
        fit: Callable[[int, float | None], DesignSpec],
        conditions: Sequence[Mapping[str, float]],
        fired: Sequence[Fired],
    ) -> None:
        self._fit, self._conditions, self._fired = fit, conditions, fired

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> Positions:
        """See `lidardesign.scoring.baselines.candidates.Candidate`."""
        return self._rays(count, None)

    def positions_within(self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth) -> Positions:
        """As many rays as the design of this bandwidth fires, or fewer where its own gates need more for so many."""
        count = max(one.rays for one in self._fired if one.mbps == limit_mbps)
        while True:
            try:
                return self._rays(count, limit_mbps)
            except InfeasibleError as error:
                if count == 1 or "budget.bandwidth_mbps" not in error.conflicts:
                    raise
                count = math.floor(FEWER_RAYS * count)

    def _rays(self, count: int, limit_mbps: float | None) -> Positions:
        return fired(self._fit(count, limit_mbps), count, self._conditions)


def occupancy(space: DesignSpace, train: Sequence[Scene], seed: int) -> BaselineLayout | None:
    """The layout of the baseline; None where no admissible ray ends in an occupied cell.

    The grid's cells are cubes; a cell's probability is the share of training scenes and frames in which a target's
    surface lies in it. A ray starts at a uniform admissible origin and is aimed at a uniform point of a cell that is
    drawn by its probability, among all such pairs that the design space admits; occlusion is ignored. The gate is
    the central 99 % of the distances to these points. Rays are drawn anew for every scene. At a condition value where
    none ends in an occupied cell, rays are uniform in what is left of the space.
    """
    if not train:
        return None
    grid = occupancy_grid(train, space, seed)
    points, weights = AimedPoints(grid, space, seed, 0).first(GATE_POINTS)
    if not len(points):
        return None
    drawn = random_generator(seed, "occupancy gate").choice(len(points), GATE_POINTS, p=weights / weights.sum())
    gate_m = opened_gate(*central_interval(points[drawn, RANGE]))
    known: dict[int, AimedPoints] = {}

    def lay_out(count: int, site: LayoutSite) -> tuple[np.ndarray, np.ndarray]:
        aimed = known.setdefault(site.number, AimedPoints(grid, site.space, seed, 1 + site.number))
        generator = random_generator(seed, "occupancy baseline", count, site.scene, site.number)
        found, weights = aimed.first(POINTS_PER_RAY * count)
        if not len(found):
            return site.space.sample(count, generator), gate_m
        return found[generator.choice(len(found), count, p=weights / weights.sum())], gate_m

    return BaselineLayout("occupancy", lay_out, drawn_anew=True)


def occupancy_grid(scenes: Sequence[Scene], space: DesignSpace, seed: int) -> OccupancyGrid:
    """The grid of all scenes and frames, from points sampled on the surfaces of the targets."""
    views = spread_frames(scenes, MOST_VIEWS)
    generator = random_generator(seed, "occupancy grid")
    count = int(np.clip(SURFACE_POINTS // len(views), FEWEST_POINTS, MOST_POINTS))
    targets = [[body for body in scene.bodies if body.is_target] for scene in scenes]
    points = [sample_body(targets[scene], space, count, generator, frame).points for scene, frame in views]
    everything = np.concatenate(points)
    low, high = everything.min(axis=0), everything.max(axis=0)
    # one cell more than fits, so that the highest point has one too
    edge = float((high - low).max()) / CELLS or 1.0
    times = np.zeros(np.floor((high - low) / edge).astype(np.int64) + 1)
    for view in points:
        times[tuple(np.unique(np.floor((view - low) / edge).astype(np.int64), axis=0).T)] += 1
    return OccupancyGrid(low, edge, times / len(views))


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """A grid with the probability that targets' surfaces lie in its cells.

    Arguments:
        low_m: Its lower corner, shape (3,).
        edge_m: The edge of its cubes.
        probability: The share of scenes and frames in which a cell is occupied, shape (A, B, C).
    """

    low_m: np.ndarray
    edge_m: float
    probability: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """The probability of the cells that points (N, 3) lie in, 0 outside the grid, shape (N,)."""
        cell = np.floor((points - self.low_m) / self.edge_m)
        inside = ((cell >= 0) & (cell < self.probability.shape)).all(axis=1)
        found = np.zeros(len(points))
        found[inside] = self.probability[tuple(cell[inside].astype(np.int64).T)]
        return found

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Points uniform in cells that are drawn by their probability, shape (count, 3)."""
        share = self.probability.ravel() / self.probability.sum()
        chosen = generator.choice(len(share), count, p=share)
        cell = np.stack(np.unravel_index(chosen, self.probability.shape), axis=1)
        return self.low_m + self.edge_m * (cell + generator.random((count, 3)))


class AimedPoints:
    """Design points that end in occupied cells, with weights that make their ends uniform in volume.

    Where an angle is fixed, no ray could be aimed at a given point. Uniform design points are weighted instead: by the
    probability of the cell that they end in, and by the volume that a ray's end sweeps there, which grows with the
    range where one angle is free and not at all where none is.

    Arguments:
        grid: The cells.
        space: The design space, or what is left of it at a condition value.
        seed, number: Root of the draws, and the index of the condition value.
    """

    def __init__(self, grid: OccupancyGrid, space: DesignSpace, seed: int, number: int) -> None:
        self._free_angles = sum(axis in space.free for axis in (AZIMUTH, ELEVATION))
        self._space = replace(space, measure="angles")
        self._grid, self._seed, self._number = grid, seed, number
        self._blocks: list[tuple[np.ndarray, np.ndarray]] = []

    def first(self, effective_samples: int) -> tuple[np.ndarray, np.ndarray]:
        """The first points (N, 6) of this effective number, or of less where it is out of reach, with weights (N,).

        The result does not depend on earlier calls.
        """
        chosen: list[tuple[np.ndarray, np.ndarray]] = []
        total = squares = 0.0
        while len(chosen) < 128 and total**2 < effective_samples * max(squares, TINY):
            if len(chosen) == HOPELESS_BLOCKS and total == 0.0:
                break
            if len(chosen) == len(self._blocks):
                self._blocks.append(self._block(len(chosen)))
            chosen.append(self._blocks[len(chosen)])
            total += float(chosen[-1][1].sum())
            squares += float(np.square(chosen[-1][1]).sum())
        points, weights = zip(*chosen, strict=True) if chosen else ([np.zeros((0, 6))], [np.zeros(0)])
        return np.concatenate(points), np.concatenate(weights)

    def _block(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        generator = random_generator(self._seed, "occupancy points", self._number, index)
        points = self._space.sample(BLOCK, generator)
        if self._free_angles == 2:
            points = aim(points[:, :3], self._grid.draw(BLOCK, generator))
            points = self._space.wrap(points[self._space.contains(points)])
            return points, np.ones(len(points))
        weights = self._grid.at(observed_point(points)) * points[:, RANGE] ** self._free_angles
        aimed = weights > 0
        return points[aimed], weights[aimed]
