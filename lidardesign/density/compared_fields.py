"""Distances by other means than learning's, to compare it with: exact queries, nearest and tricubic interpolation.

All give distances alone, without gradients, in the form of `fields.Field`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.density.bodies import place_bodies
from lidardesign.density.fields import BodyField, TableField, scene_columns
from lidardesign.density.grids import distance_grid, grid_around
from lidardesign.scene import Body, Mesh, Scene, inverse_rigid

Chosen = Callable[[Body], bool]


class ExactField:
    """The exact distances of the chosen bodies of all scenes: to meshes by libigl, triangle by triangle.

    Arguments:
        scenes: One column per scene and frame.
        chosen: Which bodies count.
    """

    def __init__(self, scenes: Sequence[Scene], chosen: Chosen) -> None:
        entries = [
            (column, body, frame)
            for column, (index, frame) in enumerate(scene_columns(scenes))
            for body in filter(chosen, scenes[index].bodies)
        ]
        self.columns = len(scene_columns(scenes))
        self.shell_m = np.zeros(self.columns)
        self._meshes = [entry for entry in entries if isinstance(entry[1].shape, Mesh)]
        others = [entry for entry in entries if not isinstance(entry[1].shape, Mesh)]
        self._others = BodyField(place_bodies(others, self.columns, _no_grid)) if others else None

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distances at points: (N, 3) to (N, columns) [m]."""
        out = np.full((len(points), self.columns), np.inf)
        if self._others is not None:
            out = self._others.distances(points)
        for column, body, frame in self._meshes:
            to_body = inverse_rigid(body.pose(frame))
            local = points @ to_body[:3, :3].T + to_body[:3, 3]
            np.minimum(out[:, column], mesh_distances(body.shape, local), out=out[:, column])
        return out


def _no_grid(mesh: Mesh) -> tuple:
    raise AssertionError("meshes are asked exactly")


def mesh_distances(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """The exact distances of points (N, 3) from a mesh in its own frame, negative inside where it has one, (N,)."""
    import igl

    # relative to the mesh's corner: squares of coordinates far from the origin would lose every digit
    corner = mesh.bounds_m[0]
    points, vertices, faces = points - corner, mesh.vertices - corner, mesh.faces.astype(np.int64)
    distance = igl.signed_distance(points, vertices, faces, sign_type=igl.SIGNED_DISTANCE_TYPE_UNSIGNED)[0]
    if mesh.sign == "unsigned":
        return distance
    return np.where(np.abs(igl.fast_winding_number(vertices, faces, points)) > 0.5, -distance, distance)


def fresh_table(scenes: Sequence[Scene], around: Sequence[Scene], resolution: int, padding_m: float) -> TableField:
    """The table of scenes whose targets are meshes at rest, built anew whatever is cached.

    Arguments:
        scenes: One column each.
        around: All scenes that the run's grid holds.
        resolution, padding_m: See `fields.build_field`.
    """
    bounds = np.concatenate([mesh.bounds_m for scene in around for mesh in target_meshes(scene)])
    grid = grid_around(np.stack([bounds.min(axis=0), bounds.max(axis=0)]), resolution, padding_m)
    columns = [np.min([distance_grid(mesh, grid) for mesh in target_meshes(scene)], axis=0) for scene in scenes]
    unsigned = [any(mesh.sign == "unsigned" for mesh in target_meshes(scene)) for scene in scenes]
    return TableField(np.stack(columns, axis=1), grid, np.where(unsigned, grid.step, 0.0))


def fresh_bodies(scenes: Sequence[Scene], resolution: int, padding_m: float) -> BodyField:
    """The targets of moving scenes with a grid for each of their meshes, built anew whatever is cached."""

    def build(mesh: Mesh) -> tuple:
        grid = grid_around(mesh.bounds_m, resolution, padding_m)
        return grid, distance_grid(mesh, grid)

    entries = [
        (column, body, frame)
        for column, (index, frame) in enumerate(scene_columns(scenes))
        for body in scenes[index].bodies
        if body.is_target
    ]
    return BodyField(place_bodies(entries, len(scene_columns(scenes)), build))


def target_meshes(scene: Scene) -> list[Mesh]:
    """The target meshes of a scene at rest, in the world."""
    return [b.shape.transformed(b.pose()) for b in scene.bodies if b.is_target and isinstance(b.shape, Mesh)]


@dataclass(frozen=True, eq=False)
class InterpolatedField:
    """A table read with splines of another order than 1.

    Arguments:
        table: Whose distances, or spline coefficients of them, are read.
        order: 0 for the nearest grid point, 3 for tricubic splines.
    """

    table: TableField
    order: int

    @classmethod
    def of(cls, table: TableField, order: int) -> InterpolatedField:
        """The same distances, with the coefficients that splines of an order need."""
        from scipy.ndimage import spline_filter

        counts = tuple(table.grid.counts)
        if order < 2:
            return cls(table, order)
        columns = [
            spline_filter(column.reshape(counts), order, output=np.float32, mode="nearest").ravel()
            for column in table.table.T
        ]
        return cls(TableField(np.stack(columns, axis=1), table.grid, table.shell_m), order)

    @property
    def columns(self) -> int:
        """The number of columns."""
        return self.table.columns

    @property
    def shell_m(self) -> np.ndarray:
        """See `Field`."""
        return self.table.shell_m

    def distances(self, points: np.ndarray) -> np.ndarray:
        """See `Field`; a lower bound outside the grid, as that of learning is."""
        from scipy.ndimage import map_coordinates

        grid = self.table.grid
        place = (points - grid.low) / grid.step
        clamped = np.clip(place, 0.0, grid.counts - 1.0)
        squared = np.square((place - clamped) * grid.step).sum(axis=1)
        inner = np.stack(
            [
                map_coordinates(
                    column.reshape(grid.counts), clamped.T, order=self.order, mode="nearest", prefilter=False
                )
                for column in self.table.table.T
            ],
            axis=1,
        ).astype(np.float64)
        outside = squared > 0
        inner[outside] = np.sqrt(squared[outside, None] + np.square(np.maximum(inner[outside], 0.0)))
        return inner
