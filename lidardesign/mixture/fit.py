"""From weighted samples of the density to a design that keeps its constraints, and how far its figures may be off."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lidardesign.constraints.check import ConstraintCheck, check_design
from lidardesign.constraints.document import MOST_FITTED, Constraints
from lidardesign.constraints.feasibility import BandwidthBudget, check_feasible
from lidardesign.constraints.origins import placement_notes, snap_to_space
from lidardesign.errors import ConfigError
from lidardesign.estimates import ROUNDING, Estimate, as_documents, effective_share_error
from lidardesign.layouts.layout import (
    FitProblem,
    Layout,
    missing_samples,
)
from lidardesign.layouts.rays import LAYOUTS, gates_of, lay_out, layout_of, own_count
from lidardesign.mixture.bounds import sensor_groups
from lidardesign.mixture.support import Retarget, Support, conditioned
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.sensor import DEFAULT_LEVEL, MOST_RAYS, DesignSpec, Gates, LayoutName, Sensor
from lidardesign.space import DIMENSIONS, DesignSpace

EM_SAMPLES = 20_000
# Of 7 fits of 10 sensors the worst is then 0.005 nats below the best on held-out samples, with 4 seeds 0.03.
RESTARTS = 12

# A design is asked for at many places of a track; the samples and the design decide what a refit finds.
_REFITS: WeakKeyDictionary[Samples, WeakKeyDictionary[DesignSpec, dict[tuple[int, int], DesignSpec]]]
_REFITS = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted design and how good it is.

    Arguments:
        design: The design; its provenance is for the caller to fill.
        log_likelihood: Weighted mean log density of the samples [nats]; None for real parts.
        admissible_mass: The share of the density inside the constraints; None with pinned origins.
        ess: Effective share of the samples that were admitted, 0 to 1.
        satisfied: Whether every constraint holds on the finished design.
        constraints: The independent checks.
        seconds: Wall time [s].
        notes: What happened to sensors, one line each.
        error_estimates: How far log_likelihood, ess and admissible_mass may be off, and the rays of sensors.
    """

    design: DesignSpec
    log_likelihood: float | None
    admissible_mass: float | None
    ess: float
    satisfied: bool
    constraints: list[ConstraintCheck]
    seconds: float
    notes: tuple[str, ...] = field(default=())
    error_estimates: Mapping[str, Estimate] = field(default_factory=dict)

    @classmethod
    def of_choice(cls, design: DesignSpec, constraints: Constraints, samples: Samples, seconds: float) -> FitResult:
        """A design that was chosen on scenes instead of being fitted to samples."""
        checks = check_design(design_document(design), constraints, samples.space)
        satisfied = all(check.satisfied for check in checks)
        return cls(design, None, None, samples.effective_sample_size, satisfied, checks, seconds)

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON keys; the path of the design is for the caller to fill."""
        return {
            "design": self.design.name,
            "frame": self.design.mount or "world",
            "sensors": [sensor.as_dict() for sensor in self.design.sensors],
            "log_likelihood": self.log_likelihood,
            "admissible_mass": self.admissible_mass,
            "ess": self.ess,
            "satisfied": self.satisfied,
            "constraints": [check.as_dict() for check in self.constraints],
            "seconds": self.seconds,
            "error_estimates": as_documents(self.error_estimates),
        }


def fit(
    samples: Samples,
    *,
    sensors: int | None = None,
    layout: LayoutName = "grid",
    rays: int | None = None,
    constraints: Constraints | None = None,
    seed: int = 0,
    restarts: int = RESTARTS,
    em_samples: int = EM_SAMPLES,
    level: float = DEFAULT_LEVEL,
    name: str = "design",
    gates: Gates | None = None,
    retarget: Retarget | None = None,
) -> FitResult:
    """Fit sensors to samples of the density under constraints.

    Arguments:
        samples: Weighted samples of the learned density.
        sensors: How many; None takes the constraints' or 4. A scan has one component per ray instead.
        layout: How rays are laid out.
        rays: Rays per frame; None takes the budget's.
        constraints: A checked constraint file.
        seed: Root of the random streams.
        restarts: Seeds that are tried.
        em_samples: Samples that the fit works on.
        level: The share of each marginal that intervals hold.
        name: The design's name.
        gates: Whether explicit rays have their sensor's gate or their own; None is the layout's
            usual ones.
        retarget: log p* of design points (N, 6), needed where an origin is pinned that the density leaves free.

    Raises:
        InfeasibleError: Constraints that contradict each other or hold too little of the density.
        ConfigError: Options that do not fit together.
    """
    started = time.perf_counter()
    constraints, moved = snap_to_space(Constraints() if constraints is None else constraints, samples.space)
    check_options(constraints, samples.space, sensors, LAYOUTS[layout], rays)
    request = FitProblem(
        samples=samples,
        constraints=constraints,
        rules=constraints.rules,
        budget=BandwidthBudget.of(constraints, rays),
        sensors=sensors,
        seed=seed,
        restarts=restarts,
        em_samples=em_samples,
        level=level,
        name=name,
        gates=gates or LAYOUTS[layout].usual_gates,
        retarget=retarget,
    )
    fitted = LAYOUTS[layout].fit(request)
    design, supports = fitted.design, fitted.supports
    with phase("checks"):
        checks = check_design(design_document(design), constraints, samples.space)
    masses = [support.mass for support in supports if support.mass is not None]
    return FitResult(
        design=design,
        log_likelihood=float(fitted.log_likelihood.value or 0.0),
        # unknown where an origin is pinned
        admissible_mass=float(max(masses)) if len(masses) == len(supports) else None,
        ess=sum(s.effective for s in supports) / max(sum(len(s.points) for s in supports), 1),
        satisfied=all(check.satisfied for check in checks),
        constraints=checks,
        seconds=time.perf_counter() - started,
        notes=(*moved, *placement_notes(constraints.rules), *fitted.notes),
        error_estimates=_error_estimates(fitted.log_likelihood, supports, samples, design.sensors),
    )


def check_options(
    constraints: Constraints, space: DesignSpace, sensors: int | None, layout: Layout, rays: int | None
) -> None:
    """Options against each other and against the constraints, before anything is computed."""
    if sensors is not None and not (isinstance(sensors, int) and 1 <= sensors <= MOST_FITTED):
        raise ConfigError(
            f"{sensors} sensors", where="--sensors", allowed=f"1 to {MOST_FITTED}", hint="--layout scan has one per ray"
        )
    if rays is not None and not 1 <= rays <= MOST_RAYS:
        raise ConfigError(f"{rays} rays", where="--rays", allowed=f"1 to {MOST_RAYS}")
    if space.conditioned and not layout.one_sensor_per_ray:
        names = [DIMENSIONS[index] for index in space.conditioned]
        raise ConfigError(
            f"the density has conditions ({', '.join(names)}), and only a scan has rays for all their values",
            where=f"--layout {layout.name}",
            hint=f"--layout scan, or {' '.join(f'--at {condition}=VALUE' for condition in names)}",
        )
    layout.check_constraints(constraints)
    count = None if layout.one_sensor_per_ray else sensors
    check_feasible(constraints, space, sensors=count, rays=rays)


def fit_like(
    design: DesignSpec,
    samples: Samples,
    *,
    rays: int | None,
    seed: int,
    restarts: int = RESTARTS,
    em_samples: int = EM_SAMPLES,
    name: str | None = None,
    retarget: Retarget | None = None,
) -> DesignSpec:
    """A design fitted to other samples as a given one was fitted to its own.

    Arguments:
        design: The design whose number of sensors, layout, constraints, level and gates are taken.
        samples, rays, seed, restarts, em_samples, retarget: See `fit`.
        name: The new design's name; None is that of the given one.
    """
    # beside chosen rays only a scan has rays for all values of a condition
    layout = LAYOUTS["scan"] if design.track is not None else layout_of(design)
    return fit(
        samples,
        sensors=None if layout.one_sensor_per_ray else len(design.sensors),
        layout=layout.fitted_as,
        rays=rays,
        constraints=Constraints.from_mapping(dict(design.constraints), where=f"constraints of {design.name}"),
        seed=seed,
        restarts=restarts,
        em_samples=em_samples,
        level=design.level,
        name=name or design.name,
        gates=gates_of(design),
        retarget=retarget,
    ).design


def refitted(
    design: DesignSpec,
    count: int | None,
    samples: Samples | None,
    *,
    seed: int = 0,
    at: Mapping[str, float] | None = None,
    retarget: Retarget | None = None,
) -> DesignSpec:
    """The design that fires so many rays: itself, or fitted anew where every ray is a sensor of its own.

    It keeps the design's constraints, but for the number of rays itself. Arguments are those of `lay_out`.

    Raises:
        ConfigError: There are no samples to fit to, or an origin is pinned.
    """
    if count in (None, 0) or not layout_of(design).one_sensor_per_ray or count == own_count(design):
        return design
    if samples is None:
        raise missing_samples(design, count, "sensor")
    if design.track is None and samples.space.conditioned:
        # where it was made: one refit then serves all places
        samples = conditioned(samples, {**(at or {}), **design.at}, retarget)
    fits = _REFITS.setdefault(samples, WeakKeyDictionary()).setdefault(design, {})
    if (count, seed) not in fits:
        document = {**design.constraints}
        if "budget" in document:
            document["budget"] = {key: value for key, value in document["budget"].items() if key != "rays"}
        constraints = Constraints.from_mapping(document, where=f"constraints of {design.name}")
        if any(pin is not None for group in sensor_groups(constraints.rules, samples.space, 1) for pin in group.pins):
            raise ConfigError(
                f"a scan from a pinned origin cannot be refitted to {count} rays without its target density",
                where=design.name,
                allowed=f"{own_count(design)} rays",
                hint=f"lidardesign constrain RUN --layout scan --rays {count} with the same constraints",
            )
        fits[count, seed] = fit_like(replace(design, constraints=document), samples, rays=count, seed=seed)
    return fits[count, seed]


def rays_at(
    design: DesignSpec,
    count: int,
    samples: Samples | None,
    *,
    at: Mapping[str, float] | None = None,
    retarget: Retarget | None = None,
) -> Rays:
    """The rays of a design at any number of rays, of a scan after another fit; arguments are those of `lay_out`."""
    return lay_out(refitted(design, count, samples, at=at, retarget=retarget), count, samples, at=at, retarget=retarget)


def _error_estimates(
    log_likelihood: Estimate, supports: Sequence[Support], samples: Samples, sensors: Sequence[Sensor]
) -> dict[str, Estimate]:
    """Everything that a fit reports with an error, by name.

    The admitted samples' ESS; the share of the density that they stand for where it is known; and how many of the rays
    that a sensor fires its weight would give to another one, as rays are whole, where they are not open.
    """
    sizes = np.array([len(support.points) for support in supports])
    errors = np.array([effective_share_error(support.weights) for support in supports])
    share = sum(support.effective for support in supports) / max(sizes.sum(), 1)
    ess = Estimate(share, float(np.linalg.norm(sizes * errors)) / max(int(sizes.sum()), 1))
    estimates = {"log_likelihood": log_likelihood, "ess": ess}
    if all(support.mass is not None for support in supports):
        widest = max(supports, key=lambda support: support.total)
        # The standard error of the share m of the density inside the constraints, of weights that sum to 1 in all
        mass, inside = widest.total, float(np.square(widest.weights).sum())
        outside = max(float(np.square(samples.weights).sum()) - inside, 0.0)
        estimates["admissible_mass"] = Estimate(mass, math.sqrt((1 - mass) ** 2 * inside + mass**2 * outside))
    counts = [sensor.rays for sensor in sensors]
    if None not in counts:
        rays = np.array(counts, dtype=np.float64)
        wanted = rays.sum() * np.array([sensor.weight for sensor in sensors])
        estimates["rays"] = Estimate(float(rays.sum()), float(np.abs(rays - wanted).sum() / 2), "rays", ROUNDING)
    return estimates
