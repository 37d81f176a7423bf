"""Where sensors have to look so that they see all of what may move in a sphere."""

from __future__ import annotations

import itertools
import math

import numpy as np

from lidardesign.numerics import circular_difference
from lidardesign.space import DesignSpace, aim


def space_around(centre: np.ndarray, radius: float, origin: np.ndarray, half: np.ndarray) -> DesignSpace:
    """The directions and ranges in which a sphere lies, seen from every origin of a box.

    An origin inside that sphere looks everywhere.

    Arguments:
        centre: Of the sphere [m], shape (3,).
        radius: Of the sphere [m].
        origin: The middle of the box of sensor origins [m], shape (3,).
        half: Half of its sides [m], shape (3,); 0 where it is fixed.
    """
    corners = origin + half * np.array([(0, 0, 0), *itertools.product((-1, 1), repeat=3)])
    seen = aim(corners, centre)
    azimuth, elevation, distance = seen[:, 3], seen[:, 4], seen[:, 5]
    nearest = float(distance.min())
    box = [*(origin - half).tolist()], [*(origin + half).tolist()]
    if nearest <= radius:
        return DesignSpace(
            low=(*box[0], 0.0, -math.pi / 2, 0.0),
            high=(*box[1], 2 * math.pi, math.pi / 2, float(distance.max()) + radius),
        )
    angle = math.asin(radius / nearest)
    bottom = max(float(elevation.min()) - angle, -math.pi / 2)
    top = min(float(elevation.max()) + angle, math.pi / 2)
    turn = circular_difference(azimuth, azimuth[0])
    # seen from above or below, a sphere covers more azimuth than its angle; over the pole, all of it
    steepest = math.cos(max(abs(bottom), abs(top)))
    widest = math.asin(math.sin(angle) / steepest) if math.sin(angle) < steepest else math.pi
    left = max(float(azimuth[0] + turn.min()) - widest, float(azimuth[0]) - math.pi)
    right = min(float(azimuth[0] + turn.max()) + widest, float(azimuth[0]) + math.pi)
    return DesignSpace(
        low=(*box[0], left, bottom, nearest - radius),
        high=(*box[1], right, top, float(distance.max()) + radius),
    )


def space_around_box(bounds_m: np.ndarray, origin_m: np.ndarray, half_m: np.ndarray) -> DesignSpace:
    """The directions and ranges in which a box (2, 3) [m] lies from every origin: as wide as corners of both make them.

    An origin above or below the box looks all around.
    """
    # from an origin to a place in the box: a box again
    low, high = bounds_m[0] - origin_m - half_m, bounds_m[1] - origin_m + half_m
    nearest, farthest = np.clip(0.0, low, high), np.maximum(np.abs(low), np.abs(high))
    across = np.hypot(nearest[0], nearest[1]), np.hypot(farthest[0], farthest[1])
    elevation = [math.atan2(z, way) for z in (low[2], high[2]) for way in across]
    ahead = math.atan2(low[1] + high[1], low[0] + high[0])
    corners = np.array([math.atan2(y, x) for x in (low[0], high[0]) for y in (low[1], high[1])])
    turn = circular_difference(corners, ahead) if across[0] > 0 else np.array([-math.pi, math.pi])
    left, right = ahead + float(turn.min()), ahead + float(turn.max())
    return DesignSpace(
        low=(*(origin_m - half_m).tolist(), left, min(elevation), float(np.linalg.norm(nearest))),
        high=(*(origin_m + half_m).tolist(), right, max(elevation), float(np.linalg.norm(farthest))),
    )
