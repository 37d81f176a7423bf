"""Naive float64 twins and closed forms that tests compare with, and the tolerances with their reasons."""

from __future__ import annotations

import math

import numpy as np

# trilinear interpolation of a smooth distance is off by about h^2 / 4 (measured: 6.3e-4 at h = 1/64 of a unit sphere)
GRID_ERROR_PER_STEP_SQUARED = 0.5
# float32 tables carry 1.2e-7 relative rounding, central differences over 1e-4 m turn it into about 1e-3
TABLE_GRADIENT = 5e-3


def naive_log_target(points, scene_distances, log_weights, sigma_m, log_transmittance=None):
    """log p* by plain loops: points (N, 6), functions of one scene point each, one per scene."""
    values = []
    for point in points:
        x, y, z, azimuth, elevation, reach = point
        place = np.array(
            [
                x + reach * math.cos(elevation) * math.cos(azimuth),
                y + reach * math.cos(elevation) * math.sin(azimuth),
                z + reach * math.sin(elevation),
            ]
        )
        terms = []
        for index, distance in enumerate(scene_distances):
            term = log_weights[index] - distance(place) ** 2 / (2 * sigma_m**2)
            terms.append(term + (0.0 if log_transmittance is None else log_transmittance(index, point)))
        peak = max(terms)
        values.append(peak + math.log(sum(math.exp(term - peak) for term in terms)))
    return np.array(values)


def sphere_distance(centre, radius):
    """The signed distance of a sphere as a function of one point."""
    return lambda place: float(np.linalg.norm(place - np.asarray(centre)) - radius)


def numerical_gradient(function, points, step):
    """Central differences of a function of (N, K) points that gives (N,), shape (N, K)."""
    columns = []
    for k in range(points.shape[1]):
        offset = np.zeros(points.shape[1])
        offset[k] = step
        columns.append((function(points + offset) - function(points - offset)) / (2 * step))
    return np.stack(columns, axis=1)
