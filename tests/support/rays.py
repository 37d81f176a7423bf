"""Rays of one sensor that are fired at once."""

from __future__ import annotations

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.space import direction


def rays_along(directions, gate_m=(0.0, 99.0), origin=(0.0, 0.0, 0.0)) -> Rays:
    """Rays in these directions; a gate and an origin may be of all rays or of each."""
    directions = np.atleast_2d(np.asarray(directions, dtype=float))
    count = len(directions)
    origins = np.array(np.broadcast_to(origin, (count, 3)), dtype=float)
    gates = np.array(np.broadcast_to(gate_m, (count, 2)), dtype=float)
    return Rays(origins, directions, gates, np.zeros(count), np.zeros(count))


def rays_of_points(points, gate_m) -> Rays:
    """The rays of design points, shape (N, 6)."""
    return rays_along(direction(points[:, 3], points[:, 4]), gate_m, points[:, :3])


def random_fan(count, spread_rad, seed=0):
    """Random directions ahead, shape (N, 3)."""
    generator = np.random.default_rng(seed)
    azimuth, elevation = (generator.uniform(-spread_rad, spread_rad, count) for _ in range(2))
    return direction(azimuth, elevation)
