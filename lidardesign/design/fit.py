"""From weighted samples of the density to a design that keeps its constraints."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lidardesign.design.bandwidth import split_budget
from lidardesign.design.constraints.budget import BandwidthBudget, fit_within_budget
from lidardesign.design.constraints.check import ConstraintCheck, check_design
from lidardesign.design.constraints.document import MOST_FITTED, Constraints, SensorRules
from lidardesign.design.constraints.feasibility import check_feasible, most_rays
from lidardesign.design.constraints.origins import is_mounted, most_mounted, placement_notes, snap_to_space
from lidardesign.design.fit_result import FitResult, fit_estimates, likelihood_error
from lidardesign.design.layouts.quantise import SAMPLES_PER_RAY
from lidardesign.design.layouts.rays import Gates, make_ray_table, own_gates
from lidardesign.design.layouts.scan import fit_scan, rays_of
from lidardesign.design.layouts.track_fit import fit_track
from lidardesign.design.mixture.bounds import bounds_of, groups
from lidardesign.design.mixture.conditions import fixed_conditions
from lidardesign.design.mixture.coupling import add_couplings
from lidardesign.design.mixture.ensemble import (
    Ensemble,
    GroupSamples,
    choose_mounts,
    fit_parts,
    heaviest_first,
    sensors_of,
)
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.support import Retarget, Support, check_support, pin_samples, restrict_samples
from lidardesign.design.sensor import DEFAULT_LEVEL, MOST_RAYS, DesignSpec, Layout, Sensor, interval_factor
from lidardesign.design.snap.fit import SnappedDesign, fix_part_origins, snap_design
from lidardesign.design.snap.parts import wants_parts
from lidardesign.errors import ConfigError
from lidardesign.estimates import Estimate
from lidardesign.numerics import systematic_draw
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.space import DIMENSIONS
from lidardesign.task import random_generator

DEFAULT_SENSORS = 4
EM_SAMPLES = 20_000
# Of 7 fits of 10 sensors the worst is then 0.005 nats below the best on held-out samples, with 4 seeds 0.03.
RESTARTS = 12
# `auto` tries up to this many sensors.
MOST_SENSORS = 12
ONE_PLACE = "every part is at one place: sensors were fixed at the middle of their origins, and fitted anew there"
# It stops after this many counts in a row that gain less than one standard error.
PATIENCE = 2
HELD_OUT_SHARE = 1 / 3


@dataclass(frozen=True)
class _Request:
    """Everything that `fit` was asked for, with the defaults filled in."""

    samples: Samples
    constraints: Constraints
    rules: tuple[SensorRules, ...]
    seed: int
    restarts: int
    em_samples: int
    level: float
    retarget: Retarget | None

    @property
    def interval(self) -> float:
        """z, half an interval in standard deviations."""
        return interval_factor(self.level)


def fit(
    samples: Samples,
    *,
    sensors: int | Literal["auto"] | None = None,
    layout: Layout = "grid",
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
        sensors: How many; `auto` chooses by held-out likelihood; None takes the constraints' or 4. A scan has
            one component per ray instead.
        layout: How rays are laid out.
        rays: Rays per frame; None takes the budget's.
        constraints: A checked constraint file.
        seed: Root of the random streams.
        restarts: Seeds that are tried.
        em_samples: Samples that the fit works on.
        level: The share of each marginal that intervals hold.
        name: The design's name.
        gates: Whether explicit rays have their sensor's gate or their own; None is `own_gates` of the layout.
        retarget: log p* of design points (N, 6), needed where an origin is pinned that the density leaves free.

    Raises:
        InfeasibleError: Constraints that contradict each other or hold too little of the density.
        ConfigError: Options that do not fit together.
    """
    started = time.perf_counter()
    constraints, moved = snap_to_space(Constraints() if constraints is None else constraints, samples.space)
    _check_options(constraints, samples, sensors, layout, rays)
    if samples.space.conditioned:
        return _along_condition(samples, constraints, rays, level, seed, name)
    request = _Request(samples, constraints, constraints.rules, seed, restarts, em_samples, level, retarget)
    read_out = BandwidthBudget.of(constraints, rays)
    supports, ensemble, design, snap = _made(request, read_out, sensors, layout, gates or own_gates(layout), name)
    checks = _checked(design, constraints, samples)
    score = Estimate(ensemble.log_likelihood, likelihood_error(ensemble, supports), "nats")
    return FitResult(
        design=design,
        log_likelihood=score.value,
        admissible_mass=_mass(supports),
        ess=sum(s.effective for s in supports) / max(sum(len(s.points) for s in supports), 1),
        satisfied=all(check.satisfied for check in checks),
        constraints=checks,
        seconds=time.perf_counter() - started,
        notes=(*moved, *placement_notes(constraints.rules), *ensemble.notes, *(snap.notes if snap else ())),
        error_estimates=fit_estimates(score, supports, samples, design.sensors),
        snap=snap.report if snap else None,
    )


def _along_condition(
    samples: Samples, constraints: Constraints, rays: int | None, level: float, seed: int, name: str
) -> FitResult:
    """A track: the rays of a scan for every value of the samples' condition."""
    started = time.perf_counter()
    fitted = fit_track(samples, rays=rays, constraints=constraints, level=level, seed=seed, name=name)
    checks = _checked(fitted.design, constraints, samples)
    score = Estimate(fitted.log_likelihood, fitted.log_likelihood_error, "nats")
    return FitResult(
        design=fitted.design,
        log_likelihood=fitted.log_likelihood,
        admissible_mass=fitted.admissible_mass,
        ess=fitted.ess,
        satisfied=all(check.satisfied for check in checks),
        constraints=checks,
        seconds=time.perf_counter() - started,
        notes=placement_notes(constraints.rules),
        error_estimates=fit_estimates(score, [fitted.support], samples, fitted.design.sensors),
    )


@phase("checks")
def _checked(design: DesignSpec, constraints: Constraints, samples: Samples) -> list[ConstraintCheck]:
    return check_design(_document(design), constraints, samples.space)


def _solved(
    request: _Request, read_out: BandwidthBudget, sensors: int | str | None, layout: Layout
) -> tuple[list[Support], tuple[Sensor, ...], int | None, Ensemble]:
    """Samples, sensors, rays per frame, and the fit that keeps its budget."""
    space = request.samples.space
    if layout == "scan":
        request = replace(request, em_samples=max(request.em_samples, SAMPLES_PER_RAY * rays_of(read_out)))
        supports = _supports(request, 1)
        part = _features(request, supports, 1)[0]
        beams, fit = fit_scan(part.features, space, request.rules, part.group, read_out, request.level, request.seed)
        return supports, beams, len(beams), fit
    supports, ensemble = _fitted(request, sensors, read_out.rays)
    ensemble, total = fit_within_budget(ensemble, Ensemble.narrowed, lambda e: (e.widths_m, e.weights), read_out)
    fitted = add_couplings(ensemble, sensors_of(ensemble, space, request.level))
    if len(request.rules) == 1:
        fitted = heaviest_first(fitted)
    return supports, fitted, total, ensemble


def _made(
    request: _Request, read_out: BandwidthBudget, sensors: int | str | None, layout: Layout, gates: Gates, name: str
) -> tuple[list[Support], Ensemble, DesignSpec, SnappedDesign | None]:
    """Samples, what was fitted to them, and the design that it stands for."""
    if wants_parts(request.rules):
        supports, snap = _snapped(request, read_out, sensors, name)
        return supports, snap.ensemble, snap.design, snap
    if layout == "density" and gates == "ray" and read_out.rays is not None:
        # the gates of rays keep the budget, not those of sensors
        read_out = replace(read_out, limit_mbps=None)
    supports, fitted, total, ensemble = _solved(request, read_out, sensors, layout)
    return supports, ensemble, _design(fitted, layout, total, request, name, gates), None


def _snapped(
    request: _Request, read_out: BandwidthBudget, sensors: int | str | None, name: str
) -> tuple[list[Support], SnappedDesign]:
    """Samples, and the design of the parts that sensors become."""
    constraints, space = request.constraints, request.samples.space
    # the parts have gates of their own: the budget is theirs
    free = replace(read_out, limit_mbps=None, rays=None)
    supports, fitted, _, ensemble = _solved(request, free, sensors, "grid")
    fixed = fix_part_origins(request.rules, fitted)
    if fixed is not None:
        supports, fitted, _, ensemble = _solved(replace(request, rules=fixed), free, len(fitted), "grid")
    parts = snap_design(ensemble, constraints, space, read_out, level=request.level, seed=request.seed, name=name)
    moved = () if fixed is None else (ONE_PLACE,)
    design = replace(parts.design, at=fixed_conditions(space))
    return supports, replace(parts, design=design, notes=(*moved, *parts.notes))


def _check_options(
    constraints: Constraints, samples: Samples, sensors: int | str | None, layout: str, rays: int | None
) -> None:
    """Options against each other and against the constraints, before anything is computed."""
    if layout == "fixed":
        raise ConfigError("the rays of real parts cannot be fitted", where="--layout fixed", hint="--layout grid")
    if isinstance(sensors, str) and sensors != "auto":
        raise ConfigError(f"{sensors!r} sensors", where="--sensors", allowed="a whole number, or auto")
    if isinstance(sensors, int) and not 1 <= sensors <= MOST_FITTED:
        raise ConfigError(
            f"{sensors} sensors", where="--sensors", allowed=f"1 to {MOST_FITTED}", hint="--layout scan has one per ray"
        )
    if rays is not None and not 1 <= rays <= MOST_RAYS:
        raise ConfigError(f"{rays} rays", where="--rays", allowed=f"1 to {MOST_RAYS}")
    if samples.space.conditioned and layout != "scan":
        names = [DIMENSIONS[index] for index in samples.space.conditioned]
        raise ConfigError(
            f"the density has conditions ({', '.join(names)}), and only a scan has rays for all their values",
            where=f"--layout {layout}",
            hint=f"--layout scan, or {' '.join(f'--at {condition}=VALUE' for condition in names)}",
        )
    if layout == "scan":
        if wants_parts(constraints.rules):
            raise ConfigError(
                "every ray of a scan is a sensor of its own, and no part has a single steered ray",
                where="snap",
                hint="--layout grid --sensors N",
            )
        if is_mounted(constraints.rules):
            raise ConfigError(
                "the rays of a scan have origins of their own",
                where="--layout scan",
                hint="remove origin.mounts_m, or choose the layout density",
            )
        if constraints.each or any(v is not None for v in constraints.sensors.model_dump().values()):
            raise ConfigError(
                "every ray of a scan is a component of its own",
                where="--layout scan",
                hint="remove sensors and each from the constraints",
            )
        check_feasible(constraints, samples.space, rays=rays)
        return
    count = sensors if isinstance(sensors, int) else None
    check_feasible(constraints, samples.space, sensors=count, rays=rays)


def _sensor_counts(constraints: Constraints, sensors: int | str | None, rays: int | None) -> list[int]:
    """The numbers of sensors to try: one where it is said, a range for `auto`; none without a ray if that can be."""
    asked = constraints.sensors
    if isinstance(sensors, int) or asked.count is not None:
        return [sensors if isinstance(sensors, int) else int(asked.count or 1)]
    low = max(asked.min or 1, len(constraints.each), 1)
    mounted = most_mounted(constraints.rules)
    high = max(MOST_SENSORS, mounted or 0) if asked.max is None else asked.max
    for limit in (mounted, rays, most_rays(constraints)):
        high = high if limit is None else min(high, limit)
    if sensors == "auto":
        return list(range(low, max(low, high) + 1))
    usual = mounted or len(constraints.each) or DEFAULT_SENSORS
    return [min(max(usual, low), max(low, high))]


def _fitted(request: _Request, sensors: int | str | None, rays: int | None) -> tuple[list[Support], Ensemble]:
    counts = _sensor_counts(request.constraints, sensors, rays)
    if is_mounted(request.rules):
        fixed, counts = choose_mounts(request.rules, request.samples, counts, request.retarget, request.seed)
        request = replace(request, rules=fixed)
    supports = _supports(request, counts[-1])
    count = counts[0] if len(counts) == 1 else _chosen_count(request, supports, counts)
    kept = supports if len(supports) == len(groups(request.rules, request.samples.space, count)) else None
    supports = kept or _supports(request, count)
    return supports, fit_parts(_features(request, supports, count), request.seed, request.restarts)


@phase("support")
def _supports(request: _Request, count: int) -> list[Support]:
    """The samples of each group of sensors, refused where they are too few."""
    found = []
    members = groups(request.rules, request.samples.space, count)
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
        found.append(replace(support, mass=mass))
    return found


def _mass(supports: list[Support]) -> float | None:
    """The share of the density that the sensors may draw on; unknown where an origin is pinned."""
    masses = [support.mass for support in supports]
    return None if any(mass is None for mass in masses) else float(max(m for m in masses if m is not None))


@phase("features")
def _features(request: _Request, supports: list[Support], count: int) -> list[GroupSamples]:
    """Features, bounds and shares of each group of sensors.

    Pinned groups share by how much density each pinned origin sees; against groups with a free origin, whose
    measure is another, they share by numbers of sensors.
    """
    space = request.samples.space
    members = groups(request.rules, space, count)
    shares = np.array([len(group.sensors) for group in members], dtype=np.float64) / count
    is_pinned = np.array([any(pin is not None for pin in group.pins) for group in members])
    totals = np.array([support.total for support in supports])
    if is_pinned.any():
        shares[is_pinned] = shares[is_pinned].sum() * totals[is_pinned] / totals[is_pinned].sum()
    parts = []
    for index, (group, support) in enumerate(zip(members, supports, strict=True)):
        points, weights = _thinned(support, request.em_samples, random_generator(request.seed, "em", index))
        features = Features.of(points, weights, Axes.of(space, group.pins), space)
        bounds = bounds_of(request.rules, space, group.sensors, request.interval)
        parts.append(GroupSamples(group, float(shares[index]), features, bounds))
    return parts


def _thinned(support: Support, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` samples: systematic resampling to equal weights where there are more."""
    if len(support.points) <= count:
        return support.points, support.weights
    chosen = systematic_draw(support.weights, count, generator)
    return support.points[generator.permutation(chosen)], np.ones(count)


def _chosen_count(request: _Request, supports: list[Support], counts: list[int]) -> int:
    """The smallest number of sensors within one standard error of the best held-out log-likelihood."""
    scores: dict[int, tuple[float, float]] = {}
    waiting, best = 0, -math.inf
    for count in counts:
        if len(groups(request.rules, request.samples.space, count)) != len(supports):
            continue
        train, test = _split(_features(request, supports, count), request.seed)
        mean, error = fit_parts(train, request.seed, request.restarts).held_out(test)
        scores[count] = mean, error
        waiting = 0 if mean > best + error else waiting + 1
        best = max(best, mean)
        if waiting >= PATIENCE:
            break
    top = max(scores, key=lambda count: scores[count][0])
    return min(count for count, (mean, _) in scores.items() if mean >= scores[top][0] - scores[top][1])


def _split(parts: list[GroupSamples], seed: int) -> tuple[list[GroupSamples], list[GroupSamples]]:
    """Samples for fitting and for judging, apart."""
    train, test = [], []
    for index, part in enumerate(parts):
        draw = random_generator(seed, "held out", index).uniform(size=len(part.features))
        held = draw < HELD_OUT_SHARE
        train.append(replace(part, features=part.features.subset(~held)))
        test.append(replace(part, features=part.features.subset(held)))
    return train, test


def _design(
    sensors: tuple[Sensor, ...],
    layout: Layout,
    total: int | None,
    request: _Request,
    name: str,
    gates: Gates,
) -> DesignSpec:
    if total is not None:
        counts = split_budget(np.array([s.weight for s in sensors]), total)
        sensors = tuple(replace(s, rays=int(n)) for s, n in zip(sensors, counts, strict=True))
    design = DesignSpec(
        name=name,
        sensors=sensors,
        layout=layout,
        rays=total,
        constraints=request.constraints.as_document(),
        level=request.level,
        at=fixed_conditions(request.samples.space),
    )
    if total is None or (layout == "grid" and gates == "sensor"):
        return design
    if layout == "scan":
        return design
    table = make_ray_table(design, total, request.samples, gates, seed=request.seed)
    counts = np.bincount(table.sensor, minlength=len(sensors))
    sensors = tuple(replace(s, rays=int(n)) for s, n in zip(sensors, counts, strict=True))
    return replace(design, sensors=sensors, ray_table=table)


def _document(design: DesignSpec) -> dict[str, Any]:
    """The written form that the checker reads."""
    # files reads and writes all formats; only its document is needed here
    from lidardesign.design.files import design_document

    return design_document(design)
