"""Distances from a grid table in plain NumPy, for the few thousand points of a process that compiles nothing.

`kernels` computes the same at a fifth of the time, after 0.8 s of loading: worth it in learning, not in `constrain`.
"""

from __future__ import annotations

import numpy as np

# Kinds of bodies, shared with the compiled kernels.
SPHERE, BOX, CAPSULE, PLANE, GRID = range(5)

CHUNK = 2048


def table_distances(
    table: np.ndarray, counts: np.ndarray, low: np.ndarray, inverse_step: float, points: np.ndarray
) -> np.ndarray:
    """Distances of all columns at points, a lower bound outside the grid: table (G, C), (N, 3) to (N, C) float32."""
    out = np.empty((len(points), table.shape[1]), dtype=np.float32)
    for start in range(0, len(points), CHUNK):
        rows = slice(start, start + CHUNK)
        out[rows] = _distances(table, counts, low, inverse_step, points[rows])
    return out


def table_values(
    table: np.ndarray, counts: np.ndarray, low: np.ndarray, inverse_step: float, points: np.ndarray
) -> np.ndarray:
    """Values of all columns at points, outside the grid those at its faces: table (G, C), (N, 3) to (N, C) float32."""
    out = np.empty((len(points), table.shape[1]), dtype=np.float32)
    for start in range(0, len(points), CHUNK):
        rows = slice(start, start + CHUNK)
        out[rows] = _blended(table, counts, np.clip((points[rows] - low) * inverse_step, 0.0, counts - 1.0))
    return out


def _distances(
    table: np.ndarray, counts: np.ndarray, low: np.ndarray, inverse_step: float, points: np.ndarray
) -> np.ndarray:
    place = (points - low) * inverse_step
    clamped = np.clip(place, 0.0, counts - 1.0)
    squared = np.square((place - clamped) / inverse_step).sum(axis=1)
    inner = _blended(table, counts, clamped)
    outside = squared > 0
    inner[outside] = np.sqrt(squared[outside, None] + np.square(np.maximum(inner[outside], 0.0)))
    return inner


def _blended(table: np.ndarray, counts: np.ndarray, clamped: np.ndarray) -> np.ndarray:
    """Trilinear values at places inside the grid, in steps from its first point: (N, 3) to (N, C)."""
    cell = np.minimum(clamped.astype(np.int64), counts - 2)
    fraction = clamped - cell
    inner = np.zeros((len(clamped), table.shape[1]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, fraction, 1.0 - fraction).prod(axis=1)
        index = np.ravel_multi_index(tuple((cell + corner).T), tuple(counts))
        inner += weight[:, None] * table[index]
    return inner
