"""Scans: every ray is a sensor of its own, with its own origin, direction and gate.

Samples are quantised into as many cells as there are rays, and each cell's mean ray is fired. What is
quantised is where rays look, never how far: with the range among the features, one ray's samples fall apart
into cells of different ranges, and its gate no longer covers how much the scenes differ there.

- Where origins are given, cells divide the directions.
- Where origins are free, many rays observe the same place, so cells divide what is observed: the point of each
  sample's ray at the mean range of the samples with like rays, which is the mean surface of the scenes.

The gate is the central level of the scene points of a cell, projected onto the ray. Measured on training
scenes as Chamfer distance, against the grid cropped to the training returns: faces at 196 rays 22.5 mm with the
range as a feature, 11.5 mm with directions (grid 12.0 mm, at twice the bandwidth); flatland at 30 rays 22.9 mm
with the range, 7.6 mm with origins and directions, 3.8 mm with the mean surface (grid 3.3 mm); faces with
origins free in a 10 cm box at 196 rays 25 mm with origins and directions, 11.3 mm with the mean surface.

Of samples with a free condition, as the position of a robot that drives by, a scan is a track: rays for every value of
it. Where they aim is said in `track`: cells of what is observed, at every value of the condition. The gate of a
ray is the central level of what its samples observe, projected onto it, over `GATE_REACH` knots on either side, inside
the constraints at every knot and therefore in between. The kernel of knot p is its hat function, so the bandwidth is
the distance of knots, and every sample counts once in all. Knots lie 0.1 m apart, over which what is seen of a scene
hardly changes, or further where fewer samples than `SAMPLES_PER_CELL` would be left for each ray of a knot.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lidardesign.constraints.document import Constraints, SensorRules
from lidardesign.constraints.feasibility import BandwidthBudget, fit_within_budget
from lidardesign.constraints.origins import free_boxes, is_mounted, origin_box
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.estimates import Estimate
from lidardesign.layouts.gates import admissible_gates, admitted_gates, central_intervals, rays_with_gates
from lidardesign.layouts.layout import (
    FitProblem,
    FittedDesign,
    Layout,
    admitted_samples,
    group_samples,
    likelihood_estimate,
    missing_samples,
    shares_of,
)
from lidardesign.layouts.track import TrackSamples, aimed_rays, boresight_azimuth, interpolated, travelled
from lidardesign.mixture.bounds import Bounds, Group, bounds_of
from lidardesign.mixture.components import Mixture, log_density
from lidardesign.mixture.em import EMResult, mixture_of_labels
from lidardesign.mixture.ensemble import Ensemble, GroupSamples, sensors_of
from lidardesign.mixture.features import Axes, Features, ray_features
from lidardesign.mixture.quantise import SAMPLES_PER_RAY, lloyd
from lidardesign.mixture.support import check_support, fixed_conditions, restrict_samples
from lidardesign.numerics import SLACK
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.sensor import DesignSpec, Gates, Sensor, Track, interval_factor
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace, angles, direction, observed_point
from lidardesign.task import random_generator

# More moves of the cells change their mean squared error by less than a percent.
LLOYD_ITERATIONS = 15
# A ray's cell of fewer samples has no shape; cells beyond that also cost more time than anybody waits.
FEWEST_PER_RAY = 4
# A track of 4.5 m has 45 spacings, whatever the division rounds to.
KNOT_SPACING_M = 0.1
# The ends of a 95 % interval are then each known from one sample in forty.
SAMPLES_PER_CELL = 40
# The gate at a knot is taken over so many knots on either side: its ends need more samples than a mean does.
GATE_REACH = 2


class ScanLayout(Layout):
    """One ray along the boresight of each sensor."""

    name = "scan"
    fitted_as = "scan"
    one_sensor_per_ray = True
    starts_at_sensors = False

    def check_constraints(self, constraints: Constraints) -> None:
        """See `Layout`."""
        if constraints.parts is not None:
            raise ConfigError(
                "every ray of a scan is a sensor of its own, and no part has a single steered ray",
                where="parts",
                hint="leave out --layout",
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

    def own_count(self, spec: DesignSpec) -> int | None:
        """See `Layout`."""
        count = super().own_count(spec)
        return len(spec.sensors) if count is None else count

    def needs_samples(self, spec: DesignSpec, count: int | None, gates: Gates) -> bool:
        """See `Layout`."""
        return gates == "ray" or count != self.own_count(spec)

    def fit(self, request: FitProblem) -> FittedDesign:
        """See `Layout`; of samples with a free condition, a track."""
        if request.samples.space.conditioned:
            return fit_track(request)
        count = request.budget.rays
        if count is None:
            raise ConfigError("a scan needs a number of rays", where="--layout scan", hint="give --rays N")
        request = replace(request, em_samples=max(request.em_samples, SAMPLES_PER_RAY * count))
        supports = admitted_samples(request, 1)
        ensemble = _fit_cells(group_samples(request, supports, 1)[0], count, request)
        order = sorted(
            sensors_of(ensemble, request.samples.space, request.level),
            key=lambda sensor: (round(sensor.elevation_rad, 9), sensor.azimuth_rad, sensor.range_m),
        )
        design = DesignSpec(
            name=request.name,
            sensors=tuple(replace(sensor, name=f"s{index}", rays=1) for index, sensor in enumerate(order)),
            layout=self.name,
            rays=count,
            constraints=request.constraints.as_document(),
            level=request.level,
            at=fixed_conditions(request.samples.space),
        )
        return FittedDesign(design, likelihood_estimate(ensemble, supports), supports, ensemble.notes)

    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """See `Layout`: at another number of rays than its own a scan has to be fitted anew, see `fit.refitted`."""
        if count != self.own_count(spec):
            raise missing_samples(spec, count, "sensor")
        own = [sensor.rays for sensor in spec.sensors]
        if count != len(own) and (None in own or sum(n or 0 for n in own) != count):
            raise ConfigError(
                f"{count} rays, but a scan of {len(spec.sensors)} sensors fires one ray of each",
                where=spec.name,
                allowed=f"{len(spec.sensors)} rays, or `rays` for every sensor",
            )
        return rays_with_gates(spec, [np.zeros((int(n), 2)) for n in shares_of(spec, count)], samples, gates)


@phase("scan")
def _fit_cells(samples: GroupSamples, count: int, request: FitProblem) -> Ensemble:
    """One component per ray, of the cells of what rays look at.

    Raises:
        ConfigError: More rays are asked for than the samples can tell apart.
    """
    features = samples.features
    if count * FEWEST_PER_RAY > len(features):
        raise ConfigError(
            f"{count} rays from {len(features)} samples",
            where="--layout scan",
            allowed=f"at most {len(features) // FEWEST_PER_RAY} rays",
            hint="learn with more samples (learning.samples)",
        )
    group = Group(samples.group.pins, tuple(range(count)))
    bounds = bounds_of(request.rules, request.samples.space, group.sensors, interval_factor(request.level))
    generator = random_generator(request.seed, "scan")
    _, labels = lloyd(ray_features(features), features.weights, count, generator, iterations=LLOYD_ITERATIONS)

    def scan(limits: Bounds) -> Ensemble:
        mixture = mixture_of_labels(features, labels, limits).with_weights(np.full(count, 1.0 / count))
        mixture = _gates_of_cells(mixture, features, labels, limits, request.level)
        values = log_density(mixture, features)
        score = float(features.weights @ values)
        result = EMResult(mixture, score, (score,), values=values)
        return Ensemble((GroupSamples(group, 1.0, features, bounds),), (result,))

    return fit_within_budget(
        scan(bounds),
        lambda _, width_m: scan(bounds.narrowed(width_m)),
        lambda e: (e.widths_m, e.weights),
        request.budget,
    )[0]


def _gates_of_cells(mixture: Mixture, features: Features, labels: np.ndarray, bounds: Bounds, level: float) -> Mixture:
    """The components with gates that hold the level of what their cells observe, along their own rays."""
    axes, count = features.axes, len(mixture)
    if not axes.range:
        return mixture
    azimuth = mixture.azimuth_rad if axes.horizontal else np.full(count, axes.azimuth_rad)
    elevation = mixture.elevation_rad if axes.vertical else np.full(count, axes.elevation_rad)
    away = observed_point(features.points) - mixture.origin_m[labels]
    along = (away * direction(azimuth, elevation)[labels]).sum(axis=1)
    wanted, effective = central_intervals(along, features.weights, labels, count, level)
    # a cell without samples repeats the heaviest one, as its other parameters do
    wanted[effective == 0] = wanted[np.bincount(labels, features.weights, minlength=count).argmax()]
    centre, spread = admissible_gates(wanted, bounds)
    return replace(mixture, range_m=centre, spread_range_m=spread)


@phase("track")
def fit_track(request: FitProblem) -> FittedDesign:
    """Rays for every value of the one condition that the samples leave free, uniform over its bounds.

    Every ray keeps the constraints at every position; a bandwidth is that of the worst position.

    Raises:
        ConfigError: The space has not just one condition that a sensor can travel along, or no number of rays.
        InfeasibleError: Constraints that hold too little of the density or that no track keeps.
    """
    samples, constraints, level, read_out = request.samples, request.constraints, request.level, request.budget
    dimension = travelled(samples.space, "scan")
    if read_out.rays is None:
        raise ConfigError("a track needs a number of rays per position", where="--layout scan", hint="give --rays N")
    group = Group((None, None, None), tuple(range(read_out.rays)))
    low, high = _track_ends(samples.space, constraints.rules[0], dimension, level)
    support = restrict_samples(samples, constraints.rules, group)
    support = replace(support, mass=support.total)
    check_support(support, group, mass=support.total, several=False)
    usual = math.ceil((high - low) / KNOT_SPACING_M - SLACK)
    affordable = int(support.effective / (read_out.rays * SAMPLES_PER_CELL))
    places = np.linspace(low, high, max(min(usual, affordable), 1) + 1)
    used = support.weights > 0
    along = TrackSamples.of(support.points[used], support.weights[used], places, dimension, samples.space)
    bounds = bounds_of(constraints.rules, samples.space, group.sensors, interval_factor(level))
    centres, labels = aimed_rays(along, read_out.rays, random_generator(request.seed, "track"))
    azimuth, elevation = _admitted(centres, along, bounds)
    track = _with_gates(along, labels, azimuth, elevation, bounds, level, read_out)
    sensors, score = _track_sensors(along, labels, track, bounds, level)
    design = DesignSpec(
        name=request.name, sensors=sensors, layout="scan", rays=read_out.rays, constraints=constraints.as_document(),
        level=level, track=track, at=fixed_conditions(samples.space),
    )  # fmt: skip
    return FittedDesign(design, score, [support])


def _track_ends(space: DesignSpace, rules: SensorRules, dimension: int, level: float) -> tuple[float, float]:
    """From where to where the rays travel: the one interval that the origin box and the excluded boxes leave [m].

    Raises:
        InfeasibleError: The constraints hold the origin still, divide its way, or keep it shorter.
    """
    name = DIMENSIONS[dimension]
    low, high = (float(end[dimension]) for end in origin_box(rules, space))
    if low < high:
        free = free_boxes(rules, space)
        pieces = sorted(zip(free.low_m[:, dimension], free.high_m[:, dimension], strict=True))
        if len(pieces) > 1:
            raise InfeasibleError(
                f"the excluded boxes divide the track into {len(pieces)} pieces",
                conflicts=["origin.exclude", "--layout scan"],
                hint=f"one of the pieces, as origin.low_m or origin.high_m with {name} "
                f"up to {pieces[0][1]:g} or from {pieces[-1][0]:g}",
            )
        low, high = max(low, pieces[0][0]), min(high, pieces[0][1])
    if not low < high:
        raise InfeasibleError(
            f"the origin is fixed at {name}={low:g}, but a track follows {name}",
            conflicts=["origin", "--layout scan"],
            hint=f"give --at {name}={low:g} instead",
        )
    limit = rules.origin.spread_m.max
    spread = (high - low) / (2 * interval_factor(level))
    if limit is not None and spread > limit:
        raise InfeasibleError(
            f"a track from {low:g} to {high:g} m has a spread of {spread:.3g} m along {name}",
            conflicts=["origin.spread_m.max", f"space.{name}"],
            allowed=f"at most {limit:g} m",
            hint="a shorter origin box, or --at",
        )
    return low, high


def _admitted(centres: np.ndarray, along: TrackSamples, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths, unrolled along the knots, and elevations inside their bounds, shape (P, N) each [rad]."""
    azimuth, elevation = angles(centres)
    space = along.space
    if ELEVATION in space.free:
        elevation = np.clip(elevation, bounds.elevation_low, bounds.elevation_high)
    else:
        elevation = np.full_like(elevation, space.low[ELEVATION])
    if AZIMUTH not in space.free:
        return np.full_like(azimuth, space.low[AZIMUTH]), elevation
    offset = azimuth - bounds.azimuth_centre
    offset -= 2 * math.pi * np.round(offset / (2 * math.pi))
    clipped = bounds.azimuth_centre + np.clip(offset, -bounds.azimuth_half, bounds.azimuth_half)
    return np.where(bounds.azimuth_half < math.pi, clipped, np.unwrap(azimuth, axis=0)), elevation


def _with_gates(
    along: TrackSamples,
    labels: np.ndarray,
    azimuth: np.ndarray,
    elevation: np.ndarray,
    bounds: Bounds,
    level: float,
    read_out: BandwidthBudget,
) -> Track:
    """The track with gates that hold the level of what each ray sees, inside bounds and within the bandwidth.

    Raises:
        InfeasibleError: Even the narrowest admitted gates exceed the bandwidth somewhere.
    """
    wanted = _wanted_gates(along, labels, azimuth, elevation, level)
    knots, count = azimuth.shape

    def track(limits: Bounds) -> Track:
        gate = np.full((knots, count, 2), along.space.low[RANGE])
        if RANGE in along.space.free:
            rows = limits.take(np.tile(np.arange(count), knots))
            gate = admitted_gates(wanted.reshape(-1, 2), rows).reshape(knots, count, 2)
        return Track(DIMENSIONS[along.dimension], along.knots, azimuth, elevation, gate, np.arange(count))

    def worst_widths(fitted: Track) -> np.ndarray:
        # at least what any position costs: the wider of two neighbouring knots, ray by ray
        width = np.diff(fitted.gate_m, axis=2)[:, :, 0]
        wider = np.maximum(width[:-1], width[1:])
        return wider[read_out.model.bins(wider).sum(axis=1).argmax()]

    return fit_within_budget(
        track(bounds),
        lambda _, width_m: track(bounds.narrowed(width_m)),
        lambda fitted: (worst_widths(fitted), np.full(count, 1.0 / count)),
        read_out,
    )[0]


def _wanted_gates(
    along: TrackSamples, labels: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray, level: float
) -> np.ndarray:
    """Central intervals of what rays observe, projected onto them, smooth along the knots: (P, N, 2) [m].

    At knots at which a ray sees nothing they follow from its other knots, or else from all rays'.
    """
    knots, count = azimuth.shape
    ray = direction(along.between(azimuth, labels), along.between(elevation, labels))
    ahead = ((observed_point(along.points) - along.points[:, :3]) * ray).sum(axis=1)
    gates = np.full((knots, count, 2), np.nan)
    for knot in range(knots):
        chosen, weights = along.near(knot, GATE_REACH)
        gates[knot], _ = central_intervals(ahead[chosen], weights, labels[chosen], count, level)
    known = np.isfinite(gates[:, :, 0])
    widest = np.nanmin(gates[:, :, 0]), np.nanmax(gates[:, :, 1])
    places = np.arange(knots)
    for own, of_ray in zip(known.T, gates.transpose(1, 2, 0), strict=True):
        for values, end in zip(of_ray, widest, strict=True):
            values[:] = np.interp(places, places[own], values[own]) if own.any() else end
    return gates


def _track_sensors(
    along: TrackSamples, labels: np.ndarray, track: Track, bounds: Bounds, level: float
) -> tuple[tuple[Sensor, ...], Estimate]:
    """One sensor per ray, the ray in the middle of its travel; the samples' log-likelihood [nats]."""
    middle = float(along.knots[0] + along.knots[-1]) / 2
    seen = [knot for knot in range(len(along.knots)) if along.near(knot)[1].sum() > 0]
    components = {knot: _components(along, labels, track, knot, bounds) for knot in seen}
    values = {knot: log_density(rays, near) for knot, (_, rays, near) in components.items()}
    score = sum(share * float(near.weights @ values[knot]) for knot, (share, _, near) in components.items())
    # a sample between two knots counts at both
    influence = np.zeros(len(along.points))
    for knot, of_knot in values.items():
        chosen, weights = along.near(knot)
        influence[chosen] += weights * (of_knot - score)
    _, mixture, features = components[min(seen, key=lambda knot: abs(along.knots[knot] - middle))]
    azimuth, elevation, gate = interpolated(track, middle)
    origin, covariance = np.array(along.space.low[:3]), np.zeros((3, 3))
    travel = along.knots[-1] - along.knots[0]
    origin[along.dimension] = middle
    covariance[along.dimension, along.dimension] = (travel / (2 * interval_factor(level))) ** 2
    axes, count = features.axes, len(track.sensor)
    sensors = tuple(
        Sensor(
            name=f"s{ray}",
            weight=1.0 / count,
            origin_m=origin,
            origin_covariance_m2=covariance,
            azimuth_rad=boresight_azimuth(azimuth[ray]),
            elevation_rad=float(elevation[ray]),
            roll_rad=float(mixture.roll_rad[ray]),
            spread_horizontal_rad=float(mixture.spread_rad[ray, 0] * axes.angle_scale) if axes.horizontal else 0.0,
            spread_vertical_rad=float(mixture.spread_rad[ray, 1]) if axes.vertical else 0.0,
            range_m=float(gate[ray].mean()),
            spread_range_m=float(gate[ray, 1] - gate[ray, 0]) / (2 * interval_factor(level)),
            level=level,
            rays=1,
        )
        for ray in range(count)
    )
    return sensors, Estimate(score, float(np.linalg.norm(influence)), "nats")


def _components(
    along: TrackSamples, labels: np.ndarray, track: Track, knot: int, bounds: Bounds
) -> tuple[float, Mixture, Features]:
    """The share of the samples near a knot, the rays there as mixture components, and these samples."""
    chosen, weights = along.near(knot)
    space = along.space.at({track.dimension: float(along.knots[knot])})
    features = Features.of(along.points[chosen], weights, Axes.of(space), space)
    count = len(track.sensor)
    mixture = mixture_of_labels(features, labels[chosen], bounds).with_weights(np.full(count, 1.0 / count))
    start, end = track.gate_m[knot].T
    mixture = replace(
        mixture,
        azimuth_rad=track.azimuth_rad[knot] if features.axes.horizontal else mixture.azimuth_rad,
        elevation_rad=track.elevation_rad[knot] if features.axes.vertical else mixture.elevation_rad,
        range_m=(start + end) / 2,
        spread_range_m=(end - start) / (2 * bounds.interval),
    )
    return float(weights.sum()), mixture, features
