"""From a vector of a direct search to the rays that it stands for, at a number of rays or within a bandwidth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.budget import BIN_MARGIN, ReadOut
from lidardesign.design.rays import lay_out, split_budget
from lidardesign.design.sensor import MOST_RAYS, Design, Sensor, interval_factor
from lidardesign.evaluate.candidates import Positions, mean_mbps
from lidardesign.evaluate.cma_figures import Figures, Setting, sensors_of
from lidardesign.evaluate.cma_parameters import SensorCoordinates
from lidardesign.numerics import safe_divide

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

    def read_outs(self, setting: Setting) -> list[ReadOut]:
        """The bandwidth budgets that hold: the constraints' own, and that of the comparison."""
        found = []
        own = ReadOut.of(setting.constraints, self.count)
        if own.limit_mbps is not None:
            found.append(own)
        if self.limit_mbps is not None:
            found.append(ReadOut(self.bandwidth, self.limit_mbps, self.count))
        return found


class Model(Protocol):
    """Vectors, and the designs that they stand for."""

    size: int
    zero: np.ndarray

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """The nearest vector that keeps the constraints."""
        ...

    def design(self, vector: np.ndarray, amount: Amount) -> Design:
        """The design of a projected vector; its number of rays may be 0 where a bandwidth pays for none."""
        ...

    def positions(self, vector: np.ndarray, amount: Amount) -> Positions:
        """The rays of that design at every condition value."""
        ...

    def with_gates(self, vector: np.ndarray, gates_m: np.ndarray) -> Model:
        """A model whose vector 0 is the same design with these gates, shape (G, 2) [m]."""
        ...


def widest_bins(fits: Callable[[float], bool], widths_m: np.ndarray, read_out: ReadOut) -> float:
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

    def design(self, vector: np.ndarray, amount: Amount) -> Design:
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

    def laid_out(self, design: Design) -> Positions:
        """The rays of a design at every condition value."""
        return tuple(lay_out(design, design.rays, None, at=condition) for condition in self.conditions)

    def _design(self, figures: Figures, count: int) -> Design:
        setting = self.setting
        scan = setting.layout == "scan"
        shares = np.ones(len(figures)) if scan and count else split_budget(np.exp(figures.log_weight), count)
        return Design(
            name="cma",
            sensors=sensors_of(figures, setting, [int(share) for share in shares]),
            layout=setting.layout,  # type: ignore[arg-type]
            rays=count,
            constraints=self._document,
            level=setting.level,
            at=dict(setting.at),
        )

    def _count(self, figures: Figures, amount: Amount) -> int:
        if self.setting.layout == "scan":
            return len(figures)
        if amount.count is not None:
            return amount.count
        widths, weights = _widths(figures), np.exp(figures.log_weight)
        affordable = [one.affordable_rays(widths, weights) for one in amount.read_outs(self.setting)]
        return min(*affordable, MOST_RAYS)

    def _afforded(self, vector: np.ndarray, figures: Figures, count: int, read_out: ReadOut) -> Figures:
        """The numbers with gates no wider than a common cap that keeps the budget."""

        def narrowed(width_m: float) -> Figures:
            return figures if math.isinf(width_m) else self.coordinates.figures(vector, width_m)

        cap = widest_bins(lambda width: self._fits(narrowed(width), count, read_out), _widths(figures), read_out)
        return narrowed(cap) if cap > 0 else figures

    def _fits(self, figures: Figures, count: int, read_out: ReadOut) -> bool:
        if self.setting.layout == "scan":
            shares = np.full(len(figures), int(count > 0))
            return read_out.model.mbps_of_widths(_widths(figures), shares) <= (read_out.limit_mbps or math.inf)
        return read_out.fits(_widths(figures), np.exp(figures.log_weight), count)

    def _raised(self, figures: Figures, design: Design, amount: Amount) -> Design:
        """More rays, where gates of their own leave bandwidth over."""
        if self.setting.layout != "distributed":
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
