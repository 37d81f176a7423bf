r"""How a ray follows from where it starts: the regressions that a product component leaves out.

A component is a product N(x) N(u) N(r). Its samples, weighted by responsibility, still hold how the angles u
follow from the origin x and the range from both. Their weighted least squares slopes are kept beside it:
$E[u \mid x] = D\,(x - \bar x)$ and $E[r \mid x, u] = \bar r + a \cdot (x - \bar x) + b \cdot u$, about the sensor's
own means. What the regressions leave are the residual spreads. The marginal spreads stay those of the
constrained fit, so fields of view and gates keep their constraints whatever the slopes are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidardesign.design.mixture.ensemble import Ensemble
from lidardesign.design.mixture.mixture import responsibilities
from lidardesign.design.sensor import Coupling, Sensor, tangent_coordinates
from lidardesign.numerics import SLACK, effective_count
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction

# A regression on five covariates means nothing from fewer effective samples.
LEAST_EFFECTIVE_SAMPLES = 30.0
# Directions of the standardised covariates with less of their variance than this share carry rounding only.
SMALLEST_VARIANCE_SHARE = SLACK


def add_couplings(ensemble: Ensemble, sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    """The sensors of an ensemble, in its own order of sensors, with their couplings."""
    coupled = list(sensors)
    for part, trace in zip(ensemble.parts, ensemble.results, strict=True):
        if not part.features.axes.origin:
            continue
        share = responsibilities(trace.mixture, part.features) * part.features.weights[:, None]
        for column, index in enumerate(part.group.sensors):
            found = coupling_of(sensors[index], part.features.points, share[:, column])
            coupled[index] = replace(sensors[index], coupling=found)
    return tuple(coupled)


def coupling_of(sensor: Sensor, points: np.ndarray, weights: np.ndarray) -> Coupling | None:
    """The coupling of a sensor's weighted samples; None where its origin is fixed or they are too few.

    Slopes are zero along what does not vary. Residual spreads never exceed the sensor's marginal ones.

    Arguments:
        sensor: Its means, frame and marginal spreads.
        points: Design points, shape (N, 6).
        weights: Non-negative, shape (N,).
    """
    if not np.any(sensor.origin_covariance_m2) or effective_count(weights) < LEAST_EFFECTIVE_SAMPLES:
        return None
    origin, tangent, range_m = relative(sensor, points)
    free = np.diag(sensor.origin_covariance_m2) > 0
    angular = np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad])
    direction_per_m, spread_rad = np.zeros((2, 3)), angular.copy()
    for axis in np.flatnonzero(angular > 0):
        slopes, spread = _regression(origin[:, free], tangent[:, axis], weights)
        direction_per_m[axis, free] = slopes
        spread_rad[axis] = min(spread, angular[axis])
    range_per_m, range_per_rad, spread_m = np.zeros(3), np.zeros(2), sensor.spread_range_m
    if sensor.spread_range_m > 0:
        covariates = np.concatenate([origin[:, free], tangent[:, angular > 0]], axis=1)
        slopes, spread = _regression(covariates, range_m, weights)
        range_per_m[free], range_per_rad[angular > 0] = np.split(slopes, [int(free.sum())])
        spread_m = min(spread, sensor.spread_range_m)
    return Coupling(direction_per_m, range_per_m, range_per_rad, spread_rad, float(spread_m))


def relative(sensor: Sensor, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins (N, 3) [m], tangent angles (N, 2) [rad] and ranges (N,) [m] about a sensor's means.

    Angles along which the sensor has no spread are 0.
    """
    tangent = tangent_coordinates(sensor.frame, direction(points[:, AZIMUTH], points[:, ELEVATION]))
    tangent[:, np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad]) == 0] = 0.0
    return points[:, :3] - sensor.origin_m, tangent, points[:, RANGE] - sensor.range_m


def conditional_means(sensor: Sensor, origin: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E[u | x] (N, 2) [rad] and E[range | x, u] (N,) [m] at origins (N, 3) and angles (N, 2) about the means."""
    coupling = sensor.coupling
    if coupling is None:
        return np.zeros((len(origin), 2)), np.full(len(origin), sensor.range_m)
    return (
        origin @ coupling.direction_per_m.T,
        sensor.range_m + origin @ coupling.range_per_m + tangent @ coupling.range_per_rad,
    )


def conditional_spreads(sensor: Sensor) -> tuple[np.ndarray, float]:
    """Standard deviations of the angles given the origin (2,) [rad], and of the range given both [m]."""
    if sensor.coupling is None:
        return np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad]), sensor.spread_range_m
    return sensor.coupling.spread_rad, sensor.coupling.spread_m


def _regression(covariates: np.ndarray, values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Weighted least squares slopes (C,) and the residual standard deviation.

    In standardised covariates through the eigenvectors of their correlation matrix, so that covariates which
    do not vary, or vary together only, get the smallest slopes that do as well.
    """
    share = weights / weights.sum()
    centred = covariates - share @ covariates
    deviation = values - share @ values
    scale = np.sqrt(share @ np.square(centred))
    varies = scale > 0
    unit = np.where(varies, scale, 1.0)
    standard = centred / unit
    variances, axes = np.linalg.eigh(standard.T @ (share[:, None] * standard))
    carried = variances > SMALLEST_VARIANCE_SHARE * max(variances[-1], 0.0)
    inverse = np.where(carried, 1.0 / np.where(carried, variances, 1.0), 0.0)
    slopes = axes @ (inverse * (axes.T @ (standard.T @ (share * deviation))))
    left = deviation - standard @ slopes
    return np.where(varies, slopes / unit, 0.0), float(np.sqrt(share @ np.square(left)))
