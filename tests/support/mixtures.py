"""Mixtures at random, and draws of them."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.mixture.components import Axes, Features, Mixture
from lidardesign.sensors.sensor import interval_factor, tangent_directions
from lidardesign.space import DesignSpace, angles

Z = interval_factor(0.95)

WHOLE = DesignSpace((-9.0, -9.0, -9.0, 0.0, -math.pi / 2, 0.0), (9.0, 9.0, 9.0, 2 * math.pi, math.pi / 2, 9.0))

POINT = DesignSpace((0.0, 0.0, 0.0, 0.0, -math.pi / 2, 0.0), (0.0, 0.0, 0.0, 2 * math.pi, math.pi / 2, 9.0))


def random_mixture(generator, count, width=0.3):
    root = generator.standard_normal((count, 3, 3)) * 0.3
    return Mixture(
        weights=generator.dirichlet(np.full(count, 4.0)),
        origin_m=generator.uniform(-1, 1, (count, 3)),
        origin_covariance_m2=root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(3),
        azimuth_rad=generator.uniform(0, 2 * np.pi, count),
        elevation_rad=generator.uniform(-1.4, 1.4, count),
        roll_rad=generator.uniform(-0.7, 0.7, count),
        spread_rad=generator.uniform(0.2, 1.0, (count, 2)) * width,
        range_m=generator.uniform(2, 5, count),
        spread_range_m=generator.uniform(0.1, 0.6, count),
    )


def drawn(mixture, count, generator, space=WHOLE):
    which = generator.choice(len(mixture), p=mixture.weights, size=count)
    points = np.empty((count, 6))
    for k in range(len(mixture)):
        rows = which == k
        n = int(rows.sum())
        free = [i for i in range(3) if i in space.free]
        points[rows, :3] = mixture.origin_m[k]
        root = np.linalg.cholesky(mixture.origin_covariance_m2[k])
        points[np.ix_(rows, free)] += (generator.standard_normal((n, 3)) @ root.T)[:, free]
        tangent = mixture.spread_rad[k] * generator.standard_normal((n, 2))
        azimuth, elevation = angles(tangent_directions(mixture.frames[k], tangent))
        points[rows, 3], points[rows, 4] = azimuth, elevation
        points[rows, 5] = mixture.range_m[k] + mixture.spread_range_m[k] * generator.standard_normal(n)
    return points


def features_of(points, space=WHOLE, weights=None):
    return Features.of(points, np.ones(len(points)) if weights is None else weights, Axes.of(space), space)


def taken(mixture, order):
    """The components at indices, their weights scaled to sum to 1."""
    rows = {name: values[order] for name, values in vars(mixture).items()}
    return Mixture(**{**rows, "weights": rows["weights"] / rows["weights"].sum()})
