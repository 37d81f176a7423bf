r"""Groups of sensors, each with its own samples, fitted as one design's mixture; and the choice of mounts.

A mount is a pinned origin. The density that sensors at several mounts see together is, per sample, the largest
weight of its scene point from any of them (re-aimed and reweighted as in `support`), summed over samples drawn
from the density. Mounts are taken one after the other, each time the one that newly sees most: this sum
is submodular, so the greedy choice sees at least 1 - 1/e of what the best choice sees (G. Nemhauser, L. Wolsey
and M. Fisher 1978). Sensors with constraints of their own are placed together with their mount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lidardesign.constraints.document import SensorRules, rules_of
from lidardesign.constraints.origins import Mount, fix_origin, fix_origins, mounts_of, mounts_suffice
from lidardesign.errors import InfeasibleError
from lidardesign.mixture.bounds import Bounds, Floors, Group, pins_of
from lidardesign.mixture.components import Axes, Features, Mixture, expect
from lidardesign.mixture.em import EMResult, fit_mixture, run_em
from lidardesign.mixture.m_step import maximise
from lidardesign.mixture.support import Retarget, reaim_samples
from lidardesign.numerics import systematic_draw, wrap_angle, wrap_turn
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.sensors.sensor import Sensor
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator

# Enough samples to distinguish mounts whose shares differ by a hundredth.
MOUNT_SAMPLES = 4000


@dataclass(frozen=True, eq=False)
class GroupSamples:
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
    """Fitted groups of sensors.

    Arguments:
        parts: The groups with their samples.
        results: One per group.
    """

    parts: tuple[GroupSamples, ...]
    results: tuple[EMResult, ...]

    @property
    def log_likelihood(self) -> float:
        """Weighted mean log density of the samples, given their group [nats]."""
        return float(sum(p.share * t.log_likelihood for p, t in zip(self.parts, self.results, strict=True)))

    @property
    def order(self) -> np.ndarray:
        """The sensor of each component, group after group, shape (S,)."""
        return np.concatenate([np.array(part.group.sensors) for part in self.parts])

    @property
    def weights(self) -> np.ndarray:
        """Shares of the rays in the order of the sensors, summing to 1."""
        pairs = zip(self.parts, self.results, strict=True)
        weights = self._in_order([part.share * result.mixture.weights for part, result in pairs])
        return weights / weights.sum()

    @property
    def widths_m(self) -> np.ndarray:
        """Gate widths in the order of the sensors [m]."""
        pairs = zip(self.parts, self.results, strict=True)
        return self._in_order([2 * part.bounds.interval * result.mixture.spread_range_m for part, result in pairs])

    def _in_order(self, values: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate(values)[np.argsort(self.order)]

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines on restarted components."""
        return tuple(note for result in self.results for note in result.notes)

    def narrowed(self, width_m: float) -> Ensemble:
        """The fit continued with gates no wider than a cap [m]."""
        results = []
        for part, result in zip(self.parts, self.results, strict=True):
            bounds = part.bounds.narrowed(width_m)
            # one M-step from its own statistics takes the fit inside other bounds
            statistics, floors = expect(result.mixture, part.features), Floors.of(part.features)
            start = maximise(result.mixture, statistics, part.features, bounds, floors, 0.0)
            results.append(replace(run_em(start, part.features, bounds), notes=result.notes))
        return Ensemble(self.parts, tuple(results))


@phase("mixture")
def fit_groups(parts: Sequence[GroupSamples], seed: int, restarts: int) -> Ensemble:
    """Fit every group."""
    results = [
        fit_mixture(part.features, part.bounds, random_generator(seed, "sensors", index), restarts=restarts)
        for index, part in enumerate(parts)
    ]
    return Ensemble(tuple(parts), tuple(results))


def sensors_of(ensemble: Ensemble, space: DesignSpace) -> tuple[Sensor, ...]:
    """The fitted components as sensors s0, s1, ... in the order of the constraint file."""
    rows = [
        _sensor(part, result.mixture, row, space)
        for part, result in zip(ensemble.parts, ensemble.results, strict=True)
        for row in range(len(part.bounds))
    ]
    order = np.argsort(ensemble.order, kind="stable")
    return _named([replace(rows[i], weight=float(w)) for i, w in zip(order, ensemble.weights, strict=True)])


def heaviest_first(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Sensors by weight, named s0, s1, ... in that order."""
    return _named(sorted(sensors, key=lambda s: (-round(s.weight, 9), s.azimuth_rad, s.elevation_rad, s.gate_m)))


def _named(sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    return tuple(replace(sensor, name=f"s{index}") for index, sensor in enumerate(sensors))


def _sensor(part: GroupSamples, mixture: Mixture, row: int, space: DesignSpace) -> Sensor:
    axes: Axes = part.features.axes
    fixed = [low if pin is None else pin for low, pin in zip(space.low[:3], part.group.pins, strict=True)]
    origin, free = np.array(fixed, dtype=np.float64), list(axes.origin)
    origin[free] = mixture.origin_m[row, free]
    covariance = np.zeros((3, 3))
    covariance[np.ix_(free, free)] = mixture.origin_covariance_m2[row][np.ix_(free, free)]
    horizontal, vertical = mixture.spread_rad[row]
    z, middle = part.bounds.interval, float(mixture.range_m[row])
    half_m = z * float(mixture.spread_range_m[row]) if axes.range else 0.0
    return Sensor(
        name="",
        weight=float(mixture.weights[row]),
        origin_m=origin,
        azimuth_rad=float(wrap_turn(wrap_angle(mixture.azimuth_rad[row]))) if axes.horizontal else axes.azimuth_rad,
        elevation_rad=float(mixture.elevation_rad[row]) if axes.vertical else axes.elevation_rad,
        roll_rad=float(mixture.roll_rad[row]),
        field_of_view_rad=(
            float(2 * z * horizontal * axes.angle_scale) if axes.horizontal else 0.0,
            float(2 * z * vertical) if axes.vertical else 0.0,
        ),
        gate_m=(max(middle - half_m, 0.0), middle + half_m),
        origin_covariance_m2=covariance if covariance.any() else None,
    )


def choose_mounts(
    rules: Sequence[SensorRules], samples: Samples, count: int, retarget: Retarget | None, seed: int
) -> tuple[SensorRules, ...]:
    """The rules with every mounted sensor fixed at the mount chosen for it.

    Arguments:
        rules: Feasible rules of all sensors.
        samples: Samples of the density.
        count: Number of sensors.
        retarget: log p* of design points, (N, 6) to (N,).
        seed: Root of the draw of samples.

    Raises:
        ConfigError: There is a choice, but no way to evaluate the target density.
        InfeasibleError: No mount sees any part of the density.
    """
    entries = len(rules) - 1
    count = count if mounts_of(rules[-1]) else entries
    options = [mounts_of(rules_of(rules, sensor)) for sensor in range(count)]
    if not entries and len(options[0]) == len(options):
        # alike sensors at all the mounts, in the file's order
        chosen = dict(enumerate(options[0]))
    else:
        chosen = _greedy(_views(rules, samples, options, retarget, seed), options)
    return fix_origins(rules, [chosen.get(sensor) for sensor in range(count)])


def _views(
    rules: Sequence[SensorRules],
    samples: Samples,
    options: list[list[Mount]],
    retarget: Retarget | None,
    seed: int,
) -> dict[tuple[int, Mount], np.ndarray]:
    """Weights of drawn samples re-aimed from each mount of each sensor, (N,) each; 0 where unseen."""
    drawn = systematic_draw(samples.weights, MOUNT_SAMPLES, random_generator(seed, "mounts"))

    @cache
    def seen_by(entry: int, mount: Mount) -> np.ndarray:
        fixed = fix_origin(rules[entry], mount)
        group = Group(pins_of(fixed, samples.space), (0,))
        return reaim_samples(samples, drawn, (fixed,), group, retarget)[1]

    # sensors beyond the entries of `each` are alike
    pairs = [(sensor, mount) for sensor, mounts in enumerate(options) for mount in mounts]
    views = {(sensor, mount): seen_by(min(sensor, len(rules) - 1), mount) for sensor, mount in pairs}
    if not any(view.any() for view in views.values()):
        names = [rules[0].path("origin.mounts_m")]
        raise InfeasibleError(
            "no mount sees any part of the density", conflicts=names, hint="add mounts in other places"
        )
    return views


def _greedy(views: dict[tuple[int, Mount], np.ndarray], options: list[list[Mount]]) -> dict[int, Mount]:
    """The mount of each mounted sensor, chosen greedily by the density seen together."""
    seen = np.zeros(len(next(iter(views.values()))))
    left = {sensor: list(mounts) for sensor, mounts in enumerate(options) if mounts}
    chosen: dict[int, Mount] = {}
    while left:
        gains = {
            (sensor, mount): float(np.maximum(seen, views[sensor, mount]).sum())
            for sensor, mounts in left.items()
            for mount in mounts
            if mounts_suffice([[m for m in others if m != mount] for other, others in left.items() if other != sensor])
        }
        sensor, mount = max(gains, key=lambda pair: gains[pair])
        chosen[sensor] = mount
        seen = np.maximum(seen, views[sensor, mount])
        del left[sensor]
        left = {other: [m for m in mounts if m != mount] for other, mounts in left.items()}
    return chosen
