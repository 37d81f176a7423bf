"""Mixtures at random and their density by plain loops."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.mixture import (
    Mixture,
)
from lidardesign.design.sensor import boresight_frame, interval_factor, tangent_coordinates, tangent_directions
from lidardesign.numerics import logsumexp
from lidardesign.space import DesignSpace, angles, direction

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


def naive_log_density(mixture, points, free_origin=True):
    """Plain loops over samples and components with the sensor module's own tangent map."""
    result = np.empty(len(points))
    for n, point in enumerate(points):
        terms = []
        for k in range(len(mixture)):
            total = math.log(mixture.weights[k])
            if free_origin:
                away = point[:3] - mixture.origin_m[k]
                covariance = mixture.origin_covariance_m2[k]
                total -= 0.5 * away @ np.linalg.solve(covariance, away)
                total -= 0.5 * math.log((2 * math.pi) ** 3 * np.linalg.det(covariance))
            frame = boresight_frame(mixture.azimuth_rad[k], mixture.elevation_rad[k], mixture.roll_rad[k])
            ray = direction(point[3], point[4])
            u = tangent_coordinates(frame, ray[None])[0]
            angle = math.atan2(np.linalg.norm(np.cross(frame[0], ray)), frame[0] @ ray)
            for axis in range(2):
                spread = mixture.spread_rad[k, axis]
                total -= 0.5 * (u[axis] / spread) ** 2 + math.log(spread * math.sqrt(2 * math.pi))
            total += math.log(angle / math.sin(angle)) if angle > 0 else 0.0
            z = (point[5] - mixture.range_m[k]) / mixture.spread_range_m[k]
            total -= 0.5 * z * z + math.log(mixture.spread_range_m[k] * math.sqrt(2 * math.pi))
            terms.append(total)
        result[n] = logsumexp(terms)
    return result
