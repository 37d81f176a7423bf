"""Design spaces that contain all rays from a box of origins to a sphere or box."""

from __future__ import annotations

import itertools
import math
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from lidardesign import DesignSpace, Metres, Vector, aim, circular_difference


def _half_size(value: float | Vector) -> float | Vector:
    if np.min(value) < 0:
        raise ValueError("half sizes are 0 m or more")
    return value


# Half size of a box of sensor origins [m]: of all its sides, or along x, y and z.
OriginBox = Annotated[Metres | Vector, AfterValidator(_half_size)]


def space_around(centre: np.ndarray, radius: float, origin: np.ndarray, half: np.ndarray) -> DesignSpace:
    """Design space with all directions and ranges to a sphere from every origin of a box.

    If an origin is inside the sphere, all directions are included.

    Arguments:
        centre: Centre of the sphere [m], shape (3,).
        radius: Radius of the sphere [m].
        origin: Centre of the box of sensor origins [m], shape (3,).
        half: Half extents of that box [m], shape (3,); 0 for a fixed origin.
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
    """Design space with all directions and ranges to a box (2, 3) [m] from every origin, from the corners of both.

    If an origin is above or below the box, all azimuths are included.
    """
    # offsets from an origin to a point of the box: a box again
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
