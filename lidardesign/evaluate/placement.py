"""Even placements of exactly N rays over boxes of any number of origin and angle axes, without randomness."""

from __future__ import annotations

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.grid import grid_tangent, low_discrepancy
from lidardesign.design.rays import fire_times
from lidardesign.simulate.returns import Rays
from lidardesign.space import AZIMUTH, ELEVATION, direction

RAY_AXES = 5  # x, y, z, azimuth, elevation: everything but the range
# A gate without width hears nothing, since gates are open at their end. Ranges that never vary get the width
# of the default 100 ps bin around them.
SMALLEST_GATE_M = 0.015


def even_unit(count: int, extents: np.ndarray) -> np.ndarray:
    """Exactly `count` even points in the unit cube of the axes given by their extents, shape (count, k).

    No axis gives equal points, one a cell-centred line, two a cell-centred grid with cells as square as
    whole rays allow, more a low-discrepancy sequence.
    """
    if len(extents) == 2:
        return grid_tangent(float(extents[0]), float(extents[1]), count) / extents + 0.5
    if len(extents) == 1:
        return (np.arange(count)[:, None] + 0.5) / count
    return low_discrepancy(count, len(extents))


def even_placement(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """Even points over the axes of a box that have a width, shapes (5,), (5,) to (count, 5).

    Two axes in the same unit (two lengths, or azimuth and elevation) get square cells in that unit; a length
    beside an angle gets cells that are square relative to the box.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    free = np.flatnonzero(high > low)
    extents = (high - low)[free]
    if len(free) == 2 and (free[0] < AZIMUTH) != (free[1] < AZIMUTH):
        extents = np.ones(2)
    points = np.tile(low, (count, 1))
    points[:, free] += even_unit(count, extents) * (high - low)[free]
    return np.clip(points, low, high)


def rays_at(points: np.ndarray, gate_m: np.ndarray) -> Rays:
    """Rays of one sensor at (x, y, z, azimuth, elevation), shape (N, 5 or 6), all with one gate (2,) [m].

    They fire one after another over a frame, as a design's do.
    """
    count = len(points)
    return Rays(
        origin_m=points[:, :3],
        direction=direction(points[:, AZIMUTH], points[:, ELEVATION]),
        gate_m=np.tile(gate_m, (count, 1)),
        sensor=np.zeros(count),
        time_s=fire_times(count, Bandwidth().rate_hz),
    )


def opened_gate(start_m: float, end_m: float) -> np.ndarray:
    """A gate that hears both its ends, shape (2,) [m]; one without width gets `SMALLEST_GATE_M`."""
    if end_m > start_m:
        return np.array([start_m, np.nextafter(end_m, np.inf)])
    start = max(0.0, start_m - SMALLEST_GATE_M / 2)
    return np.array([start, start + SMALLEST_GATE_M])
