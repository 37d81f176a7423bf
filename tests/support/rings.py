"""Rays around the ring of a distributed sensor."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.samples import Samples
from lidardesign.space import DesignSpace, aim, direction

CEILING = DesignSpace((-0.6, -0.6, 1.0, 0.0, -math.pi / 2, 0.2), (0.6, 0.6, 1.0, 2 * math.pi, -math.pi / 3, 1.2))


def ring(count=12_000, seed=0):
    """Samples from a ceiling of points in a box, with the steep rays blocked."""
    generator = np.random.default_rng(seed)
    scene = np.array([0.0, 0.0, 0.35]) + generator.uniform(-1, 1, (count, 3)) * [0.25, 0.3, 0.15]
    polar = np.arccos(generator.uniform(math.cos(math.radians(29)), math.cos(math.radians(15)), count))
    looking = direction(generator.uniform(0, 2 * math.pi, count), polar - math.pi / 2)
    origin = scene - looking * ((scene[:, 2] - 1.0) / looking[:, 2])[:, None]
    points = aim(origin, scene)
    points = points[CEILING.contains(points)]
    points[:, 2] = 1.0
    level = np.zeros(len(points))
    return Samples(points, level, level, CEILING)


RING = ring()
