"""A naive twin of distances to triangles: all pairs, in long doubles."""

from __future__ import annotations

import numpy as np

FLATTEST = 1e-12  # a triangle's height over its longest side


def naive_triangle_distance_m(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The distance of each point (N, 3) to the nearest of the triangles (T, 3, 3) [m], (N,).

    The least over the feet of perpendiculars on all three edges, cut at their ends, and over the feet on the plane that
    lie on the inner side of all edges.
    """
    points, corners = points.astype(np.longdouble)[:, None], triangles.astype(np.longdouble).transpose(1, 0, 2)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    area, sides = (normal**2).sum(axis=-1), ((corners - np.roll(corners, -1, axis=0)) ** 2).sum(axis=-1)
    # where the normal is lost even in long doubles, the sides are as near
    flat = area <= FLATTEST**2 * sides.max(axis=0) ** 2
    inside, least = np.broadcast_to(~flat, (len(points), len(area))), np.inf
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, offset = end - start, points - start
        length = (along**2).sum(axis=-1)
        share = np.clip((offset * along).sum(axis=-1) / np.where(length > 0, length, 1), 0, 1)
        least = np.minimum(least, np.linalg.norm(offset - share[..., None] * along, axis=-1))
        inside = inside & ((np.cross(along, offset) * normal).sum(axis=-1) >= 0)
    height = np.abs(((points - corners[0]) * normal).sum(axis=-1)) / np.sqrt(np.where(flat, 1, area))
    return np.where(inside, height, least).min(axis=1).astype(np.float64)
