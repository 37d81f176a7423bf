"""Gates of candidate rays: a few for each, from what the ray or its sensor returns, inside constraints.

Gates hold quantiles of the informative returns of a ray and of rays near it. Narrow gates cost fewer bits and lose
returns outside; `choice` decides between them, or `selection` where a sensor has one gate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.constraints.document import SensorRules
from lidardesign.mixture.bounds import Bounds, bounds_of
from lidardesign.mixture.m_step import fit_gate
from lidardesign.rays.training_scenes import SceneInformation
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.sensor import Sensor, interval_factor
from lidardesign.space import DesignSpace

# Shares of what a ray returns that its gates hold; the first of them counts what rays near it return too.
LEVELS = (1.0, 1.0, 0.98, 0.9, 0.75)
SENSOR_LEVELS = (1.0, 0.98, 0.9, 0.75, 0.5, 0.25)  # the same of what all rays of a sensor return
NEIGHBOURS = 7  # of a ray, with itself: those around it in a hexagonal lattice
FEWEST_RETURNS = 3  # of a ray by itself, below which its gates rest on those of rays near it
# Gates are at least this wide: a thousandth of what one bin of 100 ps resolves [m].
THINNEST_GATE_M = 1.5e-5


@phase("gates")
def admitted_choices(
    rays: Rays,
    visits: Sequence[slice],
    informed: Sequence[SceneInformation],
    *,
    sensors: Sequence[Sensor],
    rules: Sequence[SensorRules],
    level: float,
    space: DesignSpace,
    margin_m: float,
    is_shared: bool,
) -> np.ndarray:
    """A few gates for each of some rays inside the limits of a design, (N, G, 2) [m].

    Arguments:
        rays: Candidates, with the widest gates that they may have.
        visits: The rays at each condition; only those of one are near each other.
        informed: What the task says of training scenes.
        sensors: The sensors that fire the rays.
        rules: Their constraints.
        level: The share of each marginal that intervals hold.
        space: The design space.
        margin_m: Margin at both ends of gates that hold all returns, for other scenes [m].
        is_shared: Whether all rays of a sensor have one gate.
    """
    gates_m = (sensor_gates if is_shared else gate_choices)(rays, visits, informed, margin_m)
    for index, sensor in enumerate(sensors):
        own = rays.sensor == index
        wanted = gates_m[own].reshape(-1, 2)
        bounds = bounds_of(rules, space, (index,), interval_factor(level))
        allowed = bounded_gates(wanted, sensor, bounds.take(np.zeros(len(wanted), dtype=np.int64)))
        gates_m[own] = allowed.reshape(-1, *gates_m.shape[1:])
    return gates_m


def gate_choices(
    rays: Rays, visits: Sequence[slice], informed: Sequence[SceneInformation], margin_m: float
) -> np.ndarray:
    """A few gates for each ray, inside its own, (N, G, 2) [m]; a ray without information has its own alone.

    Arguments:
        rays: The candidates, with the widest gates that they may have.
        visits: The rays at each condition; only those of one are near each other.
        informed: What the task says of training scenes.
        margin_m: Margin at both ends of gates that hold all of a ray's returns, for other scenes [m].
    """
    count = len(rays)
    ray, range_m = _informative_returns(informed)
    if not len(ray):
        return np.repeat(rays.gate_m[:, None], len(LEVELS), axis=1)
    # loaded here because sensors of one gate need no neighbours
    from scipy.spatial import cKDTree

    seen = rays.origin_m + np.median(range_m) * rays.direction
    near = [
        visit.start + rows
        for visit in visits
        for rows in cKDTree(seen[visit]).query(seen[visit], [*range(1, min(NEIGHBOURS, len(seen[visit])) + 1)])[1]
    ]
    order = np.argsort(ray, kind="stable")
    start = np.searchsorted(ray[order], np.arange(count + 1))
    parts = [range_m[order[start[n] : start[n + 1]]] for n in range(count)]
    shared = [np.concatenate([parts[n] for n in group]) for group in near]
    alone = [part if len(part) >= FEWEST_RETURNS else group for part, group in zip(parts, shared, strict=True)]
    ends = []
    for source, levels in ((shared, LEVELS[:1]), (alone, LEVELS[1:])):
        cell = np.repeat(np.arange(count), [len(part) for part in source])
        ends.append(central_intervals(np.concatenate(source), cell, count, levels))
    return _inside(rays, np.concatenate(ends, axis=1), LEVELS, margin_m)


def sensor_gates(
    rays: Rays, visits: Sequence[slice], informed: Sequence[SceneInformation], margin_m: float
) -> np.ndarray:
    """A few gates of each ray's sensor, each narrower than the one before, (N, G, 2) [m]; as `gate_choices`."""
    ray, range_m = _informative_returns(informed)
    sensor, sensors = rays.sensor[ray], int(rays.sensor.max()) + 1
    ends = central_intervals(range_m, sensor, sensors, SENSOR_LEVELS)
    narrow = _inside(rays, ends[rays.sensor], SENSOR_LEVELS, margin_m)
    return np.concatenate([rays.gate_m[:, None], narrow], axis=1)


def _inside(rays: Rays, ends_m: np.ndarray, levels: Sequence[float], margin_m: float) -> np.ndarray:
    """Gates (N, L, 2) with these ends, clipped to the rays' own; NaN ends give the rays' own, level 1 a margin."""
    wider = np.where(np.array(levels) == 1.0, margin_m, 0.0)
    wider = np.stack([-wider, np.where(wider > 0, np.nextafter(wider, np.inf), 0.0)], axis=1)
    own = rays.gate_m[:, None]
    return np.where(np.isnan(ends_m), own, np.clip(ends_m + wider, own[..., :1], own[..., 1:]))


def _informative_returns(informed: Sequence[SceneInformation]) -> tuple[np.ndarray, np.ndarray]:
    """All informative returns: their rays (K,) and ranges (K,) [m]."""
    returns = [scene.informative_returns for scene in informed]
    return tuple(np.concatenate(column) for column in zip(*returns, strict=True))


def central_intervals(values: np.ndarray, cell: np.ndarray, cells: int, levels: Sequence[float]) -> np.ndarray:
    """Ends of the central shares of the values in each cell, (K, L, 2), interpolated; NaN for cells without values.

    Arguments:
        values: Shape (N,).
        cell: The cell of each value, shape (N,).
        cells: Their number K.
        levels: The shares that intervals hold, L of them.
    """
    ordered = values[np.lexsort((values, cell))]
    count = np.bincount(cell, minlength=cells)[:, None, None]
    first = np.cumsum(count, axis=0) - count
    share = np.stack([(1 - np.array(levels)) / 2, (1 + np.array(levels)) / 2], axis=-1)
    # value i of n stands for the share (i + 1/2) / n
    place = np.clip(share * count - 0.5, 0.0, np.maximum(count - 1, 0))
    below = np.floor(place).astype(np.intp)
    padded = np.append(ordered, np.nan)
    low = padded[np.minimum(first + below, len(ordered))]
    high = padded[np.minimum(first + np.minimum(below + 1, np.maximum(count - 1, 0)), len(ordered))]
    return np.where(count > 0, low + (place - below) * (high - low), np.nan)


def admitted_gates(wanted_m: np.ndarray, bounds: Bounds) -> np.ndarray:
    """The gates inside bounds that are nearest to the wanted ones: start and end, shape (K, 2) [m].

    Nearest by the likelihood of ranges whose interval is the wanted gate, as in the M-step; a gate within its bounds
    is unchanged.

    Arguments:
        wanted_m: Start and end, shape (K, 2) [m].
        bounds: One row per gate.
    """
    centre, half = wanted_m.mean(axis=1), np.diff(wanted_m, axis=1)[:, 0] / 2
    smallest = THINNEST_GATE_M / (2 * bounds.interval)
    centre, spread = fit_gate(centre, np.square(np.maximum(half / bounds.interval, smallest)), bounds, smallest)
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
