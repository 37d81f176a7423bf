"""Fields of view: the smallest that hold a sensor's rays, and the widest of sensors that replace each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.constraints.document import SensorRules, rules_of
from lidardesign.errors import ConfigError
from lidardesign.mixture.bounds import INWARD, bounds_of
from lidardesign.numerics import COARSE_SLACK
from lidardesign.samples import Samples
from lidardesign.sensors.sensor import Sensor, interval_factor, tangent_directions
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, angles, direction, observed_point

# Rounds in which a boresight moves to the middle of its rays: away from the poles it rests after two or three.
CENTRING_ROUNDS = 8
# Fields hold their outermost rays, whatever digits of angles a file rounds.
FIELD_SLACK = COARSE_SLACK / 10


def smallest_field(sensor: Sensor, looking: np.ndarray, rules: SensorRules, space: DesignSpace) -> Sensor:
    """The sensor, turned where it may turn, with the smallest field inside its own that holds directions (N, 3).

    It is unchanged where no field inside its own holds them.
    """
    widest, fields, bounds = np.array(sensor.field_of_view_rad), rules.field_of_view, rules.boresight
    least = np.radians([fields.horizontal_deg.min or 0.0, fields.vertical_deg.min or 0.0])
    ends = (bounds.azimuth_deg.min, bounds.azimuth_deg.max, bounds.elevation_deg.min, bounds.elevation_deg.max)
    may_turn = all(end is None for end in ends) and {AZIMUTH, ELEVATION} <= set(space.free)
    tried, best, smallest = sensor, sensor, math.inf
    for _ in range(CENTRING_ROUNDS if may_turn else 1):
        tangent = tried.tangent_of(looking)
        view = np.maximum(2 * np.abs(tangent).max(axis=0) * (1 + FIELD_SLACK) + FIELD_SLACK, least)
        view = np.minimum(np.where(widest > 0, view, 0.0), widest + FIELD_SLACK)
        area = float(view[view > 0].prod())
        if (2 * np.abs(tangent).max(axis=0) <= np.minimum(view, widest) + FIELD_SLACK).all() and area < smallest:
            best, smallest = replace(tried, field_of_view_rad=tuple(np.minimum(view, widest).tolist())), area
        middle = (tangent.min(axis=0) + tangent.max(axis=0)) / 2
        azimuth, elevation = (float(angle) for angle in angles(tangent_directions(tried.frame, middle[None])[0]))
        tried = replace(tried, azimuth_rad=azimuth, elevation_rad=elevation)
    return best


def check_several(sensors: float) -> None:
    """Refuse a single sensor that may fail.

    Raises:
        ConfigError: Fewer than two sensors.
    """
    if sensors < 2:
        raise ConfigError(
            "a single sensor that may fail", where="survive", allowed="2 sensors or more", hint="--sensors 2"
        )


def widened(
    sensors: Sequence[Sensor], rules: Sequence[SensorRules], level: float, samples: Samples
) -> tuple[Sensor, ...]:
    """Sensors of equal shares that see as much of the density as constraints allow, so that each can replace others.

    Raises:
        ConfigError: There is only one.
    """
    check_several(len(sensors))
    wide = [_widened(sensor, index, rules, level, samples) for index, sensor in enumerate(sensors)]
    return tuple(replace(sensor, weight=1 / len(wide)) for sensor in wide)


def _widened(sensor: Sensor, index: int, rules: Sequence[SensorRules], level: float, samples: Samples) -> Sensor:
    space, own = samples.space, rules_of(rules, index)
    origins = samples.points[:, :3].copy()
    if sensor.origin_covariance_m2 is None:
        placed = [axis for axis in range(3) if axis not in space.conditioned]
        origins[:, placed] = np.asarray(sensor.origin_m)[placed]
    points = space.wrap(aim(origins, observed_point(samples.points)))
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    values = np.column_stack([sensor.tangent_of(looking), points[:, RANGE]])
    low, high = np.transpose([central_share(column, samples.weights, level) for column in values.T])
    inside = ((low <= values) & (values <= high)).all(axis=1)
    bounds = bounds_of(rules, space, (index,), interval_factor(level))
    start = max(min(float(low[-1]), sensor.gate_m[0]), float(bounds.start_low[0]))
    end = min(max(float(high[-1]), sensor.gate_m[1]), float(bounds.end_high[0]))
    limits = (own.field_of_view.horizontal_deg.max, own.field_of_view.vertical_deg.max)
    view = tuple(
        (2 * math.pi if limit is None else (1 - INWARD) * math.radians(limit)) if field > 0 else 0.0
        for field, limit in zip(sensor.field_of_view_rad, limits, strict=True)
    )
    gate_m = (start, end) if end - start <= bounds.width_high[0] else sensor.gate_m
    return smallest_field(replace(sensor, field_of_view_rad=view, gate_m=gate_m), looking[inside], own, space)


def central_share(values: np.ndarray, weights: np.ndarray, level: float) -> tuple[float, float]:
    """The ends of the central share of weighted values, (N,) each."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order]) / weights.sum()
    first, last = np.searchsorted(below, [(1 - level) / 2, (1 + level) / 2])
    return float(values[order[first]]), float(values[order[min(last, len(order) - 1)]])
