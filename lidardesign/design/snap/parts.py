"""Parts as components of fixed shape, and which of them may stand in for a sensor.

A part's field of view and range cannot be narrowed; only outside the design space's range, where no task has anything,
does its read-out stop. So a constraint that no part keeps is said by name.

A part is a component of its own shape (see `shapes`), where the sensor stands. One sensor after the other takes the
part with which the mixture's log-likelihood is highest, until none changes any more; then the poses are refitted with
these shapes and the sensors' own shares of the rays, which never lowers it. Where the parts lack the rays that are
asked for, or need more bandwidth than there is, sensors change to parts that help (see `fit`).

Parts as components of fixed shape: their field of view and gate are what they are, only the pose is free.

A part may be mounted upright or turned by a quarter about its boresight. A component's roll stays within an eighth of
a turn, so a part that is turned is a component whose two spreads are exchanged. What a part can see, and which of its
rays look at something, is asked of its pattern.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.catalog.library import SUFFIX, Pose, load_library
from lidardesign.design.catalog.part import Part, to_angles, to_directions
from lidardesign.design.constraints.document import SensorRules, Snap, rules_of
from lidardesign.design.mixture.bounds import Bounds, Floors
from lidardesign.design.mixture.em import CONVERGENCE_NATS, EMResult
from lidardesign.design.mixture.ensemble import Ensemble
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.m_step import maximise
from lidardesign.design.mixture.mixture import Mixture, expect, log_density
from lidardesign.design.sensor import boresight_frame, boresight_of
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK, systematic_draw
from lidardesign.run.clock import phase
from lidardesign.space import RANGE, DesignSpace, angles, observed_point
from lidardesign.task import random_generator

# A line scanner's field has no height; as a component it has this one, which a density can be fitted with.
LEAST_FIELD_RAD = math.radians(1.0)
# A ray counts as coming near what is this close to it: a line scanner's beam is as high.
LEAST_REACH_RAD = 0.005
# Rays are worth firing that see this share of what the part could see: the rest are strays.
SEEN_SHARE = 0.99
# Of so many things in view the nearest says how far from them a ray looks.
NEAR_POINTS = 400
# What bounds fix of a component that is a part.
SHAPE_BOUNDS = (
    "spread_low", "spread_high", "start_low", "start_high", "end_low", "end_high", "width_low", "width_high",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class PartShape:
    """A part in one of its two ways to be mounted.

    Arguments:
        part: The part.
        turned: Whether its horizontal angle runs along the component's vertical one.
        gate_m: The ranges that it measures inside the design space.
    """

    part: Part
    turned: bool
    gate_m: tuple[float, float]

    @property
    def field_of_view_rad(self) -> tuple[float, float]:
        """Full horizontal and vertical angles of the component."""
        horizontal, vertical = self.part.field_of_view_rad
        return (vertical, horizontal) if self.turned else (horizontal, vertical)

    def spread_rad(self, interval: float, axes: Axes) -> np.ndarray:
        """Internal standard deviations, horizontal and vertical, shape (2,)."""
        return np.maximum(self.field_of_view_rad, LEAST_FIELD_RAD) / (2 * interval * np.array([axes.angle_scale, 1.0]))

    def pose(self, origin_m: np.ndarray, azimuth_rad: float, elevation_rad: float, roll_rad: float, axes: Axes) -> Pose:
        """The part's pose where its component has an origin and a boresight: the centre of its field looks there.

        Across a plane in which the design space holds all rays, its row or column nearest to the centre looks there.
        """
        roll_rad = roll_rad + math.pi / 2 if self.turned else roll_rad
        frame = boresight_frame(*self._aimed(axes)).T @ boresight_frame(azimuth_rad, elevation_rad, roll_rad)
        return Pose(np.asarray(origin_m, dtype=np.float64), *boresight_of(frame))

    def _aimed(self, axes: Axes) -> tuple[float, float]:
        """Azimuth and elevation, in the part's frame, of what looks along the component's boresight."""
        part = self.part
        if axes.angular == 2:
            return part.centre_rad
        held = [not axes.vertical, not axes.horizontal] if self.turned else [not axes.horizontal, not axes.vertical]
        found = np.array(part.centre_rad)
        every = to_angles(part.projection, part.directions)
        for axis in np.flatnonzero(held):
            found[axis] = every[np.abs(every[:, axis] - found[axis]).argmin(), axis]
        azimuth, elevation = angles(to_directions(part.projection, found[None]))
        return float(azimuth[0]), float(elevation[0])


def gate_inside(part: Part, space: DesignSpace) -> tuple[float, float] | None:
    """The ranges of a part inside a design space's [m], its own where that has one; None where they do not meet."""
    near, far = part.range_m
    if RANGE not in space.free:
        return (near, far) if near <= space.low[RANGE] < far else None
    start, end = max(near, space.low[RANGE]), min(far, space.high[RANGE])
    return (start, end) if start < end else None


def shapes_of(part: Part, space: DesignSpace) -> list[PartShape]:
    """The ways to mount a part: none where it measures nothing inside the space, one where both angles are equal."""
    gate = gate_inside(part, space)
    if gate is None:
        return []
    horizontal, vertical = part.field_of_view_rad
    return [PartShape(part, turned, gate) for turned in ((False, True) if horizontal != vertical else (False,))]


def shaped_bounds(bounds: Bounds, shapes: Sequence[PartShape | None], axes: Axes) -> Bounds:
    """Bounds whose components have the shapes of parts and nothing else; None leaves one as it was."""
    columns = {name: np.array(getattr(bounds, name), dtype=np.float64) for name in SHAPE_BOUNDS}
    for row, shape in enumerate(shapes):
        if shape is not None:
            spread, (start, end) = shape.spread_rad(bounds.interval, axes), shape.gate_m
            values = (spread, spread, start, start, end, end, end - start, end - start)
            for name, value in zip(SHAPE_BOUNDS, values, strict=True):
                columns[name][row] = value
    return replace(bounds, **columns)


def shaped_mixture(mixture: Mixture, shapes: Sequence[PartShape | None], interval: float, axes: Axes) -> Mixture:
    """Components that stand where they stood, with the shapes of parts; None leaves one as it was."""
    spread, middle, depth = mixture.spread_rad.copy(), mixture.range_m.copy(), mixture.spread_range_m.copy()
    for row, shape in enumerate(shapes):
        if shape is not None:
            start, end = shape.gate_m
            spread[row] = shape.spread_rad(interval, axes)
            middle[row], depth[row] = (start + end) / 2, (end - start) / (2 * interval)
    return replace(mixture, spread_rad=spread, range_m=middle, spread_range_m=depth)


def in_part_view(part: Part, directions: np.ndarray) -> np.ndarray:
    """Which unit vectors in a part's frame its rays come near to, (N, 3) to bool (N,).

    Its field of view and half a cell around it: the field of a line scanner has no height.
    """
    columns, rows = part.grid
    horizontal, vertical = part.field_of_view_rad
    reach = np.maximum(np.array([horizontal / columns, vertical / rows]) / 2, LEAST_REACH_RAD)
    offset = to_angles(part.projection, directions) - np.array(part.centre_rad)
    half = np.array([horizontal, vertical]) / 2 + reach
    if part.view.shape == "ellipse":
        return np.square(offset / half).sum(axis=1) <= 1
    return (np.abs(offset) <= half).all(axis=1)


def useful_ray_filter(
    part: Part, pose: Pose, points: np.ndarray, weights: np.ndarray, *, least: int = 0
) -> Callable[[np.ndarray], np.ndarray]:
    """Which rays of a part at a pose look where scene points are: unit vectors (N, 3) of the world to bool (N,).

    The fewest that are nearest to 99 % of the weight that the part has in view; none where nothing is.

    Arguments:
        part: The part.
        pose: Where it stands.
        points: Design points that observe the scene points, shape (M, 6).
        weights: Non-negative, shape (M,).
        least: So many rays in any case, where something is in view: then those that look nearest to it, too.
    """
    offset = observed_point(points) - pose.origin_m
    range_m = np.linalg.norm(offset, axis=1)
    kept = (range_m > 0) & (weights > 0)
    looking = offset[kept] / range_m[kept, None]
    seen = in_part_view(part, looking @ pose.frame.T)
    looking, mass = looking[seen], weights[kept][seen]

    def wanted(directions: np.ndarray) -> np.ndarray:
        mask = np.zeros(len(directions), dtype=bool)
        if len(looking):
            share = np.bincount(cKDTree(directions).query(looking)[1], mass, minlength=len(directions))
            order = np.argsort(-share, kind="stable")
            enough = int(np.searchsorted(np.cumsum(share[order]), SEEN_SHARE * mass.sum())) + 1
            mask[order[:enough]] = True
            mask &= share > 0
            lacking = min(least, len(directions)) - int(mask.sum())
            if lacking > 0:
                others = np.flatnonzero(~mask)
                away = cKDTree(looking[:: -(-len(looking) // NEAR_POINTS)]).query(directions[others])[0]
                mask[others[np.argsort(away, kind="stable")[:lacking]]] = True
        return mask

    return wanted


SPACE_RANGE = "space.range_m"
BOUNDED = ("field_of_view.horizontal_deg", "field_of_view.vertical_deg", "gate.start_m", "gate.end_m", "gate.width_m")
# Parts are compared on so many samples: losses are then known to some hundredths of a nat.
COMPARED_SAMPLES = 4000
MOST_SWEEPS = 5
MOST_ROTATIONS = 50
# Zones of the multi-zone rangers that most parts of the catalogue are compared with.
USUAL_RAYS = 64
# Parts whose likelihoods differ by less are equally near: the one with more rays is taken [nats].
EQUAL_NATS = SLACK


@dataclass(frozen=True, eq=False)
class PartOptions:
    """The parts that a sensor may become.

    Arguments:
        shapes: The parts, each upright and turned where that differs; empty where the sensor stays as it is.
        lacking: Names of a smallest set of constraints that no part keeps together; empty where some do.
    """

    shapes: list[PartShape]
    lacking: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PartChoice:
    """The part of one sensor, and what the other parts would have been worth in its place.

    Arguments:
        shape: The part; None leaves the sensor as it is.
        losses: What each of its options loses beside the sensor as fitted [nats], in the order of the options.
    """

    shape: PartShape | None
    losses: tuple[float, ...] = ()


def part_options(rules: Sequence[SensorRules], space: DesignSpace, middles_m: Sequence[float]) -> list[PartOptions]:
    """What each of some sensors may become.

    Arguments:
        rules: What the sensors must keep.
        space: The design space.
        middles_m: The mean range of each sensor: a part that does not measure there is none for it.

    Raises:
        InfeasibleError: No part keeps a sensor's constraints, and it is not said that it may stay as it is.
        ConfigError: A part that is not there, or no part file.
    """
    rules = rules[: len(middles_m)]
    shapes = [
        [] if one.snap is None else [shapes for part in parts_of(one.snap) if (shapes := shapes_of(part, space))]
        for one in rules
    ]
    options, conflicts, refused = [], [], []
    for sensor, middle_m in enumerate(middles_m):
        own, kept, broken = rules_of(rules, sensor), [], []
        if own.snap is None:
            options.append(PartOptions([]))
            continue
        for one in shapes[min(sensor, len(rules) - 1)]:
            if one[0].gate_m[0] <= middle_m <= one[0].gate_m[1]:
                broken.append(_broken_keys(one[0], own))
                kept += [] if broken[-1] else one
        # the fewest constraints of which every part breaks at least one
        every = sorted(set().union(*broken))
        sizes = range(1, len(every) + 1) if broken and not kept else ()
        sets = (keys for size in sizes for keys in itertools.combinations(every, size))
        fewest = next((keys for keys in sets if all(set(keys) & found for found in broken)), ())
        lacking = () if kept else tuple(map(own.path, fewest)) or (SPACE_RANGE,)
        options.append(PartOptions(kept, lacking))
        if lacking and own.snap.otherwise == "refuse":
            conflicts += lacking
            refused.append(sensor)
    if refused:
        names = tuple(dict.fromkeys(conflicts))
        raise InfeasibleError(
            f"no part can stand in for {', '.join(f's{sensor}' for sensor in refused)} and keep {', '.join(names)}",
            conflicts=[*names, rules_of(rules, refused[0]).path("snap")],
            hint="loosen one of the constraints named, or leave such sensors as they are: --set snap.otherwise=keep",
        )
    return options


def _broken_keys(shape: PartShape, rules: SensorRules) -> set[str]:
    """Keys of the constraints that a part does not keep."""
    start, end = shape.gate_m
    values = (*(math.degrees(angle) for angle in shape.part.field_of_view_rad), start, end, end - start)
    broken = set()
    for key, value in zip(BOUNDED, values, strict=True):
        bounds = attrgetter(key)(rules)
        if bounds.min is not None and value < bounds.min * (1 - SLACK):
            broken.add(f"{key}.min")
        if bounds.max is not None and value > bounds.max * (1 + SLACK):
            broken.add(f"{key}.max")
    return broken


def parts_of(snap: Snap) -> list[Part]:
    """The parts, in all modes where none is named, that a constraint file chooses from.

    Of the whole catalogue, those of which a source says from where they measure.

    Raises:
        ConfigError: A name or path that is no part.
    """
    if snap.parts is None:
        return list(_catalogue())
    parts: dict[str, Part] = {}
    for text in snap.parts:
        # a name, or the path of a file or folder, with a mode behind it or not
        name, mode = text.rsplit(":", 1) if f"{SUFFIX}:" in text else (text, "")
        path = Path(name)
        if name.endswith(SUFFIX) or path.is_dir():
            library = load_library([path])
            files = {str(file) for file in path.glob(f"*{SUFFIX}")} if path.is_dir() else {str(path)}
            stems = [stem for stem, origin in library.origins.items() if origin in files]
        else:
            library = load_library()
            stem, _, mode = text.partition(":")
            stems = [stem]
        for stem in stems:
            parts |= {part.name: part for part in library.in_modes(stem, mode)}
    return list(parts.values())


@lru_cache(maxsize=1)
def _catalogue() -> tuple[Part, ...]:
    # kept, because patterns of hundred thousands of rays take a while
    return tuple(part for part in load_library().every_mode() if part.value("near_m") is not None)


@phase("parts")
def nearest_parts(ensemble: Ensemble, options: Sequence[PartOptions], rays: int | None, seed: int) -> list[PartChoice]:
    """The part that every sensor of an ensemble becomes, in the order of the sensors.

    Arguments:
        ensemble: The fit.
        options: What each sensor may become.
        rays: Rays of all sensors together; None counts as many as zones of a usual ranger for each.
        seed: Root of the draw of samples.
    """
    rays = USUAL_RAYS * len(options) if rays is None else rays
    choices: dict[int, PartChoice] = {}
    for index, (part, result) in enumerate(zip(ensemble.parts, ensemble.results, strict=True)):
        features = part.features
        if len(features) > COMPARED_SAMPLES:
            drawn = systematic_draw(features.weights, COMPARED_SAMPLES, random_generator(seed, "parts", index))
            drawn, times = np.unique(drawn, return_counts=True)
            features = replace(features.subset(drawn), weights=times / times.sum())
        shapes = [options[sensor].shapes for sensor in part.group.sensors]
        nearest = _nearest(result.mixture, features, shapes, part.bounds.interval, rays * part.share)
        choices |= dict(zip(part.group.sensors, nearest, strict=True))
    return [choices[sensor] for sensor in range(len(options))]


def _nearest(
    mixture: Mixture, features: Features, options: Sequence[Sequence[PartShape]], interval: float, rays: float
) -> list[PartChoice]:
    """Coordinate ascent over the shapes of a group's components, the heaviest first."""
    chosen: list[PartShape | None] = [None] * len(mixture)
    losses: list[tuple[float, ...]] = [()] * len(mixture)
    singles = [mixture.take(np.array([row])) for row in range(len(mixture))]
    log_share = [float(np.log(weight)) for weight in mixture.weights]
    # the log of each component's share times its density at every sample
    own = np.stack([log_share[row] + log_density(single, features) for row, single in enumerate(singles)])
    rows = [int(row) for row in np.argsort(-mixture.weights, kind="stable") if options[row]]
    # the same were it each of its parts, which does not depend on what the others become
    as_parts: dict[int, list[np.ndarray]] = {}
    for row in rows:
        known: dict[tuple[float, ...], np.ndarray] = {}
        as_parts[row] = []
        for shape in options[row]:
            key = (*shape.field_of_view_rad, *shape.gate_m)
            if key not in known:
                single = shaped_mixture(singles[row], [shape], interval, features.axes)
                known[key] = log_share[row] + log_density(single, features)
            # a part with fewer rays than its sensor's share of them has only as much weight as it has rays
            as_parts[row].append(
                known[key] + min(0.0, math.log(shape.part.rays / (rays * float(mixture.weights[row]))))
            )
    for _ in range(MOST_SWEEPS):
        before = list(chosen)
        for row in rows:
            others = np.delete(own, row, axis=0)
            rest = np.logaddexp.reduce(others, axis=0) if len(others) else np.full(len(features), -np.inf)
            values = np.array([features.weights @ np.logaddexp(rest, part) for part in as_parts[row]])
            if not losses[row]:
                fitted = float(features.weights @ np.logaddexp(rest, own[row]))
                losses[row] = tuple(fitted - float(value) for value in values)
            # of equally likely parts the one with most rays, then the first by name
            ranked = ((-s.part.rays, s.part.name, s.turned, index) for index, s in enumerate(options[row]))
            best = min(rank for rank in ranked if values[rank[-1]] >= values.max() - EQUAL_NATS)[-1]
            chosen[row], own[row] = options[row][best], as_parts[row][best]
        if chosen == before:
            break
    return [PartChoice(shape, loss) for shape, loss in zip(chosen, losses, strict=True)]


@phase("parts")
def fit_part_poses(ensemble: Ensemble, choices: Sequence[PartChoice], held: Sequence[bool]) -> Ensemble:
    """The ensemble with its components in the shapes of parts, their poses refitted.

    The shares of the rays stay those of the sensors: wide parts that see the same would divide them at random.

    Arguments:
        ensemble: The fit.
        choices: What each sensor becomes.
        held: Which sensors look where they did.
    """
    results = []
    for part, result in zip(ensemble.parts, ensemble.results, strict=True):
        shapes = [choices[sensor].shape for sensor in part.group.sensors]
        still = np.array([held[sensor] for sensor in part.group.sensors])
        mixture = shaped_mixture(result.mixture, shapes, part.bounds.interval, part.features.axes)
        bounds = shaped_bounds(part.bounds, shapes, part.features.axes)
        bounds = replace(
            bounds,
            azimuth_centre=np.where(still, mixture.azimuth_rad, bounds.azimuth_centre),
            azimuth_half=np.where(still, 0.0, bounds.azimuth_half),
            elevation_low=np.where(still, mixture.elevation_rad, bounds.elevation_low),
            elevation_high=np.where(still, mixture.elevation_rad, bounds.elevation_high),
        )
        results.append(replace(_rotate(mixture, part.features, bounds, still), notes=result.notes))
    return Ensemble(ensemble.parts, tuple(results))


def _rotate(mixture: Mixture, features: Features, bounds: Bounds, still: np.ndarray) -> EMResult:
    """Expectation maximisation with the shares held; some components do not roll. The likelihood never falls."""
    floors, statistics = Floors.of(features), expect(mixture, features)
    history = [statistics.log_likelihood]
    for _ in range(MOST_ROTATIONS):
        for step in (1.0, 0.0):
            moved = maximise(mixture, statistics, features, bounds, floors, step).with_weights(mixture.weights)
            # the roll has no bounds of its own
            moved = replace(moved, roll_rad=np.where(still, mixture.roll_rad, moved.roll_rad))
            outcome = expect(moved, features)
            if outcome.log_likelihood >= history[-1]:
                break
        gain = outcome.log_likelihood - history[-1]
        if not gain > 0:
            break
        mixture, statistics = moved, outcome
        history.append(outcome.log_likelihood)
        if gain < CONVERGENCE_NATS:
            break
    return EMResult(mixture, history[-1], tuple(history))
