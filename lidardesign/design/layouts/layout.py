"""What a layout of rays is: how its sensors are fitted, and where their rays go."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lidardesign.design.bandwidth import split_budget
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.sensor_fit import FitProblem, fit_sensors
from lidardesign.design.layouts.track import placed
from lidardesign.design.mixture.ensemble import Ensemble
from lidardesign.design.mixture.mixture import log_density
from lidardesign.design.mixture.support import Support, fixed_conditions
from lidardesign.design.sensor import DesignSpec, Gates, LayoutName, Sensor
from lidardesign.errors import ConfigError
from lidardesign.estimates import Estimate
from lidardesign.geometry.rays import Rays
from lidardesign.run.clock import phase
from lidardesign.samples import Samples


class FittedDesign(NamedTuple):
    """A design and how good it is.

    Arguments:
        design: The design.
        log_likelihood: Weighted mean log density of the samples [nats].
        supports: The samples that were admitted, of each group of sensors.
        notes: What happened to sensors, one line each.
        snap: What sensors lost that became parts, as plain values; None where none did.
    """

    design: DesignSpec
    log_likelihood: Estimate
    supports: Sequence[Support]
    notes: tuple[str, ...] = ()
    snap: Mapping[str, Any] | None = None


class Layout(ABC):
    """One way to lay out rays. Every question that depends on a layout is asked here; `layout_of` finds a design's.

    Class attributes:
        name: As it stands in files and options.
        fitted_as: The layout in which sensors like a design's are fitted.
        usual_gates: Whether rays have their sensor's gate or their own, where nothing else is said.
        one_sensor_per_ray: Whether every ray is a sensor of its own: another number of rays is another fit.
        follows_from_sensors: Whether the sensors alone say where rays go.
        starts_at_sensors: Whether rays start where their sensor stands.
        extends_origins: Whether rays start across their sensor's origins; then they have gates of their own, without
            samples too.
    """

    name: ClassVar[LayoutName]
    fitted_as: ClassVar[LayoutName]
    usual_gates: ClassVar[Gates] = "sensor"
    one_sensor_per_ray: ClassVar[bool] = False
    follows_from_sensors: ClassVar[bool] = True
    starts_at_sensors: ClassVar[bool] = True
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
                table = self._ray_table(design, request)
                counts = np.bincount(table.sensor, minlength=len(sensors))
                design = replace(design, sensors=_with_rays(sensors, counts), ray_table=table)
        score = likelihood_estimate(fitted.ensemble, fitted.supports)
        return FittedDesign(design, score, fitted.supports, fitted.ensemble.notes)

    @phase("rays")
    def _ray_table(self, design: DesignSpec, request: FitProblem) -> Rays:
        here = placed(design, design.at) if design.at else design
        return self.lay_out(here, design.rays, request.samples, request.gates, request.seed).as_angles()

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
        return gates == "ray"

    def uses_samples(self, spec: DesignSpec, count: int | None, gates: Gates) -> bool:
        """Whether that number of rays follows from samples where there are some."""
        return self.needs_samples(spec, count, gates)

    def leaves_rays_open(self, gates: Gates | None) -> bool:
        """Whether a fit may leave the number of rays open, and keeps no table of them."""
        return False

    def own_count(self, spec: DesignSpec) -> int | None:
        """The number of rays that a design was made for; None where it leaves it open."""
        if spec.rays is not None:
            return spec.rays
        if spec.ray_table is not None:
            return len(spec.ray_table)
        counts = [sensor.rays for sensor in spec.sensors]
        return None if None in counts else sum(count or 0 for count in counts)

    def most_count(self, spec: DesignSpec) -> int | None:
        """The most rays that a design can fire; None where it can be laid out at any number."""
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
