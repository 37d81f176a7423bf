"""Gates of single rays: as constraints admit them, priced under a bandwidth, and over fields that sensors share.

Under a bandwidth every metre of gate, wherever it is, holds as many returns as it costs. The interval [a, b] of a ray
that maximises its returns less a price per metre, P(a, b) - price * (b - a), listens where the density of returns along
the ray is above the price. The same price for all rays holds the most returns for the bins that they take together; the
price is found by bisection.

Rays in the fields of view of sensors, from their mean origins; and which samples of the density a sensor sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.layouts.grid import field_on_sphere, grid_tangent
from lidardesign.layouts.layout import Layout, missing_samples, shares_of
from lidardesign.mixture.bounds import Bounds, bounds_of
from lidardesign.mixture.m_step import fit_gate
from lidardesign.numerics import ROUNDING, TINY, angle_over_sine
from lidardesign.samples import Samples
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.sensor import (
    DesignSpec,
    Gates,
    Sensor,
    interval_factor,
    tangent_coordinates,
    tangent_directions,
)
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, direction, observed_point

# A 95 % interval of ranges means nothing from fewer (effective) samples: one in forty lies beyond each end.
SMALLEST_CELL = 20.0
# Gates are at least this wide: a thousandth of what one bin of 100 ps resolves [m].
THINNEST_GATE_M = 1.5e-5


def central_intervals(
    values: np.ndarray, weights: np.ndarray, labels: np.ndarray, count: int, level: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The central `level` of weighted values in each cell, and how many equal weights each rests on.

    Arguments:
        values: Shape (N,).
        weights: Non-negative, shape (N,).
        labels: The cell of each value, shape (N,).
        count: Number of cells K.
        level: The share that an interval holds, or several of any shape.

    Returns:
        Ends, shape (K, ..., 2), NaN for cells without weight; effective counts, shape (K,).
    """
    shares = np.stack([(1 - np.asarray(level)) / 2, (1 + np.asarray(level)) / 2], axis=-1)
    ends, effective = np.full((count, *shares.shape), np.nan), np.zeros(count)
    order = np.lexsort((values, labels))
    starts = np.searchsorted(labels[order], np.arange(count + 1))
    for cell in np.flatnonzero(np.diff(starts)):
        part = order[starts[cell] : starts[cell + 1]]
        mass = weights[part].sum()
        if mass <= 0:
            continue
        share = (np.cumsum(weights[part]) - weights[part] / 2) / mass
        ends[cell] = np.interp(shares, share, values[part])
        # shares first: squares of weights below 1e-160 are zero
        effective[cell] = 1 / np.square(weights[part] / mass).sum()
    return ends, effective


def admissible_gates(wanted_m: np.ndarray, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
    """The gates inside bounds that suit the wanted ones best: centre and spread, shape (K,) each [m].

    Best as the likelihood of ranges whose interval is the wanted gate, which is what the M-step maximises;
    a gate that keeps its bounds stays as it is.

    Arguments:
        wanted_m: Start and end, shape (K, 2) [m].
        bounds: One row per gate.
    """
    centre, half = wanted_m.mean(axis=1), np.diff(wanted_m, axis=1)[:, 0] / 2
    smallest = THINNEST_GATE_M / (2 * bounds.interval)
    return fit_gate(centre, np.square(np.maximum(half / bounds.interval, smallest)), bounds, smallest)


def admitted_gates(wanted_m: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Start and end of the gates that `admissible_gates` finds, shape (K, 2) [m]."""
    centre, spread = admissible_gates(wanted_m, bounds)
    half = bounds.interval * spread
    # half an ulp may take a gate that starts at 0 below it
    return np.maximum(np.stack([centre - half, centre + half], axis=1), 0.0)


def bounded_gates(wanted: np.ndarray, sensor: Sensor, bounds: Bounds) -> np.ndarray:
    """Wanted gates (K, 2), those that break a bound replaced by the best gate that keeps all of them [m]."""
    start, end = sensor.gate_m
    width = np.diff(wanted, axis=1)[:, 0]
    broken = (wanted[:, 0] > bounds.start_high) | (wanted[:, 1] < bounds.end_low) | (width < bounds.width_low)
    if not broken.any():
        return wanted
    if end <= start:
        return np.tile([start, end], (len(wanted), 1))
    inner = replace(bounds, start_low=np.full(len(wanted), start), end_high=np.full(len(wanted), end))
    return np.where(broken[:, None], np.clip(admitted_gates(wanted, inner), start, end), wanted)


# Prices are bisected on a logarithmic scale, from this share of the dearest one.
CHEAPEST = 1 / 2**36
BISECTIONS = 26


@dataclass(frozen=True, eq=False)
class RayRanges:
    """Ranges that rays would measure, over scenes or samples.

    Arguments:
        range_m: Shape (M,) [m].
        weights: How often, shape (M,), not negative.
        ray: Which ray each belongs to, shape (M,).
        count: Number of rays N.
    """

    range_m: np.ndarray
    weights: np.ndarray
    ray: np.ndarray
    count: int


def gates_within(heard: RayRanges, bounds: Bounds, level: float, model: Bandwidth, most_bins: int | None) -> np.ndarray:
    """Gates that hold the level of what each ray hears, or less where their bins would be too many.

    Arguments:
        heard: What rays would measure, of every ray something.
        bounds: One row per ray.
        level: The share that a gate holds where bandwidth allows it.
        model: Bins of gates.
        most_bins: Bins of all rays together; None is no limit.

    Returns:
        Gates (N, 2) [m]. Bounds that do not admit narrow gates may need more bins, which is for the caller to check.
    """
    heard, wide = _admissible(heard, bounds, level)

    def fits(gates: np.ndarray) -> bool:
        return most_bins is None or int(model.bins(gates[:, 1] - gates[:, 0]).sum()) <= most_bins

    gates = admitted_gates(wide, bounds)
    if fits(gates):
        return gates
    prices = _Prices.of(heard, wide)
    # no interval as long as a bin is worth this price
    dear = float(np.log(2 * max(prices.until.max(), TINY) / model.bin_m))
    cheap = dear + float(np.log(CHEAPEST))
    for _ in range(BISECTIONS):
        middle = (cheap + dear) / 2
        gates = admitted_gates(prices.gates(float(np.exp(middle))), bounds)
        cheap, dear = (cheap, middle) if fits(gates) else (middle, dear)
    return admitted_gates(prices.gates(float(np.exp(dear))), bounds)


def _admissible(heard: RayRanges, bounds: Bounds, level: float) -> tuple[RayRanges, np.ndarray]:
    """What gates may hear at all, and the gates (N, 2) [m] that hold the level of it; narrow where it is nothing."""
    low, high = np.maximum(bounds.start_low, 0.0), bounds.end_high
    kept = (heard.weights > 0) & (heard.range_m >= low[heard.ray]) & (heard.range_m <= high[heard.ray])
    inside = RayRanges(heard.range_m[kept], heard.weights[kept], heard.ray[kept], heard.count)
    wide, _ = central_intervals(inside.range_m, inside.weights, inside.ray, heard.count, level)
    middle = np.bincount(heard.ray, heard.range_m, heard.count) / np.bincount(heard.ray, minlength=heard.count)
    return inside, np.where(np.isnan(wide), np.clip(middle, low, high)[:, None], wide)


@dataclass(frozen=True, eq=False)
class _Prices:
    """What rays hear in the order of their ranges, within their widest gates, one row each, shape (N, W)."""

    range_m: np.ndarray
    before: np.ndarray
    until: np.ndarray

    @classmethod
    def of(cls, heard: RayRanges, wide: np.ndarray) -> _Prices:
        start, end = wide[heard.ray].T
        inside = (heard.range_m >= start) & (heard.range_m <= end) & (heard.weights > 0)
        ranges, weights, ray = heard.range_m[inside], heard.weights[inside], heard.ray[inside]
        order = np.lexsort((ranges, ray))
        ranges, weights, ray = ranges[order], weights[order], ray[order]
        place = np.arange(len(ray)) - np.searchsorted(ray, np.arange(heard.count))[ray]
        width = int(place.max(initial=0)) + 1
        # rows are filled up with their own last range, which holds nothing more
        table = np.tile(wide.mean(axis=1)[:, None], (1, width))
        held = np.zeros((heard.count, width))
        table[ray, place], held[ray, place] = ranges, weights
        lengths = np.maximum(np.bincount(ray, minlength=heard.count), 1)
        last = table[np.arange(heard.count), lengths - 1]
        table = np.where(np.arange(width) < lengths[:, None], table, last[:, None])
        mean = max(held.sum() / heard.count, TINY)
        until = np.cumsum(held, axis=1) / mean
        return cls(table, until - held / mean, until)

    def gates(self, price: float) -> np.ndarray:
        """The gates of a price per metre, shape (N, 2) [m]."""
        opening = self.before - price * self.range_m
        lowest, rows = np.minimum.accumulate(opening, axis=1), np.arange(len(opening))
        end = (self.until - price * self.range_m - lowest).argmax(axis=1)
        reached = np.arange(opening.shape[1]) <= end[:, None]
        start = np.where(reached, opening, np.inf).argmin(axis=1)
        return np.stack([self.range_m[rows, start], self.range_m[rows, end]], axis=1)


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
    best, owner = np.full(len(points), -np.inf), np.full(len(points), -1)
    tangent, distance = np.zeros((len(points), 2)), np.zeros(len(points))
    for index, (sensor, weight) in enumerate(zip(design.sensors, design.weights, strict=True)):
        if weight == 0:
            continue
        angles, ranges = seen_from(sensor, observed)
        score = np.log(weight) + log_density(sensor, angles, ranges, smallest_m=smallest)
        better = score > best
        best[better], owner[better] = score[better], index
        tangent[better], distance[better] = angles[better], ranges[better]
    seen = []
    for index, sensor in enumerate(design.sensors):
        start, end = sensor.gate_m
        inside = (owner == index) & (weights > 0) & (distance >= start) & (distance < end)
        inside &= (np.abs(tangent) <= np.array(sensor.field_of_view_rad) / 2 + FIELD_ROUNDING_RAD).all(axis=1)
        rows = np.flatnonzero(inside)
        seen.append(Members(rows, tangent[rows], distance[rows], weights[rows]))
    return seen


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
    log_jacobian = np.log(angle_over_sine(np.hypot(tangent[:, 0], tangent[:, 1])))
    return -squares / 2 - np.log(angular).sum() - np.log(depth) + log_jacobian


class GridLayout(Layout):
    """Rays even in the field of view of each sensor."""

    name = "grid"
    fitted_as = "grid"

    def leaves_rays_open(self, gates: Gates | None) -> bool:
        """See `Layout`: even rays need no table, but gates of their own do."""
        return gates != "ray"

    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """See `Layout`."""
        shares = zip(spec.sensors, shares_of(spec, count), strict=True)
        tangents = [grid_tangent(*field_on_sphere(sensor), int(n)) for sensor, n in shares]
        return rays_with_gates(spec, tangents, samples, gates)


def rays_with_gates(spec: DesignSpec, tangents: Sequence[np.ndarray], samples: Samples | None, gates: Gates) -> Rays:
    """Rays at angles (N, 2) [rad] as `rays_in_fields`, with their sensors' gates or with their own of the samples."""
    if gates == "sensor":
        return rays_in_fields(spec, tangents)
    if samples is None:
        raise missing_samples(spec, sum(map(len, tangents)), gates)
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
    from scipy.spatial import cKDTree

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
