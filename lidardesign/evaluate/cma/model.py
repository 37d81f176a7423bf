"""The one encoding of a design: the vectors that a direct search varies about a start, and the rays they stand for.

A vector holds, per sensor and in steps that change a score about equally: the shift of its origin along the free
axes, the turn of its boresight in the start's own tangent plane, the roll that is left when the frame is carried along,
the logarithms of both angular spreads, the middle and the logarithm of the width of its gate, and the logarithm of its
weight. A scan has no spreads and weights to vary; a track is a scan at both ends of its way, linear in between. A
vector beyond the constraints stands for the projected one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth, split_budget
from lidardesign.design.constraints.feasibility import BIN_MARGIN, BandwidthBudget
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.layouts.track import boresight_azimuth
from lidardesign.design.sensor import MOST_RAYS, DesignSpec, Sensor, Track, interval_factor
from lidardesign.evaluate.baselines.candidates import RaysPerCondition
from lidardesign.evaluate.cma.parameters import NARROWEST_RAD, SearchRules, SensorParameters
from lidardesign.numerics import TINY, sphere_exp, sphere_log
from lidardesign.space import DIMENSIONS, angles

# One unit of a vector: shares of the start's own field of view and gate, or nats, or radians.
DIRECTION_SHARE, GATE_SHARE = 0.15, 0.1
ROLL_RAD, LOG_SPREAD, LOG_WIDTH, LOG_WEIGHT = 0.2, 0.15, 0.15, 0.2
# A shift of an origin, as a share of its box.
BOX_SHARE = 0.05
# The turn of a ray of a track, as a share of the angle that is its own where rays are even.
TURN_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Way:
    """Where the rays of a track travel.

    Arguments:
        dimension: The condition that they follow, as 0 for x.
        places: Both its ends, at which rays are given, ascending [m], shape (2,).
    """

    dimension: int
    places: np.ndarray


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


def widest_bins(fits: Callable[[float], bool], widths_m: np.ndarray, read_out: BandwidthBudget) -> float:
    """The largest common cap of gates [m] that keeps a budget; infinite where none is needed, 0 where none does."""
    if fits(math.inf):
        return math.inf
    low, high = 0, int(read_out.model.bins(widths_m).max())
    while low + 1 < high:
        middle = (low + high) // 2
        low, high = (middle, high) if fits((1 - BIN_MARGIN) * middle * read_out.model.bin_m) else (low, middle)
    return (1 - BIN_MARGIN) * low * read_out.model.bin_m


def with_gate(sensor: Sensor, start_m: float, end_m: float) -> Sensor:
    """A sensor with another gate."""
    spread = (end_m - start_m) / (2 * interval_factor(sensor.level))
    return replace(sensor, range_m=(start_m + end_m) / 2, spread_range_m=spread)


class DesignModel:
    """Vectors about some sensors, and the designs that they stand for.

    Arguments:
        rules: What all candidates share; the space of a track leaves its condition free.
        start: The sensors that the vector 0 stands for, up to their projection; of a track, the rays at its first
            place, then those at the next.
        conditions: The condition values that rays are laid out at.
        document: The constraints that the designs say they keep.
        way: Of a track.
    """

    def __init__(
        self,
        rules: SearchRules,
        start: Sequence[Sensor],
        conditions: Sequence[Mapping[str, float]],
        document: Mapping[str, Any],
        way: Way | None = None,
    ) -> None:
        self.rules, self.conditions, self.way, self._document = rules, conditions, way, dict(document)
        places = 1 if way is None else len(way.places)
        self._bounds = rules.bounds(len(start) // places)
        if way is not None:
            self._bounds = self._bounds.take(np.tile(np.arange(len(start) // places), places))
        self._start = SensorParameters.of(start).projected(rules, self._bounds)
        self._columns = self._make_columns()
        self.size = len(start) * sum(width for width, _ in self._columns.values())
        self.zero = self.projected(np.zeros(self.size))

    def _make_columns(self) -> dict[str, tuple[int, np.ndarray]]:
        """What one sensor's part of a vector holds, by name: its width, and one unit of it, shape (G or 1, any)."""
        start, rules, axes = self._start, self.rules, self.rules.axes
        gates, several = int(axes.range and rules.gates), not rules.one_sensor_per_ray
        shift = BOX_SHARE * (self._bounds.origin_high - self._bounds.origin_low)[:, list(axes.origin)]
        field = 2 * rules.interval * np.maximum(start.spread.max(axis=1, keepdims=True), NARROWEST_RAD)
        turn = DIRECTION_SHARE * field
        if self.way is not None:
            first = start.looking[: len(start) // len(self.way.places)]
            spans = np.array([np.ptp(np.unwrap(values)) for values in angles(first)])
            even = np.maximum(spans, NARROWEST_RAD) / len(first) ** (1 / max(axes.angular, 1))
            turn = TURN_SHARE * even[None, [axes.horizontal, axes.vertical]]
        columns = {
            "origin": (0 if self.way is not None else len(axes.origin), np.where(shift > 0, shift, 1.0)),
            "looking": (axes.angular, turn),
            "roll": (int(several and axes.angular == 2), ROLL_RAD),
            "spread": (axes.angular * several, LOG_SPREAD),
            "middle": (gates, GATE_SHARE * np.maximum(np.diff(start.gate, axis=1), TINY)),
            "width": (gates, LOG_WIDTH),
            "log_weight": (int(several and len(start) > 1), LOG_WEIGHT),
        }
        return {name: (width, np.atleast_2d(unit)) for name, (width, unit) in columns.items() if width}

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """The nearest vector, step by step, that keeps the constraints."""
        start, axes, found = self._start, self.rules.axes, self.parameters(vector)
        free = [axes.horizontal, axes.vertical]
        widths = [np.diff(one.gate, axis=1) for one in (found, start)]
        values = {
            "origin": (found.origin - start.origin)[:, list(axes.origin)],
            "looking": sphere_log(np.einsum("gij,gj->gi", start.carried, found.looking))[:, free],
            "roll": (found.roll - start.roll)[:, None],
            "spread": np.log(np.maximum(found.spread / np.maximum(start.spread, TINY), TINY))[:, free],
            "middle": (found.gate.mean(axis=1) - start.gate.mean(axis=1))[:, None],
            "width": np.log(np.maximum(widths[0] / np.maximum(widths[1], TINY), TINY)),
            "log_weight": (found.log_weight - start.log_weight)[:, None],
        }
        parts = [values[name] / unit for name, (_, unit) in self._columns.items()]
        return np.concatenate(parts, axis=1).ravel() if parts else np.zeros(0)

    def parameters(self, vector: np.ndarray, narrowed_m: float = math.inf) -> SensorParameters:
        """The numbers that a vector stands for, projected; gates no wider than a cap [m]."""
        start, axes = self._start, self.rules.axes
        free = [axes.horizontal, axes.vertical]
        rows = np.asarray(vector, dtype=np.float64).reshape(len(start), -1)
        parts: dict[str, np.ndarray] = {}
        for name, (width, unit) in self._columns.items():
            parts[name], rows = rows[:, :width] * unit, rows[:, width:]
        changes: dict[str, np.ndarray] = {}
        if "origin" in parts:
            changes["origin"] = start.origin.copy()
            changes["origin"][:, list(axes.origin)] += parts["origin"]
        if "looking" in parts:
            turn = np.zeros((len(start), 2))
            turn[:, free] = parts["looking"]
            changes["looking"] = np.einsum("gi,gij->gj", sphere_exp(turn), start.carried)
        if "spread" in parts:
            changes["spread"] = start.spread.copy()
            changes["spread"][:, free] *= np.exp(parts["spread"])
        if "middle" in parts:
            middle = start.gate.mean(axis=1) + parts["middle"][:, 0]
            half = np.diff(start.gate, axis=1)[:, 0] / 2 * np.exp(parts["width"][:, 0])
            changes["gate"] = np.stack([middle - half, middle + half], axis=1)
        for name in ("roll", "log_weight"):
            if name in parts:
                changes[name] = getattr(start, name) + parts[name][:, 0]
        bounds = self._bounds if math.isinf(narrowed_m) else self._bounds.narrowed(narrowed_m)
        return replace(start, **changes).projected(self.rules, bounds)

    def design(self, vector: np.ndarray, budget: RayAllowance) -> DesignSpec:
        """The design of a projected vector; its number of rays may be 0 where a bandwidth pays for none."""
        found = self.parameters(vector)
        count = self._count(found, budget)
        for read_out in budget.read_outs(self.rules):
            found = self._afforded(vector, found, count, read_out)
            count = count if self._fits(found, count, read_out) else 0
        return self._design(found, count)

    def positions(self, vector: np.ndarray, budget: RayAllowance) -> RaysPerCondition:
        """The rays of that design at every condition value."""
        return self.laid_out(self.design(vector, budget))

    def laid_out(self, design: DesignSpec) -> RaysPerCondition:
        """The rays of a design at every condition value."""
        return tuple(lay_out(design, design.rays, None, at=condition) for condition in self.conditions)

    def with_gates(self, vector: np.ndarray, gates_m: np.ndarray) -> DesignModel:
        """A model whose vector 0 is the same design with these gates, shape (sensors, 2) [m], at every place."""
        sensors = self.parameters(vector).sensors(self.rules)
        gates = np.tile(gates_m, (len(sensors) // len(gates_m), 1)).tolist()
        start = [with_gate(sensor, *gate) for sensor, gate in zip(sensors, gates, strict=True)]
        return DesignModel(self.rules, start, self.conditions, self._document, self.way)

    def _afforded(
        self, vector: np.ndarray, found: SensorParameters, count: int, read_out: BandwidthBudget
    ) -> SensorParameters:
        """The numbers with gates no wider than a common cap that keeps the budget."""

        def narrowed(width_m: float) -> SensorParameters:
            return found if math.isinf(width_m) else self.parameters(vector, width_m)

        cap = widest_bins(lambda width: self._fits(narrowed(width), count, read_out), self._widths(found), read_out)
        return narrowed(cap) if cap > 0 else found

    def _widths(self, found: SensorParameters) -> np.ndarray:
        """Gate widths [m], shape (G,); of a track those that cost at least what any place does."""
        widths = np.diff(found.gate, axis=1)[:, 0]
        return widths if self.way is None else widths.reshape(len(self.way.places), -1).max(axis=0)

    def _weights(self, found: SensorParameters) -> np.ndarray:
        """Shares of the rays of each sensor, shape (G,); of a track every ray's, which are equal."""
        return np.exp(found.log_weight)[: len(self._widths(found))]

    def _count(self, found: SensorParameters, budget: RayAllowance) -> int:
        widths, weights = self._widths(found), self._weights(found)
        if self.rules.one_sensor_per_ray:
            return len(widths)
        if budget.count is not None:
            return budget.count
        return min(*(one.affordable_rays(widths, weights) for one in budget.read_outs(self.rules)), MOST_RAYS)

    def _fits(self, found: SensorParameters, count: int, read_out: BandwidthBudget) -> bool:
        return read_out.fits(self._widths(found), self._weights(found), count)

    def _design(self, found: SensorParameters, count: int) -> DesignSpec:
        rules, track, at = self.rules, None, dict(self.rules.at)
        if self.way is not None:
            track, sensors = self._track(found, self.way)
            at.pop(track.dimension, None)
        else:
            sensors = found.sensors(rules, split_budget(np.exp(found.log_weight), count).tolist())
        return DesignSpec(
            name="cma", sensors=sensors, layout="scan" if rules.one_sensor_per_ray else "grid", rays=count,
            constraints=self._document, level=rules.level, track=track, at=at,
        )  # fmt: skip

    def _track(self, found: SensorParameters, way: Way) -> tuple[Track, tuple[Sensor, ...]]:
        """The track of rays at every place, and one sensor per ray: the ray in the middle of its way."""
        rules, places = self.rules, len(way.places)
        azimuth, elevation = (values.reshape(places, -1) for values in angles(found.looking))
        gate = np.maximum(found.gate, 0.0).reshape(places, -1, 2)
        azimuth = np.unwrap(azimuth, axis=0)
        count = azimuth.shape[1]
        track = Track(DIMENSIONS[way.dimension], way.places, azimuth, elevation, gate, np.arange(count))
        origin, covariance = np.array(rules.space.low[:3]), np.zeros((3, 3))
        origin[way.dimension] = float(way.places[0] + way.places[-1]) / 2
        covariance[way.dimension, way.dimension] = np.square(np.ptp(way.places) / (2 * rules.interval))
        least = self._bounds.spread_low * [rules.axes.angle_scale, 1.0] * [rules.axes.horizontal, rules.axes.vertical]
        # linear between the ends of the way
        azimuth, elevation, gate = ((values[0] + values[-1]) / 2 for values in (azimuth, elevation, gate))
        sensors = tuple(
            Sensor(
                name=f"s{ray}",
                weight=1.0 / count,
                origin_m=origin,
                origin_covariance_m2=covariance,
                azimuth_rad=boresight_azimuth(azimuth[ray]),
                elevation_rad=float(elevation[ray]),
                roll_rad=0.0,
                spread_horizontal_rad=float(least[ray, 0]),
                spread_vertical_rad=float(least[ray, 1]),
                range_m=float(gate[ray].mean()),
                spread_range_m=float(np.ptp(gate[ray])) / (2 * rules.interval),
                level=rules.level,
                rays=1,
            )
            for ray in range(count)
        )
        return track, sensors
