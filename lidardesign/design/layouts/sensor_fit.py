"""The fit of sensors as components of a mixture: their samples, how many they are, and the budget that they keep."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidardesign.design.constraints.budget import BandwidthBudget, fit_within_budget
from lidardesign.design.constraints.document import Constraints, SensorRules
from lidardesign.design.constraints.feasibility import most_rays
from lidardesign.design.constraints.origins import is_mounted, most_mounted
from lidardesign.design.mixture.bounds import bounds_of, sensor_groups
from lidardesign.design.mixture.ensemble import (
    Ensemble,
    GroupSamples,
    add_couplings,
    choose_mounts,
    fit_groups,
    heaviest_first,
    sensors_of,
)
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.support import Retarget, Support, check_support, pin_samples, restrict_samples
from lidardesign.design.sensor import Gates, Sensor, interval_factor
from lidardesign.numerics import systematic_draw
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.task import random_generator

DEFAULT_SENSORS = 4
# `auto` tries up to this many sensors.
MOST_SENSORS = 12
# It stops after this many counts in a row that gain less than one standard error.
PATIENCE = 2
HELD_OUT_SHARE = 1 / 3


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Everything that a fit is asked for, with the defaults filled in.

    Arguments:
        samples: Weighted samples of the learned density.
        constraints: The constraint file.
        rules: What each sensor keeps: of the file, or with origins that the fit has chosen.
        budget: Rays and bandwidth.
        sensors: How many; `auto` chooses; None takes the constraints' or the usual number.
        seed: Root of the random streams.
        restarts: Seeds that are tried.
        em_samples: Samples that the fit works on.
        level: The share that intervals hold.
        name: The design's name.
        gates: Whether explicit rays have their sensor's gate or their own.
        retarget: log p* of design points (N, 6), needed where an origin is pinned that the density leaves free.
    """

    samples: Samples
    constraints: Constraints
    rules: tuple[SensorRules, ...]
    budget: BandwidthBudget
    sensors: int | str | None
    seed: int
    restarts: int
    em_samples: int
    level: float
    name: str
    gates: Gates
    retarget: Retarget | None


class FittedSensors(NamedTuple):
    """Sensors with the samples and the mixture that they follow from.

    Arguments:
        sensors: In the order of the constraint file, or the heaviest first.
        rays: Rays per frame; None leaves them open.
        ensemble: The mixture.
        supports: The admitted samples of each group of sensors.
    """

    sensors: tuple[Sensor, ...]
    rays: int | None
    ensemble: Ensemble
    supports: list[Support]


def fit_sensors(request: FitProblem) -> FittedSensors:
    """Sensors that keep the constraints and the budget."""
    counts = _sensor_counts(request)
    if is_mounted(request.rules):
        fixed, counts = choose_mounts(request.rules, request.samples, counts, request.retarget, request.seed)
        request = replace(request, rules=fixed)
    supports = admitted_samples(request, counts[-1])
    count = counts[0] if len(counts) == 1 else _best_count(request, supports, counts)
    if len(supports) != len(sensor_groups(request.rules, request.samples.space, count)):
        supports = admitted_samples(request, count)
    fitted = fit_groups(group_samples(request, supports, count), request.seed, request.restarts)
    ensemble, rays = fit_within_budget(fitted, Ensemble.narrowed, lambda e: (e.widths_m, e.weights), request.budget)
    sensors = add_couplings(ensemble, sensors_of(ensemble, request.samples.space, request.level))
    sensors = sensors if request.constraints.each else heaviest_first(sensors)
    return FittedSensors(sensors, rays, ensemble, supports)


def _sensor_counts(request: FitProblem) -> list[int]:
    """The numbers of sensors to try: one where it is said, a range for `auto`; none without a ray if that can be."""
    constraints, sensors = request.constraints, request.sensors
    asked = constraints.sensors
    if isinstance(sensors, int) or asked.count is not None:
        return [sensors if isinstance(sensors, int) else int(asked.count or 1)]
    low = max(asked.min or 1, len(constraints.each), 1)
    mounted = most_mounted(request.rules)
    high = max(MOST_SENSORS, mounted or 0) if asked.max is None else asked.max
    for limit in (mounted, request.budget.rays, most_rays(constraints)):
        high = high if limit is None else min(high, limit)
    if sensors == "auto":
        return list(range(low, max(low, high) + 1))
    usual = mounted or len(constraints.each) or DEFAULT_SENSORS
    return [min(max(usual, low), max(low, high))]


@phase("support")
def admitted_samples(request: FitProblem, count: int) -> list[Support]:
    """The samples of each group of sensors, refused where they are too few."""
    supports = []
    members = sensor_groups(request.rules, request.samples.space, count)
    for index, group in enumerate(members):
        free = all(pin is None for pin in group.pins)
        if free:
            support = restrict_samples(request.samples, request.rules, group)
        else:
            generator = random_generator(request.seed, "pinned", index)
            support = pin_samples(
                request.samples, request.rules, group, request.retarget, request.em_samples, generator
            )
        mass = support.total if free else None
        check_support(support, group, mass=mass, several=len(members) > 1)
        supports.append(replace(support, mass=mass))
    return supports


@phase("features")
def group_samples(request: FitProblem, supports: list[Support], count: int) -> list[GroupSamples]:
    """Features, bounds and shares of each group of sensors.

    Pinned groups share by how much density each pinned origin sees; against groups with a free origin, whose
    measure is another, they share by numbers of sensors.
    """
    space = request.samples.space
    members = sensor_groups(request.rules, space, count)
    shares = np.array([len(group.sensors) for group in members], dtype=np.float64) / count
    is_pinned = np.array([any(pin is not None for pin in group.pins) for group in members])
    totals = np.array([support.total for support in supports])
    if is_pinned.any():
        shares[is_pinned] = shares[is_pinned].sum() * totals[is_pinned] / totals[is_pinned].sum()
    parts = []
    for index, (group, support) in enumerate(zip(members, supports, strict=True)):
        points, weights = support.points, support.weights
        if len(points) > request.em_samples:
            generator = random_generator(request.seed, "em", index)
            chosen = systematic_draw(weights, request.em_samples, generator)
            points, weights = points[generator.permutation(chosen)], np.ones(request.em_samples)
        features = Features.of(points, weights, Axes.of(space, group.pins), space)
        bounds = bounds_of(request.rules, space, group.sensors, interval_factor(request.level))
        parts.append(GroupSamples(group, float(shares[index]), features, bounds))
    return parts


def _best_count(request: FitProblem, supports: list[Support], counts: list[int]) -> int:
    """The smallest number of sensors within one standard error of the best held-out log-likelihood."""
    scores: dict[int, tuple[float, float]] = {}
    waiting, best = 0, -math.inf
    for count in counts:
        if len(sensor_groups(request.rules, request.samples.space, count)) != len(supports):
            continue
        train, test = [], []
        for index, part in enumerate(group_samples(request, supports, count)):
            draw = random_generator(request.seed, "held out", index).uniform(size=len(part.features))
            train.append(replace(part, features=part.features.subset(draw >= HELD_OUT_SHARE)))
            test.append(replace(part, features=part.features.subset(draw < HELD_OUT_SHARE)))
        mean, error = fit_groups(train, request.seed, request.restarts).held_out(test)
        scores[count] = mean, error
        waiting = 0 if mean > best + error else waiting + 1
        best = max(best, mean)
        if waiting >= PATIENCE:
            break
    top = max(scores, key=lambda count: scores[count][0])
    return min(count for count, (mean, _) in scores.items() if mean >= scores[top][0] - scores[top][1])
