"""The one encoding of a design: the vectors that a direct search varies about a start, and the rays they stand for.

A vector holds, per sensor and in steps that change a score about equally: the shift of its origin, its turn about its
own three axes, the logarithms of both angular spreads, the middle and the logarithm of the width of its gate, and the
logarithm of its weight, as far as they are free. A scan has no spreads and weights to vary; a track is a scan at both
ends of its way, linear in between. Beyond the constraints that bind `fit` a vector stands for the nearest numbers, one
after the other, that keep them, and says how far beyond it lies.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lidardesign.design.bandwidth import Bandwidth, split_budget
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.constraints.feasibility import BIN_MARGIN, BandwidthBudget
from lidardesign.design.layouts.gates import admissible_gates
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.mixture.bounds import Bounds, bounds_of, clip_azimuth
from lidardesign.design.mixture.features import Axes
from lidardesign.design.sensor import MOST_RAYS, DesignSpec, Sensor, boresight_frame, interval_factor
from lidardesign.evaluate.baselines.candidates import RaysPerCondition, rays_at
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import TINY
from lidardesign.space import DIMENSIONS, DesignSpace, angles, direction

# Weights that differ by more nats leave sensors without a ray.
MOST_LOG_WEIGHT = 5.0
NARROWEST_RAD = 1e-3
# One unit of a vector: shares of the start's own field of view and gate, or nats, or radians.
DIRECTION_SHARE, GATE_SHARE = 0.15, 0.1
ROLL_RAD, LOG_SPREAD, LOG_WIDTH, LOG_WEIGHT = 0.2, 0.15, 0.15, 0.2
# A shift of an origin, as a share of its box.
BOX_SHARE = 0.05
# The turn of a ray of a track, as a share of the angle that is its own where rays are even.
TURN_SHARE = 0.5
# What stands where among a sensor's numbers: a turn is about forward, horizontal and vertical.
ORIGIN, TURN, SPREAD, MIDDLE, WIDTH, WEIGHT, NUMBERS = slice(0, 3), slice(3, 6), slice(6, 8), 8, 9, 10, 11


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
        origins: Where the sensors stand, where they stand at mounts or between excluded boxes, shape (G, 3) [m]; None:
            they are moved within their bounds.
    """

    space: DesignSpace
    constraints: Constraints
    level: float
    one_sensor_per_ray: bool
    at: Mapping[str, float]
    gates: bool = True
    origins: np.ndarray | None = None

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

    def standing(self, origins: np.ndarray) -> np.ndarray:
        """The nearest places (G, 3) where sensors may stand [m]."""
        if self.origins is not None:
            return self.origins[np.arange(len(origins)) % len(self.origins)]
        bounds = self.bounds(len(origins))
        return np.clip(origins, bounds.origin_low, bounds.origin_high)


class RayAllowance:
    """How many rays a design fires: a number, or as many as a bandwidth pays for.

    Arguments:
        count: The number of rays; of a scan within a bandwidth, the number that its gates are narrowed for.
        limit_mbps: The bandwidth; None leaves it to the constraints.
        bandwidth: The read-out model of `limit_mbps`.
    """

    def __init__(self, count: int | None, limit_mbps: float | None = None, bandwidth: Bandwidth | None = None) -> None:
        self.count, self.limit_mbps, self.bandwidth = count, limit_mbps, bandwidth or Bandwidth()

    def read_outs(self, rules: SearchRules) -> list[BandwidthBudget]:
        """The bandwidth budgets that hold: the constraints' own, and that of the comparison."""
        own = BandwidthBudget.of(rules.constraints, self.count)
        found = [] if own.limit_mbps is None else [own]
        if self.limit_mbps is not None:
            found.append(BandwidthBudget(self.bandwidth, self.limit_mbps, self.count))
        return found


class Numbers(NamedTuple):
    """Of G sensors origins (G, 3) and gates (G, 2) [m], angles (G,) and angular spreads (G, 2) [rad], log weights."""

    origin: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    roll: np.ndarray
    spread: np.ndarray
    gate: np.ndarray
    log_weight: np.ndarray

    @classmethod
    def of(cls, sensors: Sequence[Sensor]) -> Numbers:
        """The numbers of sensors."""
        weights = np.array([sensor.weight for sensor in sensors])
        return cls(
            np.array([sensor.origin_m for sensor in sensors], dtype=np.float64),
            *np.array([(one.azimuth_rad, one.elevation_rad, one.roll_rad) for one in sensors]).T,
            np.array([(one.spread_horizontal_rad, one.spread_vertical_rad) for one in sensors]),
            np.array([sensor.gate_m for sensor in sensors]),
            np.log(np.maximum(weights / weights.sum(), TINY)),
        )


class DesignModel:
    """Vectors about some sensors, and the designs that they stand for.

    Arguments:
        rules: What all candidates share.
        start: The sensors that the vector 0 stands for, as far as they keep the constraints; of a track, the rays at
            one end of its way, then those at the other.
        conditions: The condition values that rays are laid out at.
        document: The constraints that the designs say they keep.
        way: Of a track: the condition that its rays follow, and both its ends, ascending [m].
    """

    def __init__(
        self,
        rules: SearchRules,
        start: Sequence[Sensor],
        conditions: Sequence[Mapping[str, float]],
        document: Mapping[str, Any],
        way: tuple[str, float, float] | None = None,
    ) -> None:
        self.rules, self.conditions, self.way, self._document = rules, conditions, way, dict(document)
        self._rays = len(start) if way is None else len(start) // 2
        self._bounds = rules.bounds(self._rays).take(np.arange(len(start)) % self._rays)
        self._start = self._admitted(Numbers.of(start))
        self._frames = np.array([boresight_frame(*turn) for turn in zip(*self._start[1:4], strict=True)])
        self._unit = self._units()
        self._free = np.flatnonzero(self._varied())
        self.size = len(start) * len(self._free)
        self.zero = np.zeros(self.size)

    def _varied(self) -> np.ndarray:
        """Which of a sensor's numbers are varied, shape (NUMBERS,)."""
        rules, axes, found = self.rules, self.rules.axes, np.zeros(NUMBERS, dtype=bool)
        several = not rules.one_sensor_per_ray
        found[list(axes.origin) if self.way is None and rules.origins is None else []] = True
        found[TURN] = several and axes.angular == 2, axes.vertical, axes.horizontal
        found[SPREAD] = several and axes.horizontal, several and axes.vertical
        found[[MIDDLE, WIDTH]] = axes.range and rules.gates
        found[WEIGHT] = several and len(self._bounds) > 1
        return found

    def _units(self) -> np.ndarray:
        """One unit of each number, shape (G, NUMBERS)."""
        start, axes, unit = self._start, self.rules.axes, np.ones((len(self._bounds), NUMBERS))
        shift = BOX_SHARE * (self._bounds.origin_high - self._bounds.origin_low)
        unit[:, ORIGIN] = np.where(np.isfinite(shift) & (shift > 0), shift, 1.0)
        field = 2 * self.rules.interval * np.maximum(start.spread.max(axis=1), NARROWEST_RAD)
        unit[:, TURN] = np.stack([np.full(len(field), ROLL_RAD), DIRECTION_SHARE * field, DIRECTION_SHARE * field], 1)
        if self.way is not None:
            spans = [np.ptp(np.unwrap(values[: self._rays])) for values in (start.elevation, start.azimuth)]
            even = np.maximum(spans, NARROWEST_RAD) / self._rays ** (1 / max(axes.angular, 1))
            unit[:, 4:6] = TURN_SHARE * even
        unit[:, SPREAD], unit[:, WIDTH], unit[:, WEIGHT] = LOG_SPREAD, LOG_WIDTH, LOG_WEIGHT
        unit[:, MIDDLE] = GATE_SHARE * np.maximum(np.diff(start.gate, axis=1)[:, 0], TINY)
        return unit

    def _wished(self, vector: np.ndarray) -> Numbers:
        """The numbers that a vector asks for, within the constraints or not."""
        start, change = self._start, np.zeros(self._unit.shape)
        change[:, self._free] = np.reshape(vector, (len(change), -1))
        change *= self._unit
        turn = Rotation.from_rotvec(np.einsum("gi,gij->gj", change[:, TURN], self._frames)).as_matrix()
        frames = np.einsum("gij,gkj->gki", turn, self._frames)
        azimuth, elevation = angles(frames[:, 0])
        level = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))], axis=1)
        upright = np.cross(frames[:, 0], level)
        roll = np.arctan2(*(np.einsum("gi,gi->g", frames[:, 1], axis) for axis in (upright, level)))
        middle = start.gate.mean(axis=1) + change[:, MIDDLE]
        half = np.diff(start.gate, axis=1)[:, 0] / 2 * np.exp(change[:, WIDTH])
        return Numbers(
            start.origin + change[:, ORIGIN],
            azimuth,
            elevation,
            roll,
            start.spread * np.exp(change[:, SPREAD]),
            np.stack([middle - half, middle + half], axis=1),
            start.log_weight + change[:, WEIGHT],
        )

    def _admitted(self, wished: Numbers, widest_m: float = math.inf) -> Numbers:
        """The nearest numbers that keep the constraints, one after the other; gates no wider than a cap [m]."""
        axes, space, count = self.rules.axes, self.rules.space, len(wished.origin)
        bounds = self._bounds if math.isinf(widest_m) else self._bounds.narrowed(widest_m)
        fixed = np.full(count, space.low[3]), np.full(count, space.low[4])
        gate = wished.gate
        if axes.range:
            centre, spread_m = admissible_gates(gate, bounds)
            gate = centre[:, None] + bounds.interval * np.stack([-spread_m, spread_m], axis=1)
        weight = np.maximum(wished.log_weight, wished.log_weight.max() - MOST_LOG_WEIGHT)
        scale = np.array([axes.angle_scale, 1.0])
        low, high = bounds.spread_low * scale, np.minimum(bounds.spread_high * scale, math.pi / 2 / bounds.interval)
        high = np.maximum(high, low)
        least = np.maximum(np.minimum(NARROWEST_RAD * scale / bounds.interval, high / 2), low)
        return Numbers(
            self.rules.standing(wished.origin) if self.way is None else wished.origin,
            clip_azimuth(wished.azimuth, bounds) if axes.horizontal else fixed[0],
            np.clip(wished.elevation, bounds.elevation_low, bounds.elevation_high) if axes.vertical else fixed[1],
            wished.roll if axes.angular == 2 else np.zeros(count),
            np.array([axes.horizontal, axes.vertical]) * np.clip(wished.spread, least, high),
            gate,
            weight - np.logaddexp.reduce(weight),
        )

    def excess(self, vector: np.ndarray) -> float:
        """How far a vector lies beyond the constraints: the mean square of what they move, in units; 0 inside."""
        wished = self._wished(vector)
        kept, unit = self._admitted(wished), self._unit
        looking = [direction(one.azimuth, one.elevation) for one in (wished, kept)]
        spreads = [np.log(np.maximum(one.spread, TINY)) for one in (wished, kept)]
        moved = [
            (wished.origin - kept.origin) / unit[:, ORIGIN],
            (looking[0] - looking[1]) / unit[:, 5:6],
            (spreads[0] - spreads[1]) / unit[:, SPREAD],
            (wished.gate - kept.gate) / unit[:, [MIDDLE]],
        ]
        return float(np.square(np.concatenate(moved, axis=1)).sum() / max(self.size, 1))

    def _afforded(self, vector: np.ndarray, budget: RayAllowance) -> tuple[Numbers, int]:
        """The numbers of a vector, gates narrowed to a common cap that bandwidths pay for, and the number of rays."""
        wished = self._wished(vector)
        found, read_outs = self._admitted(wished), budget.read_outs(self.rules)
        shape = self._widths(found), np.exp(found.log_weight)[: self._rays]
        if self.rules.one_sensor_per_ray:
            count = self._rays
        elif budget.count is not None:
            count = budget.count
        else:
            count = min(*(one.affordable_rays(*shape) for one in read_outs), MOST_RAYS)
        for one in read_outs:
            if not one.fits(self._widths(found), shape[1], count):
                found = self._narrowed(wished, shape, count, one)
                count *= one.fits(self._widths(found), shape[1], count)
        return found, int(count)

    def _narrowed(
        self, wished: Numbers, shape: tuple[np.ndarray, np.ndarray], count: int, budget: BandwidthBudget
    ) -> Numbers:
        """Numbers whose gates have at most so many bins that a budget is kept, or one bin."""

        def capped(bins: int) -> Numbers:
            return self._admitted(wished, (1 - BIN_MARGIN) * bins * budget.model.bin_m)

        def breaks(bins: int) -> bool:
            return not budget.fits(self._widths(capped(bins)), shape[1], count)

        bins = bisect_left(range(1, int(budget.model.bins(shape[0]).max())), True, key=breaks)
        return capped(max(bins, 1))

    def _widths(self, found: Numbers) -> np.ndarray:
        """Gate widths [m]; of a track those that cost at least what any place does."""
        return np.diff(found.gate, axis=1).reshape(-1, self._rays).max(axis=0)

    def designs(self, vector: np.ndarray, budget: RayAllowance) -> list[DesignSpec]:
        """The design of a vector, of a track those at both ends of its way; without rays where none can be paid for."""
        found, count = self._afforded(vector, budget)
        parts = np.arange(len(found.gate)).reshape(-1, self._rays)
        return [self._design(Numbers(*(values[rows] for values in found)), count) for rows in parts]

    def positions(self, vector: np.ndarray, budget: RayAllowance) -> RaysPerCondition:
        """The rays of that design at every condition value."""
        if self.way is None:
            (design,) = self.designs(vector, budget)
            return tuple(lay_out(design, design.rays, None, at=condition) for condition in self.conditions)
        found, count = self._afforded(vector, budget)
        return tuple(self._along(found, count, condition[self.way[0]]) for condition in self.conditions)

    def _along(self, found: Numbers, count: int, place_m: float) -> Rays:
        """The rays of a track at a place: linear between both ends."""
        name, first_m, last_m = self.way
        share = np.clip((place_m - first_m) / (last_m - first_m), 0.0, 1.0)
        ends = [values.reshape(2, self._rays, -1)[:, :count] for values in (found.azimuth, found.elevation, found.gate)]
        ends[0] = np.unwrap(ends[0], axis=0)
        azimuth, elevation, gate = ((1 - share) * first + share * last for first, last in ends)
        origin = np.array(self.rules.space.low[:3])
        origin[DIMENSIONS.index(name)] = place_m
        rays = rays_at(np.column_stack([np.tile(origin, (count, 1)), azimuth, elevation]), np.maximum(gate, 0.0))
        return replace(rays, sensor=np.arange(count))

    def _design(self, found: Numbers, count: int) -> DesignSpec:
        rules = self.rules
        rays = np.ones(count, dtype=int) if rules.one_sensor_per_ray else split_budget(np.exp(found.log_weight), count)
        weight, spread_m = np.exp(found.log_weight), np.diff(found.gate, axis=1)[:, 0] / (2 * rules.interval)
        sensors = tuple(
            Sensor(
                name=f"s{index}",
                weight=float(weight[index] / weight.sum()),
                origin_m=found.origin[index],
                origin_covariance_m2=np.zeros((3, 3)),
                azimuth_rad=float(found.azimuth[index]),
                elevation_rad=float(found.elevation[index]),
                roll_rad=float(found.roll[index]),
                spread_horizontal_rad=float(found.spread[index, 0]),
                spread_vertical_rad=float(found.spread[index, 1]),
                range_m=float(found.gate[index].mean()),
                spread_range_m=float(spread_m[index]),
                level=rules.level,
                rays=int(rays[index]) if count else 0,
            )
            for index in range(len(weight))
        )
        layout = "scan" if rules.one_sensor_per_ray else "grid"
        return DesignSpec(
            "cma", sensors, layout, rays=count, constraints=self._document, level=rules.level, at=dict(rules.at)
        )
