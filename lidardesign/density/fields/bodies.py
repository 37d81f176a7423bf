"""Many bodies in many columns as flat arrays: one row per body and frame, evaluated in the body's own frame.

A column is a scene, or a frame of a moving scene. Thousands of frames share the shapes of their bodies, so a frame
costs a pose and a bounding box, never a grid; meshes have one distance grid each, in their own frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lidardesign.density.fields.grids import Grid, cached_distance_grids, grid_around
from lidardesign.numerics import EPSILON
from lidardesign.scenes.scene import Body, Mesh, Scene, inverse_rigid
from lidardesign.scenes.surface import GRID, KINDS, PLANE, SIZES, SPHERE, half_extents_m

# Frames of one motion are close together: so many of them are looked at, or passed over, at once.
GROUP_COLUMNS = 16
# Of the sides of bounding boxes.
ROUNDINGS = 8
BuildGrid = Callable[[Mesh], tuple[Grid, np.ndarray]]
Entry = tuple[int, Body, int]


@dataclass(frozen=True, eq=False)
class Grids:
    """The distance grids of meshes in their own frames, end to end; row 0 stands for bodies without a grid.

    Arguments:
        values: All distances [m], float32.
        starts, counts, lows, inverse_steps: Where each grid begins and how it is placed, one row per grid.
        meshes: The mesh of each grid, from row 1 on.
        high: Upper corners of the grids, one row per grid.
        log_weights: log importance at the points of `values`, float32; None: 0 everywhere.
    """

    values: np.ndarray
    starts: np.ndarray
    counts: np.ndarray
    lows: np.ndarray
    inverse_steps: np.ndarray
    high: np.ndarray
    meshes: tuple[Mesh, ...]
    log_weights: np.ndarray | None = None


class BodyArrays(NamedTuple):
    """`Bodies` and the `Grids` of their meshes as arrays for the compiled loops.

    Arguments:
        kinds, sizes, to_body, grid, low, high, starts: See `Bodies`.
        values: The distances of all grids, end to end.
        grids: Low corner, counts, inverse step and start in `values` of each grid, shape (grids, 8).
        edges: The low and then the high sides of the bounding boxes by axis, shape (6, B).
    """

    kinds: np.ndarray
    sizes: np.ndarray
    to_body: np.ndarray
    grid: np.ndarray
    values: np.ndarray
    grids: np.ndarray
    low: np.ndarray
    high: np.ndarray
    edges: np.ndarray
    starts: np.ndarray


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points, or their rays, with the columns that matter to them, row by row.

    Arguments:
        row_starts: Where each point's pairs begin, shape (N + 1,).
        columns: Shape (P,).
        distances: Of the points to the columns' bodies, shape (P,) [m].
        bodies: The nearest body of each, shape (P,).
    """

    row_starts: np.ndarray
    columns: np.ndarray
    distances: np.ndarray
    bodies: np.ndarray

    @property
    def shape(self) -> tuple[int]:
        """The shape of an array with one value per pair, (P,)."""
        return self.columns.shape

    @property
    def rows(self) -> np.ndarray:
        """The point of each pair, shape (P,)."""
        return np.repeat(np.arange(len(self.row_starts) - 1), np.diff(self.row_starts))

    def where(self, mask: np.ndarray) -> Pairs:
        """The pairs in a mask (P,)."""
        before = np.concatenate([[0], np.cumsum(mask)])
        return Pairs(before[self.row_starts], self.columns[mask], self.distances[mask], self.bodies[mask])


@dataclass(frozen=True, eq=False)
class Bodies:
    """Bodies of many columns, sorted by column.

    Arguments:
        kinds: What each is (`SPHERE`, ...), shape (B,).
        sizes: Radius, radius and half length, or half extents or semi-axes, shape (B, 3) [m].
        to_body: Rows of the world-to-body transform, shape (B, 3, 4).
        grid: Row in `grids` of meshes, 0 for others, shape (B,).
        low, high: World bounding boxes, shape (B, 3); infinite for planes.
        column: The column of each, ascending, shape (B,).
        starts: Where each column begins, shape (columns + 1,).
        grids: Of the meshes.
        log_weight: log importance: that of each as a whole, and with its mesh's the least and the largest, shape
            (B, 3); None: 0 everywhere.
    """

    kinds: np.ndarray
    sizes: np.ndarray
    to_body: np.ndarray
    grid: np.ndarray
    low: np.ndarray
    high: np.ndarray
    column: np.ndarray
    starts: np.ndarray
    grids: Grids
    log_weight: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.kinds)

    @property
    def columns(self) -> int:
        """The number of columns."""
        return len(self.starts) - 1

    @cached_property
    def arrays(self) -> BodyArrays:
        """The arrays for the compiled loops."""
        # a little wider, so that no rounding passes over a surface on a face of its box
        grids, slack = self.grids, ROUNDINGS * EPSILON * np.maximum(np.abs(self.low), np.abs(self.high))
        edges = np.concatenate([(self.low - slack).T, (self.high + slack).T])
        return BodyArrays(
            self.kinds, self.sizes, self.to_body, self.grid, grids.values,
            np.column_stack([grids.lows, grids.counts, grids.inverse_steps, grids.starts]),
            self.low, self.high, edges, self.starts,
        )  # fmt: skip

    @property
    def grid_steps_m(self) -> np.ndarray:
        """The grid steps of all meshes [m]."""
        return 1.0 / self.grids.inverse_steps[1:]

    @cached_property
    def mesh_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounding boxes of the meshes in their own frames by grid row, shape (rows, 3) each [m]."""
        bounds = [np.zeros((2, 3)), *(mesh.bounds_m for mesh in self.grids.meshes)]
        return np.stack([b[0] for b in bounds]), np.stack([b[1] for b in bounds])

    @cached_property
    def group_edges(self) -> np.ndarray:
        """Boxes around `GROUP_COLUMNS` neighbouring columns each, as `BodyArrays.edges`; inverted for empty groups."""
        first = np.arange(0, self.columns, GROUP_COLUMNS)
        rows = self.starts[first]
        low, high = np.full((len(first), 3), np.inf), np.full((len(first), 3), -np.inf)
        filled = self.starts[np.minimum(first + GROUP_COLUMNS, self.columns)] > rows
        if filled.any():
            low[filled] = np.minimum.reduceat(self.low, rows[filled])
            high[filled] = np.maximum.reduceat(self.high, rows[filled])
        return np.concatenate([low.T, high.T])

    def take(self, columns: np.ndarray) -> Bodies:
        """The bodies of some columns, which become columns 0, 1, ... in this order."""
        counts = self.starts[columns + 1] - self.starts[columns]
        starts = np.concatenate([[0], np.cumsum(counts)])
        rows = np.arange(starts[-1]) - np.repeat(starts[:-1] - self.starts[columns], counts)
        names = ["kinds", "sizes", "to_body", "grid", "low", "high", *["log_weight"] * (self.log_weight is not None)]
        fields = {name: getattr(self, name)[rows] for name in names}
        return replace(self, **fields, column=np.repeat(np.arange(len(columns)), counts), starts=starts)


def occluding_bodies(scenes: Sequence[Scene]) -> Bodies:
    """The occluders of all scenes and frames; their meshes are only cast at, so they have no distance grids."""
    columns = [(scene, frame) for scene in scenes for frame in range(scene.frames)]
    entries = [
        (column, body, frame)
        for column, (scene, frame) in enumerate(columns)
        for body in scene.bodies
        if body.is_occluder
    ]
    return place_bodies(entries, len(columns), no_distances)


def own_grid(mesh: Mesh, resolution: int, padding_m: float) -> tuple[Grid, np.ndarray]:
    """The distance grid of a mesh in its own frame."""
    grid = grid_around(mesh.bounds_m, resolution, padding_m)
    return grid, cached_distance_grids([mesh], grid)[0]


def no_distances(mesh: Mesh) -> tuple[Grid, np.ndarray]:
    """A grid around a mesh whose distances nobody asks for."""
    return grid_around(mesh.bounds_m, 2, 0.0), np.zeros(0, dtype=np.float32)


def place_bodies(entries: Sequence[Entry], columns: int, build_grid: BuildGrid) -> Bodies:
    """The arrays of bodies, given with their column and frame in ascending order of columns."""
    poses = np.array([body.pose(frame) for _, body, frame in entries]).reshape(-1, 4, 4)
    column = np.array([column for column, _, _ in entries], dtype=np.int64)
    grids, grid = _grids(entries, build_grid)
    kinds = np.array([KINDS[type(body.shape)] for _, body, _ in entries], dtype=np.int64)
    sizes = np.array([SIZES[type(body.shape)](body.shape) for _, body, _ in entries], dtype=np.float64).reshape(-1, 3)
    # World boxes around every body, shape (B, 3) each; of a mesh, around its whole grid
    mesh, sphere, plane = kinds == GRID, kinds == SPHERE, kinds == PLANE
    half = np.array([half_extents_m(body.shape) for _, body, _ in entries], dtype=np.float64).reshape(-1, 3)
    centre, half[plane] = np.zeros((len(kinds), 3)), 0.0
    centre[mesh] = (grids.lows[grid[mesh]] + grids.high[grid[mesh]]) / 2
    half[mesh] = (grids.high[grid[mesh]] - grids.lows[grid[mesh]]) / 2
    rotation = poses[:, :3, :3]
    middle = np.einsum("bij,bj->bi", rotation, centre) + poses[:, :3, 3]
    reach = np.einsum("bij,bj->bi", np.abs(rotation), half)
    # a sphere is as wide in every turned frame
    reach[sphere] = half[sphere]
    reach[plane] = np.inf
    return Bodies(
        kinds=kinds,
        sizes=sizes,
        to_body=np.ascontiguousarray(inverse_rigid(poses)[:, :3]),
        grid=grid,
        low=np.ascontiguousarray(middle - reach),
        high=np.ascontiguousarray(middle + reach),
        column=column,
        starts=np.searchsorted(column, np.arange(columns + 1)),
        grids=grids,
    )


def _grids(entries: Sequence[Entry], build_grid: BuildGrid) -> tuple[Grids, np.ndarray]:
    """One grid per distinct mesh, and the grid row of every entry."""
    row_of: dict[tuple[str, str], int] = {}
    meshes: list[Mesh] = []
    row = np.zeros(len(entries), dtype=np.int64)
    for index, (_, body, _) in enumerate(entries):
        if isinstance(body.shape, Mesh):
            name = body.shape.content_hash, body.shape.importance_hash
            if name not in row_of:
                meshes.append(body.shape)
                row_of[name] = len(meshes)
            row[index] = row_of[name]
    built = [build_grid(mesh) for mesh in meshes]
    # row 0 is a grid of one empty cell, so that the kernels always have something to index
    values = [np.zeros(8, np.float32), *(distances for _, distances in built)]
    counts = np.array([np.full(3, 2), *(grid.counts for grid, _ in built)], dtype=np.int64)
    lows = np.array([np.zeros(3), *(grid.low for grid, _ in built)])
    steps = np.array([1.0, *(grid.step for grid, _ in built)])
    grids = Grids(
        values=np.concatenate(values),
        starts=np.concatenate([[0], np.cumsum([len(part) for part in values])[:-1]]).astype(np.int64),
        counts=counts,
        lows=lows,
        inverse_steps=1.0 / steps,
        high=lows + (counts - 1) * steps[:, None],
        meshes=tuple(meshes),
    )
    return grids, row
