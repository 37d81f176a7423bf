"""The sensors of a design as they can be moved: a vector of numbers, and the rays that move with them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import BandwidthBudget
from lidardesign.constraints.origins import mounts_of
from lidardesign.mixture.bounds import bounds_of
from lidardesign.mixture.components import Axes
from lidardesign.numerics import SLACK, TINY, sphere_exp, sphere_log, wrap_angle
from lidardesign.rays.gates import admitted_gates
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import Positions
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import boresight_frame, interval_factor
from lidardesign.space import DesignSpace, angles, direction

# Columns of a sensor's numbers.
ORIGIN, AIM, AZIMUTH, ELEVATION, ROLL, FIELD, GATE = slice(0, 3), slice(3, 6), 3, 4, 5, slice(6, 8), slice(8, 10)
# One unit: shares of the box of origins, of the field of view and of the gate, radians of roll, or nats.
BOX_SHARE, FIELD_SHARE, ROLL_RAD, GATE_SHARE, LOG_STEP = 0.05, 0.15, 0.2, 0.1, 0.15
NARROWEST_RAD, STEEPEST_COSINE = 1e-3, 0.1
WIDEST_LOG = 5.0


class MovableSensors:
    """The sensors of a design, and its rays as they move with them.

    Arguments:
        design: Whose sensors and constraints.
        start: Its rays, of which all sensors have some or none.
        space: The design space at one condition value.
        bandwidth: The read-out model of the comparison.

    `vector_bounds` are the lowest and the highest vector, shape (2, M).
    """

    def __init__(self, design: DesignSpec, start: Positions, space: DesignSpace, bandwidth: Bandwidth) -> None:
        constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
        every, z = Rays.joined(start), interval_factor(design.level)
        self.start, self.count, self._axes = start, int(every.sensor.max()) + 1, Axes.of(space)
        self._bounds = bounds_of(constraints.rules, space, tuple(range(self.count)), z)
        models = (bandwidth, BandwidthBudget.of(constraints, None).model)
        self._limits = [(model, mean_mbps(start, model)) for model in models]
        sensors = design.sensors[: self.count]
        self._aim = np.array([(one.azimuth_rad, one.elevation_rad, one.roll_rad) for one in sensors])
        spread = np.array([one.field_of_view_rad for one in sensors]) / (2 * z)
        self._frames = np.array([boresight_frame(*aim) for aim in self._aim])
        sides = self._changes(every, spread)
        if any(mounts_of(rules) or rules.origin.exclude for rules in constraints.rules):
            sides[..., ORIGIN] = 0.0
        parts = [index for index, sensor in enumerate(design.sensors[: self.count]) if sensor.part is not None]
        sides[:, parts, FIELD.start :] = 0.0
        sides[:, np.bincount(every.sensor) == 0] = 0.0
        # a start at a bound may lie an ulp beyond it
        self._low, self._high = np.minimum(sides[0], 0.0), np.maximum(sides[1], 0.0)
        self._free = self._high - self._low > SLACK
        self._unit = np.minimum(self._units(every, spread), np.where(self._free, self._high - self._low, 1.0))
        self.vector_bounds = [(side / self._unit)[self._free] for side in (self._low, self._high)]

    def _changes(self, every: Rays, spread: np.ndarray) -> np.ndarray:
        """Lowest and highest change of each parameter, shape (2, G, 10); 0 where it is not free."""
        axes, bounds, sides = self._axes, self._bounds, np.zeros((2, self.count, 10))
        first, last = np.full((self.count, 3), np.inf), np.full((self.count, 3), -np.inf)
        np.minimum.at(first, every.sensor, every.origin_m)
        np.maximum.at(last, every.sensor, every.origin_m)
        for axis in axes.origin:
            sides[..., axis] = (bounds.origin_low - first)[:, axis], (bounds.origin_high - last)[:, axis]
        if axes.horizontal:
            offset = np.where(bounds.azimuth_half < math.pi, wrap_angle(self._aim[:, 0] - bounds.azimuth_centre), 0.0)
            sides[..., AZIMUTH] = -bounds.azimuth_half - offset, bounds.azimuth_half - offset
        if axes.vertical:
            sides[..., ELEVATION] = bounds.elevation_low - self._aim[:, 1], bounds.elevation_high - self._aim[:, 1]
        if axes.angular == 2:
            rolls = np.stack([bounds.roll_low, bounds.roll_high])
            is_bounded = np.ptp(rolls, axis=0) < math.pi / 2
            sides[..., ROLL] = np.where(is_bounded, rolls - self._aim[:, 2], np.array([[-math.pi], [math.pi]]))
        wide = np.array([axes.horizontal, axes.vertical]) & (spread > 0)
        widest = np.minimum(bounds.spread_high * [axes.angle_scale, 1.0], math.pi / 2 / bounds.interval)
        ends = np.stack([bounds.spread_low * [axes.angle_scale, 1.0], widest]) / np.where(wide, spread, 1.0)
        sides[..., FIELD] = np.where(wide, np.log(np.clip(ends, *np.exp([-WIDEST_LOG, WIDEST_LOG]))), 0.0)
        if axes.range:
            reach_m = np.ptp(every.gate_m)
            sides[..., GATE] = np.array([(-reach_m, -WIDEST_LOG), (reach_m, WIDEST_LOG)])[:, None]
        return sides

    def _units(self, every: Rays, spread: np.ndarray) -> np.ndarray:
        """The unit of each parameter, shape (G, 10)."""
        unit = np.full((self.count, 10), LOG_STEP)
        unit[:, ORIGIN] = np.maximum(BOX_SHARE * (self._bounds.origin_high - self._bounds.origin_low), TINY)
        middle = every.direction.mean(axis=0)
        away = (every.direction @ middle).min() / max(np.linalg.norm(middle), TINY)
        even = 2 * math.acos(np.clip(away, -1.0, 1.0)) / self.count ** (1 / max(self._axes.angular, 1))
        field = np.where(spread.max(axis=1) > 0, 2 * self._bounds.interval * spread.max(axis=1), even)
        unit[:, ELEVATION] = FIELD_SHARE * np.maximum(field, NARROWEST_RAD)
        unit[:, AZIMUTH] = unit[:, ELEVATION] / np.maximum(np.cos(self._aim[:, 1]), STEEPEST_COSINE)
        unit[:, ROLL] = ROLL_RAD
        unit[:, GATE.start] = GATE_SHARE * max(float(np.ptp(every.gate_m, axis=1).mean()), TINY)
        return unit

    def rays(self, vector: np.ndarray) -> Positions:
        """The rays of a vector (M,); of the vector 0 those of the design."""
        if not vector.any():
            return self.start
        change = np.zeros(self._unit.shape)
        change[self._free] = vector * self._unit[self._free]
        change = np.clip(change, self._low, self._high)
        return tuple(self._moved(rays, change) for rays in self.start)

    def _moved(self, rays: Rays, change: np.ndarray) -> Rays:
        sensor, own, rows = rays.sensor, change[rays.sensor], self._bounds.take(rays.sensor)
        if self._axes.angular == 2:
            local = np.einsum("nij,nj->ni", self._frames[sensor], rays.direction)
            turned = np.array([boresight_frame(*aim) for aim in self._aim + change[:, AIM]])
            local = sphere_exp(sphere_log(local) * np.exp(own[:, FIELD]))
            azimuth, elevation = angles(np.einsum("nij,ni->nj", turned[sensor], local))
        else:
            # in the plane or on the cone that the design space holds all rays in
            offset = np.stack(angles(rays.direction), axis=1) - self._aim[sensor, :2]
            offset[:, 0] = wrap_angle(offset[:, 0])
            azimuth, elevation = (self._aim[sensor, :2] + own[:, AIM][:, :2] + offset * np.exp(own[:, FIELD])).T
        middle, half = rays.gate_m.mean(axis=1) + own[:, 8], np.ptp(rays.gate_m, axis=1) / 2 * np.exp(own[:, 9])
        gate_m = np.stack([middle - half, middle + half], axis=1)
        varied = own[:, GATE].any(axis=1, keepdims=True)
        gate_m = np.where(varied, admitted_gates(gate_m, rows), rays.gate_m) if varied.any() else rays.gate_m
        looking = direction(azimuth, elevation)
        angles_rad = np.stack([azimuth, elevation], axis=1)
        place_m = rays.origin_m + own[:, ORIGIN]
        return replace(rays, origin_m=place_m, direction=looking, gate_m=gate_m, angles_rad=angles_rad)

    def excess(self, positions: Positions) -> float:
        """The share by which the bandwidth of rays exceeds the design's; 0 where it does not."""
        return max(max(mean_mbps(positions, model) / limit - 1 - SLACK, 0.0) for model, limit in self._limits)
