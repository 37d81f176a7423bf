"""Signed distance grids of meshes: exact near the surface, filled from the nearest exact points beyond, cached on disk.

A tree of triangles gives the unsigned distance in a narrow band, and libigl's generalised winding number the sign.
Beyond the band the distance to the nearest closest point of the band is taken, found by an exact Euclidean distance
transform, so that gradients reach from afar.

Distances and values are read from tables in plain NumPy, for the few thousand points of a process that compiles
nothing. `table_kernels` computes the same at a fifth of the time, after 0.8 s of loading: worth it in learning, not in
`constrain`.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError, DataError
from lidardesign.numerics import SLACK
from lidardesign.run.inputs import MESH, read_file
from lidardesign.scenes.scene import Mesh

ALGORITHM = "3 cells by a tree, flat triangles as segments; sign by winding number; distance transform; float32"
BAND_CELLS = 3.0
MAXIMUM_CELLS = 40_000_000
DIGEST_BYTES = 32


@dataclass(frozen=True, eq=False)
class Grid:
    """A regular grid of points low + step * (i, j, k).

    Arguments:
        low: The first point [m], shape (3,).
        step: The spacing [m].
        counts: Points per axis, at least 2 each, shape (3,).
    """

    low: np.ndarray
    step: float
    counts: np.ndarray

    @property
    def size(self) -> int:
        """The number of points."""
        return int(np.prod(self.counts))

    def points(self) -> np.ndarray:
        """All points in C order, shape (size, 3) [m]."""
        axes = [self.low[k] + self.step * np.arange(self.counts[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


class GridTable(NamedTuple):
    """Values of many columns at the points of a grid, as compiled loops take them.

    Arguments:
        table: Shape (grid points, columns) float32.
        counts, low, inverse_step: How the grid is placed, see `Grid`.
    """

    table: np.ndarray
    counts: np.ndarray
    low: np.ndarray
    inverse_step: float


def grid_around(bounds_m: np.ndarray, resolution: int, padding_m: float) -> Grid:
    """A grid over an axis-aligned box, shape (2, 3), with `resolution` points along its longest padded side."""
    low, high = bounds_m[0] - padding_m, bounds_m[1] + padding_m
    step = float((high - low).max() / (resolution - 1))
    if not step > 0:
        raise DataError("the meshes have no extent")
    counts = np.maximum(np.ceil((high - low) / step - SLACK).astype(np.int64) + 1, 2)
    if counts.prod() > MAXIMUM_CELLS:
        raise ConfigError(
            f"a field of {' x '.join(map(str, counts))} points is too large",
            where="density.field_resolution",
            allowed=f"at most {MAXIMUM_CELLS} points",
        )
    return Grid(low, step, counts)


def distance_grid(mesh: Mesh, grid: Grid) -> np.ndarray:
    """Distances at all grid points, negative inside unless the mesh has no inside: shape (size,) float32 [m]."""
    # relative to the grid's corner: squares of coordinates far from the origin would lose every digit
    points, vertices = Grid(np.zeros(3), grid.step, grid.counts).points(), mesh.vertices - grid.low
    faces = mesh.faces
    distance, _, closest = narrow_band(points, vertices, faces, grid)
    beyond = np.isinf(distance)
    if beyond.any():
        distance[beyond] = np.linalg.norm(points[beyond] - closest[nearest_known(beyond, grid)], axis=1)
    if mesh.sign == "winding":
        distance = np.where(is_wound(points, vertices, faces), -distance, distance)
    elif mesh.sign == "solid":
        distance = np.where(is_inside(points, distance, vertices, faces, grid), -distance, distance)
    return distance.astype(np.float32)


def is_wound(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of the points with a winding number above 1/2 in size, shape (N,) bool."""
    import igl

    # -1 is the inside of a part whose faces all point inwards
    return np.abs(igl.fast_winding_number(vertices, faces, points)) > 0.5


def is_inside(
    points: np.ndarray, distance: np.ndarray, vertices: np.ndarray, faces: np.ndarray, grid: Grid
) -> np.ndarray:
    """Mask of the grid points inside a closed surface, shape (size,) bool, from few winding numbers.

    No surface lies between neighbours that are both more than half a step away from it.
    """
    from scipy.ndimage import label

    regions, _ = label((distance > grid.step / 2).reshape(grid.counts))
    _, first, region = np.unique(regions, return_index=True, return_inverse=True)
    inside, near = is_wound(points[first], vertices, faces)[region.reshape(-1)], regions.reshape(-1) == 0
    inside[near] = is_wound(points[near], vertices, faces)
    return inside


def narrow_band(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, grid: Grid
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact unsigned distances within the band (infinite beyond), the closest faces and the closest surface points."""
    from lidardesign.scenes.distances import TriangleTree

    tree = TriangleTree(vertices[faces])
    distance, face, closest = tree.closest(points, BAND_CELLS * grid.step)
    if np.isinf(distance).all():  # a surface that no grid point comes near: exact everywhere
        return tree.closest(points)
    return distance, face, closest


def nearest_known(beyond: np.ndarray, grid: Grid) -> np.ndarray:
    """Rows of the nearest grid points inside a band, for each of those `beyond` it, shape (size,) bool."""
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(beyond.reshape(grid.counts), return_distances=False, return_indices=True).reshape(
        3, -1
    )[:, beyond]
    return np.ravel_multi_index(tuple(nearest), tuple(grid.counts))


def cache_folder() -> Path:
    """The folder of cached grids: $LIDARDESIGN_CACHE, else the user's cache folder."""
    chosen = os.environ.get("LIDARDESIGN_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lidardesign"


def cached_distance_grids(meshes: list[Mesh], grid: Grid, workers: int = 2) -> list[np.ndarray]:
    """One distance grid per mesh, from the cache where its content hash is known; damaged files are built again."""
    return cached_grids(meshes, grid, distance_grid, lambda _: ALGORITHM, workers)


def cached_grids(
    meshes: list[Mesh],
    grid: Grid,
    build: Callable[[Mesh, Grid], np.ndarray],
    named: Callable[[Mesh], str],
    workers: int = 2,
) -> list[np.ndarray]:
    """Grid values of each mesh, shape (size,) float32: cached ones, else built by `build` and stored.

    Arguments:
        meshes: The meshes.
        grid: The grid of the values.
        build: Builds the values of a mesh.
        named: A key of `build` and all that it depends on besides the geometry of mesh and grid.
        workers: Threads.
    """

    def load_or_build(mesh: Mesh) -> np.ndarray:
        path = _cache_path(mesh, grid, named(mesh))
        values = _load(path, grid.size)
        if values is None:
            values = build(mesh, grid)
            _store(path, values)
        return values

    # compiled loops, libigl and SciPy release the interpreter lock
    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(load_or_build, meshes))


def _cache_path(mesh: Mesh, grid: Grid, name: str) -> Path:
    placed = np.array([*grid.low, grid.step, *grid.counts]).tobytes()
    digest = _digest(mesh.content_hash.encode() + name.encode() + placed)
    return cache_folder() / "fields" / f"{digest.hex()}.npy"


def _load(path: Path, size: int) -> np.ndarray | None:
    """The values of a cached field; None where the file is damaged by the hash at its end."""
    try:
        content = read_file(path, MESH)
        if _digest(content[:-DIGEST_BYTES]) != content[-DIGEST_BYTES:]:
            return None
        values = np.load(io.BytesIO(content), allow_pickle=False)
    # numpy raises anything on garbage, as TokenError; what cannot be read is made again
    except Exception:
        return None
    return values if values.shape == (size,) and values.dtype == np.float32 and np.isfinite(values).all() else None


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


def _store(path: Path, values: np.ndarray) -> None:
    from lidardesign.run.files import write_atomic

    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    # a cache that cannot be written costs time, never the result
    with contextlib.suppress(OSError, DataError):
        write_atomic(path, buffer.getvalue() + _digest(buffer.getvalue()))


CHUNK = 2048


def table_values(field: GridTable, points: np.ndarray, *, grows: bool) -> np.ndarray:
    """Values of all columns at points, (N, 3) to (N, C) float32.

    Outside the grid they are those at its faces or, of distances, which grow there, a lower bound.
    """
    out = np.empty((len(points), field.table.shape[1]), dtype=np.float32)
    for start in range(0, len(points), CHUNK):
        rows = slice(start, start + CHUNK)
        place = (points[rows] - field.low) * field.inverse_step
        clamped = np.clip(place, 0.0, field.counts - 1.0)
        # trilinear, at places in steps from the first point of the grid
        cell = np.minimum(clamped.astype(np.int64), field.counts - 2)
        fraction, inner = clamped - cell, np.zeros((len(clamped), field.table.shape[1]))
        for corner in np.ndindex(2, 2, 2):
            weight = np.where(corner, fraction, 1.0 - fraction).prod(axis=1)
            inner += weight[:, None] * field.table[np.ravel_multi_index(tuple((cell + corner).T), tuple(field.counts))]
        if grows:
            squared = np.square((place - clamped) / field.inverse_step).sum(axis=1)
            outside = squared > 0
            inner[outside] = np.sqrt(squared[outside, None] + np.square(np.maximum(inner[outside], 0.0)))
        out[rows] = inner
    return out
