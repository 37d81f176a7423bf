"""An order of points in which neighbours in space follow each other and find each other's memory in the cache.

Results do not depend on it, to the last bit: every point is evaluated by itself.
"""

from __future__ import annotations

import numpy as np

# Cells per axis are 2 to this power: finer than the points of a batch lie apart.
LEVELS = 6


def nearby_order(points: np.ndarray) -> np.ndarray:
    """The order of points (N, 3) along a Z-shaped curve through their bounding box, shape (N,) (Morton 1966)."""
    if len(points) < 2:
        return np.arange(len(points))
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    # points that share a coordinate have no extent there
    shares = (points - low) / np.where(size > 0, size, 1.0)
    cells = np.minimum((shares * 2**LEVELS).astype(np.int64), 2**LEVELS - 1)
    keys = np.zeros(len(points), dtype=np.int64)
    for level in range(LEVELS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> level) & 1) << (3 * level + axis)
    return np.argsort(keys, kind="stable")
