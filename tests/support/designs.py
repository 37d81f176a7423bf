"""Sensors, and samples that lie inside them."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.samples import Samples
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.sensor import interval_factor, tangent_directions
from lidardesign.space import DesignSpace, aim, angles
from support.sensors import normal_sensor

SPACE = DesignSpace((-5, -5, -5, 0, -math.pi / 2, 0), (5, 5, 5, 2 * math.pi, math.pi / 2, 10))


def sensor(name="s", weight=1.0, **changes):
    values = {
        "origin_m": (0.1, -0.2, 0.3), "azimuth_rad": 1.0, "elevation_rad": -0.3, "roll_rad": 0.2,
        "spread_rad": (0.12, 0.06), "range_m": 1.0, "spread_range_m": 0.1, **changes,
    }  # fmt: skip
    return normal_sensor(name, weight, **values)


def three_sensors(**changes):
    return (
        sensor("a", 0.5, azimuth_rad=0.2, **changes),
        sensor("b", 0.3, azimuth_rad=1.0, elevation_rad=0.9, **changes),
        sensor("c", 0.2, azimuth_rad=2.5, spread_range_m=0.3, **changes),
    )


def drawn_from(design, count=6000, seed=0):
    """Samples of the mixture itself, with random weights."""
    generator = np.random.default_rng(seed)
    parts = []
    for component, n in zip(design.sensors, split_budget(design.weights, count), strict=True):
        tangent = generator.normal(0, [0.12, 0.06], (n, 2))
        azimuth, elevation = angles(tangent_directions(component.frame, tangent))
        start, end = component.gate_m
        spread_m = (end - start) / 2 / interval_factor(design.level)
        distance = np.abs(generator.normal((start + end) / 2, spread_m, n))
        origin = np.tile(component.origin_m, (n, 1))
        parts.append(np.column_stack([origin, azimuth, elevation, distance]))
    points = np.concatenate(parts)
    log_weights = generator.normal(0, 0.3, len(points))
    return Samples(points, np.zeros(len(points)), log_weights, SPACE)


CEILING = DesignSpace((-0.6, -0.5, 1.0, 0.0, -math.pi / 2, 0.2), (0.6, 0.7, 1.0, 2 * math.pi, -0.9, 1.3))


def from_the_ceiling(count=6000, seed=0):
    generator = np.random.default_rng(seed)
    scene = np.array([0.1, 0.0, 0.3]) + generator.uniform(-1, 1, (count, 3)) * [0.2, 0.3, 0.1]
    origin = np.column_stack([generator.uniform(-0.6, 0.6, count), generator.uniform(-0.5, 0.7, count), np.ones(count)])
    points = aim(origin, scene)
    points = points[CEILING.contains(points)]
    log_weights = np.random.default_rng(1).normal(0, 0.3, len(points))
    return Samples(points, np.zeros(len(points)), log_weights, CEILING)
