"""Sensors as arrays of numbers in their own units, and their projection onto the constraints.

Every constraint that binds `fit` binds here: the same bounds, each kept by moving to the nearest number that keeps it,
one after the other.

Origins and their covariances moved to where the constraints admit them: the nearest place, the largest spread.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.constraints.origins import Boxes, Mount, box_around, mounts_of, nearest_in_boxes
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


def log_matrix(matrices: np.ndarray) -> np.ndarray:
    """Logarithms of symmetric matrices (..., k, k) whose eigenvalues are variances [m^2], at least `LEAST_M2`."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuilt(vectors, np.log(np.maximum(values, LEAST_M2)))


def exp_matrix(matrices: np.ndarray) -> np.ndarray:
    """Exponentials of symmetric matrices, (..., k, k)."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuilt(vectors, np.exp(values))


def _rebuilt(vectors: np.ndarray, values: np.ndarray) -> np.ndarray:
    rebuilt = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return (rebuilt + np.swapaxes(rebuilt, -1, -2)) / 2


def admitted_origins(origins: np.ndarray, bounds: Bounds, constraints: Constraints) -> np.ndarray:
    """The nearest admissible mean origins, (G, 3) to (G, 3) [m]; mounted sensors at distinct mounts."""
    moved = np.clip(origins, bounds.origin_low, bounds.origin_high)
    for row in range(len(moved)):
        free = bounds.free_low[row], bounds.free_high[row]
        if np.isfinite(free[0]).any() or np.isfinite(free[1]).any():
            boxed = nearest_in_boxes(moved[row : row + 1], *free)
            moved[row] = np.clip(boxed[0], bounds.origin_low[row], bounds.origin_high[row])
    return _mounted(moved, constraints)


def _mounted(origins: np.ndarray, constraints: Constraints) -> np.ndarray:
    """Origins with mounted sensors at mounts of their own, as near as all of them together can be."""
    options = _mounts(constraints, len(origins))
    mounted = [sensor for sensor, mounts in enumerate(options) if mounts]
    if not mounted:
        return origins
    # loaded here because few constraint files have mounts
    from scipy.optimize import linear_sum_assignment

    places = sorted({mount for mounts in options for mount in mounts})
    away = np.square(np.array(places)[None] - origins[mounted][:, None]).sum(axis=2)
    # far beyond any distance that is admitted, so that no sensor takes a mount that is none of its own
    barred = 1.0 + len(mounted) * (1.0 + away.max())
    for row, sensor in enumerate(mounted):
        away[row, [place not in options[sensor] for place in places]] += barred
    rows, columns = linear_sum_assignment(away)
    moved = origins.copy()
    moved[np.array(mounted)[rows]] = np.array(places)[columns]
    return moved


def held_still(constraints: Constraints, bounds: Bounds) -> np.ndarray:
    """Which sensors are at a point: mounted, or fixed by their constraints, shape (G,) bool."""
    fixed = [rules.origin.fixed_m is not None for rules in constraints.rules]
    mounted = _mounts(constraints, len(bounds))
    return np.array([bool(mounts) or fixed[min(i, len(constraints.each))] for i, mounts in enumerate(mounted)])


def _mounts(constraints: Constraints, count: int) -> list[list[Mount]]:
    """The mounts that each of the first sensors may take; those beyond `each` share the common ones."""
    distinct = [mounts_of(rules) for rules in constraints.rules]
    return [distinct[min(sensor, len(distinct) - 1)] for sensor in range(count)]


def admitted_covariances(
    origins: np.ndarray, covariances: np.ndarray, axes: tuple[int, ...], bounds: Bounds
) -> np.ndarray:
    """Covariances (G, k, k) along some axes within their bounds [m^2]; their intervals keep out of excluded boxes."""
    most = np.square(bounds.origin_spread), np.square(bounds.origin_thickness)
    # the thinnest direction of the whole space has no spread where an axis is fixed
    thinnest = most[1] if len(axes) == origins.shape[1] else np.full(len(origins), np.inf)
    least = np.square(LEAST_SHARE * np.ptp([bounds.origin_low, bounds.origin_high], axis=0).max(axis=1))
    admitted = clipped_eigenvalues(covariances, np.minimum(least, most[0]), most[0], thinnest)
    for row in range(len(origins)):
        low, high = bounds.free_low[row], bounds.free_high[row]
        if not (np.isfinite(low).any() or np.isfinite(high).any()):
            continue
        reach = np.zeros(origins.shape[1])
        reach[list(axes)] = bounds.interval * np.sqrt(np.diag(admitted[row]))
        slack = SLACK * np.maximum(np.abs(origins[row]), 1.0)
        around = ((low <= origins[row] + slack) & (origins[row] - slack <= high)).all(axis=1)
        box = box_around(origins[row], reach, Boxes(low[around], high[around]))
        room = np.maximum(np.minimum(origins[row] - box[0], box[1] - origins[row]), 0.0)
        shrink = np.minimum(1.0, (1 - SLACK) * room / np.maximum(reach, TINY))[list(axes)]
        admitted[row] *= shrink[:, None] * shrink
    return admitted


# Weights that differ by more nats leave sensors without a ray.
MOST_LOG_WEIGHT = 5.0
NARROWEST_RAD = 1e-3
WIDEST_RAD = math.pi / 2
# Rays that meet nearer than a quarter of their range, or behind the sensor as near, are no design that anybody wants.
MOST_FOCUS = 4.0


@dataclass(frozen=True, eq=False)
class Setting:
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


@dataclass(frozen=True, eq=False)
class Figures:
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


def projected(figures: Figures, setting: Setting, bounds: Bounds) -> Figures:
    """Numbers moved to where the constraints admit them, one after the other."""
    axes, space = setting.axes, setting.space
    origin = admitted_origins(figures.origin, bounds, setting.constraints)
    azimuth, elevation = angles(figures.looking)
    azimuth = clip_azimuth(azimuth, bounds) if axes.horizontal else np.full(len(figures), space.low[3])
    low, high = bounds.elevation_low, bounds.elevation_high
    elevation = np.clip(elevation, low, high) if axes.vertical else np.full(len(figures), space.low[4])
    covariance = figures.covariance
    if setting.spread_axes:
        still = held_still(setting.constraints, bounds)
        covariance = admitted_covariances(origin, covariance, setting.spread_axes, bounds) * ~still[:, None, None]
    gate = figures.gate
    if axes.range:
        centre, spread_m = admissible_gates(gate, bounds)
        half = bounds.interval * spread_m
        gate = np.stack([centre - half, centre + half], axis=1)
    looking = direction(azimuth, elevation)
    weight = figures.log_weight - np.logaddexp.reduce(figures.log_weight)
    weight = np.maximum(weight, weight.max() - MOST_LOG_WEIGHT)
    moved = replace(
        figures,
        origin=origin,
        looking=looking,
        gate=gate,
        covariance=covariance,
        log_weight=weight - np.logaddexp.reduce(weight),
        focus=np.clip(figures.focus, -MOST_FOCUS, MOST_FOCUS),
        log_share=np.minimum(figures.log_share, 0.0),
    )
    return _within_fields(moved, setting, bounds)


def _within_fields(figures: Figures, setting: Setting, bounds: Bounds) -> Figures:
    """Spreads and focus such that the fields of view keep their bounds: what moves with the origin counts in them."""
    axes = setting.axes
    scale = np.array([axes.angle_scale, 1.0])
    low, high = bounds.spread_low * scale, np.minimum(bounds.spread_high * scale, WIDEST_RAD / bounds.interval)
    high = np.maximum(high, low)
    moving = np.abs(figures.focus) * _spread_with_origin(figures, setting)
    shrink = np.minimum(1.0, high / np.maximum(np.hypot(figures.spread, moving), TINY))
    free = np.array([axes.horizontal, axes.vertical], dtype=np.float64)
    least = np.minimum(NARROWEST_RAD * scale / bounds.interval, high / 2)
    spread = free * np.clip(shrink * figures.spread, least, high)
    kept = np.minimum(shrink * moving, np.sqrt(np.square(high) - np.square(spread)))
    needed = np.sqrt(np.maximum(np.square(low) - np.square(kept), 0.0))
    focus = figures.focus * free * safe_divide(kept, moving, 1.0)
    return replace(figures, spread=free * np.maximum(spread, needed), focus=focus)


def _spread_with_origin(figures: Figures, setting: Setting) -> np.ndarray:
    """Standard deviation of the tangent angles that follow from the origin at focus 1, shape (G, 2) [rad]."""
    if not setting.spread_axes:
        return np.zeros((len(figures), 2))
    slopes = _slopes(figures, setting)[:, :, list(setting.spread_axes)]
    return np.sqrt(np.maximum(np.einsum("gai,gij,gaj->ga", slopes, figures.covariance, slopes), 0.0))


def _slopes(figures: Figures, setting: Setting) -> np.ndarray:
    """How tangent angles follow from the origin at focus 1 [rad / m], shape (G, 2, 3)."""
    reach = np.maximum(figures.gate.mean(axis=1), NARROWEST_RAD)
    return -frames_of(figures, setting)[:, 1:] / reach[:, None, None]


def frames_of(figures: Figures, setting: Setting) -> np.ndarray:
    """Rows forward, horizontal, vertical of each sensor, shape (G, 3, 3).

    The start's frame is carried along by the smallest turn, then rolled: near the poles azimuths jump, this does not.
    """
    if setting.axes.angular < 2:
        return _level_frames(figures.looking)
    forward, level = figures.carried[:, 0], figures.carried[:, 1]
    ahead = 1.0 + np.einsum("gi,gi->g", forward, figures.looking)
    along = np.einsum("gi,gi->g", level, figures.looking)
    carried = level - (along / np.maximum(ahead, SLACK))[:, None] * (forward + figures.looking)
    carried /= np.linalg.norm(carried, axis=1, keepdims=True)
    upright = np.cross(figures.looking, carried)
    cosine, sine = np.cos(figures.roll)[:, None], np.sin(figures.roll)[:, None]
    rolled = cosine * carried + sine * upright, cosine * upright - sine * carried
    return np.stack([figures.looking, *rolled], axis=1)


def _level_frames(looking: np.ndarray) -> np.ndarray:
    """The frames without roll, shape (G, 3, 3)."""
    return np.array([boresight_frame(a, e) for a, e in zip(*angles(looking), strict=True)])


def figures_of(sensors: Sequence[Sensor], setting: Setting) -> Figures:
    """The numbers of sensors; those with spread origins have rays that meet where their coupling says."""
    along = list(setting.spread_axes)
    frames = np.array([sensor.frame for sensor in sensors])
    weights = np.array([sensor.weight for sensor in sensors])
    spreads = [(sensor.spread_horizontal_rad, sensor.spread_vertical_rad) for sensor in sensors]
    if along:
        spreads = [
            spread if s.coupling is None else s.coupling.spread_rad for s, spread in zip(sensors, spreads, strict=True)
        ]
    return Figures(
        origin=np.array([sensor.origin_m for sensor in sensors], dtype=np.float64),
        carried=frames,
        looking=frames[:, 0],
        roll=np.zeros(len(sensors)),
        spread=np.array(spreads, dtype=np.float64),
        gate=np.array([sensor.gate_m for sensor in sensors]),
        log_weight=np.log(np.maximum(weights / weights.sum(), TINY)),
        covariance=np.array([np.asarray(sensor.origin_covariance_m2)[np.ix_(along, along)] for sensor in sensors]),
        focus=np.array([_focus(sensor) for sensor in sensors]),
        log_share=np.zeros(len(sensors)),
    )


def _focus(sensor: Sensor) -> np.ndarray:
    """How near a sensor's rays meet, horizontally and vertically, shape (2,)."""
    if sensor.coupling is None:
        return np.zeros(2)
    return -sensor.range_m * np.einsum("ai,ai->a", np.asarray(sensor.coupling.direction_per_m), sensor.frame[1:])


def sensors_of(figures: Figures, setting: Setting, rays: Sequence[int] | None = None) -> tuple[Sensor, ...]:
    """The sensors of projected numbers, each with its rays where they are known."""
    azimuth, elevation = angles(figures.looking)
    frames, level = frames_of(figures, setting), _level_frames(figures.looking)
    roll = np.arctan2(*(np.einsum("gi,gi->g", frames[:, 1], level[:, axis]) for axis in (2, 1)))
    moving = np.abs(figures.focus) * _spread_with_origin(figures, setting)
    spread = np.hypot(figures.spread, moving)
    slopes = figures.focus[:, :, None] * _slopes(figures, setting)
    weight = np.exp(figures.log_weight)
    spread_m = np.diff(figures.gate, axis=1)[:, 0] / (2 * setting.interval)
    return tuple(
        Sensor(
            name=f"s{index}",
            weight=float(weight[index] / weight.sum()),
            origin_m=figures.origin[index],
            origin_covariance_m2=_covariance(figures, setting, index),
            azimuth_rad=float(azimuth[index]),
            elevation_rad=float(elevation[index]),
            roll_rad=float(roll[index]),
            spread_horizontal_rad=float(spread[index, 0]),
            spread_vertical_rad=float(spread[index, 1]),
            range_m=float(figures.gate[index].mean()),
            spread_range_m=float(spread_m[index]),
            level=setting.level,
            rays=None if rays is None else int(rays[index]),
            coupling=_coupling(figures, setting, index, slopes[index], float(spread_m[index])),
        )
        for index in range(len(figures))
    )


def _covariance(figures: Figures, setting: Setting, index: int) -> np.ndarray:
    covariance = np.zeros((3, 3))
    along = list(setting.spread_axes)
    covariance[np.ix_(along, along)] = figures.covariance[index]
    return covariance


def _coupling(figures: Figures, setting: Setting, index: int, slopes: np.ndarray, spread_m: float) -> Coupling | None:
    """Rays that start off the mean origin look where they meet the others, and listen at the same plane."""
    if not setting.spread_axes:
        return None
    free = np.isin(np.arange(3), setting.spread_axes)
    share = math.exp(figures.log_share[index])
    return Coupling(
        direction_per_m=np.where(free, slopes, 0.0),
        range_per_m=np.where(free, -figures.looking[index], 0.0),
        range_per_rad=np.zeros(2),
        spread_rad=figures.spread[index],
        spread_m=share * spread_m,
    )
