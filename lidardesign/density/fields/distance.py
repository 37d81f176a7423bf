"""Distances of many scenes at once: one column per scene, or per frame of a moving scene.

Meshes at rest share one table (grid points by columns); primitives and moving bodies are evaluated exactly or in
their own frame by transforming the query. Distances are positive outside and exact for primitives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from types import ModuleType

import numpy as np

from lidardesign.density.fields import grids
from lidardesign.density.fields.bodies import Bodies, Pairs, own_grid, place_bodies
from lidardesign.density.fields.grids import Grid, GridTable, cached_distance_grids, grid_around
from lidardesign.errors import ConfigError
from lidardesign.scenes.scene import Body, Mesh, Scene

MAXIMUM_TABLE_BYTES = 6 * 2**30
FAR_M = np.float32(1e9)  # the distance of a column without a mesh in the table


def body_kernels() -> ModuleType:
    """The compiled loops over bodies, which take 0.8 s to load: when they are first used."""
    from lidardesign.density.fields import body_kernels

    return body_kernels


def table_kernels() -> ModuleType:
    """The compiled loops over tables, likewise."""
    from lidardesign.density.fields import table_kernels

    return table_kernels


@dataclass(frozen=True, eq=False)
class GridColumns:
    """Values of all columns at the points of one grid: a row per grid point.

    Arguments:
        table: Shape (grid points, columns) float32.
        grid: Where the rows are.
        compiled: Whether values come from the compiled kernels, which take 0.8 s to load.
    """

    table: np.ndarray
    grid: Grid
    compiled: bool = field(default=True, kw_only=True)

    @property
    def columns(self) -> int:
        """The number of columns."""
        return self.table.shape[1]

    @cached_property
    def arrays(self) -> GridTable:
        """As the compiled loops take it."""
        return GridTable(self.table, self.grid.counts, self.grid.low, 1.0 / self.grid.step)

    def _read(self, points: np.ndarray, *, grows: bool) -> np.ndarray:
        """Values at points, (N, 3) to (N, columns): beyond the grid those at its faces, or distances that grow."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        if not self.compiled:
            return grids.table_values(self.arrays, points, grows=grows)
        kernels, out = table_kernels(), np.empty((len(points), self.columns), dtype=np.float32)
        (kernels.table_distances if grows else kernels.table_values)(self.arrays, points, out)
        return out

    def _contract(self, points: np.ndarray, weights: np.ndarray, *, grows: bool) -> np.ndarray:
        """Gradients of sum_c weights_nc * value_c(points_n): (N, 3), (N, columns) to (N, 3)."""
        points, weights = (np.ascontiguousarray(values, dtype=np.float64) for values in (points, weights))
        out = np.empty_like(points)
        kernels = table_kernels()
        (kernels.table_gradient if grows else kernels.table_value_gradient)(self.arrays, points, weights, out)
        return out


@dataclass(frozen=True, eq=False)
class TableField(GridColumns):
    """Distances of meshes at rest [m].

    Arguments:
        shell_m: Half the thickness given to surfaces without an inside where they occlude, shape (columns,).
    """

    shell_m: np.ndarray

    @property
    def grid_steps_m(self) -> np.ndarray:
        """The grid steps of all meshes [m]: none where every distance is exact."""
        return np.array([self.grid.step])

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distances at points: (N, 3) to (N, columns) [m]."""
        return self._read(points, grows=True)

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Gradients of sum_c weights_nc * d_c(points_n): (N, 3), (N, columns) to (N, 3)."""
        return self._contract(points, weights, grows=True)


def all_pairs(bodies: Bodies, points: np.ndarray) -> Pairs:
    """Points (N, 3) with all columns."""
    shape = len(points), bodies.columns
    distances, nearest = np.empty(shape), np.empty(shape, dtype=np.int64)
    body_kernels().all_distances(bodies.arrays, np.ascontiguousarray(points, dtype=np.float64), distances, nearest)
    columns = np.tile(np.arange(shape[1]), shape[0])
    return Pairs(np.arange(shape[0] + 1) * shape[1], columns, distances.ravel(), nearest.ravel())


class BodyField:
    """Primitives and moving bodies, each evaluated in its own frame.

    Arguments:
        bodies: Every body that counts, by column.
    """

    def __init__(self, bodies: Bodies) -> None:
        self.bodies = bodies
        self.columns, self.grid_steps_m = bodies.columns, bodies.grid_steps_m
        self.shell_m = np.zeros(bodies.columns)
        steps = 1.0 / bodies.grids.inverse_steps
        unsigned = np.array([False, *(mesh.sign == "unsigned" for mesh in bodies.grids.meshes)])
        np.maximum.at(self.shell_m, bodies.column, np.where(unsigned, steps, 0.0)[bodies.grid])

    def distances(self, points: np.ndarray) -> np.ndarray:
        """See `TableField`."""
        return all_pairs(self.bodies, points).distances.reshape(len(points), self.columns)

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `TableField`."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        pairs, out = all_pairs(self.bodies, points), np.empty_like(points)
        # a column without bodies has no nearest one, and no gradient
        pulls = np.where(pairs.bodies >= 0, np.ravel(weights), 0.0)
        body_kernels().add_gradients(self.bodies.arrays, points, pairs.row_starts, pairs.bodies, pulls, out)
        return out


@dataclass(frozen=True, eq=False)
class UnionField:
    """The nearest of two fields over the same columns."""

    first: Field
    second: Field

    @property
    def columns(self) -> int:
        """The number of columns."""
        return self.first.columns

    @property
    def shell_m(self) -> np.ndarray:
        """See `TableField`."""
        return np.maximum(self.first.shell_m, self.second.shell_m)

    @property
    def grid_steps_m(self) -> np.ndarray:
        """See `TableField`."""
        return np.concatenate([self.first.grid_steps_m, self.second.grid_steps_m])

    def distances(self, points: np.ndarray) -> np.ndarray:
        """See `TableField`."""
        return np.minimum(self.first.distances(points), self.second.distances(points))

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `TableField`."""
        nearer = self.first.distances(points) <= self.second.distances(points)
        own, other = np.where(nearer, weights, 0.0), np.where(nearer, 0.0, weights)
        return self.first.gradient(points, own) + self.second.gradient(points, other)


Field = TableField | BodyField | UnionField


def scene_columns(scenes: Sequence[Scene]) -> list[tuple[int, int]]:
    """Scene and frame of every column, in order."""
    return [(index, frame) for index, scene in enumerate(scenes) for frame in range(scene.frames)]


def bodies_by_rest(
    scenes: Sequence[Scene], chosen: Callable[[Body], bool]
) -> tuple[list[tuple[int, Body]], list[tuple[int, Body, int]]]:
    """Columns and bodies of chosen meshes at rest, which share a table; columns, bodies and frames of all others."""
    at_rest, others = [], []
    for column, (index, frame) in enumerate(scene_columns(scenes)):
        for body in filter(chosen, scenes[index].bodies):
            if isinstance(body.shape, Mesh) and scenes[index].frames == 1:
                at_rest.append((column, body))
            else:
                others.append((column, body, frame))
    return at_rest, others


def build_field(scenes: Sequence[Scene], chosen: Callable[[Body], bool], *, resolution: int, padding_m: float) -> Field:
    """The distances of the chosen bodies of all scenes.

    Arguments:
        scenes: One column per scene and frame, in the order of `scene_columns`.
        chosen: Which bodies count, as `lambda body: body.is_target`.
        resolution: Grid points along the longest side of a mesh field.
        padding_m: How far grids reach beyond their meshes [m].
    """
    columns = len(scene_columns(scenes))
    at_rest, others = bodies_by_rest(scenes, chosen)
    fields: list[Field] = []
    if at_rest:
        fields.append(_table_field(at_rest, columns, resolution, padding_m))
    if others or not at_rest:
        build = partial(own_grid, resolution=resolution, padding_m=padding_m)
        fields.append(BodyField(place_bodies(others, columns, build)))
    return fields[0] if len(fields) == 1 else UnionField(*fields)


def check_table(grid: Grid, columns: int, tables: int = 1) -> None:
    """Refuse tables that no memory holds.

    Raises:
        ConfigError: So it is.
    """
    size = grid.size * columns * 4 * tables
    if size > MAXIMUM_TABLE_BYTES:
        raise ConfigError(
            f"fields of {columns} scenes at {grid.size} points need {size / 2**30:.1f} GiB",
            where="density.field_resolution",
            allowed=f"{MAXIMUM_TABLE_BYTES / 2**30:.0f} GiB",
            hint="lower density.field_resolution or use fewer scenes",
        )


def _table_field(bodies: list[tuple[int, Body]], columns: int, resolution: int, padding_m: float) -> TableField:
    meshes = [body.shape.transformed(body.pose()) for _, body in bodies]
    corners = np.concatenate([mesh.bounds_m for mesh in meshes])
    grid = grid_around(np.stack([corners.min(axis=0), corners.max(axis=0)]), resolution, padding_m)
    check_table(grid, columns)
    table = np.full((grid.size, columns), FAR_M, dtype=np.float32)
    shell_m = np.zeros(columns)
    for (column, _), mesh, values in zip(bodies, meshes, cached_distance_grids(meshes, grid), strict=True):
        np.minimum(table[:, column], values, out=table[:, column])
        if mesh.sign == "unsigned":
            shell_m[column] = grid.step
    return TableField(table, grid, shell_m)
