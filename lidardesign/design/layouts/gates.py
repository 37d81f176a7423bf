"""Gates of single rays: the interval of ranges that a ray would see, moved no further than constraints ask.

Under a bandwidth every metre of gate, wherever it is, holds as many returns as it costs. The interval [a, b] of a ray
that maximises its returns less a price per metre, P(a, b) - price * (b - a), listens where the density of returns along
the ray is above the price. The same price for all rays holds the most returns for the bins that they take together; the
price is found by bisection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.mixture.bounds import Bounds
from lidardesign.design.mixture.m_step import fit_gate
from lidardesign.design.sensor import Sensor
from lidardesign.numerics import TINY

# A 95 % interval of ranges means nothing from fewer (effective) samples: one in forty lies beyond each end.
SMALLEST_CELL = 20.0
# Gates are at least this wide: a thousandth of what one bin of 100 ps resolves [m].
THINNEST_GATE_M = 1.5e-5


def central_intervals(
    values: np.ndarray, weights: np.ndarray, labels: np.ndarray, count: int, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """The central `level` of weighted values in each cell, and how many equal weights each rests on.

    Arguments:
        values: Shape (N,).
        weights: Non-negative, shape (N,).
        labels: The cell of each value, shape (N,).
        count: Number of cells K.
        level: The share that an interval holds.

    Returns:
        Ends, shape (K, 2), NaN for cells without weight; effective counts, shape (K,).
    """
    ends, effective = np.full((count, 2), np.nan), np.zeros(count)
    order = np.lexsort((values, labels))
    starts = np.searchsorted(labels[order], np.arange(count + 1))
    for cell in np.flatnonzero(np.diff(starts)):
        part = order[starts[cell] : starts[cell + 1]]
        mass = weights[part].sum()
        if mass <= 0:
            continue
        share = (np.cumsum(weights[part]) - weights[part] / 2) / mass
        ends[cell] = np.interp([(1 - level) / 2, (1 + level) / 2], share, values[part])
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
    spread = np.maximum(half / bounds.interval, smallest)
    return fit_gate(centre, np.square(spread), bounds, smallest)


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
    centre, spread = admissible_gates(wanted, inner)
    half = bounds.interval * spread
    moved = np.clip(np.stack([centre - half, centre + half], axis=1), start, end)
    return np.where(broken[:, None], moved, wanted)


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

    def held_by(self, gates: np.ndarray) -> float:
        """The weight that gates (N, 2) hold; what lies on their very ends counts, whatever rounding did to these."""
        start, end = gates[self.ray].T
        held = (self.range_m >= start - THINNEST_GATE_M) & (self.range_m <= end + THINNEST_GATE_M)
        return float(self.weights[held].sum())


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

    def admitted(gates: np.ndarray) -> np.ndarray:
        centre, spread = admissible_gates(gates, bounds)
        half = bounds.interval * spread
        return np.maximum(np.stack([centre - half, centre + half], axis=1), 0.0)

    def fits(gates: np.ndarray) -> bool:
        return most_bins is None or int(model.bins(gates[:, 1] - gates[:, 0]).sum()) <= most_bins

    found = admitted(wide)
    if fits(found):
        return found
    prices = _Prices.of(heard, wide)
    # no interval as long as a bin is worth this price
    dear = float(np.log(2 * max(prices.until.max(), TINY) / model.bin_m))
    cheap = dear + float(np.log(CHEAPEST))
    for _ in range(BISECTIONS):
        middle = (cheap + dear) / 2
        gates = admitted(prices.gates(float(np.exp(middle))))
        cheap, dear = (cheap, middle) if fits(gates) else (middle, dear)
    return admitted(prices.gates(float(np.exp(dear))))


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
        starts = np.searchsorted(ray, np.arange(heard.count))
        place = np.arange(len(ray)) - starts[ray]
        width = int(place.max(initial=0)) + 1
        # rows are filled up with their own last range, which holds nothing more
        table = np.tile(wide.mean(axis=1)[:, None], (1, width))
        held = np.zeros((heard.count, width))
        table[ray, place], held[ray, place] = ranges, weights
        lengths = np.bincount(ray, minlength=heard.count)
        last = table[np.arange(heard.count), np.maximum(lengths - 1, 0)]
        table = np.where(np.arange(width) < np.maximum(lengths, 1)[:, None], table, last[:, None])
        mean = max(held.sum() / heard.count, TINY)
        until = np.cumsum(held, axis=1) / mean
        return cls(table, until - held / mean, until)

    def gates(self, price: float) -> np.ndarray:
        """The gates of a price per metre, shape (N, 2) [m]."""
        opening = self.before - price * self.range_m
        lowest = np.minimum.accumulate(opening, axis=1)
        end = (self.until - price * self.range_m - lowest).argmax(axis=1)
        rows = np.arange(len(end))
        reached = np.arange(opening.shape[1]) <= end[:, None]
        start = np.where(reached, opening, np.inf).argmin(axis=1)
        return np.stack([self.range_m[rows, start], self.range_m[rows, end]], axis=1)
