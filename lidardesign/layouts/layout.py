"""What a layout of rays is, where its rays go, and how its sensors are fitted as components of a mixture.

The fit of sensors: their samples, their number, and the budget that they keep.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from lidardesign.constraints.document import Constraints, SensorRules
from lidardesign.constraints.feasibility import BandwidthBudget, fit_within_budget, most_rays
from lidardesign.constraints.origins import is_mounted, most_mounted
from lidardesign.errors import ConfigError
from lidardesign.estimates import Estimate
from lidardesign.layouts.track import placed
from lidardesign.mixture.bounds import bounds_of, sensor_groups
from lidardesign.mixture.components import log_density
from lidardesign.mixture.ensemble import (
    Ensemble,
    GroupSamples,
    add_couplings,
    choose_mounts,
    fit_groups,
    heaviest_first,
    sensors_of,
)
from lidardesign.mixture.features import Axes, Features
from lidardesign.mixture.support import (
    Retarget,
    Support,
    check_support,
    fixed_conditions,
    pin_samples,
    restrict_samples,
)
from lidardesign.numerics import systematic_draw
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.sensor import DesignSpec, Gates, LayoutName, Sensor, interval_factor
from lidardesign.task import random_generator

DEFAULT_SENSORS = 4


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Everything that a fit is asked for, with the defaults filled in.

    Arguments:
        samples: Weighted samples of the learned density.
        constraints: The constraint file.
        rules: What each sensor keeps: of the file, or with origins that the fit has chosen.
        budget: Rays and bandwidth.
        sensors: How many; None takes the constraints' or the usual number.
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
    sensors: int | None
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
    count = _sensor_count(request)
    if is_mounted(request.rules):
        fixed = choose_mounts(request.rules, request.samples, count, request.retarget, request.seed)
        request = replace(request, rules=fixed)
    supports = admitted_samples(request, count)
    fitted = fit_groups(group_samples(request, supports, count), request.seed, request.restarts)
    ensemble, rays = fit_within_budget(fitted, Ensemble.narrowed, lambda e: (e.widths_m, e.weights), request.budget)
    sensors = add_couplings(ensemble, sensors_of(ensemble, request.samples.space, request.level))
    sensors = sensors if request.constraints.each else heaviest_first(sensors)
    return FittedSensors(sensors, rays, ensemble, supports)


def _sensor_count(request: FitProblem) -> int:
    """The number of sensors: as asked for, else the usual one within the constraints, none without a ray."""
    constraints, asked = request.constraints, request.constraints.sensors
    if request.sensors is not None or asked.count is not None:
        return int(request.sensors or asked.count or 1)
    low = max(asked.min or 1, len(constraints.each), 1)
    mounted = most_mounted(request.rules)
    limits = (asked.max, mounted, request.budget.rays, most_rays(constraints))
    high = min((limit for limit in limits if limit is not None), default=math.inf)
    usual = mounted or len(constraints.each) or DEFAULT_SENSORS
    return int(min(max(usual, low), max(low, high)))


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


class FittedDesign(NamedTuple):
    """A design and how good it is.

    Arguments:
        design: The design.
        log_likelihood: Weighted mean log density of the samples [nats].
        supports: The samples that were admitted, of each group of sensors.
        notes: What happened to sensors, one line each.
    """

    design: DesignSpec
    log_likelihood: Estimate
    supports: Sequence[Support]
    notes: tuple[str, ...] = ()


class Layout(ABC):
    """One way to lay out rays. Every question that depends on a layout is asked here; `layout_of` finds a design's.

    Class attributes:
        name: As it stands in files and options.
        fitted_as: The layout in which sensors like a design's are fitted.
        usual_gates: Whether rays have their sensor's gate or their own, where nothing else is said.
        one_sensor_per_ray: Whether every ray is a sensor of its own: another number of rays is another fit.
        follows_from_samples: Whether rays follow from samples of the density alone; None where only gates per ray do.
        starts_at_sensors: Whether rays start where their sensor stands.
        chosen_on_scenes: Whether rays are chosen by what a task says of scenes, which takes a run.
        extends_origins: Whether rays start across their sensor's origins; then they have gates of their own, without
            samples too.
    """

    name: ClassVar[LayoutName]
    fitted_as: ClassVar[LayoutName]
    usual_gates: ClassVar[Gates] = "sensor"
    one_sensor_per_ray: ClassVar[bool] = False
    follows_from_samples: ClassVar[bool | None] = None
    starts_at_sensors: ClassVar[bool] = True
    chosen_on_scenes: ClassVar[bool] = False
    extends_origins: ClassVar[bool] = False

    def check_constraints(self, constraints: Constraints) -> None:  # noqa: B027
        """Refuse constraints that sensors of this layout cannot have.

        Raises:
            ConfigError: See above.
        """

    def fit(self, request: FitProblem) -> FittedDesign:
        """Sensors as a mixture of the samples, and their rays where the sensors alone do not say them.

        Raises:
            InfeasibleError: Constraints that hold too little of the density, or that no fit keeps.
        """
        fitted = fit_sensors(request)
        sensors = fitted.sensors
        design = DesignSpec(
            name=request.name,
            sensors=sensors,
            layout=self.name,
            rays=fitted.rays,
            constraints=request.constraints.as_document(),
            level=request.level,
            at=fixed_conditions(request.samples.space),
            gates=None if request.gates == self.usual_gates else request.gates,
        )
        if fitted.rays is not None:
            counts = split_budget(np.array([sensor.weight for sensor in sensors]), fitted.rays)
            design = replace(design, sensors=_with_rays(sensors, counts))
            if not self.leaves_rays_open(request.gates):
                here = placed(design, design.at) if design.at else design
                with phase("rays"):
                    rays = self.lay_out(here, design.rays, request.samples, request.gates, request.seed)
                table = rays.as_angles()
                counts = np.bincount(table.sensor, minlength=len(sensors))
                design = replace(design, sensors=_with_rays(sensors, counts), ray_table=table)
        score = likelihood_estimate(fitted.ensemble, fitted.supports)
        return FittedDesign(design, score, fitted.supports, fitted.ensemble.notes)

    @abstractmethod
    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """The rays of a design where it stands.

        Arguments:
            spec: The design, without a table of so many rays and without a track.
            count: Rays per frame, at least 1.
            samples: Samples of the density, at the design's conditions.
            gates: Whether every ray has its sensor's gate or its own.
            seed: For the quantisation.

        Raises:
            ConfigError: The design does not have so many rays, or they follow from samples and there are none.
        """

    def needs_samples(self, spec: DesignSpec, count: int | None, gates: Gates) -> bool:
        """Whether a number of rays, None for any but its own, follows from samples of the density alone."""
        return gates == "ray" if self.follows_from_samples is None else self.follows_from_samples

    def uses_samples(self, spec: DesignSpec, count: int | None, gates: Gates) -> bool:
        """Whether that number of rays follows from samples where there are some."""
        return self.extends_origins or self.needs_samples(spec, count, gates)

    def leaves_rays_open(self, gates: Gates | None) -> bool:
        """Whether a fit may leave the number of rays open, and keeps no table of them."""
        return False

    def own_count(self, spec: DesignSpec) -> int | None:
        """The number of rays that a design was made for; None where it leaves it open."""
        if spec.rays is not None:
            return spec.rays
        if spec.track is not None:
            return len(spec.track.sensor)
        if spec.ray_table is not None:
            return len(spec.ray_table)
        counts = [sensor.rays for sensor in spec.sensors]
        return None if None in counts else sum(count or 0 for count in counts)

    def most_count(self, spec: DesignSpec) -> int | None:
        """The most rays that a design can fire; None where it can be laid out at any number."""
        return None

    def counts(self, spec: DesignSpec) -> Sequence[int] | None:
        """The only numbers of rays that a design can fire; None where it can fire others."""
        return None


def shares_of(spec: DesignSpec, count: int) -> np.ndarray:
    """Rays per sensor: the design's own at its own number, else by weight."""
    own = [sensor.rays for sensor in spec.sensors]
    if None not in own and sum(n or 0 for n in own) == count:
        return np.array(own, dtype=np.int64)
    return split_budget(spec.weights, count)


def likelihood_estimate(ensemble: Ensemble, supports: Sequence[Support]) -> Estimate:
    """The log-likelihood of a fit and its standard error over other samples [nats].

    A fit on fewer samples than were admitted knows as much as they are worth, and one on more no more than those.
    That the sensors were fitted to these very samples is not in it.
    """
    variance = 0.0
    for part, trace, support in zip(ensemble.parts, ensemble.results, supports, strict=True):
        weights = part.features.weights
        # as long as finding the components took, where there are hundreds of them
        values = log_density(trace.mixture, part.features) if trace.values is None else trace.values
        spread = float(weights @ np.square(values - weights @ values))
        variance += part.share**2 * spread / min(support.effective, len(values))
    return Estimate(ensemble.log_likelihood, math.sqrt(variance), "nats")


def missing_samples(spec: DesignSpec, count: int, gates: Gates) -> ConfigError:
    """The error of a design whose rays follow from samples where there are none."""
    wanted = "gates per ray" if gates == "ray" else f"{count} rays in the layout `{spec.layout}`"
    return ConfigError(
        f"{wanted} need samples of the learned density, and a design file alone has none",
        where=spec.name,
        allowed=f"{len(spec.ray_table)} rays" if spec.ray_table is not None else None,
        hint=f"lidardesign fit RUN --layout {spec.layout} --rays {count}",
    )


def _with_rays(sensors: Sequence[Sensor], counts: np.ndarray) -> tuple[Sensor, ...]:
    return tuple(replace(sensor, rays=int(count)) for sensor, count in zip(sensors, counts, strict=True))
