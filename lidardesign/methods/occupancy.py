"""The method `occupancy`: rays towards the cells of a grid that targets occupy, by how often they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.methods.fields import central_interval
from lidardesign.methods.laid_out import LaidOut, Layout, Site
from lidardesign.methods.returns import opened_gate, spread_frames
from lidardesign.methods.uniform import random_layout
from lidardesign.numerics import TINY
from lidardesign.problem.problem import Problem
from lidardesign.scenes.scene import Scene
from lidardesign.scenes.surface import sample_body
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, observed_point
from lidardesign.task import random_generator

CELLS = 64  # along the longest side of the box round all surface points
MOST_VIEWS = 4096  # scenes times frames that enter the grid, evenly spread where there are more
SURFACE_POINTS = 400_000  # over all views, between these numbers in each
FEWEST_POINTS, MOST_POINTS = 256, 4096
BLOCK = 16_384  # draws at a time
HOPELESS_BLOCKS = 32  # without one aimed point
# Rays are drawn from so many times as many weighted points as there are rays, so that few are drawn twice.
POINTS_PER_RAY = 16
GATE_POINTS = 4096


def occupancy_layout(problem: Problem) -> Layout | None:
    """The layout; None where no admissible ray ends in an occupied cell.

    The grid's cells are cubes; a cell's probability is the share of training scenes and frames in which a target's
    surface lies in it. A ray starts at a uniform admissible origin and is aimed at a uniform point of a cell that is
    drawn by its probability, among all such pairs that the design space admits; occlusion is ignored. The gate is
    the central 99 % of the distances to these points. Rays are drawn anew for every scene. At a condition value where
    none ends in an occupied cell, rays are uniform in what is left of the space.
    """
    space, train, seed = problem.world.space, problem.world.learned, problem.world.seed
    if not train:
        return None
    grid = occupancy_grid(train, space, seed)
    points, weights = AimedPoints(grid, space, seed, 0).first(GATE_POINTS)
    if not len(points):
        return None
    drawn = random_generator(seed, "occupancy gate").choice(len(points), GATE_POINTS, p=weights / weights.sum())
    gate_m = opened_gate(*central_interval(points[drawn, RANGE]))
    known: dict[int, AimedPoints] = {}

    def lay_out(count: int, site: Site) -> tuple[np.ndarray, np.ndarray]:
        aimed = known.setdefault(site.number, AimedPoints(grid, site.space, seed, 1 + site.number))
        generator = random_generator(seed, "occupancy baseline", count, site.draw, site.number)
        found, weights = aimed.first(POINTS_PER_RAY * count)
        if not len(found):
            return site.space.sample(count, generator), gate_m
        return found[generator.choice(len(found), count, p=weights / weights.sum())], gate_m

    return Layout("occupancy", lay_out)


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


OCCUPANCY = LaidOut(
    "occupancy", "rays towards cells that targets occupy, drawn anew in every scene",
    lambda problem: [occupancy_layout(problem) or random_layout(problem)], is_redrawn=True,
)  # fmt: skip
