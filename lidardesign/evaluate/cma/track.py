"""Tracks that a direct search varies: rays at a few places of the way, linear in between.

A vector holds, per place and ray, shifts of the free angles and of the middle of the gate, and the logarithm of its
width, in steps that are shares of what all returns span.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lidardesign.design.constraints.budget import BandwidthBudget
from lidardesign.design.layouts.gates import admissible_gates
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.layouts.track import boresight_azimuth
from lidardesign.design.mixture.bounds import Bounds
from lidardesign.design.sensor import DesignSpec, Sensor, Track
from lidardesign.evaluate.baselines.candidates import Positions
from lidardesign.evaluate.cma.models import GATE_SHARE, LOG_WIDTH, Amount, widest_bins
from lidardesign.evaluate.cma.sensor_parameters import NARROWEST_RAD, Setting
from lidardesign.numerics import TINY, wrap_angle
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION

# A ray's turn, as a share of the angle that is its own where rays are even.
TURN_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Way:
    """Where rays travel.

    Arguments:
        dimension: The condition that they follow, as 0 for x.
        places: Ascending values of it at which rays are given, shape (P,) [m].
    """

    dimension: int
    places: np.ndarray


@dataclass(frozen=True, eq=False)
class TrackFigures:
    """Rays at the places of a way.

    Arguments:
        azimuth, elevation: Shape (P, N) [rad].
        gate: Start and end, shape (P, N, 2) [m].
    """

    azimuth: np.ndarray
    elevation: np.ndarray
    gate: np.ndarray


class TrackModel:
    """Designs with a track.

    Arguments:
        setting: What all candidates share; its space leaves the condition free.
        way: Where rays travel.
        start: The rays that the vector 0 stands for, up to their projection.
        conditions: The condition values that rays are laid out at.
        document: The constraints that the designs say they keep.
    """

    def __init__(
        self,
        setting: Setting,
        way: Way,
        start: TrackFigures,
        conditions: Sequence[Mapping[str, float]],
        document: Mapping[str, object],
    ) -> None:
        self.setting, self.way, self.conditions, self._document = setting, way, conditions, dict(document)
        self._bounds = setting.bounds(start.azimuth.shape[1])
        self._free = [axis in setting.space.free for axis in (AZIMUTH, ELEVATION)]
        self._start = self._admitted(start, self._bounds)
        width = sum(self._free) + 2 * (setting.axes.range and setting.gates)
        self.size = start.azimuth.size * width
        self.zero = np.zeros(self.size)

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """See `cma_models.Model`."""
        return self._encoded(self.figures(vector))

    def figures(self, vector: np.ndarray, narrowed_m: float = math.inf) -> TrackFigures:
        """The rays that a vector stands for, projected; gates no wider than a cap [m]."""
        bounds = self._bounds if math.isinf(narrowed_m) else self._bounds.narrowed(narrowed_m)
        return self._admitted(self._decoded(vector), bounds)

    def design(self, vector: np.ndarray, amount: Amount) -> DesignSpec:
        """See `cma_models.Model`; the number of rays is the start's, or 0 where a bandwidth pays for no such number."""
        figures = self.figures(vector)
        count = figures.azimuth.shape[1]
        for read_out in amount.read_outs(self.setting):
            cap = widest_bins(partial(self._fits, vector, read_out), _widths(figures), read_out)
            figures = self.figures(vector, cap) if 0 < cap < math.inf else figures
            count = count if read_out.model.mbps_of_widths(_widths(figures)) <= (read_out.limit_mbps or 0) else 0
        return self._design(figures, count)

    def with_gates(self, vector: np.ndarray, gates_m: np.ndarray) -> TrackModel:
        """See `cma_models.Model`; the same gates at every place."""
        figures = self.figures(vector)
        gate = np.tile(gates_m, (len(self.way.places), 1, 1))
        start = TrackFigures(figures.azimuth, figures.elevation, gate)
        return TrackModel(self.setting, self.way, start, self.conditions, self._document)

    def positions(self, vector: np.ndarray, amount: Amount) -> Positions:
        """See `cma_models.Model`."""
        design = self.design(vector, amount)
        return tuple(lay_out(design, design.rays, None, at=condition) for condition in self.conditions)

    def _fits(self, vector: np.ndarray, read_out: BandwidthBudget, width_m: float) -> bool:
        return read_out.model.mbps_of_widths(_widths(self.figures(vector, width_m))) <= (read_out.limit_mbps or 0.0)

    def _units(self) -> tuple[np.ndarray, np.ndarray]:
        """One unit of the free angles (2,) [rad] and of the middle of the gates (P, N) [m]."""
        count = self._start.azimuth.shape[1]
        spans = [np.ptp(self._start.azimuth[0]), np.ptp(self._start.elevation[0])]
        even = np.maximum(spans, NARROWEST_RAD) / count ** (1 / max(sum(self._free), 1))
        return TURN_SHARE * even, GATE_SHARE * np.maximum(np.diff(self._start.gate, axis=2)[:, :, 0], TINY)

    def _decoded(self, vector: np.ndarray) -> TrackFigures:
        start = self._start
        parts = list(np.asarray(vector, dtype=np.float64).reshape(-1, *start.azimuth.shape))
        turn, shift = self._units()
        both = [start.azimuth, start.elevation]
        for axis, free in enumerate(self._free):
            if free:
                both[axis] = both[axis] + turn[axis] * parts.pop(0)
        gate = start.gate
        if parts:
            middle = gate.mean(axis=2) + shift * parts[0]
            half = np.diff(gate, axis=2)[:, :, 0] / 2 * np.exp(LOG_WIDTH * parts[1])
            gate = np.stack([middle - half, middle + half], axis=2)
        return TrackFigures(*both, gate)

    def _encoded(self, figures: TrackFigures) -> np.ndarray:
        start = self._start
        turn, shift = self._units()
        turned = [figures.azimuth - start.azimuth, figures.elevation - start.elevation]
        parts = [turned[axis] / turn[axis] for axis, free in enumerate(self._free) if free]
        if self.setting.axes.range and self.setting.gates:
            widths = [np.diff(one.gate, axis=2)[:, :, 0] for one in (figures, start)]
            parts.append((figures.gate.mean(axis=2) - start.gate.mean(axis=2)) / shift)
            parts.append(np.log(np.maximum(widths[0] / np.maximum(widths[1], TINY), TINY)) / LOG_WIDTH)
        return np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0)

    def _admitted(self, figures: TrackFigures, bounds: Bounds) -> TrackFigures:
        """Rays moved to where the constraints admit them, at every place and therefore between."""
        space, (places, count) = self.setting.space, figures.azimuth.shape
        azimuth, elevation = figures.azimuth, figures.elevation
        if self._free[0]:
            offset = wrap_angle(azimuth - bounds.azimuth_centre)
            clipped = bounds.azimuth_centre + np.clip(offset, -bounds.azimuth_half, bounds.azimuth_half)
            azimuth = np.where(bounds.azimuth_half >= math.pi, azimuth, clipped)
        else:
            azimuth = np.full_like(azimuth, space.low[AZIMUTH])
        if self._free[1]:
            elevation = np.clip(elevation, bounds.elevation_low, bounds.elevation_high)
        else:
            elevation = np.full_like(elevation, space.low[ELEVATION])
        gate = figures.gate
        if self.setting.axes.range:
            rows = bounds.take(np.tile(np.arange(count), places))
            centre, spread = admissible_gates(gate.reshape(-1, 2), rows)
            half = bounds.interval * spread
            gate = np.maximum(np.stack([centre - half, centre + half], axis=1), 0.0).reshape(places, count, 2)
        return TrackFigures(azimuth, elevation, gate)

    def _design(self, figures: TrackFigures, count: int) -> DesignSpec:
        setting, total = self.setting, figures.azimuth.shape[1]
        name = DIMENSIONS[self.way.dimension]
        track = Track(name, self.way.places, figures.azimuth, figures.elevation, figures.gate, np.arange(total))
        at = {key: value for key, value in setting.at.items() if key != name}
        return DesignSpec(
            name="cma", sensors=self._sensors(figures), layout="scan", rays=count, constraints=self._document,
            level=setting.level, track=track, at=at,
        )  # fmt: skip

    def _sensors(self, figures: TrackFigures) -> tuple[Sensor, ...]:
        """One sensor per ray, the ray in the middle of its way."""
        places, setting = self.way.places, self.setting
        middle = float(places[0] + places[-1]) / 2
        origin, covariance = np.array(setting.space.low[:3]), np.zeros((3, 3))
        axis = self.way.dimension
        origin[axis] = middle
        covariance[axis, axis] = np.square((places[-1] - places[0]) / (2 * setting.interval))
        index = np.searchsorted(places, middle, side="right") - 1
        between = (middle - places[index]) / (places[index + 1] - places[index])
        least = self._bounds.spread_low * [setting.axes.angle_scale, 1.0] * self._free
        azimuth, elevation, gate = (
            (1 - between) * values[index] + between * values[index + 1]
            for values in (figures.azimuth, figures.elevation, figures.gate)
        )
        return tuple(
            Sensor(
                name=f"s{ray}",
                weight=1.0 / len(azimuth),
                origin_m=origin,
                origin_covariance_m2=covariance,
                azimuth_rad=boresight_azimuth(azimuth[ray]),
                elevation_rad=float(elevation[ray]),
                roll_rad=0.0,
                spread_horizontal_rad=float(least[ray, 0]),
                spread_vertical_rad=float(least[ray, 1]),
                range_m=float(gate[ray].mean()),
                spread_range_m=float(np.diff(gate[ray])[0]) / (2 * setting.interval),
                level=setting.level,
                rays=1,
            )
            for ray in range(len(azimuth))
        )


def _widths(figures: TrackFigures) -> np.ndarray:
    """Gate widths that cost at least what any place does, shape (N,) [m]."""
    return np.diff(figures.gate, axis=2)[:, :, 0].max(axis=0)
