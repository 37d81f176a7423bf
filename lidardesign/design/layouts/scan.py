"""Scans: every ray is a component of its own, with its own origin, direction and gate.

Samples are quantised into as many cells as there are rays, and each cell's mean ray is fired. What is
quantised is where rays look, never how far: with the range among the features, one ray's samples fall apart
into cells of different ranges, and its gate no longer covers how much the scenes differ there.

- Where origins are given, cells divide the directions.
- Where origins are free, many rays observe the same place, so cells divide what is observed: the point of each
  sample's ray at the mean range of the samples with like rays, which is the mean surface of the scenes.

The gate is the central level of the scene points of a cell, projected onto the ray. Measured on training
scenes as Chamfer distance, against the grid cropped to the training returns: faces at 196 rays 22.5 mm with the
range as a feature, 11.5 mm with directions (grid 12.0 mm, at twice the bandwidth); flatland at 30 rays 22.9 mm
with the range, 7.6 mm with origins and directions, 3.8 mm with the mean surface (grid 3.3 mm); faces with
origins free in a 10 cm box at 196 rays 25 mm with origins and directions, 11.3 mm with the mean surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.design.constraints.budget import BandwidthBudget, fit_within_budget
from lidardesign.design.constraints.document import SensorRules
from lidardesign.design.layouts.gates import admissible_gates, central_intervals
from lidardesign.design.layouts.quantise import lloyd
from lidardesign.design.mixture.bounds import Bounds, Group, bounds_of
from lidardesign.design.mixture.em import EMResult, from_labels
from lidardesign.design.mixture.ensemble import Ensemble, GroupSamples, sensors_of
from lidardesign.design.mixture.features import Features, ray_features
from lidardesign.design.mixture.mixture import Mixture, log_density
from lidardesign.design.sensor import Sensor, interval_factor
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.space import DesignSpace, direction, observed_point
from lidardesign.task import random_generator

# More moves of the cells change their mean squared error by less than a percent.
LLOYD_ITERATIONS = 15
# A ray's cell of fewer samples has no shape; cells beyond that also cost more time than anybody waits.
FEWEST_PER_RAY = 4


@phase("scan")
def fit_scan(
    features: Features,
    space: DesignSpace,
    rules: Sequence[SensorRules],
    group: Group,
    read_out: BandwidthBudget,
    level: float,
    seed: int,
) -> tuple[tuple[Sensor, ...], Ensemble]:
    """One sensor per ray, and the components that they are of, in another order.

    Arguments:
        features: Weighted samples.
        space: The design space.
        rules: What every ray keeps.
        group: The pinned origin, if any.
        read_out: The number of rays and the bandwidth budget.
        level: The share that intervals hold.
        seed: Root of the quantisation's stream.

    Raises:
        ConfigError: No number of rays is known, or more are asked for than the samples can tell apart.
    """
    count = rays_of(read_out)
    if count * FEWEST_PER_RAY > len(features):
        raise ConfigError(
            f"{count} rays from {len(features)} samples",
            where="--layout scan",
            allowed=f"at most {len(features) // FEWEST_PER_RAY} rays",
            hint="learn with more samples (learning.samples)",
        )
    everyone = Group(group.pins, tuple(range(count)))
    bounds = bounds_of(rules, space, everyone.sensors, interval_factor(level))
    generator = random_generator(seed, "scan")
    _, labels = lloyd(ray_features(features), features.weights, count, generator, iterations=LLOYD_ITERATIONS)
    part = GroupSamples(everyone, 1.0, features, bounds)

    def scan(limits: Bounds) -> Ensemble:
        mixture = from_labels(features, labels, limits).with_weights(np.full(count, 1.0 / count))
        mixture = _with_gates(mixture, features, labels, limits, level)
        values = log_density(mixture, features)
        score = float(features.weights @ values)
        return Ensemble((part,), (EMResult(mixture, score, (score,), values=values),))

    fitted, _ = fit_within_budget(
        scan(bounds),
        lambda _, width_m: scan(bounds.narrowed(width_m)),
        lambda e: (e.widths_m, e.weights),
        read_out,
    )
    sensors = sensors_of(fitted, space, level)
    order = sorted(sensors, key=lambda s: (round(s.elevation_rad, 9), s.azimuth_rad, s.range_m))
    named = tuple(replace(sensor, name=f"s{index}") for index, sensor in enumerate(order))
    return named, fitted


def rays_of(read_out: BandwidthBudget) -> int:
    """The number of rays of a scan, which nothing else can tell.

    Raises:
        ConfigError: It is not known.
    """
    if read_out.rays is None:
        raise ConfigError("a scan needs its number of rays", where="--layout scan", hint="give --rays N")
    return read_out.rays


def _with_gates(mixture: Mixture, features: Features, labels: np.ndarray, bounds: Bounds, level: float) -> Mixture:
    """The components with gates that hold the level of what their cells observe, along their own rays."""
    axes, count = features.axes, len(mixture)
    if not axes.range:
        return mixture
    azimuth = mixture.azimuth_rad if axes.horizontal else np.full(count, axes.azimuth_rad)
    elevation = mixture.elevation_rad if axes.vertical else np.full(count, axes.elevation_rad)
    away = observed_point(features.points) - mixture.origin_m[labels]
    along = (away * direction(azimuth, elevation)[labels]).sum(axis=1)
    wanted, effective = central_intervals(along, features.weights, labels, count, level)
    # a cell without samples repeats the heaviest one, as its other parameters do
    wanted[effective == 0] = wanted[np.bincount(labels, features.weights, minlength=count).argmax()]
    centre, spread = admissible_gates(wanted, bounds)
    return replace(mixture, range_m=centre, spread_range_m=spread)
