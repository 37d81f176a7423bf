"""Fits of several groups of sensors, each on its own samples, as one design's mixture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.design.bounds import Bounds, Floors
from lidardesign.design.em import Trace, climb, fit_mixture
from lidardesign.design.features import Axes, Features
from lidardesign.design.mixture import Mixture, expect, log_density
from lidardesign.design.mstep import maximise
from lidardesign.design.resolve import Group, mean_azimuth
from lidardesign.design.sensor import Sensor
from lidardesign.run.clock import phase
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator


@dataclass(frozen=True, eq=False)
class Part:
    """One group of sensors with its samples and bounds.

    Arguments:
        group: Which sensors, and where they are pinned.
        share: The group's share of the density, all groups summing to 1.
        features: Weighted samples.
        bounds: One row per sensor of the group.
    """

    group: Group
    share: float
    features: Features
    bounds: Bounds


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Fitted parts.

    Arguments:
        parts: What was fitted.
        traces: One per part.
    """

    parts: tuple[Part, ...]
    traces: tuple[Trace, ...]

    @property
    def log_likelihood(self) -> float:
        """Weighted mean log density of the samples, given their group [nats]."""
        return float(sum(p.share * t.log_likelihood for p, t in zip(self.parts, self.traces, strict=True)))

    @property
    def order(self) -> np.ndarray:
        """The sensor that each component of all parts, one after the other, stands for."""
        return np.concatenate([np.array(part.group.sensors) for part in self.parts])

    @property
    def weights(self) -> np.ndarray:
        """Shares of the rays in the order of the sensors, summing to 1."""
        weights = np.empty(len(self.order))
        pairs = zip(self.parts, self.traces, strict=True)
        weights[self.order] = np.concatenate([part.share * trace.mixture.weights for part, trace in pairs])
        return weights / weights.sum()

    @property
    def widths_m(self) -> np.ndarray:
        """Gate widths in the order of the sensors [m]."""
        widths = np.empty(len(self.order))
        pairs = zip(self.parts, self.traces, strict=True)
        widths[self.order] = np.concatenate(
            [2 * part.bounds.interval * trace.mixture.spread_range_m for part, trace in pairs]
        )
        return widths

    @property
    def notes(self) -> tuple[str, ...]:
        """What happened to components."""
        return tuple(note for trace in self.traces for note in trace.notes)

    def narrowed(self, width_m: float) -> Ensemble:
        """The fit continued with gates no wider than a cap [m]."""
        traces = []
        for part, trace in zip(self.parts, self.traces, strict=True):
            bounds = part.bounds.narrowed(width_m)
            start = admitted(trace.mixture, part.features, bounds)
            traces.append(replace(climb(start, part.features, bounds), notes=trace.notes))
        return Ensemble(self.parts, tuple(traces))

    def held_out(self, parts: Sequence[Part]) -> tuple[float, float]:
        """Mean log density of other samples of the same groups, and its standard error [nats]."""
        mean, variance = 0.0, 0.0
        for part, trace in zip(parts, self.traces, strict=True):
            values, weights = log_density(trace.mixture, part.features), part.features.weights
            centre = float(weights @ values)
            mean += part.share * centre
            variance += part.share**2 * float(np.square(weights) @ np.square(values - centre))
        return mean, variance**0.5


@phase("mixture")
def fit_parts(parts: Sequence[Part], seed: int, restarts: int) -> Ensemble:
    """Fit every group."""
    traces = [
        fit_mixture(part.features, part.bounds, random_generator(seed, "sensors", index), restarts=restarts)
        for index, part in enumerate(parts)
    ]
    return Ensemble(tuple(parts), tuple(traces))


def admitted(mixture: Mixture, features: Features, bounds: Bounds) -> Mixture:
    """The nearest parameters of a fit inside other bounds: one M-step from its own statistics."""
    return maximise(mixture, expect(mixture, features), features, bounds, Floors.of(features), 0.0)


def sensors_of(ensemble: Ensemble, space: DesignSpace, level: float) -> tuple[Sensor, ...]:
    """The fitted components as sensors s0, s1, ... in the order of the constraint file."""
    rows = [
        _sensor(part, trace.mixture, row, space, level)
        for part, trace in zip(ensemble.parts, ensemble.traces, strict=True)
        for row in range(len(part.bounds))
    ]
    placed = [rows[i] for i in np.argsort(ensemble.order, kind="stable")]
    placed = [replace(s, weight=float(w)) for s, w in zip(placed, ensemble.weights, strict=True)]
    return _named(placed)


def heaviest_first(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Sensors by weight, named s0, s1, ... in that order."""
    return _named(sorted(sensors, key=lambda s: (-round(s.weight, 9), s.azimuth_rad, s.elevation_rad, s.range_m)))


def _named(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    return tuple(replace(sensor, name=f"s{index}") for index, sensor in enumerate(sensors))


def _sensor(part: Part, mixture: Mixture, row: int, space: DesignSpace, level: float) -> Sensor:
    axes: Axes = part.features.axes
    origin = np.array(space.low[:3], dtype=np.float64)
    for axis, pin in enumerate(part.group.pins):
        if pin is not None:
            origin[axis] = pin
    free = list(axes.origin)
    origin[free] = mixture.origin_m[row, free]
    covariance = np.zeros((3, 3))
    covariance[np.ix_(free, free)] = mixture.origin_covariance_m2[row][np.ix_(free, free)]
    horizontal, vertical = mixture.spread_rad[row]
    return Sensor(
        name="",
        weight=float(mixture.weights[row]),
        origin_m=origin,
        origin_covariance_m2=covariance,
        azimuth_rad=float(mean_azimuth(mixture.azimuth_rad[row])) if axes.horizontal else axes.azimuth_rad,
        elevation_rad=float(mixture.elevation_rad[row]) if axes.vertical else axes.elevation_rad,
        roll_rad=float(mixture.roll_rad[row]),
        spread_horizontal_rad=float(horizontal * axes.angle_scale) if axes.horizontal else 0.0,
        spread_vertical_rad=float(vertical) if axes.vertical else 0.0,
        range_m=float(mixture.range_m[row]),
        spread_range_m=float(mixture.spread_range_m[row]) if axes.range else 0.0,
        level=level,
    )
