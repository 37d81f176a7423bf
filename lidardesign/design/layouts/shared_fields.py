"""Rays of sensors at one place with gates of their own: divided over all their fields together.

Sensors of a mixture overlap in direction where surfaces lie behind each other, and each listens at its own ranges. Once
every ray has its own gate that division means nothing any more: what counts is which directions are looked at. So the
samples of all sensors at a place are quantised together, a ray goes to the sensor that owns most of its cell, and its
gate holds what the cell sees. Measured on 50 held-out faces with 361 rays of 10 sensors in half the bandwidth of a grid
cropped to the training returns, after refinement: 9 % less error than that grid, 6 % with each sensor's rays by itself.

Which sensor a sample of the density belongs to, and where it lies in that sensor's field and gate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.gates import Heard, gates_within
from lidardesign.design.layouts.quantise import lloyd, samples_for
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.sensor import DesignSpec, Sensor, interval_factor, tangent_coordinates, tangent_directions
from lidardesign.numerics import ROUNDING, angle_over_sine, systematic_draw, unit_vectors
from lidardesign.samples import Samples
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, aim, direction, observed_point
from lidardesign.task import random_generator

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


# Of a normal distribution, where nothing better is known of what a ray hears.
QUANTILES = 31
# Heights of directions that are told apart when rays are put in order.
ORDER_DECIMALS = 9


@dataclass(frozen=True, eq=False)
class _Seen:
    """Samples inside some sensors' fields and gates: unit vectors (M, 3), ranges, weights and owners (M,)."""

    looking: np.ndarray
    range_m: np.ndarray
    weights: np.ndarray
    owner: np.ndarray

    def take(self, rows: np.ndarray) -> _Seen:
        return _Seen(self.looking[rows], self.range_m[rows], self.weights[rows], self.owner[rows])


@dataclass(frozen=True, eq=False)
class SharedRays:
    """Rays in the order of their sensors: direction (N, 3), gate (N, 2) [m] and sensor (N,)."""

    direction: np.ndarray
    gate_m: np.ndarray
    sensor: np.ndarray


def shared_rays(design: DesignSpec, shares: np.ndarray, samples: Samples, seed: int) -> SharedRays | None:
    """The rays of a design whose sensors stand at one place or at a few; None where its samples are too few.

    Arguments:
        design: G sensors.
        shares: Rays of each by weight, shape (G,); sensors at one place share theirs out anew.
        samples: Samples of the density.
        seed: For the quantisation.
    """
    seen = _seen(design, samples)
    place = np.unique([sensor.origin_m for sensor in design.sensors], axis=0, return_inverse=True)[1].reshape(-1)
    found = []
    for index in range(int(place.max()) + 1):
        count = int(shares[place == index].sum())
        own = seen.take(np.flatnonzero(place[seen.owner] == index))
        if not count:
            continue
        if len(np.unique(own.looking, axis=0)) < count:
            return None
        found.append(_at_one_place(own, count, design.sensors, random_generator(seed, "shared fields", index)))
    if not found:
        return None
    directions, sensor = (np.concatenate([one[part] for one in found]) for part in (0, 1))
    gate = ray_gates(design, _together([one[2] for one in found]), sensor, samples)
    order = np.lexsort((directions[:, 0], directions[:, 1], np.round(directions[:, 2], ORDER_DECIMALS), sensor))
    return SharedRays(directions[order], gate[order], sensor[order])


def _at_one_place(
    seen: _Seen, count: int, sensors: Sequence[Sensor], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Heard]:
    """Directions (N, 3) of the rays from one place, the sensor of each (N,), and what they hear."""
    directions, sensor = _cells(_thinned(seen, count, generator), count, len(sensors), generator)
    directions = _in_fields(directions, sensor, sensors)
    # gates rest on all samples: their ends are rare
    ray = cKDTree(directions).query(seen.looking)[1]
    silent = np.setdiff1d(np.arange(count), ray)
    if not len(silent):
        return directions, sensor, Heard(seen.range_m, seen.weights, ray, count)
    # a ray between two that are nearer to all of its samples hears what its nearest sample does
    nearest = cKDTree(seen.looking).query(directions[silent])[1]
    ranges, weights = (np.concatenate([v, v[nearest]]) for v in (seen.range_m, seen.weights))
    return directions, sensor, Heard(ranges, weights, np.concatenate([ray, silent]), count)


def _together(heard: list[Heard]) -> Heard:
    """What the rays of several places hear, one after the other."""
    firsts = np.cumsum([0, *(one.count for one in heard)])
    ray = np.concatenate([one.ray + first for one, first in zip(heard, firsts[:-1], strict=True)])
    ranges, weights = (np.concatenate([getattr(one, name) for one in heard]) for name in ("range_m", "weights"))
    return Heard(ranges, weights, ray, int(firsts[-1]))


def _thinned(seen: _Seen, count: int, generator: np.random.Generator) -> _Seen:
    """As many samples as a number of cells needs, drawn by weight, so that they count alike."""
    if len(seen.weights) <= samples_for(count):
        return seen
    drawn = seen.take(systematic_draw(seen.weights, samples_for(count), generator))
    # where a few samples have nearly all weight they are drawn again and again, and cells would be left without
    if len(np.unique(drawn.looking, axis=0)) < count:
        return seen
    return _Seen(drawn.looking, drawn.range_m, np.ones(len(drawn.weights)), drawn.owner)


def _in_fields(directions: np.ndarray, sensor: np.ndarray, sensors: Sequence[Sensor]) -> np.ndarray:
    """Directions (N, 3) inside the fields of their sensors: means of samples at the edge of a wide field bulge."""
    inside = directions.copy()
    for index, one in enumerate(sensors):
        own = np.flatnonzero(sensor == index)
        tangent, half = tangent_coordinates(one.frame, directions[own]), np.array(one.field_of_view_rad) / 2
        beyond = (np.abs(tangent) > half + FIELD_ROUNDING_RAD).any(axis=1)
        inside[own[beyond]] = tangent_directions(one.frame, np.clip(tangent[beyond], -half, half))
    return inside


def ray_gates(design: DesignSpec, heard: Heard, sensor: np.ndarray, samples: Samples) -> np.ndarray:
    """Gates by what rays hear, inside their sensors' bounds and the design's bandwidth, shape (N, 2) [m]."""
    constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
    count = len(design.sensors)
    bounds = bounds_of(constraints.rules, samples.space, tuple(range(count)), interval_factor(design.level))
    bounds = bounds.take(sensor)
    model, limit = bandwidth_limit(constraints, len(sensor))
    return gates_within(heard, bounds, design.level, model, limit)


def narrowed(design: DesignSpec, gates: np.ndarray, sensor: np.ndarray, samples: Samples) -> np.ndarray:
    """Gates (N, 2) [m] that were not priced, where they are too wide for the design's bandwidth: towards their middles.

    Rays of which too little is known count as hearing most in the middle of their gates.
    """
    constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
    model, limit = bandwidth_limit(constraints, len(gates))
    if limit is None or int(model.bins(gates[:, 1] - gates[:, 0]).sum()) <= limit:
        return gates
    shape = ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES)
    ranges = gates.mean(axis=1)[:, None] + np.diff(gates, axis=1) / 2 * shape / shape[-1]
    ray = np.repeat(np.arange(len(gates)), QUANTILES)
    return ray_gates(design, Heard(ranges.reshape(-1), np.ones(ranges.size), ray, len(gates)), sensor, samples)


def bandwidth_limit(constraints: Constraints, rays: int) -> tuple[Bandwidth, int | None]:
    """The read-out model, and how many bins a number of rays may take in the bandwidth budget."""
    budget = constraints.budget
    model = Bandwidth(budget.bin_ps, budget.bits_per_bin, budget.rate_hz)
    if budget.bandwidth_mbps is None:
        return model, None
    one_bin = model.mbps_of_widths(np.zeros(1))
    return model, max(int(budget.bandwidth_mbps / one_bin), rays)


def _seen(design: DesignSpec, samples: Samples) -> _Seen:
    """The samples inside the fields and gates of sensors, each with one of them."""
    parts = members(design, samples.points, samples.weights)
    return _Seen(
        np.concatenate([tangent_directions(s.frame, m.tangent) for s, m in zip(design.sensors, parts, strict=True)]),
        np.concatenate([part.range_m for part in parts]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate([np.full(len(part), index) for index, part in enumerate(parts)]),
    )


def _cells(seen: _Seen, count: int, sensors: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) of rays and the sensor of each (N,).

    A ray looks at the middle of its own sensor's samples in the cell.
    """
    _, labels = lloyd(seen.looking, seen.weights, count, generator)
    votes = np.bincount(labels * sensors + seen.owner, seen.weights, count * sensors).reshape(count, sensors)
    owner = votes.argmax(axis=1)
    own = seen.owner == owner[labels]
    sums = [np.bincount(labels[own], seen.weights[own] * axis[own], count) for axis in seen.looking.T]
    return unit_vectors(np.stack(sums, axis=1)), owner
