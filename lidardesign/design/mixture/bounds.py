"""The bounds that every parameter of every component must keep, as arrays: what the M-step works with.

Angles are internal ones (see `features`); gates and fields of view are bounds on reported intervals, which
the factor z = `interval_factor(level)` ties to means and spreads.

From a constraint file and a design space to the bounds of each component and to pinned origins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lidardesign.design.constraints.document import Constraints, SensorConstraints
from lidardesign.design.constraints.feasibility import azimuth_interval
from lidardesign.design.constraints.origins import PINNED_BOX_M, free_boxes, origin_box
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK, wrap_angle, wrap_turn
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace

# Smallest standard deviations relative to the spread of all data: below it a component has collapsed on a
# duplicate. In angle and range separately, and per origin axis. Where the data themselves do not vary, their scale
# is a share of the space (see `features`), so that no length stands here that would be coarse in a small world.
RELATIVE_FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of K components; low and high arrays of shape (K,) where not said otherwise.

    Arguments:
        interval: z, the standard deviations on each side of a mean that an interval spans.
        origin_low, origin_high: Box of the mean origin [m], shape (K, 3).
        free_low, free_high: Boxes one of which holds the interval of the origin along each axis, shape (K, M, 3) [m].
        origin_spread: Largest standard deviation of the origin along any direction [m].
        origin_thickness: Largest standard deviation of the origin along its thinnest direction [m].
        azimuth_centre, azimuth_half: Interval of the boresight's azimuth on the circle [rad].
        elevation_low, elevation_high: Of the boresight [rad].
        spread_low, spread_high: Angular standard deviations, horizontal and vertical, shape (K, 2) [rad].
        start_low, start_high, end_low, end_high, width_low, width_high: Of the gate [m].
    """

    interval: float
    origin_low: np.ndarray
    origin_high: np.ndarray
    free_low: np.ndarray
    free_high: np.ndarray
    origin_spread: np.ndarray
    origin_thickness: np.ndarray
    azimuth_centre: np.ndarray
    azimuth_half: np.ndarray
    elevation_low: np.ndarray
    elevation_high: np.ndarray
    spread_low: np.ndarray
    spread_high: np.ndarray
    start_low: np.ndarray
    start_high: np.ndarray
    end_low: np.ndarray
    end_high: np.ndarray
    width_low: np.ndarray
    width_high: np.ndarray

    def __len__(self) -> int:
        return len(self.origin_low)

    def take(self, rows: np.ndarray) -> Bounds:
        """The bounds of some components, in their order."""
        arrays = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "interval"}
        return replace(self, **arrays)

    def narrowed(self, width_m: float) -> Bounds:
        """The same with gates no wider than a common cap [m], never below a component's least width.

        A gate that must start early and end late has a least width, too.
        """
        least = np.maximum(self.width_low, self.end_low - self.start_high)
        return replace(self, width_high=np.maximum(np.minimum(self.width_high, width_m), least))

    @classmethod
    def unbounded(cls, count: int, interval: float) -> Bounds:
        """Bounds that bind nowhere."""
        low, high = np.full(count, -math.inf), np.full(count, math.inf)
        return cls(
            interval=interval,
            origin_low=np.full((count, 3), -math.inf),
            origin_high=np.full((count, 3), math.inf),
            free_low=np.full((count, 1, 3), -math.inf),
            free_high=np.full((count, 1, 3), math.inf),
            origin_spread=high,
            origin_thickness=high,
            azimuth_centre=np.zeros(count),
            azimuth_half=np.full(count, math.pi),
            elevation_low=np.full(count, -math.pi / 2),
            elevation_high=np.full(count, math.pi / 2),
            spread_low=np.zeros((count, 2)),
            spread_high=np.full((count, 2), math.pi / interval),
            start_low=low,
            start_high=high,
            end_low=low,
            end_high=high,
            width_low=np.zeros(count),
            width_high=high,
        )


@dataclass(frozen=True)
class Floors:
    """Smallest standard deviations: of the origin and the range [m], of angles [rad]."""

    origin_m: float
    angle_rad: float
    range_m: float

    @classmethod
    def of(cls, features: Features) -> Floors:
        """Floors relative to the scale of the data."""
        count = len(features.axes.origin)
        origin = float(features.scale[:count].min()) if count else 1.0
        reach = float(features.scale[-1]) if features.axes.range else 1.0
        return cls(RELATIVE_FLOOR * origin, RELATIVE_FLOOR * features.angular_scale, RELATIVE_FLOOR * reach)


def clip_azimuth(azimuth_rad: np.ndarray, bounds: Bounds) -> np.ndarray:
    """The nearest admissible azimuth on the circle, shape (K,) [rad]."""
    offset = wrap_angle(azimuth_rad - bounds.azimuth_centre)
    free = bounds.azimuth_half >= math.pi
    clipped = bounds.azimuth_centre + np.clip(offset, -bounds.azimuth_half, bounds.azimuth_half)
    return np.where(free, azimuth_rad, clipped)


# Bounds move inward by this share, so that a value at its bound still keeps it after unit conversions, the
# interval's own arithmetic and writing; a micrometre per kilometre.
INWARD = SLACK

Pins = tuple[float | None, float | None, float | None]


@dataclass(frozen=True)
class Group:
    """Sensors that share pinned origin coordinates: they draw on one set of samples.

    Arguments:
        pins: The pinned coordinate of each origin axis [m], None where it is free or fixed by the space.
        sensors: Indices of the sensors.
    """

    pins: Pins
    sensors: tuple[int, ...]


def inward(low: float, high: float) -> tuple[float, float]:
    """The interval a little smaller; its middle where nothing would be left."""
    size = max(abs(v) for v in (low, high, 0.0) if math.isfinite(v))
    fresh = low + INWARD * size, high - INWARD * size
    if fresh[0] <= fresh[1]:
        return fresh
    return (low + high) / 2, (low + high) / 2


def pins_of(one: SensorConstraints, space: DesignSpace) -> Pins:
    """The origin coordinates that the constraints pin and the space does not."""
    low, high = origin_box(one, space)
    pinned = [i in space.free and high[i] - low[i] <= PINNED_BOX_M for i in range(3)]
    x, y, z = (float(low[i]) if pinned[i] else None for i in range(3))
    return x, y, z


def groups(constraints: Constraints, space: DesignSpace, count: int) -> list[Group]:
    """Sensors by their pinned origins, in order of first appearance."""
    members: dict[Pins, list[int]] = {}
    for index in range(count):
        members.setdefault(pins_of(constraints.of_sensor(index), space), []).append(index)
    return [Group(pins, tuple(sensors)) for pins, sensors in members.items()]


def bounds_of(constraints: Constraints, space: DesignSpace, sensors: tuple[int, ...], interval: float) -> Bounds:
    """The bounds of some sensors' components, one row each.

    Arguments:
        constraints: Feasible constraints.
        space: The design space.
        sensors: Indices of the sensors.
        interval: z, half an interval in standard deviations.
    """
    axes = Axes.of(space)
    distinct = {i: _row(constraints, i, space, axes, interval) for i in _distinct(constraints, sensors)}
    _even_out(list(distinct.values()))
    last = len(constraints.each)
    rows = [distinct[min(i, last)] for i in sensors]
    arrays = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return Bounds(interval=interval, **arrays)


def _distinct(constraints: Constraints, sensors: tuple[int, ...]) -> set[int]:
    """Sensors beyond the entries of `each` all have the common constraints."""
    return {min(i, len(constraints.each)) for i in sensors}


def _even_out(rows: list[dict[str, Any]]) -> None:
    """Give all rows as many free boxes as the longest has, by repeating their first."""
    most = max(len(row["free_low"]) for row in rows)
    for row in rows:
        for key in ("free_low", "free_high"):
            boxes = row[key]
            row[key] = np.concatenate([boxes, np.repeat(boxes[:1], most - len(boxes), axis=0)])


def _row(constraints: Constraints, index: int, space: DesignSpace, axes: Axes, interval: float) -> dict[str, Any]:
    one = constraints.of_sensor(index)
    low, high = origin_box(one, space)
    spread, thickness = one.origin.spread_m.max, one.origin.thickness_m.max
    free_low, free_high = _free_sides(constraints, index, space)
    row: dict[str, Any] = {
        "origin_low": low,
        "origin_high": high,
        "free_low": free_low,
        "free_high": free_high,
        "origin_spread": math.inf if spread is None else (1 - INWARD) * spread,
        "origin_thickness": math.inf if thickness is None else (1 - INWARD) * thickness,
    }
    row |= _boresight_row(one, space, axes)
    row |= _field_row(one, axes, interval)
    row |= _gate_row(one, space)
    return row


def _free_sides(constraints: Constraints, index: int, space: DesignSpace) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the boxes between the excluded ones, a little inward, (M, 3) each [m]."""
    low, high = free_boxes(constraints.of_sensor(index), space)
    if not len(low):
        name = constraints.name_of(index, "origin.exclude")
        raise InfeasibleError(f"{name} leaves sensor {index} no place", conflicts=[name])
    size = np.where(np.isfinite(low), np.abs(low), 0.0), np.where(np.isfinite(high), np.abs(high), 0.0)
    step = np.minimum(INWARD * np.maximum(*size), (high - low) / 4)
    return low + step, high - step


def _boresight_row(one: SensorConstraints, space: DesignSpace, axes: Axes) -> dict[str, object]:
    centre, half = 0.0, math.pi
    if axes.horizontal:
        centre, half = _arc(one, space)
    low, high = -math.pi / 2, math.pi / 2
    if axes.vertical:
        given = one.boresight.elevation_deg
        low = max(space.low[ELEVATION], -math.pi / 2 if given.min is None else math.radians(given.min))
        high = min(space.high[ELEVATION], math.pi / 2 if given.max is None else math.radians(given.max))
        low, high = inward(low, high) if (low, high) != (-math.pi / 2, math.pi / 2) else (low, high)
    return {"azimuth_centre": centre, "azimuth_half": half, "elevation_low": low, "elevation_high": high}


def _arc(one: SensorConstraints, space: DesignSpace) -> tuple[float, float]:
    """Centre and half width of the admitted azimuths inside the space's [rad]."""
    low, high = azimuth_interval(one, space)
    if not space.full_azimuth:
        low, high = _arc_intersection(low, high, space.low[AZIMUTH], space.high[AZIMUTH])
    if high - low >= 2 * math.pi:
        return 0.0, math.pi
    low, high = inward(low, high)
    return (low + high) / 2, (high - low) / 2


def _arc_intersection(low: float, high: float, other_low: float, other_high: float) -> tuple[float, float]:
    """The larger common piece of two arcs that meet, each [low, high] with high - low at most a turn."""
    pieces = []
    for turns in (-2, -1, 0, 1, 2):
        shift = 2 * math.pi * (turns - math.floor((low - other_low) / (2 * math.pi)))
        pieces.append((max(low + shift, other_low), min(high + shift, other_high)))
    low, high = max(pieces, key=lambda piece: piece[1] - piece[0])
    return (low, high) if low <= high else ((low + high) / 2, (low + high) / 2)


def _field_row(one: SensorConstraints, axes: Axes, interval: float) -> dict[str, object]:
    lows, highs = [], []
    for axis, scale in (("horizontal", axes.angle_scale), ("vertical", 1.0)):
        given = getattr(one.field_of_view, f"{axis}_deg")
        low, high = inward(given.min or 0.0, 360.0 if given.max is None else given.max)
        # the internal angle along a fixed elevation is the azimuth, which is wider than the true angle
        lows.append(math.radians(low) / (2 * interval * scale))
        highs.append(math.radians(high) / (2 * interval * scale))
    return {"spread_low": lows, "spread_high": highs}


def _gate_row(one: SensorConstraints, space: DesignSpace) -> dict[str, object]:
    gate = one.gate
    near, far = space.low[RANGE], space.high[RANGE]

    def ends(low: float | None, high: float | None) -> tuple[float, float]:
        return inward(near if low is None else max(low, near), far if high is None else min(high, far))

    start = ends(gate.start_m.min, gate.start_m.max)
    end = ends(gate.end_m.min, gate.end_m.max)
    width = inward(gate.width_m.min or 0.0, far - near if gate.width_m.max is None else gate.width_m.max)
    # inward steps must not close a gate that just fits
    width = min(width[0], end[1] - start[0]), max(width[1], end[0] - start[1])
    return {
        "start_low": start[0],
        "start_high": start[1],
        "end_low": end[0],
        "end_high": end[1],
        "width_low": width[0],
        "width_high": width[1],
    }


def mean_azimuth(internal_rad: np.ndarray) -> np.ndarray:
    """Azimuths in [0, 2 pi) as they are written [rad]."""
    return wrap_turn(wrap_angle(internal_rad))
