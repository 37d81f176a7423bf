"""Sensors fitted to weighted samples of the density: the first step from a density to rays.

A sensor stands at one place, unless constraints allow its rays to start all over a region (`origin.spread_m`). Where
origins are free the mixture is first fitted with them; then each sensor is fixed at the mean of its origins, and fitted
to all samples seen from there. Where constraints keep a field of view from holding all of them, sensors are fitted to
their own samples of the mixture instead, so that narrow sensors divide them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.constraints.document import Constraints, SensorRules, rules_of
from lidardesign.constraints.feasibility import BandwidthBudget, affordable_bins, check_feasible, most_rays
from lidardesign.constraints.origins import fix_origins, is_mounted, most_mounted
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.estimates import Estimate, effective_share_error
from lidardesign.limits import MOST_FITTED
from lidardesign.mixture.bounds import bounds_of, sensor_groups
from lidardesign.mixture.components import Axes, Features, log_density, responsibilities
from lidardesign.mixture.em import LEAST_SAMPLES
from lidardesign.mixture.ensemble import (
    Ensemble,
    GroupSamples,
    choose_mounts,
    fit_groups,
    heaviest_first,
    sensors_of,
)
from lidardesign.mixture.support import Retarget, Support, check_support, pin_samples, restrict_samples
from lidardesign.numerics import COARSE_SLACK, TINY, effective_count, systematic_draw
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, interval_factor
from lidardesign.task import random_generator

DEFAULT_SENSORS = 4
EM_SAMPLES = 20_000
# Of 7 fits of 10 sensors the worst is then 0.005 nats below the best on held-out samples, with 4 seeds 0.03.
RESTARTS = 12
# A field of view this near to the widest that it may have would be wider.
WIDEST = 0.999
# A cap of n bins is this share narrower, so that its width never rounds up to n + 1 bins.
BIN_MARGIN = COARSE_SLACK
MOST_REFITS = 12
ATTEMPTS = 3  # starts of a fit of which a sensor gets too little of the density
TOO_FEW = ("--sensors",)  # what then conflicts


@dataclass(frozen=True, eq=False, kw_only=True)
class FitProblem:
    """A fit of sensors to samples under constraints.

    Arguments:
        samples: Weighted samples of the learned density, at one value of its conditions.
        constraints: The constraints on the sensors.
        sensors: Their number; None takes the constraints' or the usual number.
        rays: Rays per frame; None leaves them open.
        seed: Root of the random streams.
        level: The share of each marginal that intervals hold.
        retarget: log p* of design points (N, 6), needed where an origin is fixed that the density leaves free.
        keeps_bandwidth: Whether the sensors' gates keep the bandwidth; those of chosen rays do it by themselves.
        restarts: Seeds that are tried.
        em_samples: Samples that the fit works on.
    """

    samples: Samples
    constraints: Constraints
    sensors: int | None = None
    rays: int | None = None
    seed: int = 0
    level: float = DEFAULT_LEVEL
    retarget: Retarget | None = None
    keeps_bandwidth: bool = True
    restarts: int = RESTARTS
    em_samples: int = EM_SAMPLES


@dataclass(frozen=True, eq=False)
class FittedSensors:
    """Fitted sensors and their likelihood.

    Arguments:
        sensors: In the order of the constraint file, or the heaviest first.
        log_likelihood: Weighted mean log density of the samples [nats].
        supports: The admitted samples of each group of sensors.
        rays: Rays per frame that the bandwidth allows; None leaves them open.
        notes: Lines on sensors.
    """

    sensors: tuple[Sensor, ...]
    log_likelihood: Estimate
    supports: Sequence[Support]
    rays: int | None
    notes: tuple[str, ...] = ()

    @property
    def admissible_mass(self) -> float | None:
        """The share of the density inside the constraints; None with fixed origins."""
        masses = [support.mass for support in self.supports if support.mass is not None]
        return float(max(masses)) if len(masses) == len(self.supports) else None

    @property
    def ess(self) -> float:
        """Effective share of the samples that were admitted, 0 to 1."""
        points = sum(len(support.points) for support in self.supports)
        return sum(support.effective for support in self.supports) / max(points, 1)

    def estimates(self, samples: Samples) -> dict[str, Estimate]:
        """log_likelihood, ess and where it is known admissible_mass, with their standard errors."""
        sizes = np.array([len(support.points) for support in self.supports])
        errors = np.array([effective_share_error(support.weights) for support in self.supports])
        ess = Estimate(self.ess, float(np.linalg.norm(sizes * errors)) / max(int(sizes.sum()), 1))
        estimates = {"log_likelihood": self.log_likelihood, "ess": ess}
        if self.admissible_mass is not None:
            widest = max(self.supports, key=lambda support: support.total)
            # The standard error of the share m of the density inside the constraints, of weights that sum to 1 in all
            mass, inside = widest.total, float(np.square(widest.weights).sum())
            outside = max(float(np.square(samples.weights).sum()) - inside, 0.0)
            error = math.sqrt((1 - mass) ** 2 * inside + mass**2 * outside)
            estimates["admissible_mass"] = Estimate(mass, error)
        return estimates


def fit_sensors(problem: FitProblem) -> FittedSensors:
    """Sensors that keep the constraints; each rests on at least `LEAST_SAMPLES` effective samples.

    Raises:
        ConfigError: More sensors than can be fitted, or an origin that cannot be fixed without a target density.
        InfeasibleError: Constraints that contradict each other or hold too little of the density, or a number of
            sensors of which one would rest on too few samples.
    """
    for attempt in range(ATTEMPTS - 1):
        try:
            return _fit(replace(problem, seed=problem.seed + attempt))
        except InfeasibleError as error:
            # where one sensor got too little of the density, another start may divide it better
            if error.conflicts != TOO_FEW:
                raise
    return _fit(replace(problem, seed=problem.seed + ATTEMPTS - 1))


def _fit(problem: FitProblem) -> FittedSensors:
    """Sensors from one start; see `fit_sensors`."""
    constraints, samples = problem.constraints, problem.samples
    if problem.sensors is not None and not 1 <= problem.sensors <= MOST_FITTED:
        raise ConfigError(f"{problem.sensors} sensors", where="--sensors", allowed=f"1 to {MOST_FITTED}")
    check_feasible(constraints, samples.space, sensors=problem.sensors, rays=problem.rays)
    budget, rules = BandwidthBudget.of(constraints, problem.rays), constraints.rules
    if not problem.keeps_bandwidth:
        budget = replace(budget, limit_mbps=None)
    count = _sensor_count(problem, budget)
    if is_mounted(rules):
        rules = choose_mounts(rules, samples, count, problem.retarget, problem.seed)
    supports = _supports(problem, rules, count)
    ensemble = fit_groups(_group_samples(problem, rules, supports, count), problem.seed, problem.restarts)
    loose = [index for index in range(count) if _is_loose(rules_of(rules, index), samples)]
    if loose:
        ensemble, rules, supports = _fixed(problem, rules, ensemble, loose, count)
    ensemble, rays = _within_budget(ensemble, budget)
    _check_effective(ensemble, supports)
    sensors = sensors_of(ensemble, samples.space)
    sensors = sensors if constraints.each else heaviest_first(sensors)
    return FittedSensors(sensors, _likelihood(ensemble, supports), supports, rays, ensemble.notes)


def _sensor_count(problem: FitProblem, budget: BandwidthBudget) -> int:
    """The number of sensors: as asked for, else the usual one within the constraints, none without a ray."""
    constraints, asked = problem.constraints, problem.constraints.sensors
    if problem.sensors is not None or asked.count is not None:
        return int(problem.sensors or asked.count or 1)
    low = max(asked.min or 1, len(constraints.each), 1)
    mounted = most_mounted(constraints.rules)
    limits = (asked.max, mounted, budget.rays, most_rays(constraints))
    high = min((limit for limit in limits if limit is not None), default=math.inf)
    return int(min(max(mounted or len(constraints.each) or DEFAULT_SENSORS, low), max(low, high)))


def _is_loose(rules: SensorRules, samples: Samples) -> bool:
    """True where a sensor's origin is free but without spread, so that the fit chooses its place."""
    (group,) = sensor_groups((rules,), samples.space, 1)
    free = [axis for axis in range(3) if axis in samples.space.free and group.pins[axis] is None]
    return bool(free) and rules.origin.spread_m.max is None


@phase("support")
def _supports(
    problem: FitProblem,
    rules: Sequence[SensorRules],
    count: int,
    placed: Sequence[int] = (),
    shares: np.ndarray | None = None,
) -> list[Support]:
    """The samples of each group of sensors, refused where they are too few.

    Arguments:
        problem: The fit.
        rules: Of all sensors.
        count: How many sensors there are.
        placed: Sensors whose place is the fit's own, not the constraints'.
        shares: Responsibilities of the sensors for each sample, (N, S), where they divide the samples.
    """
    supports, samples = [], problem.samples
    groups = sensor_groups(rules, samples.space, count)
    for index, group in enumerate(groups):
        is_free = all(pin is None for pin in group.pins)
        if is_free:
            support = restrict_samples(samples, rules, group)
        else:
            own = samples
            if shares is not None:
                share = shares[:, list(group.sensors)].sum(axis=1)
                own = replace(samples, log_prob=samples.log_prob - np.log(np.maximum(share, TINY)))
            generator = random_generator(problem.seed, "pinned", index)
            support = pin_samples(own, rules, group, problem.retarget, problem.em_samples, generator)
        mass = support.total if is_free else None
        if group.sensors[0] not in placed:
            check_support(support, group, mass=mass, several=len(groups) > 1)
        elif support.effective < LEAST_SAMPLES:
            raise _too_few(group.sensors[0], count, support.effective)
        supports.append(replace(support, mass=mass))
    return supports


@phase("features")
def _group_samples(
    problem: FitProblem, rules: Sequence[SensorRules], supports: Sequence[Support], count: int
) -> list[GroupSamples]:
    """Features, bounds and shares of each group of sensors.

    Pinned groups share by how much density each pinned origin sees; against groups with a free origin, whose
    measure is another, they share by numbers of sensors.
    """
    space = problem.samples.space
    groups = sensor_groups(rules, space, count)
    shares = np.array([len(group.sensors) for group in groups], dtype=np.float64) / count
    is_pinned = np.array([any(pin is not None for pin in group.pins) for group in groups])
    totals = np.array([support.total for support in supports])
    if is_pinned.any():
        shares[is_pinned] = shares[is_pinned].sum() * totals[is_pinned] / totals[is_pinned].sum()
    parts = []
    for index, (group, support) in enumerate(zip(groups, supports, strict=True)):
        points, weights = support.points, support.weights
        if len(points) > problem.em_samples:
            generator = random_generator(problem.seed, "em", index)
            chosen = systematic_draw(weights, problem.em_samples, generator)
            points, weights = points[generator.permutation(chosen)], np.ones(problem.em_samples)
        features = Features.of(points, weights, Axes.of(space, group.pins), space)
        bounds = bounds_of(rules, space, group.sensors, interval_factor(problem.level))
        parts.append(GroupSamples(group, float(shares[index]), features, bounds))
    return parts


def _fixed(
    problem: FitProblem, rules: Sequence[SensorRules], ensemble: Ensemble, loose: Sequence[int], count: int
) -> tuple[Ensemble, Sequence[SensorRules], list[Support]]:
    """A new fit with loose sensors fixed at the means of their origins, with its rules and supports."""
    sensors = sensors_of(ensemble, problem.samples.space)
    places = [tuple(map(float, sensors[index].origin_m)) if index in loose else None for index in range(count)]
    fixed = fix_origins(rules, places)
    supports = _supports(problem, fixed, count, loose)
    whole = fit_groups(_group_samples(problem, fixed, supports, count), problem.seed, problem.restarts)
    pairs = zip(whole.parts, whole.results, strict=True)
    if not any((one.mixture.spread_rad >= WIDEST * part.bounds.spread_high).any() for part, one in pairs):
        return whole, fixed, supports
    supports = _supports(problem, fixed, count, loose, _belonging(problem.samples, ensemble, count))
    return fit_groups(_group_samples(problem, fixed, supports, count), problem.seed, problem.restarts), fixed, supports


def _within_budget(ensemble: Ensemble, budget: BandwidthBudget) -> tuple[Ensemble, int | None]:
    """A fit that keeps the bandwidth, and its number of rays.

    Where it is too expensive its gates are narrowed to a common number of bins and it is continued from where it was,
    until the count of whole bins keeps the budget.

    Raises:
        InfeasibleError: Even the narrowest admitted gates exceed the budget.
    """
    widths, weights = ensemble.widths_m, ensemble.weights
    if budget.limit_mbps is None:
        return ensemble, budget.rays
    rays = budget.rays if budget.rays is not None else budget.affordable_rays(widths, weights)
    if budget.fits(widths, weights, rays):
        return ensemble, rays
    bins = affordable_bins(budget, widths, weights, rays)
    for _ in range(MOST_REFITS):
        ensemble = ensemble.narrowed((1 - BIN_MARGIN) * max(bins, 1) * budget.model.bin_m)
        widths, weights = ensemble.widths_m, ensemble.weights
        if budget.fits(widths, weights, rays):
            return ensemble, rays
        if bins <= 1:
            break
        bins = min(bins - 1, affordable_bins(budget, widths, weights, rays))
    needed = budget.mbps(widths, weights, rays)
    raise InfeasibleError(
        f"{rays} rays still need {needed:g} Mbit/s with the narrowest gates that the other constraints allow",
        conflicts=["budget.bandwidth_mbps", *budget.names],
        allowed=f"at most {budget.limit_mbps:g} Mbit/s",
        hint="fewer rays, narrower gates, or more bandwidth",
    )


def _belonging(samples: Samples, ensemble: Ensemble, count: int) -> np.ndarray:
    """Responsibilities of the sensors of a fit with free origins for each sample, (N, S)."""
    shares = np.zeros((len(samples), count))
    for part, result in zip(ensemble.parts, ensemble.results, strict=True):
        features = Features(
            samples.points, samples.weights, part.features.axes, part.features.centre, part.features.scale
        )
        shares[:, list(part.group.sensors)] = responsibilities(result.mixture, features)
    return shares


def _check_effective(ensemble: Ensemble, supports: Sequence[Support]) -> None:
    """Refuse components that rest on too few samples."""
    for part, result, support in zip(ensemble.parts, ensemble.results, supports, strict=True):
        own = responsibilities(result.mixture, part.features) * part.features.weights[:, None]
        worth = support.effective / max(effective_count(part.features.weights), 1.0)
        for sensor, weights in zip(part.group.sensors, own.T, strict=True):
            found = effective_count(weights) * min(worth, 1.0)
            if found < LEAST_SAMPLES:
                raise _too_few(sensor, len(ensemble.order), found)


def _too_few(sensor: int, count: int, found: float) -> InfeasibleError:
    return InfeasibleError(
        f"sensor {sensor} of {count} would rest on {found:.0f} effective samples",
        conflicts=TOO_FEW,
        allowed=f"at least {LEAST_SAMPLES:g}",
        hint="fewer sensors, or learn longer (--preset standard or fine)",
    )


def _likelihood(ensemble: Ensemble, supports: Sequence[Support]) -> Estimate:
    """The log-likelihood of a fit and its standard error over other samples [nats].

    Of the samples of the fit and the effective number admitted the smaller counts. The bias of fitting to the same
    samples is not included.
    """
    variance = 0.0
    for part, result, support in zip(ensemble.parts, ensemble.results, supports, strict=True):
        weights, values = part.features.weights, log_density(result.mixture, part.features)
        spread = float(weights @ np.square(values - weights @ values))
        variance += part.share**2 * spread / min(support.effective, len(values))
    return Estimate(ensemble.log_likelihood, math.sqrt(variance), "nats")
