"""Gates of single rays: the interval of ranges that a ray would see, moved no further than constraints ask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidardesign.design.bounds import Bounds
from lidardesign.design.mstep import fit_gate
from lidardesign.design.sensor import Sensor

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


def kept_gates(wanted: np.ndarray, sensor: Sensor, bounds: Bounds) -> np.ndarray:
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
