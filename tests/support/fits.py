"""Samples in free and moving spaces, and a target for pinned origins."""

from __future__ import annotations

import numpy as np

from lidardesign.samples import Samples
from lidardesign.space import DesignSpace, aim, observed_point

FACE = DesignSpace((0.0, 0.0, 0.0, -0.6, -0.6, 0.05), (0.0, 0.0, 0.0, 0.6, 0.6, 1.05))

FREE = DesignSpace((-0.05, -0.05, -0.05, -0.8, -0.8, 0.05), (0.05, 0.05, 0.05, 0.8, 0.8, 1.5))

CENTRE, WIDTH = np.array([0.6, 0.0, 0.05]), 0.06


def log_target(points):
    """A Gaussian blob of scene points, per solid angle and range from anywhere."""
    return -0.5 * np.square((observed_point(points) - CENTRE) / WIDTH).sum(axis=-1)


def blob(space, count=8000, seed=0):
    """Samples of p*(d) = blob(M(d)) through scene points: their density per design point is blob r^2."""
    generator = np.random.default_rng(seed)
    scene = CENTRE + WIDTH * generator.standard_normal((count, 3))
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    points = space.wrap(aim(low + (high - low) * generator.uniform(size=(count, 3)), scene))
    points = points[space.contains(points)]
    target = log_target(points)
    return Samples(points, target + 2 * np.log(points[:, 5]), target, space)


FIXED, MOVING = blob(FACE), blob(FREE)
