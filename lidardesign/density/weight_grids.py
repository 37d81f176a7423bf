"""The importance of meshes on grids: log w at the nearest surface point of every grid point, cached on disk.

As with distances (`grids`) the nearest surface point is exact in a narrow band around the surface; beyond it, that of
the nearest grid point of the band is taken.
"""

from __future__ import annotations

import numpy as np

from lidardesign.density.grids import Grid, cached_grids, narrow_band, nearest_known
from lidardesign.scene import Mesh

ALGORITHM = "log importance at the nearest surface point, narrow band 3 cells, filled by distance transform, float32"


def log_weight_grid(mesh: Mesh, grid: Grid) -> np.ndarray:
    """log w at the nearest surface point of all grid points, shape (size,) float32; zeros without an importance."""
    if mesh.importance is None:
        return np.zeros(grid.size, dtype=np.float32)
    # relative to the grid's corner: squares of coordinates far from the origin would lose every digit
    points, vertices = Grid(np.zeros(3), grid.step, grid.counts).points(), mesh.vertices - grid.low
    distance, face, closest = narrow_band(points, vertices, mesh.faces.astype(np.int64), grid)
    known = ~np.isnan(distance)
    log_weights = np.zeros(grid.size)
    corners = mesh.faces[face[known]]
    shares = barycentric(closest[known], vertices[corners])
    log_weights[known] = np.einsum("nk,nk->n", shares, np.log(mesh.importance)[corners])
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
    opposite = [(b, c), (c, a), (a, b)]
    areas = np.stack([np.einsum("nk,nk->n", np.cross(p - points, q - points), normal) for p, q in opposite], axis=1)
    areas = np.maximum(areas, 0.0)
    total = areas.sum(axis=1, keepdims=True)
    return np.where(total > 0, areas / np.where(total > 0, total, 1.0), 1 / 3)
