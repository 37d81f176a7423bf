"""Sensors as arrays of numbers in their own units, and their projection onto the constraints.

Every constraint that binds `fit` binds here: the same bounds, each kept by moving to the nearest number that keeps it,
one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.constraints.origins import mounts_of, nearest_in_boxes
from lidardesign.design.layouts.gates import admissible_gates
from lidardesign.design.mixture.bounds import Bounds, bounds_of, clip_azimuth
from lidardesign.design.mixture.features import Axes
from lidardesign.design.sensor import Sensor, boresight_frame, interval_factor
from lidardesign.numerics import SLACK, TINY
from lidardesign.space import DesignSpace, angles, direction

# Weights that differ by more nats leave sensors without a ray.
MOST_LOG_WEIGHT = 5.0
NARROWEST_RAD = 1e-3


@dataclass(frozen=True, eq=False)
class SearchRules:
    """What all candidates of a search share.

    Arguments:
        space: The design space, at the condition values of the design that is followed.
        constraints: Its constraints.
        level: The share of each marginal that fields of view and gates hold.
        one_sensor_per_ray: Whether every ray is a sensor of its own, without spreads and weights to vary, as in a scan.
        at: The condition values that it is for.
        gates: Whether gates are varied; otherwise they are as wide as is admitted, and cropped in the end.
    """

    space: DesignSpace
    constraints: Constraints
    level: float
    one_sensor_per_ray: bool
    at: Mapping[str, float]
    gates: bool = True

    @property
    def interval(self) -> float:
        """z, half an interval in standard deviations."""
        return interval_factor(self.level)

    @property
    def axes(self) -> Axes:
        """Which dimensions are free."""
        return Axes.of(self.space)

    def bounds(self, count: int) -> Bounds:
        """The bounds of the first sensors."""
        return bounds_of(self.constraints.rules, self.space, tuple(range(count)), self.interval)


@dataclass(frozen=True, eq=False)
class SensorParameters:
    """The numbers of G sensors in their own units.

    Arguments:
        origin: Origins [m], shape (G, 3).
        carried: The start's frames, rows forward, horizontal, vertical, shape (G, 3, 3).
        looking: Boresights, unit vectors, shape (G, 3).
        roll: About the boresight, from the start's frame carried along [rad], shape (G,).
        spread: Angular standard deviations [rad], shape (G, 2).
        gate: Start and end [m], shape (G, 2).
        log_weight: Shape (G,).
    """

    origin: np.ndarray
    carried: np.ndarray
    looking: np.ndarray
    roll: np.ndarray
    spread: np.ndarray
    gate: np.ndarray
    log_weight: np.ndarray

    def __len__(self) -> int:
        return len(self.origin)

    @classmethod
    def of(cls, sensors: Sequence[Sensor]) -> SensorParameters:
        """The numbers of sensors."""
        frames = np.array([sensor.frame for sensor in sensors])
        weights = np.array([sensor.weight for sensor in sensors])
        return cls(
            origin=np.array([sensor.origin_m for sensor in sensors], dtype=np.float64),
            carried=frames,
            looking=frames[:, 0],
            roll=np.zeros(len(sensors)),
            spread=np.array([(one.spread_horizontal_rad, one.spread_vertical_rad) for one in sensors]),
            gate=np.array([sensor.gate_m for sensor in sensors]),
            log_weight=np.log(np.maximum(weights / weights.sum(), TINY)),
        )

    def frames(self, rules: SearchRules) -> np.ndarray:
        """Rows forward, horizontal, vertical of each sensor, shape (G, 3, 3).

        The start's frame is carried along by the smallest turn, then rolled: near the poles azimuths jump, this does
        not.
        """
        if rules.axes.angular < 2:
            return _level_frames(self.looking)
        forward, level = self.carried[:, 0], self.carried[:, 1]
        ahead = 1.0 + np.einsum("gi,gi->g", forward, self.looking)
        along = np.einsum("gi,gi->g", level, self.looking)
        carried = level - (along / np.maximum(ahead, SLACK))[:, None] * (forward + self.looking)
        carried /= np.linalg.norm(carried, axis=1, keepdims=True)
        upright = np.cross(self.looking, carried)
        cosine, sine = np.cos(self.roll)[:, None], np.sin(self.roll)[:, None]
        rolled = cosine * carried + sine * upright, cosine * upright - sine * carried
        return np.stack([self.looking, *rolled], axis=1)

    def projected(self, rules: SearchRules, bounds: Bounds) -> SensorParameters:
        """Numbers moved to where the constraints admit them, one after the other."""
        axes, space = rules.axes, rules.space
        origin = admitted_origins(self.origin, bounds, rules.constraints)
        azimuth, elevation = angles(self.looking)
        azimuth = clip_azimuth(azimuth, bounds) if axes.horizontal else np.full(len(self), space.low[3])
        elevation = (
            np.clip(elevation, bounds.elevation_low, bounds.elevation_high)
            if axes.vertical
            else np.full(len(self), space.low[4])
        )
        gate = self.gate
        if axes.range:
            centre, spread_m = admissible_gates(gate, bounds)
            half = bounds.interval * spread_m
            gate = np.stack([centre - half, centre + half], axis=1)
        weight = self.log_weight - np.logaddexp.reduce(self.log_weight)
        weight = np.maximum(weight, weight.max() - MOST_LOG_WEIGHT)
        scale = np.array([axes.angle_scale, 1.0])
        low, high = bounds.spread_low * scale, np.minimum(bounds.spread_high * scale, math.pi / 2 / bounds.interval)
        high = np.maximum(high, low)
        least = np.maximum(np.minimum(NARROWEST_RAD * scale / bounds.interval, high / 2), low)
        return replace(
            self,
            origin=origin,
            looking=direction(azimuth, elevation),
            spread=np.array([axes.horizontal, axes.vertical]) * np.clip(self.spread, least, high),
            gate=gate,
            log_weight=weight - np.logaddexp.reduce(weight),
        )

    def sensors(self, rules: SearchRules, rays: Sequence[int] | None = None) -> tuple[Sensor, ...]:
        """The sensors of projected numbers, each with its rays where they are known."""
        azimuth, elevation = angles(self.looking)
        frames, level = self.frames(rules), _level_frames(self.looking)
        roll = np.arctan2(*(np.einsum("gi,gi->g", frames[:, 1], level[:, axis]) for axis in (2, 1)))
        weight = np.exp(self.log_weight)
        spread_m = np.diff(self.gate, axis=1)[:, 0] / (2 * rules.interval)
        return tuple(
            Sensor(
                name=f"s{index}",
                weight=float(weight[index] / weight.sum()),
                origin_m=self.origin[index],
                origin_covariance_m2=np.zeros((3, 3)),
                azimuth_rad=float(azimuth[index]),
                elevation_rad=float(elevation[index]),
                roll_rad=float(roll[index]),
                spread_horizontal_rad=float(self.spread[index, 0]),
                spread_vertical_rad=float(self.spread[index, 1]),
                range_m=float(self.gate[index].mean()),
                spread_range_m=float(spread_m[index]),
                level=rules.level,
                rays=None if rays is None else int(rays[index]),
            )
            for index in range(len(self))
        )


def _level_frames(looking: np.ndarray) -> np.ndarray:
    """The frames without roll, shape (G, 3, 3)."""
    return np.array([boresight_frame(a, e) for a, e in zip(*angles(looking), strict=True)])


def admitted_origins(origins: np.ndarray, bounds: Bounds, constraints: Constraints) -> np.ndarray:
    """The nearest admissible origins, (G, 3) to (G, 3) [m]; mounted sensors at distinct mounts."""
    moved = np.clip(origins, bounds.origin_low, bounds.origin_high)
    for row in range(len(moved)):
        free = bounds.free_low[row], bounds.free_high[row]
        if np.isfinite(free[0]).any() or np.isfinite(free[1]).any():
            boxed = nearest_in_boxes(moved[row : row + 1], *free)
            moved[row] = np.clip(boxed[0], bounds.origin_low[row], bounds.origin_high[row])
    options = [mounts_of(rules) for rules in _rules_of_each(constraints, len(moved))]
    mounted = [sensor for sensor, mounts in enumerate(options) if mounts]
    if not mounted:
        return moved
    # loaded here because few constraint files have mounts
    from scipy.optimize import linear_sum_assignment

    places = sorted({mount for mounts in options for mount in mounts})
    away = np.square(np.array(places)[None] - moved[mounted][:, None]).sum(axis=2)
    # far beyond any distance that is admitted, so that no sensor takes a mount that is none of its own
    barred = 1.0 + len(mounted) * (1.0 + away.max())
    for row, sensor in enumerate(mounted):
        away[row, [place not in options[sensor] for place in places]] += barred
    # all of them together as near as can be
    rows, columns = linear_sum_assignment(away)
    moved[np.array(mounted)[rows]] = np.array(places)[columns]
    return moved


def _rules_of_each(constraints: Constraints, count: int) -> list:
    """The rules of each of the first sensors; those beyond `each` share the common ones."""
    return [constraints.rules[min(sensor, len(constraints.rules) - 1)] for sensor in range(count)]
