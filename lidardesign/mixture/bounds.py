"""Bounds on the parameters of components, from the rules of sensors, as arrays for the M-step.

Angles are internal ones (see `features`); gates and fields of view are bounds on reported intervals, which
the factor z = `interval_factor(level)` ties to means and spreads. Sensors whose origins are pinned to one place
form a `Group`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lidardesign.constraints.document import MOST_ROLL_DEG, Gate, SensorRules, rules_of
from lidardesign.constraints.feasibility import azimuth_interval
from lidardesign.constraints.origins import PINNED_BOX_M, free_boxes, origin_box
from lidardesign.errors import InfeasibleError
from lidardesign.mixture.components import Axes, Features
from lidardesign.numerics import SLACK, wrap_angle
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace

# Smallest standard deviations relative to the spread of all data: below it a component has collapsed on a
# duplicate. In angle and range separately, and per origin axis. Where the data themselves do not vary, their scale
# is a share of the space (see `features`), so that no length stands here that would be coarse in a small world.
RELATIVE_FLOOR = 1e-4
# Bounds move inward by this share, so that a value at its bound still keeps it after unit conversions, the
# interval's own arithmetic and writing; a micrometre per kilometre.
INWARD = SLACK
# Rolls beyond this would swap what is called horizontal and vertical.
LARGEST_ROLL_RAD = math.radians(MOST_ROLL_DEG)

Pins = tuple[float | None, ...]


@dataclass(frozen=True)
class Group:
    """Sensors that share pinned origin coordinates: they draw on one set of samples.

    Arguments:
        pins: The pinned coordinate of each origin axis [m], None where it is free or fixed by the space.
        sensors: Indices of the sensors.
    """

    pins: Pins
    sensors: tuple[int, ...]


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
        roll_low, roll_high: Of the boresight, within an eighth of a turn [rad].
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
    roll_low: np.ndarray
    roll_high: np.ndarray
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
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "interval"})

    def narrowed(self, width_m: float) -> Bounds:
        """The bounds with gates no wider than a common cap [m], but never below a component's least width.

        Bounds on start and end imply a least width, too.
        """
        least = np.maximum(self.width_low, self.end_low - self.start_high)
        return replace(self, width_high=np.maximum(np.minimum(self.width_high, width_m), least))

    @classmethod
    def unbounded(cls, count: int, interval: float) -> Bounds:
        """Bounds of infinite extent."""
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
            roll_low=np.full(count, -LARGEST_ROLL_RAD),
            roll_high=np.full(count, LARGEST_ROLL_RAD),
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
        axes = features.axes.origin
        origin = float(features.scale[: len(axes)].min()) if axes else 1.0
        reach = float(features.scale[-1]) if features.axes.range else 1.0
        return cls(RELATIVE_FLOOR * origin, RELATIVE_FLOOR * features.angular_scale, RELATIVE_FLOOR * reach)


def clip_azimuth(azimuth_rad: np.ndarray, bounds: Bounds) -> np.ndarray:
    """The nearest admissible azimuth on the circle, shape (K,) [rad]."""
    offset = wrap_angle(azimuth_rad - bounds.azimuth_centre)
    clipped = bounds.azimuth_centre + np.clip(offset, -bounds.azimuth_half, bounds.azimuth_half)
    return np.where(bounds.azimuth_half >= math.pi, azimuth_rad, clipped)


def inward(low: float, high: float) -> tuple[float, float]:
    """An interval shrunk by the share `INWARD` at both ends; its middle where nothing would be left."""
    size = max(abs(v) for v in (low, high, 0.0) if math.isfinite(v))
    smaller = low + INWARD * size, high - INWARD * size
    return smaller if smaller[0] <= smaller[1] else ((low + high) / 2, (low + high) / 2)


def pins_of(rules: SensorRules, space: DesignSpace) -> Pins:
    """The origin coordinates that a sensor's rules pin and the space does not."""
    low, high = origin_box(rules, space)
    pinned = [i in space.free and high[i] - low[i] <= PINNED_BOX_M for i in range(3)]
    return tuple(float(low[i]) if pinned[i] else None for i in range(3))


def sensor_groups(rules: Sequence[SensorRules], space: DesignSpace, count: int) -> list[Group]:
    """Groups of the first `count` sensors by their pinned origins, in order of first appearance."""
    members: dict[Pins, list[int]] = {}
    for sensor in range(count):
        members.setdefault(pins_of(rules_of(rules, sensor), space), []).append(sensor)
    return [Group(pins, tuple(sensors)) for pins, sensors in members.items()]


def bounds_of(rules: Sequence[SensorRules], space: DesignSpace, sensors: tuple[int, ...], interval: float) -> Bounds:
    """The bounds of some sensors' components, one row each.

    Arguments:
        rules: Feasible rules of all sensors.
        space: The design space.
        sensors: Indices of the sensors.
        interval: z, half an interval in standard deviations.
    """
    last = len(rules) - 1
    distinct = {index: _bounds_row(rules[index], space, interval) for index in {min(i, last) for i in sensors}}
    # all rows get as many free boxes as the longest has, by repeating their first
    most = max(len(row["free_low"]) for row in distinct.values())
    for row in distinct.values():
        for key in ("free_low", "free_high"):
            row[key] = np.concatenate([row[key], np.repeat(row[key][:1], most - len(row[key]), axis=0)])
    rows = [distinct[min(i, last)] for i in sensors]
    return Bounds(interval=interval, **{key: np.array([row[key] for row in rows]) for key in rows[0]})


def _bounds_row(rules: SensorRules, space: DesignSpace, interval: float) -> dict[str, Any]:
    """The fields of `Bounds` for one sensor."""
    axes, origin = Axes.of(space), rules.origin
    low, high = origin_box(rules, space)
    free_low, free_high = free_boxes(rules, space)
    if not len(free_low):
        name = rules.path("origin.exclude")
        raise InfeasibleError(f"{name} leaves no place for sensor {rules.index}", conflicts=[name])
    size = np.maximum(*(np.where(np.isfinite(side), np.abs(side), 0.0) for side in (free_low, free_high)))
    step = np.minimum(INWARD * size, (free_high - free_low) / 4)
    centre, half = _azimuth_arc(rules, space) if axes.horizontal else (0.0, math.pi)
    poles = lowest, highest = -math.pi / 2, math.pi / 2
    if axes.vertical:
        elevation = rules.boresight.elevation_deg
        lowest = max(space.low[ELEVATION], lowest if elevation.min is None else math.radians(elevation.min))
        highest = min(space.high[ELEVATION], highest if elevation.max is None else math.radians(elevation.max))
        lowest, highest = poles if (lowest, highest) == poles else inward(lowest, highest)
    roll = rules.boresight.roll_deg
    ends = (-MOST_ROLL_DEG if roll.min is None else roll.min, MOST_ROLL_DEG if roll.max is None else roll.max)
    limits = inward(*np.clip(ends, -MOST_ROLL_DEG, MOST_ROLL_DEG).tolist())
    is_open = roll.min is None and roll.max is None
    rolls = (-LARGEST_ROLL_RAD, LARGEST_ROLL_RAD) if is_open else tuple(map(math.radians, limits))
    fields_deg = [
        inward(field.min or 0.0, 360.0 if field.max is None else field.max)
        for field in (rules.field_of_view.horizontal_deg, rules.field_of_view.vertical_deg)
    ]
    # the internal angle along a fixed elevation is the azimuth, which is wider than the true angle
    units = (2 * interval * axes.angle_scale, 2 * interval * 1.0)
    return {
        "origin_low": low,
        "origin_high": high,
        "free_low": free_low + step,
        "free_high": free_high - step,
        "origin_spread": math.inf if origin.spread_m.max is None else (1 - INWARD) * origin.spread_m.max,
        "origin_thickness": math.inf if origin.thickness_m.max is None else (1 - INWARD) * origin.thickness_m.max,
        "azimuth_centre": centre,
        "azimuth_half": half,
        "elevation_low": lowest,
        "elevation_high": highest,
        "roll_low": rolls[0],
        "roll_high": rolls[1],
        "spread_low": [math.radians(field[0]) / unit for field, unit in zip(fields_deg, units, strict=True)],
        "spread_high": [math.radians(field[1]) / unit for field, unit in zip(fields_deg, units, strict=True)],
        **_gate_bounds(rules.gate, space),
    }


def _azimuth_arc(rules: SensorRules, space: DesignSpace) -> tuple[float, float]:
    """Centre and half width of the admitted azimuths inside the space's [rad]."""
    low, high = azimuth_interval(rules, space)
    if not space.full_azimuth:
        # the larger common piece of two arcs that meet
        behind = math.floor((low - space.low[AZIMUTH]) / (2 * math.pi))
        shifts = [2 * math.pi * (turns - behind) for turns in (-2, -1, 0, 1, 2)]
        pieces = [(max(low + shift, space.low[AZIMUTH]), min(high + shift, space.high[AZIMUTH])) for shift in shifts]
        low, high = max(pieces, key=lambda piece: piece[1] - piece[0])
        low, high = (low, high) if low <= high else ((low + high) / 2, (low + high) / 2)
    if high - low >= 2 * math.pi:
        return 0.0, math.pi
    low, high = inward(low, high)
    return (low + high) / 2, (high - low) / 2


def _gate_bounds(gate: Gate, space: DesignSpace) -> dict[str, float]:
    """Bounds on a gate's start, end and width inside the space [m]; `m_step.fit_gate` keeps them."""
    near, far = space.low[RANGE], space.high[RANGE]
    start, end = (
        inward(near if ends.min is None else max(ends.min, near), far if ends.max is None else min(ends.max, far))
        for ends in (gate.start_m, gate.end_m)
    )
    width = inward(gate.width_m.min or 0.0, far - near if gate.width_m.max is None else gate.width_m.max)
    return {
        "start_low": start[0],
        "start_high": start[1],
        "end_low": end[0],
        "end_high": end[1],
        # inward steps must not close a gate that just fits
        "width_low": min(width[0], end[1] - start[0]),
        "width_high": max(width[1], end[0] - start[1]),
    }
