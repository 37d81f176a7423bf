"""Which sensor a sample of the density belongs to, and where it lies in that sensor's field and gate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.design.sensor import Design, Sensor, angle_over_sine, tangent_coordinates
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, aim, direction, observed_point

# A fixed origin, angle or range has no density of its own. These smallest spreads, far below any that
# matters, order samples by their distance instead; lengths are relative to the sensors' mean range.
SMALLEST_LENGTH = 1e-4
SMALLEST_ANGLE_RAD = 1e-4
# Rays on the field's very edge belong to it: rounding of the tangent map, in radians.
FIELD_ROUNDING_RAD = 1e-12


@dataclass(frozen=True, eq=False)
class Members:
    """The samples that one sensor can see.

    Arguments:
        index: Their place in the samples, shape (M,).
        tangent: Horizontal and vertical angle from the boresight, shape (M, 2) [rad].
        range_m: Distance from the sensor's mean origin, shape (M,) [m].
        weights: Their weights, shape (M,), not normalised.
    """

    index: np.ndarray
    tangent: np.ndarray
    range_m: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.index)


def members(design: Design, points: np.ndarray, weights: np.ndarray) -> list[Members]:
    """The samples inside each sensor's field of view and gate, each sample with one sensor at most.

    A sample goes to the sensor that is most responsible for it (highest weighted density). Rays start at the
    sensor's mean origin, so the sample is then aimed anew, from there at the scene point that it observes.

    Arguments:
        design: G sensors.
        points: Design points, shape (N, 6).
        weights: Their weights, shape (N,).
    """
    owner = owners(design, points)
    observed = observed_point(points)
    return [
        _inside(sensor, np.flatnonzero(owner == index), observed, weights)
        for index, sensor in enumerate(design.sensors)
    ]


def _inside(sensor: Sensor, index: np.ndarray, observed: np.ndarray, weights: np.ndarray) -> Members:
    aimed = aim(sensor.origin_m, observed[index])
    tangent = tangent_coordinates(sensor.frame, direction(aimed[:, AZIMUTH], aimed[:, ELEVATION]))
    tangent[:, ~_spreading(sensor)] = 0.0
    half_field = np.array(sensor.field_of_view_rad) / 2 + FIELD_ROUNDING_RAD
    start, end = sensor.gate_m
    distance = aimed[:, RANGE]
    keep = (np.abs(tangent) <= half_field).all(axis=1) & (distance >= start) & (distance < end)
    keep &= weights[index] > 0
    kept = index[keep]
    return Members(kept, tangent[keep], distance[keep], weights[kept])


def _spreading(sensor: Sensor) -> np.ndarray:
    """Which tangent axes say where a sample lies, shape (2,): in a fan of rays only the one along it."""
    spread = np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad]) > 0
    return spread if spread.any() else np.ones(2, dtype=bool)


def owners(design: Design, points: np.ndarray) -> np.ndarray:
    """The sensor with the highest weighted density at each design point, the first where they tie: (N,)."""
    scale = float(np.mean([sensor.range_m for sensor in design.sensors])) or 1.0
    best = np.full(len(points), -np.inf)
    owner = np.zeros(len(points), dtype=np.int64)
    for index, (sensor, weight) in enumerate(zip(design.sensors, design.weights, strict=True)):
        if weight == 0:
            continue
        score = np.log(weight) + log_density(sensor, points, smallest_m=SMALLEST_LENGTH * scale)
        better = score > best
        best[better], owner[better] = score[better], index
    return owner


def log_density(sensor: Sensor, points: np.ndarray, *, smallest_m: float) -> np.ndarray:
    """Log density of a sensor per volume, solid angle and length, up to a constant: (N, 6) to (N,).

    Arguments:
        sensor: The component.
        points: Design points, shape (N, 6).
        smallest_m: Spreads of origin and range count as at least this [m].
    """
    variance, axes = np.linalg.eigh(np.asarray(sensor.origin_covariance_m2, dtype=np.float64))
    spread = np.sqrt(np.maximum(variance, smallest_m**2))
    offset = (points[:, :3] - sensor.origin_m) @ axes
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    tangent = tangent_coordinates(sensor.frame, looking)
    used = _spreading(sensor)
    spreads = np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad])
    angular = np.maximum(spreads, SMALLEST_ANGLE_RAD)[used]
    depth = max(sensor.spread_range_m, smallest_m)
    squares = np.square(offset / spread).sum(axis=1) + np.square(tangent[:, used] / angular).sum(axis=1)
    squares += np.square((points[:, RANGE] - sensor.range_m) / depth)
    angle = np.hypot(tangent[:, 0], tangent[:, 1])
    log_jacobian = np.log(angle_over_sine(angle, np.sin(angle)))
    return -squares / 2 - np.log(spread).sum() - np.log(angular).sum() - np.log(depth) + log_jacobian
