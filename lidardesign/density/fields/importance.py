"""The weight of surfaces in the target density: log w at the nearest surface point, in the form of `distance`.

Meshes at rest share one table of log weights on the grid of their distances; primitives and moving bodies have theirs
in their own frames. As with distances (`grids`) the nearest surface point is exact in a narrow band around the surface;
beyond it, that of the nearest grid point of the band is taken. Between grid points log w is trilinear, so its gradient
is exact for what the density uses; beyond a grid's faces it is constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lidardesign.density.fields.bodies import Bodies, Pairs
from lidardesign.density.fields.distance import (
    BodyField,
    Field,
    GridColumns,
    TableField,
    UnionField,
    all_pairs,
    bodies_by_rest,
    body_kernels,
    check_table,
)
from lidardesign.density.fields.grids import (
    Grid,
    cached_distance_grids,
    cached_grids,
    narrow_band,
    nearest_known,
)
from lidardesign.errors import BackgroundNote
from lidardesign.numerics import safe_divide
from lidardesign.scenes.scene import Body, Mesh, Scene

ALGORITHM = "log importance at the nearest surface point, flat triangles as segments, 3 cells; distance transform"


def log_weight_grid(mesh: Mesh, grid: Grid) -> np.ndarray:
    """log w at the nearest surface point of all grid points, shape (size,) float32; zeros without an importance."""
    if mesh.importance is None:
        return np.zeros(grid.size, dtype=np.float32)
    # relative to the grid's corner: squares of coordinates far from the origin would lose every digit
    points, vertices = Grid(np.zeros(3), grid.step, grid.counts).points(), mesh.vertices - grid.low
    distance, face, closest = narrow_band(points, vertices, mesh.faces, grid)
    known = np.isfinite(distance)
    log_weights = np.zeros(grid.size)
    corners = mesh.faces[face[known]]
    at_corners = np.log(mesh.importance)[corners]
    log_weights[known] = np.einsum("nk,nk->n", barycentric(closest[known], vertices[corners]), at_corners)
    if not known.all():
        log_weights[~known] = log_weights[nearest_known(~known, grid)]
    return log_weights.astype(np.float32)


def cached_log_weight_grids(meshes: list[Mesh], grid: Grid) -> list[np.ndarray]:
    """`log_weight_grid` of each mesh, from the cache where geometry and importance are known."""
    return cached_grids(meshes, grid, log_weight_grid, lambda mesh: ALGORITHM + mesh.importance_hash)


def barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The shares of triangles' corners in points on them, (N, 3) and (N, 3, 3) to (N, 3); all are at least 0.

    A triangle without area belongs to its corners evenly.
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    crosses = [np.cross(p - points, q - points) for p, q in ((b, c), (c, a), (a, b))]
    areas = np.maximum(np.stack([np.einsum("nk,nk->n", cross, normal) for cross in crosses], axis=1), 0.0)
    return safe_divide(areas, areas.sum(axis=1, keepdims=True), otherwise=1 / 3)


@dataclass(frozen=True, eq=False)
class TableWeights(GridColumns):
    """log importance of meshes at rest."""

    @cached_property
    def peak(self) -> float:
        """An upper bound of all values."""
        return float(self.table.max())

    def values(self, points: np.ndarray) -> np.ndarray:
        """log w at points: (N, 3) to (N, columns)."""
        return self._read(points, grows=False)

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Gradients of sum_c weights_nc log w_c(points_n): (N, 3), (N, columns) to (N, 3)."""
        return self._contract(points, weights, grows=False)


@dataclass(frozen=True, eq=False)
class BodyWeights:
    """Primitives and moving bodies: a constant for each, and for meshes a grid of their own.

    Arguments:
        bodies: With their log weights, see `weigh`.
    """

    bodies: Bodies

    @cached_property
    def column_peaks(self) -> np.ndarray:
        """The largest log weight in each column, 0 in one without bodies, shape (columns,)."""
        peaks = np.full(self.bodies.columns, -np.inf)
        np.maximum.at(peaks, self.bodies.column, self.bodies.log_weight[:, 2])
        return np.where(np.isfinite(peaks), peaks, 0.0)

    @property
    def peak(self) -> float:
        """See `TableWeights`."""
        return float(self.column_peaks.max())

    @cached_property
    def spread(self) -> float:
        """The largest difference of a log weight to the largest of its column [nats]."""
        return float((self.column_peaks[self.bodies.column] - self.bodies.log_weight[:, 1]).max(initial=0.0))

    def values(self, points: np.ndarray) -> np.ndarray:
        """See `TableWeights`."""
        return self.of_pairs(points, all_pairs(self.bodies, points)).reshape(len(points), -1)

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `TableWeights`."""
        out = np.zeros(points.shape)
        pulls = np.ascontiguousarray(weights, dtype=np.float64).ravel()
        self.add_pair_gradients(points, all_pairs(self.bodies, points), pulls, out)
        return out

    def of_pairs(self, points: np.ndarray, pairs: Pairs) -> np.ndarray:
        """log w of pairs of points (N, 3) and columns, shape (P,)."""
        points, values = np.ascontiguousarray(points, dtype=np.float64), self.bodies.grids.log_weights
        constants, out = np.ascontiguousarray(self.bodies.log_weight[:, 0]), np.empty(len(pairs.bodies))
        body_kernels().pair_log_weights(
            self.bodies.arrays, constants, values, points, pairs.row_starts, pairs.bodies, out
        )
        return out

    def add_pair_gradients(self, points: np.ndarray, pairs: Pairs, weights: np.ndarray, out: np.ndarray) -> None:
        """Add the gradients of sum_p weights_p log w_p by the points to `out` (N, 3)."""
        points, values = np.ascontiguousarray(points, dtype=np.float64), self.bodies.grids.log_weights
        body_kernels().add_log_weight_gradients(
            self.bodies.arrays, values, points, pairs.row_starts, pairs.bodies, weights, out
        )


@dataclass(frozen=True, eq=False)
class UnionWeights:
    """The weights of the nearer of two fields over the same columns.

    Arguments:
        fields: Their distances.
        first, second: Their weights.
    """

    fields: UnionField
    first: LogWeights
    second: LogWeights

    @property
    def peak(self) -> float:
        """See `TableWeights`."""
        return max(self.first.peak, self.second.peak)

    def _nearer(self, points: np.ndarray) -> np.ndarray:
        return self.fields.first.distances(points) <= self.fields.second.distances(points)

    def values(self, points: np.ndarray) -> np.ndarray:
        """See `TableWeights`."""
        return np.where(self._nearer(points), self.first.values(points), self.second.values(points))

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `TableWeights`."""
        nearer = self._nearer(points)
        own, other = np.where(nearer, weights, 0.0), np.where(nearer, 0.0, weights)
        return self.first.gradient(points, own) + self.second.gradient(points, other)


LogWeights = TableWeights | BodyWeights | UnionWeights


def is_weighted(scenes: Sequence[Scene]) -> bool:
    """True where any target has an importance other than 1."""
    return any(log_weight_range(body) != (0.0, 0.0) for scene in scenes for body in scene.bodies if body.is_target)


def importance_notes(scenes: Sequence[Scene]) -> list[str]:
    """A note on the range of importance of the targets, where it is not 1 throughout."""
    if not is_weighted(scenes):
        return []
    ranges = np.array([log_weight_range(body) for scene in scenes for body in scene.bodies if body.is_target])
    least, largest = np.exp([ranges[:, 0].min(), ranges[:, 1].max()])
    return [BackgroundNote(f"importance: parts of the targets count from {least:.2g} to {largest:.2g}")]


def log_weight_range(body: Body) -> tuple[float, float]:
    """The least and the largest log importance of a body's surface."""
    constant = float(np.log(body.importance))
    if not isinstance(body.shape, Mesh) or body.shape.importance is None:
        return constant, constant
    weights = np.log(body.shape.importance)
    return constant + float(weights.min()), constant + float(weights.max())


def weigh(bodies: Bodies, entries: Sequence[Body]) -> Bodies:
    """Bodies with their log weights.

    Arguments:
        bodies: Of all columns; their meshes have grids.
        entries: The body of each row.
    """
    grids, values = bodies.grids, [np.zeros(8, np.float32)]
    for row, mesh in enumerate(grids.meshes, start=1):
        grid = Grid(grids.lows[row], 1.0 / grids.inverse_steps[row], grids.counts[row])
        values += cached_log_weight_grids([mesh], grid)
    # thousands of frames share few bodies
    distinct = {id(body): body for body in entries}
    weights = {key: (float(np.log(body.importance)), *log_weight_range(body)) for key, body in distinct.items()}
    log_weight = np.array([weights[id(body)] for body in entries]).reshape(-1, 3)
    return replace(bodies, log_weight=log_weight, grids=replace(grids, log_weights=np.concatenate(values)))


def build_log_weights(scenes: Sequence[Scene], field: Field) -> LogWeights | None:
    """The importance of the targets of scenes; None where all count 1.

    Arguments:
        scenes: One column per scene and frame.
        field: The distances of their targets, as `fields.build_field` gives them.
    """
    if not is_weighted(scenes):
        return None
    at_rest, others = bodies_by_rest(scenes, lambda body: body.is_target)
    if isinstance(field, TableField):
        return _table_weights(field, at_rest)
    entries = [body for _, body, _ in others]
    if isinstance(field, BodyField):
        return BodyWeights(weigh(field.bodies, entries))
    return UnionWeights(field, _table_weights(field.first, at_rest), BodyWeights(weigh(field.second.bodies, entries)))


def _table_weights(field: TableField, bodies: list[tuple[int, Body]]) -> TableWeights:
    columns = field.columns
    check_table(field.grid, columns, tables=2)
    meshes = [body.shape.transformed(body.pose()) for _, body in bodies]
    table = np.zeros((field.grid.size, columns), dtype=np.float32)
    nearest = np.full(table.shape, np.inf, dtype=np.float32)
    for (column, body), mesh, values in zip(bodies, meshes, cached_log_weight_grids(meshes, field.grid), strict=True):
        distances = cached_distance_grids([mesh], field.grid)[0]
        nearer = distances < nearest[:, column]
        nearest[nearer, column] = distances[nearer]
        table[nearer, column] = values[nearer] + np.float32(np.log(body.importance))
    return TableWeights(table, field.grid, compiled=field.compiled)
