"""Rays in the fields of view of sensors, from their mean origins; and which samples of the density a sensor sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.gates import SMALLEST_CELL, bounded_gates, central_intervals
from lidardesign.design.layouts.grid import field_on_sphere, grid_tangent
from lidardesign.design.layouts.layout import Layout, missing_samples, shares_of
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.sensor import (
    DesignSpec,
    Gates,
    Sensor,
    interval_factor,
    tangent_coordinates,
    tangent_directions,
)
from lidardesign.geometry.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.numerics import ROUNDING, angle_over_sine
from lidardesign.samples import Samples
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, direction, observed_point

# A direction or range without spread has no density. These smallest spreads, far below any that matters,
# order samples by their distance instead; the one of the range is relative to the sensors' mean range.
SMALLEST_ANGLE_RAD = 1e-4
SMALLEST_LENGTH = 1e-4
# Rays on the field's very edge belong to it: rounding of the tangent map, in radians.
FIELD_ROUNDING_RAD = ROUNDING


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


def members(design: DesignSpec, points: np.ndarray, weights: np.ndarray) -> list[Members]:
    """The samples inside each sensor's field of view and gate, each sample with one sensor at most.

    Rays start at their sensor's mean origin. So each sample is aimed anew, from there at the scene point that
    it observes, and goes to the sensor with the highest weighted density of that direction and range, the
    first where they tie.

    Arguments:
        design: G sensors.
        points: Design points, shape (N, 6).
        weights: Their weights, shape (N,).
    """
    observed = observed_point(points)
    smallest = SMALLEST_LENGTH * (float(np.mean([sensor.range_m for sensor in design.sensors])) or 1.0)
    best = np.full(len(points), -np.inf)
    owner = np.full(len(points), -1)
    tangent, distance = np.zeros((len(points), 2)), np.zeros(len(points))
    for index, (sensor, weight) in enumerate(zip(design.sensors, design.weights, strict=True)):
        if weight == 0:
            continue
        angles, ranges = seen_from(sensor, observed)
        score = np.log(weight) + log_density(sensor, angles, ranges, smallest_m=smallest)
        better = score > best
        best[better], owner[better] = score[better], index
        tangent[better], distance[better] = angles[better], ranges[better]
    return [
        _inside(sensor, np.flatnonzero((owner == index) & (weights > 0)), tangent, distance, weights)
        for index, sensor in enumerate(design.sensors)
    ]


def seen_from(sensor: Sensor, observed_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tangent coordinates (N, 2) [rad] and ranges (N,) [m] of scene points (N, 3) from the mean origin.

    In a fan of rays (one angle without spread) only the angle along the fan says where a point lies.
    """
    aimed = aim(sensor.origin_m, observed_m)
    tangent = tangent_coordinates(sensor.frame, direction(aimed[:, AZIMUTH], aimed[:, ELEVATION]))
    spread = np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad]) > 0
    if spread.any():
        tangent[:, ~spread] = 0.0
    return tangent, aimed[:, RANGE]


def log_density(sensor: Sensor, tangent: np.ndarray, range_m: np.ndarray, *, smallest_m: float) -> np.ndarray:
    """Log density of directions and ranges per solid angle and length, up to a constant, shape (N,).

    Arguments:
        sensor: The component.
        tangent: Angles from its boresight, shape (N, 2) [rad].
        range_m: Shape (N,) [m].
        smallest_m: The spread of the range counts as at least this [m].
    """
    angular = np.maximum([sensor.spread_horizontal_rad, sensor.spread_vertical_rad], SMALLEST_ANGLE_RAD)
    depth = max(sensor.spread_range_m, smallest_m)
    squares = np.square(tangent / angular).sum(axis=1) + np.square((range_m - sensor.range_m) / depth)
    angle = np.hypot(tangent[:, 0], tangent[:, 1])
    log_jacobian = np.log(angle_over_sine(angle))
    return -squares / 2 - np.log(angular).sum() - np.log(depth) + log_jacobian


def _inside(
    sensor: Sensor, index: np.ndarray, tangent: np.ndarray, distance: np.ndarray, weights: np.ndarray
) -> Members:
    half_field = np.array(sensor.field_of_view_rad) / 2 + FIELD_ROUNDING_RAD
    start, end = sensor.gate_m
    within = (np.abs(tangent[index]) <= half_field).all(axis=1)
    within &= (distance[index] >= start) & (distance[index] < end)
    kept = index[within]
    return Members(kept, tangent[kept], distance[kept], weights[kept])


class GridLayout(Layout):
    """Rays even in the field of view of each sensor."""

    name = "grid"
    fitted_as = "grid"

    def leaves_rays_open(self, gates: Gates | None) -> bool:
        """See `Layout`: even rays need no table, but gates of their own do."""
        return gates != "ray"

    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """See `Layout`."""
        shares = shares_of(spec, count)
        tangents = [
            grid_tangent(*field_on_sphere(sensor), int(n)) for sensor, n in zip(spec.sensors, shares, strict=True)
        ]
        if gates == "sensor":
            return rays_in_fields(spec, tangents)
        if samples is None:
            raise missing_samples(spec, count, gates)
        seen = members(spec, samples.points, samples.weights)
        return rays_in_fields(spec, tangents, ray_gates(spec, tangents, seen, samples.space))


def rays_in_fields(spec: DesignSpec, tangents: Sequence[np.ndarray], gate_m: np.ndarray | None = None) -> Rays:
    """Rays at angles (N, 2) [rad] in the tangent plane of each sensor, from its mean origin.

    Without gates (N, 2) [m], rays have those of their sensors.
    """
    sensor = np.repeat(np.arange(len(tangents)), [len(tangent) for tangent in tangents])
    looking = [tangent_directions(s.frame, tangent) for s, tangent in zip(spec.sensors, tangents, strict=True)]
    origin = np.array([s.origin_m for s in spec.sensors], dtype=np.float64)[sensor]
    gate = np.array([s.gate_m for s in spec.sensors])[sensor] if gate_m is None else gate_m
    return Rays(origin, np.concatenate(looking), gate, sensor, fire_times(len(sensor), DEFAULT_RATE_HZ))


def ray_gates(
    design: DesignSpec, tangents: Sequence[np.ndarray], seen: Sequence[Members], space: DesignSpace
) -> np.ndarray:
    """The gate of each ray, from the ranges of the samples that are nearest to it, shape (N, 2) [m].

    Inside its sensor's gate, and moved no further than the design's constraints ask: they bound every ray.
    """
    constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
    gates = []
    for index, (sensor, tangent, inside) in enumerate(zip(design.sensors, tangents, seen, strict=True)):
        own = np.tile(sensor.gate_m, (len(tangent), 1))
        if len(tangent) and len(inside):
            cell = cKDTree(tangent).query(inside.tangent)[1]
            wanted, effective = central_intervals(inside.range_m, inside.weights, cell, len(tangent), design.level)
            known = np.flatnonzero((effective >= SMALLEST_CELL) & (np.diff(wanted, axis=1)[:, 0] > 0))
            wanted = np.clip(wanted[known], *sensor.gate_m)
            bounds = bounds_of(constraints.rules, space, (index,), interval_factor(design.level))
            own[known] = bounded_gates(wanted, sensor, bounds.take(np.zeros(len(known), dtype=np.int64)))
        gates.append(own)
    return np.concatenate(gates)
