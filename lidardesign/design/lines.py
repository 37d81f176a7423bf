r"""Cells of rays: scene points by the ray that passes nearest to them, however far along it they are.

A quantisation in which the centres are lines. With x a scene point and o + t v a ray, the squared distance is
$|x - o|^2 - ((x - o) \cdot v)^2$. Rays are real samples' rays (a medoid for each cell, as in k-medoids; L. Kaufman
and P. Rousseeuw 1987), so that they are rays that see something.
"""

from __future__ import annotations

import numpy as np

# Distances that are held at once: 16 MB of them.
BLOCK = 2_097_152


def squared_distances(points: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Squared distances of points (N, 3) from rays' lines, given by origins and unit vectors (K, 3): (N, K)."""
    # about the points' mean, so that few digits cancel
    middle = points.mean(axis=0)
    points, origins = points - middle, origins - middle
    squares = np.square(points).sum(axis=1)[:, None] - 2 * points @ origins.T + np.square(origins).sum(axis=1)
    squares -= np.square(points @ directions.T - np.einsum("ki,ki->k", origins, directions))
    return np.maximum(squares, 0.0)


def nearest_lines(points: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The line nearest to each point, and its squared distance, shape (N,) each."""
    nearest, away = np.empty(len(points), dtype=np.int64), np.empty(len(points))
    size = max(BLOCK // len(origins), 1)
    for start in range(0, len(points), size):
        part = slice(start, start + size)
        squares = squared_distances(points[part], origins, directions)
        nearest[part] = squares.argmin(axis=1)
        away[part] = np.take_along_axis(squares, nearest[part, None], axis=1)[:, 0]
    return nearest, away


def mean_squares(points: np.ndarray, weights: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Weighted sums of squared distances of a cell's points (M, 3) from each of its own rays' lines, shape (M,)."""
    size = max(BLOCK // len(points), 1)
    parts = [slice(start, start + size) for start in range(0, len(origins), size)]
    return np.concatenate([weights @ squared_distances(points, origins[part], directions[part]) for part in parts])
