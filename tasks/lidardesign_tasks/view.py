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
