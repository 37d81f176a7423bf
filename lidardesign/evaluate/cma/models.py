"""From a vector of a direct search to the rays that it stands for, at a number of rays or within a bandwidth.

The vectors that a direct search varies, about a start, and the sensors that they stand for.

A vector holds, per sensor and in steps that change a score about equally: the shift of its origin along the free
axes, the turn of its boresight in the start's own tangent plane, the roll that is left when the frame is carried along,
the logarithms of both angular spreads, the middle and the logarithm of the width of its gate, and the logarithm of its
weight. Sensors whose origins are spread out also vary the matrix logarithm of their covariance, how far in front of
the sensor its rays meet (0: nowhere, 1: at its mean range, in each tangent direction), and the share of the gate that
is left for a ray whose origin is known. A scan has no spreads and weights to vary. A vector beyond the constraints
stands for the projected one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from lidardesign.design.bandwidth import Bandwidth, split_budget
from lidardesign.design.constraints.budget import BIN_MARGIN, BandwidthBudget
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.sensor import MOST_RAYS, DesignSpec, Sensor, interval_factor
from lidardesign.evaluate.baselines.candidates import Positions, mean_mbps
from lidardesign.evaluate.cma.sensor_parameters import (
    NARROWEST_RAD,
    Figures,
    Setting,
    exp_matrix,
    figures_of,
    log_matrix,
    projected,
    sensors_of,
)
from lidardesign.numerics import TINY, safe_divide, sphere_exp, sphere_log

# One unit of a vector: shares of the start's own field of view, gate and origin spread, or nats, or radians.
DIRECTION_SHARE, GATE_SHARE, ORIGIN_SHARE = 0.15, 0.1, 0.5
ROLL_RAD, LOG_SPREAD, LOG_WIDTH, LOG_WEIGHT, LOG_SHARE = 0.2, 0.15, 0.15, 0.2, 0.2
LOG_COVARIANCE, FOCUS = 0.3, 0.15
# A shift of an origin that is a point at the start, as a share of its box.
BOX_SHARE = 0.05


class SensorCoordinates:
    """Vectors about some sensors, and the sensors that they stand for.

    Arguments:
        setting: What all candidates share.
        start: The sensors that the vector 0 stands for, up to their projection.
    """

    def __init__(self, setting: Setting, start: Sequence[Sensor]) -> None:
        self.setting = setting
        figures = figures_of(start, setting)
        self._bounds = setting.bounds(len(figures))
        self._start = projected(figures, setting, self._bounds)
        self._columns = self._varied()
        self.size = len(figures) * sum(width for _, width in self._columns)

    def _varied(self) -> list[tuple[str, int]]:
        """Names and widths of what one sensor's part of a vector holds."""
        axes, setting = self.setting.axes, self.setting
        spread = len(setting.spread_axes)
        whole = not setting.one_sensor_per_ray
        both = axes.angular == 2
        columns = [
            ("origin", len(axes.origin)),
            ("looking", axes.angular),
            ("roll", int(whole and both)),
            ("spread", axes.angular * whole),
            ("middle", int(axes.range and setting.gates)),
            ("width", int(axes.range and setting.gates)),
            ("log_weight", int(whole and len(self._start) > 1)),
            ("covariance", spread * (spread + 1) // 2),
            ("focus", axes.angular * bool(spread)),
            ("log_share", int(axes.range and setting.gates and bool(spread))),
        ]
        return [(name, width) for name, width in columns if width]

    @property
    def zero(self) -> np.ndarray:
        """The vector of the start, projected."""
        return self.projected(np.zeros(self.size))

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """The nearest vector, step by step, that keeps the constraints."""
        return self._encoded(self.figures(vector))

    def figures(self, vector: np.ndarray, narrowed_m: float = math.inf) -> Figures:
        """The numbers that a vector stands for, projected; gates no wider than a cap [m]."""
        bounds = self._bounds if math.isinf(narrowed_m) else self._bounds.narrowed(narrowed_m)
        return projected(self._decoded(vector), self.setting, bounds)

    def _parts(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        rows = np.asarray(vector, dtype=np.float64).reshape(len(self._start), -1)
        parts, start = {}, 0
        for name, width in self._columns:
            parts[name] = rows[:, start : start + width]
            start += width
        return parts

    def _units(self) -> dict[str, np.ndarray]:
        """One unit of each column, shape (G, 1 or width)."""
        start, axes = self._start, self.setting.axes
        field = 2 * self.setting.interval * np.maximum(start.spread.max(axis=1, keepdims=True), NARROWEST_RAD)
        width = np.diff(start.gate, axis=1)
        box = (self._bounds.origin_high - self._bounds.origin_low)[:, list(axes.origin)]
        shift = BOX_SHARE * box
        if self.setting.spread_axes:
            spread = np.sqrt(np.einsum("gii->gi", start.covariance))
            shift = np.where(spread > 0, ORIGIN_SHARE * spread, shift)
        constants = {
            "roll": ROLL_RAD, "spread": LOG_SPREAD, "width": LOG_WIDTH, "log_weight": LOG_WEIGHT,
            "covariance": LOG_COVARIANCE, "focus": FOCUS, "log_share": LOG_SHARE,
        }  # fmt: skip
        units = {name: np.full((1, 1), value) for name, value in constants.items()}
        return units | {
            "origin": np.where(shift > 0, shift, 1.0),
            "looking": DIRECTION_SHARE * field,
            "middle": GATE_SHARE * np.maximum(width, TINY),
        }

    def _decoded(self, vector: np.ndarray) -> Figures:
        units = self._units()
        parts = {name: values * units[name] for name, values in self._parts(vector).items()}
        start, axes = self._start, self.setting.axes
        changes: dict[str, np.ndarray] = {}
        if "origin" in parts:
            changes["origin"] = start.origin.copy()
            changes["origin"][:, list(axes.origin)] += parts["origin"]
        free = [axes.horizontal, axes.vertical]
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
        if "covariance" in parts:
            logarithm = log_matrix(start.covariance) + _symmetric(parts["covariance"], len(axes.origin))
            changes["covariance"] = exp_matrix(logarithm)
        if "focus" in parts:
            changes["focus"] = start.focus.copy()
            changes["focus"][:, free] += parts["focus"]
        for name in ("roll", "log_weight", "log_share"):
            if name in parts:
                changes[name] = getattr(start, name) + parts[name][:, 0]
        return replace(start, **changes)

    def _encoded(self, figures: Figures) -> np.ndarray:
        """The vector of projected numbers."""
        start, axes, units = self._start, self.setting.axes, self._units()
        free = [axes.horizontal, axes.vertical]
        turned = np.einsum("gij,gj->gi", start.carried, figures.looking)
        widths = [np.diff(one.gate, axis=1) for one in (figures, start)]
        values = {
            "origin": (figures.origin - start.origin)[:, list(axes.origin)],
            "looking": sphere_log(turned)[:, free],
            "roll": (figures.roll - start.roll)[:, None],
            "spread": np.log(np.maximum(figures.spread / np.maximum(start.spread, TINY), TINY))[:, free],
            "middle": (figures.gate.mean(axis=1) - start.gate.mean(axis=1))[:, None],
            "width": np.log(np.maximum(widths[0] / np.maximum(widths[1], TINY), TINY)),
            "log_weight": (figures.log_weight - start.log_weight)[:, None],
            "focus": (figures.focus - start.focus)[:, free],
            "log_share": (figures.log_share - start.log_share)[:, None],
        }
        if self.setting.spread_axes:
            moved = log_matrix(figures.covariance) - log_matrix(start.covariance)
            rows, columns = np.triu_indices(moved.shape[1])
            values["covariance"] = moved[:, rows, columns]
        return np.concatenate([values[name] / units[name] for name, _ in self._columns], axis=1).ravel()


def _symmetric(upper: np.ndarray, size: int) -> np.ndarray:
    """Upper triangles (G, k (k + 1) / 2) as symmetric matrices (G, k, k)."""
    rows, columns = np.triu_indices(size)
    full = np.zeros((len(upper), size, size))
    full[:, rows, columns] = full[:, columns, rows] = upper
    return full


# Rays whose gates are their own cost less than their sensors' gates: so often is the number of rays raised.
MOST_RAISES = 3


class Amount:
    """How many rays a design fires: a number, or as many as a bandwidth pays for.

    Arguments:
        count: The number of rays; of a scan within a bandwidth, the number that its gates are narrowed for.
        limit_mbps: The bandwidth; None leaves it to the constraints.
        bandwidth: The read-out model of `limit_mbps`.
    """

    def __init__(self, count: int | None, limit_mbps: float | None = None, bandwidth: Bandwidth | None = None) -> None:
        self.count, self.limit_mbps, self.bandwidth = count, limit_mbps, bandwidth or Bandwidth()

    def read_outs(self, setting: Setting) -> list[BandwidthBudget]:
        """The bandwidth budgets that hold: the constraints' own, and that of the comparison."""
        found = []
        own = BandwidthBudget.of(setting.constraints, self.count)
        if own.limit_mbps is not None:
            found.append(own)
        if self.limit_mbps is not None:
            found.append(BandwidthBudget(self.bandwidth, self.limit_mbps, self.count))
        return found


class Model(Protocol):
    """Vectors, and the designs that they stand for."""

    size: int
    zero: np.ndarray

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """The nearest vector that keeps the constraints."""
        ...

    def design(self, vector: np.ndarray, amount: Amount) -> DesignSpec:
        """The design of a projected vector; its number of rays may be 0 where a bandwidth pays for none."""
        ...

    def positions(self, vector: np.ndarray, amount: Amount) -> Positions:
        """The rays of that design at every condition value."""
        ...

    def with_gates(self, vector: np.ndarray, gates_m: np.ndarray) -> Model:
        """A model whose vector 0 is the same design with these gates, shape (G, 2) [m]."""
        ...


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
    """A sensor with another gate; what its coupling leaves of the gate's spread keeps its share."""
    spread = (end_m - start_m) / (2 * interval_factor(sensor.level))
    coupling = sensor.coupling
    if coupling is not None:
        coupling = replace(coupling, spread_m=spread * safe_divide(coupling.spread_m, sensor.spread_range_m, 1.0))
    return replace(sensor, range_m=(start_m + end_m) / 2, spread_range_m=spread, coupling=coupling)


def starting_inside(document: Mapping[str, Any], setting: Setting) -> dict[str, Any]:
    """Constraints that say where rays may start: where sensors are spread out, they do not leave the space."""
    kept = dict(document)
    if not setting.spread_axes:
        return kept
    origin = dict(kept.get("origin") or {})
    low, high = (list(map(float, end[:3])) for end in (setting.space.low, setting.space.high))
    origin["low_m"] = [max(pair) for pair in zip(low, origin.get("low_m", low), strict=True)]
    origin["high_m"] = [min(pair) for pair in zip(high, origin.get("high_m", high), strict=True)]
    return {**kept, "origin": origin}


class SensorModel:
    """Designs of a few sensors, or of one per ray.

    Arguments:
        setting: What all candidates share.
        start: The sensors that the vector 0 stands for.
        conditions: The condition values that rays are laid out at.
        document: The constraints that the designs say they keep.
    """

    def __init__(
        self,
        setting: Setting,
        start: Sequence[Sensor],
        conditions: Sequence[Mapping[str, float]],
        document: Mapping[str, Any],
    ) -> None:
        self.setting, self.conditions, self._document = setting, conditions, starting_inside(document, setting)
        self.coordinates = SensorCoordinates(setting, start)
        self.size, self.zero = self.coordinates.size, self.coordinates.zero

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """See `Model`."""
        return self.coordinates.projected(vector)

    def design(self, vector: np.ndarray, amount: Amount) -> DesignSpec:
        """See `Model`."""
        figures = self.coordinates.figures(vector)
        count = self._count(figures, amount)
        for read_out in amount.read_outs(self.setting):
            figures = self._afforded(vector, figures, count, read_out)
            count = count if self._fits(figures, count, read_out) else 0
        design = self._design(figures, count)
        return self._raised(figures, design, amount) if amount.count is None and count else design

    def positions(self, vector: np.ndarray, amount: Amount) -> Positions:
        """See `Model`."""
        return self.laid_out(self.design(vector, amount))

    def with_gates(self, vector: np.ndarray, gates_m: np.ndarray) -> SensorModel:
        """See `Model`."""
        sensors = sensors_of(self.coordinates.figures(vector), self.setting)
        start = [with_gate(sensor, *gate) for sensor, gate in zip(sensors, gates_m.tolist(), strict=True)]
        return SensorModel(self.setting, start, self.conditions, self._document)

    def laid_out(self, design: DesignSpec) -> Positions:
        """The rays of a design at every condition value."""
        return tuple(lay_out(design, design.rays, None, at=condition) for condition in self.conditions)

    def _design(self, figures: Figures, count: int) -> DesignSpec:
        setting = self.setting
        scan = setting.one_sensor_per_ray
        shares = np.ones(len(figures)) if scan and count else split_budget(np.exp(figures.log_weight), count)
        return DesignSpec(
            name="cma",
            sensors=sensors_of(figures, setting, [int(share) for share in shares]),
            layout=setting.layout,
            rays=count,
            constraints=self._document,
            level=setting.level,
            at=dict(setting.at),
        )

    def _count(self, figures: Figures, amount: Amount) -> int:
        if self.setting.one_sensor_per_ray:
            return len(figures)
        if amount.count is not None:
            return amount.count
        widths, weights = _widths(figures), np.exp(figures.log_weight)
        affordable = [one.affordable_rays(widths, weights) for one in amount.read_outs(self.setting)]
        return min(*affordable, MOST_RAYS)

    def _afforded(self, vector: np.ndarray, figures: Figures, count: int, read_out: BandwidthBudget) -> Figures:
        """The numbers with gates no wider than a common cap that keeps the budget."""

        def narrowed(width_m: float) -> Figures:
            return figures if math.isinf(width_m) else self.coordinates.figures(vector, width_m)

        cap = widest_bins(lambda width: self._fits(narrowed(width), count, read_out), _widths(figures), read_out)
        return narrowed(cap) if cap > 0 else figures

    def _fits(self, figures: Figures, count: int, read_out: BandwidthBudget) -> bool:
        if self.setting.one_sensor_per_ray:
            shares = np.full(len(figures), int(count > 0))
            return read_out.model.mbps_of_widths(_widths(figures), shares) <= (read_out.limit_mbps or math.inf)
        return read_out.fits(_widths(figures), np.exp(figures.log_weight), count)

    def _raised(self, figures: Figures, design: DesignSpec, amount: Amount) -> DesignSpec:
        """More rays, where gates of their own leave bandwidth over."""
        if not self.setting.extends_origins:
            return design
        for _ in range(MOST_RAISES):
            spent = mean_mbps(self.laid_out(design), amount.bandwidth)
            limit = amount.limit_mbps or 0.0
            count = int((design.rays or 0) * limit / spent) if spent > 0 else 0
            if count <= (design.rays or 0):
                break
            more = self._design(figures, min(count, MOST_RAYS))
            if mean_mbps(self.laid_out(more), amount.bandwidth) > limit:
                break
            design = more
        return design


def _widths(figures: Figures) -> np.ndarray:
    return np.diff(figures.gate, axis=1)[:, 0]
