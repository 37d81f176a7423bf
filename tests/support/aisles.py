"""Samples of a robot that drives past shelves."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

AISLE = DesignSpace(
    (-0.5, 0.0, 0.0, -math.pi / 2, 0.0, 0.1), (4.0, 0.0, 0.0, -math.pi / 2, math.pi / 2, 5.0), condition=("x_m",),
    measure="angles",
)  # fmt: skip


def shelves(count=12_000, seed=0, space=AISLE):
    """Two levels of a wall that comes nearer along the aisle; the upper one rises."""
    generator = np.random.default_rng(seed)
    points = np.zeros((count, 6))
    x = points[:, 0] = generator.uniform(-0.5, 4.0, count)
    upper = generator.uniform(size=count) < 0.5
    height = np.where(upper, 0.9 + 0.1 * x, 0.2) + generator.uniform(0.0, 0.2, count)
    wall = 1.2 - 0.05 * x + 0.03 * generator.standard_normal(count)
    points[:, 3] = -math.pi / 2
    points[:, 4], points[:, 5] = np.arctan2(height, wall), np.hypot(height, wall)
    return Samples(points, np.zeros(count), np.zeros(count), space)


SAMPLES = shelves()
