"""The joint region of a sensor with an extended origin: which samples it fires itself, from where they start.

The region holds the origins inside the ellipsoid of the level and the directions inside the field of view. The
gate is no part of it: a ray is fired at all ranges, and its gate is found from all that it could return. (With
the gate, rays would get the central 95 % of a central 95 %.) Along pinned origin axes, where samples have
measure zero, they are aimed anew at their scene points, as in `membership`.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from lidardesign.design.constraints import Constraints
from lidardesign.design.coupling import conditional_means, conditional_spreads, relative
from lidardesign.design.membership import FIELD_ROUNDING_RAD, SMALLEST_ANGLE_RAD, SMALLEST_LENGTH
from lidardesign.design.origins import inside_excluded, origin_box
from lidardesign.design.sensor import Design, Sensor
from lidardesign.numerics import ROUNDING, SLACK, angle_over_sine
from lidardesign.space import DesignSpace, aim, observed_point

# Samples may lie outside a box or an ellipsoid by the rounding of their coordinates [m].
ROUNDING_M = SLACK
# Principal axes of an origin with less of the variance than this share are fixed: only rounding is left there.
SMALLEST_AXIS_SHARE = ROUNDING


def owned(
    design: Design, points: np.ndarray, weights: np.ndarray, space: DesignSpace, constraints: Constraints
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The samples of each sensor: their indices and, as it fires them, their design points.

    A sample belongs to the sensor with the highest weighted density of its own origin, direction and range
    among those whose region and origin box hold its ray, outside the excluded boxes, the first where they tie.

    Arguments:
        design: G sensors.
        points: Design points, shape (N, 6).
        weights: Their weights, shape (N,).
        space: The samples' design space.
        constraints: The design's constraints.
    """
    best, owner = np.full(len(points), -np.inf), np.full(len(points), -1)
    fired = []
    smallest = SMALLEST_LENGTH * (float(np.mean([sensor.range_m for sensor in design.sensors])) or 1.0)
    for index, (sensor, share) in enumerate(zip(design.sensors, design.weights, strict=True)):
        own = _fired_by(sensor, points, space)
        fired.append(own)
        if share == 0:
            continue
        one = constraints.of_sensor(index)
        low, high = origin_box(one, space)
        inside = ((own[:, :3] >= low - ROUNDING_M) & (own[:, :3] <= high + ROUNDING_M)).all(axis=1)
        inside &= ~inside_excluded(own[:, :3], one)
        inside &= in_region(sensor, own) & space.contains(own) & (weights > 0)
        score = np.where(inside, np.log(share) + log_joint_density(sensor, own, smallest_m=smallest), -np.inf)
        better = score > best
        best[better], owner[better] = score[better], index
    members = [np.flatnonzero(owner == index) for index in range(len(design.sensors))]
    return members, [own[member] for own, member in zip(fired, members, strict=True)]


def _fired_by(sensor: Sensor, points: np.ndarray, space: DesignSpace) -> np.ndarray:
    """The samples as a sensor fires them: aimed anew where its origin is pinned along an axis of theirs."""
    pinned = [axis for axis in range(3) if axis in space.free and sensor.origin_covariance_m2[axis, axis] == 0]
    if not pinned:
        return points
    origins = points[:, :3].copy()
    origins[:, pinned] = np.asarray(sensor.origin_m)[pinned]
    return space.wrap(aim(origins, observed_point(points)))


def in_region(sensor: Sensor, points: np.ndarray) -> np.ndarray:
    """Which design points (N, 6) lie in a sensor's joint region, shape (N,) bool."""
    origin, tangent, _ = relative(sensor, points)
    inside = (np.abs(tangent) <= np.array(sensor.field_of_view_rad) / 2 + FIELD_ROUNDING_RAD).all(axis=1)
    spreads, axes = principal_axes(sensor)
    along = origin @ axes
    within = np.square(along / spreads).sum(axis=1) <= ellipsoid_radius(sensor.level, len(spreads)) ** 2
    return inside & within


def principal_axes(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (k,) [m] of the origin along its free principal axes, and these as columns (3, k)."""
    values, axes = np.linalg.eigh(np.asarray(sensor.origin_covariance_m2, dtype=np.float64))
    free = values > SMALLEST_AXIS_SHARE * max(values[-1], 0.0)
    return np.sqrt(values[free]), axes[:, free]


def ellipsoid_radius(level: float, axes: int) -> float:
    """The number of standard deviations within which `level` of a normal vector of `axes` dimensions lies."""
    return float(np.sqrt(chdtri(axes, 1 - level))) if axes else 0.0


def log_joint_density(sensor: Sensor, points: np.ndarray, *, smallest_m: float) -> np.ndarray:
    """Log density of origin, direction given origin and range given both, up to a constant, shape (N,).

    Arguments:
        sensor: The component.
        points: Design points, shape (N, 6).
        smallest_m: The spread of the range counts as at least this [m].
    """
    origin, tangent, range_m = relative(sensor, points)
    spreads, axes = principal_axes(sensor)
    mean_angle, mean_range = conditional_means(sensor, origin, tangent)
    angular, depth = conditional_spreads(sensor)
    angular, depth = np.maximum(angular, SMALLEST_ANGLE_RAD), max(depth, smallest_m)
    squares = np.square((origin @ axes) / spreads).sum(axis=1) + np.square((tangent - mean_angle) / angular).sum(axis=1)
    squares += np.square((range_m + sensor.range_m - mean_range) / depth)
    angle = np.hypot(tangent[:, 0], tangent[:, 1])
    log_jacobian = np.log(angle_over_sine(angle))
    return -squares / 2 - np.log(spreads).sum() - np.log(angular).sum() - np.log(depth) + log_jacobian
