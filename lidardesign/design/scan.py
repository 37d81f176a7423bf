"""Scans: every ray is a component of its own, with its own origin, direction and gate.

Samples are quantised into as many cells as there are rays by Lloyd's iteration on origin, direction and
range, each scaled by its spread; one constrained M-step per cell, all cells at once, makes the components.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidardesign.design.bounds import Bounds
from lidardesign.design.budget import ReadOut, within_budget
from lidardesign.design.constraints import Constraints
from lidardesign.design.em import Trace, from_labels
from lidardesign.design.ensemble import Ensemble, Part, sensors_of
from lidardesign.design.features import Features
from lidardesign.design.mixture import log_density
from lidardesign.design.quantise import lloyd
from lidardesign.design.resolve import Group, bounds_of
from lidardesign.design.sensor import Sensor, interval_factor
from lidardesign.errors import ConfigError
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator

# More moves of the cells change their mean squared error by less than a percent.
LLOYD_ITERATIONS = 15


def fit_scan(
    features: Features,
    space: DesignSpace,
    constraints: Constraints,
    group: Group,
    read_out: ReadOut,
    level: float,
    seed: int,
) -> tuple[tuple[Sensor, ...], float]:
    """One sensor per ray, and the mean log-likelihood of the samples in their own cells [nats].

    Arguments:
        features: Weighted samples.
        space: The design space.
        constraints: Bounds that every ray keeps.
        group: The pinned origin, if any.
        read_out: The number of rays and the bandwidth budget.
        level: The share that intervals hold.
        seed: Root of the quantisation's stream.

    Raises:
        ConfigError: No number of rays is known.
    """
    if read_out.rays is None:
        raise ConfigError("a scan needs its number of rays", where="--layout scan", hint="give --rays N")
    count = read_out.rays
    everyone = Group(group.pins, tuple(range(count)))
    bounds = bounds_of(constraints, space, everyone.sensors, interval_factor(level))
    generator = random_generator(seed, "scan")
    embedding = np.ascontiguousarray(features.embedding)
    _, labels = lloyd(embedding, features.weights, count, generator, iterations=LLOYD_ITERATIONS)
    part = Part(everyone, 1.0, features, bounds)

    def scan(limits: Bounds) -> Ensemble:
        mixture = from_labels(features, labels, limits).with_weights(np.full(count, 1.0 / count))
        score = float(features.weights @ log_density(mixture, features))
        return Ensemble((part,), (Trace(mixture, score, (score,)),))

    fitted, _ = within_budget(
        scan(bounds),
        lambda _, width_m: scan(bounds.narrowed(width_m)),
        lambda e: (e.widths_m, e.weights),
        read_out,
    )
    sensors = sensors_of(fitted, space, level, by_weight=False)
    order = sorted(sensors, key=lambda s: (round(s.elevation_rad, 9), s.azimuth_rad, s.range_m))
    named = tuple(replace(sensor, name=f"s{index}") for index, sensor in enumerate(order))
    return named, fitted.log_likelihood
