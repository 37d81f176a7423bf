"""Sensors as arrays of numbers in their own units, and their projection onto the constraints.

Every constraint that binds `fit` binds here: the same bounds, each kept by moving to the nearest number that keeps it,
one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.constraints.origins import Boxes, box_around, mounts_of, nearest_in_boxes
from lidardesign.design.layouts.gates import admissible_gates
from lidardesign.design.layouts.rays import LAYOUTS
from lidardesign.design.mixture.bounds import Bounds, bounds_of, clip_azimuth
from lidardesign.design.mixture.features import Axes
from lidardesign.design.sensor import Coupling, LayoutName, Sensor, boresight_frame, interval_factor
from lidardesign.numerics import ROUNDING, SLACK, TINY, clipped_eigenvalues, safe_divide
from lidardesign.space import DesignSpace, angles, direction

# A micrometre: less is a point.
LEAST_M2 = ROUNDING
# Origins that are spread out at all are so by this share of the largest box that they may lie in.
LEAST_SHARE = 1e-3
# Weights that differ by more nats leave sensors without a ray.
MOST_LOG_WEIGHT = 5.0
NARROWEST_RAD = 1e-3
# Rays that meet nearer than a quarter of their range, or behind the sensor as near, are no design that anybody wants.
MOST_FOCUS = 4.0


@dataclass(frozen=True, eq=False)
class SearchRules:
    """What all candidates of a search share.

    Arguments:
        space: The design space, at the condition values of the design that is followed.
        constraints: Its constraints.
        level: The share of each marginal that fields of view and gates hold.
        layout: `grid`, `scan` or `distributed`.
        at: The condition values that it is for.
        gates: Whether gates are varied; otherwise they are as wide as is admitted, and cropped in the end.
    """

    space: DesignSpace
    constraints: Constraints
    level: float
    layout: LayoutName
    at: Mapping[str, float]
    gates: bool = True

    @property
    def one_sensor_per_ray(self) -> bool:
        """Whether every ray is a sensor of its own, without spreads and weights to vary."""
        return LAYOUTS[self.layout].one_sensor_per_ray

    @property
    def extends_origins(self) -> bool:
        """Whether rays start across the origins of their sensor."""
        return LAYOUTS[self.layout].extends_origins

    @property
    def interval(self) -> float:
        """z, half an interval in standard deviations."""
        return interval_factor(self.level)

    @property
    def axes(self) -> Axes:
        """Which dimensions are free."""
        return Axes.of(self.space)

    @cached_property
    def spread_axes(self) -> tuple[int, ...]:
        """The axes along which sensors' rays start at different places; none where all sensors are held still."""
        still = all(rules.origin.fixed_m is not None or rules.origin.mounts_m for rules in self.constraints.rules)
        return () if still or not self.extends_origins else self.axes.origin

    def bounds(self, count: int) -> Bounds:
        """The bounds of the first sensors."""
        return bounds_of(self.constraints.rules, self.space, tuple(range(count)), self.interval)


def log_matrix(matrices: np.ndarray) -> np.ndarray:
    """Logarithms of symmetric matrices (..., k, k) whose eigenvalues are variances [m^2], at least `LEAST_M2`."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuild(vectors, np.log(np.maximum(values, LEAST_M2)))


def exp_matrix(matrices: np.ndarray) -> np.ndarray:
    """Exponentials of symmetric matrices, (..., k, k)."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuild(vectors, np.exp(values))


def _rebuild(vectors: np.ndarray, values: np.ndarray) -> np.ndarray:
    rebuilt = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return (rebuilt + np.swapaxes(rebuilt, -1, -2)) / 2


@dataclass(frozen=True, eq=False)
class SensorParameters:
    """The numbers of G sensors in their own units.

    Arguments:
        origin: Mean origins [m], shape (G, 3).
        carried: The start's frames, rows forward, horizontal, vertical, shape (G, 3, 3).
        looking: Boresights, unit vectors, shape (G, 3).
        roll: About the boresight, from the start's frame carried along [rad], shape (G,).
        spread: Angular standard deviations given the origin [rad], shape (G, 2).
        gate: Start and end [m], shape (G, 2).
        log_weight: Shape (G,).
        covariance: Of the origin along the spread axes [m^2], shape (G, k, k).
        focus: Mean range over the distance at which rays meet, shape (G, 2).
        log_share: Logarithm of the part of the gate's spread that the origin leaves, at most 0, shape (G,).
    """

    origin: np.ndarray
    carried: np.ndarray
    looking: np.ndarray
    roll: np.ndarray
    spread: np.ndarray
    gate: np.ndarray
    log_weight: np.ndarray
    covariance: np.ndarray
    focus: np.ndarray
    log_share: np.ndarray

    def __len__(self) -> int:
        return len(self.origin)

    @classmethod
    def of(cls, sensors: Sequence[Sensor], rules: SearchRules) -> SensorParameters:
        """The numbers of sensors; those with spread origins have rays that meet where their coupling says."""
        along = list(rules.spread_axes)
        frames = np.array([sensor.frame for sensor in sensors])
        weights = np.array([sensor.weight for sensor in sensors])
        spreads, focus = [], np.zeros((len(sensors), 2))
        for row, sensor in enumerate(sensors):
            spread = sensor.spread_horizontal_rad, sensor.spread_vertical_rad
            spreads.append(sensor.coupling.spread_rad if along and sensor.coupling is not None else spread)
            if sensor.coupling is not None:
                slopes = np.asarray(sensor.coupling.direction_per_m)
                focus[row] = -sensor.range_m * np.einsum("ai,ai->a", slopes, sensor.frame[1:])
        return cls(
            origin=np.array([sensor.origin_m for sensor in sensors], dtype=np.float64),
            carried=frames,
            looking=frames[:, 0],
            roll=np.zeros(len(sensors)),
            spread=np.array(spreads, dtype=np.float64),
            gate=np.array([sensor.gate_m for sensor in sensors]),
            log_weight=np.log(np.maximum(weights / weights.sum(), TINY)),
            covariance=np.array([np.asarray(sensor.origin_covariance_m2)[np.ix_(along, along)] for sensor in sensors]),
            focus=focus,
            log_share=np.zeros(len(sensors)),
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

    def slopes(self, rules: SearchRules) -> np.ndarray:
        """How tangent angles follow from the origin at focus 1 [rad / m], shape (G, 2, 3)."""
        reach = np.maximum(self.gate.mean(axis=1), NARROWEST_RAD)
        return -self.frames(rules)[:, 1:] / reach[:, None, None]

    def moving(self, rules: SearchRules) -> np.ndarray:
        """Standard deviation of the tangent angles that follow from the origin, shape (G, 2) [rad]."""
        if not rules.spread_axes:
            return np.abs(self.focus) * np.zeros((len(self), 2))
        slopes = self.slopes(rules)[:, :, list(rules.spread_axes)]
        variance = np.einsum("gai,gij,gaj->ga", slopes, self.covariance, slopes)
        return np.abs(self.focus) * np.sqrt(np.maximum(variance, 0.0))

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
        covariance, gate = self.covariance, self.gate
        if rules.spread_axes:
            covariance = _admitted_covariances(origin, covariance, rules, bounds)
        if axes.range:
            centre, spread_m = admissible_gates(gate, bounds)
            half = bounds.interval * spread_m
            gate = np.stack([centre - half, centre + half], axis=1)
        weight = self.log_weight - np.logaddexp.reduce(self.log_weight)
        weight = np.maximum(weight, weight.max() - MOST_LOG_WEIGHT)
        moved = replace(
            self,
            origin=origin,
            looking=direction(azimuth, elevation),
            gate=gate,
            covariance=covariance,
            log_weight=weight - np.logaddexp.reduce(weight),
            focus=np.clip(self.focus, -MOST_FOCUS, MOST_FOCUS),
            log_share=np.minimum(self.log_share, 0.0),
        )
        # what moves with the origin counts in the fields of view
        scale = np.array([axes.angle_scale, 1.0])
        low, high = bounds.spread_low * scale, np.minimum(bounds.spread_high * scale, math.pi / 2 / bounds.interval)
        high = np.maximum(high, low)
        moving = moved.moving(rules)
        shrink = np.minimum(1.0, high / np.maximum(np.hypot(moved.spread, moving), TINY))
        free = np.array([axes.horizontal, axes.vertical], dtype=np.float64)
        least = np.minimum(NARROWEST_RAD * scale / bounds.interval, high / 2)
        spread = free * np.clip(shrink * moved.spread, least, high)
        slower = np.minimum(shrink * moving, np.sqrt(np.square(high) - np.square(spread)))
        needed = np.sqrt(np.maximum(np.square(low) - np.square(slower), 0.0))
        focus = moved.focus * free * safe_divide(slower, moving, 1.0)
        return replace(moved, spread=free * np.maximum(spread, needed), focus=focus)

    def sensors(self, rules: SearchRules, rays: Sequence[int] | None = None) -> tuple[Sensor, ...]:
        """The sensors of projected numbers, each with its rays where they are known."""
        azimuth, elevation = angles(self.looking)
        frames, level = self.frames(rules), _level_frames(self.looking)
        roll = np.arctan2(*(np.einsum("gi,gi->g", frames[:, 1], level[:, axis]) for axis in (2, 1)))
        spread = np.hypot(self.spread, self.moving(rules))
        slopes = self.focus[:, :, None] * self.slopes(rules)
        weight = np.exp(self.log_weight)
        spread_m = np.diff(self.gate, axis=1)[:, 0] / (2 * rules.interval)
        along = list(rules.spread_axes)
        free = np.isin(np.arange(3), along)
        found = []
        for index in range(len(self)):
            covariance = np.zeros((3, 3))
            covariance[np.ix_(along, along)] = self.covariance[index]
            # rays that start off the mean origin look where they meet the others, and listen at the same plane
            coupling = Coupling(
                direction_per_m=np.where(free, slopes[index], 0.0),
                range_per_m=np.where(free, -self.looking[index], 0.0),
                range_per_rad=np.zeros(2),
                spread_rad=self.spread[index],
                spread_m=math.exp(self.log_share[index]) * float(spread_m[index]),
            )
            sensor = Sensor(
                name=f"s{index}",
                weight=float(weight[index] / weight.sum()),
                origin_m=self.origin[index],
                origin_covariance_m2=covariance,
                azimuth_rad=float(azimuth[index]),
                elevation_rad=float(elevation[index]),
                roll_rad=float(roll[index]),
                spread_horizontal_rad=float(spread[index, 0]),
                spread_vertical_rad=float(spread[index, 1]),
                range_m=float(self.gate[index].mean()),
                spread_range_m=float(spread_m[index]),
                level=rules.level,
                rays=None if rays is None else int(rays[index]),
                coupling=coupling if along else None,
            )
            found.append(sensor)
        return tuple(found)


def _level_frames(looking: np.ndarray) -> np.ndarray:
    """The frames without roll, shape (G, 3, 3)."""
    return np.array([boresight_frame(a, e) for a, e in zip(*angles(looking), strict=True)])


def admitted_origins(origins: np.ndarray, bounds: Bounds, constraints: Constraints) -> np.ndarray:
    """The nearest admissible mean origins, (G, 3) to (G, 3) [m]; mounted sensors at distinct mounts."""
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


def _admitted_covariances(
    origins: np.ndarray, covariances: np.ndarray, rules: SearchRules, bounds: Bounds
) -> np.ndarray:
    """Covariances (G, k, k) along the spread axes within their bounds [m^2]; 0 of sensors that are held still.

    Their intervals keep out of excluded boxes.
    """
    axes = list(rules.spread_axes)
    most = np.square(bounds.origin_spread), np.square(bounds.origin_thickness)
    # the thinnest direction of the whole space has no spread where an axis is fixed
    thinnest = most[1] if len(axes) == origins.shape[1] else np.full(len(origins), np.inf)
    least = np.square(LEAST_SHARE * np.ptp([bounds.origin_low, bounds.origin_high], axis=0).max(axis=1))
    admitted = clipped_eigenvalues(covariances, np.minimum(least, most[0]), most[0], thinnest)
    for row, own in enumerate(_rules_of_each(rules.constraints, len(origins))):
        low, high = bounds.free_low[row], bounds.free_high[row]
        if np.isfinite(low).any() or np.isfinite(high).any():
            reach = np.zeros(origins.shape[1])
            reach[axes] = bounds.interval * np.sqrt(np.diag(admitted[row]))
            slack = SLACK * np.maximum(np.abs(origins[row]), 1.0)
            around = ((low <= origins[row] + slack) & (origins[row] - slack <= high)).all(axis=1)
            box = box_around(origins[row], reach, Boxes(low[around], high[around]))
            room = np.maximum(np.minimum(origins[row] - box[0], box[1] - origins[row]), 0.0)
            shrink = np.minimum(1.0, (1 - SLACK) * room / np.maximum(reach, TINY))[axes]
            admitted[row] *= shrink[:, None] * shrink
        if own.origin.fixed_m is not None or mounts_of(own):
            admitted[row] = 0.0
    return admitted
