r"""Rays along a track: where each ray looks and listens at any position between the knots.

Directions and gates are linear in between, so they are continuous, pass through the knots exactly, and keep every
bound on elevation, azimuth, start, end and width that both neighbouring knots keep: each is a convex set per ray.

Cells along a condition: where the rays of a track aim, and which samples are theirs.

Rays divide what is observed: the mean surface of the scenes, seen from the sensor, in metres. With hat functions
h_p(x) over the knots, ray n aims at $c_n(x) = \sum_p h_p(x) c_{p,n}$, and what is minimised is

$$\sum_i w_i \min_n |y_i - c_n(x_i)| + \frac{\kappa}{2} \sum_{p,n} |c_{p-1,n} - 2 c_{p,n} + c_{p+1,n}|^2,$$

y_i the surface point of a sample relative to its own origin, x_i its own condition value, w_i its importance weight
per area that faces the ray. No sample is moved or cut off, rays stay themselves, and knots where a ray sees nothing
are bridged straight. Distances count once, not squared, so that more rays go to where surfaces often are (their
density is as the root of the surface's, not the third root). Cells, then knots by their normal equations with
weights w / |y - c|, are updated in turn (Weiszfeld 1937): the sum falls with every update. It starts from Lloyd's
cells at each knot, begun at the neighbouring knot's, outward from the knot with most samples, where the best of
several seedings is taken.

Measured on warehouse shelves (40 held-out, 24 positions, rays' hits without gates), as miss rate in % with 6, 12,
18 rays, each at its global optimum: directions and squares 19.5, 15.7, 10.6; surface points and squares 20.1, 13.0,
7.7; surface points and distances, per facing area, 19.6, 11.3, 6.7; chosen greedily with the training scenes' own
boxes in hand 18.8, 9.1, 5.2.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.mixture.features import Axes, Features, ray_features
from lidardesign.mixture.quantise import lloyd
from lidardesign.mixture.support import condition_text
from lidardesign.numerics import ROUNDING, SLACK, effective_count, wrap_angle, wrap_turn
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.sensor import DesignSpec, Sensor, Track, interval_factor
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, DesignSpace, angles

# Conditions that a sensor can travel along: where a ray starts, not where it looks.
TRAVELLED = DIMENSIONS[:3]
# The bending's weight kappa relative to the pull of one ray's samples at one knot.
ROUGHNESS = 1.0
LLOYD_ITERATIONS = 15
SWEEPS = 30
# Sweeps end when one lowers the cost by less than this share.
SMALLEST_GAIN = 1e-4
STARTS = 12
# Nearer samples than this share of the mean distance pull no harder.
SMALLEST_DISTANCE = 0.01
# Mean elevations closer than this are the same row [rad].
ORDER_DECIMALS = 9
# So many distances of samples to rays are held at once.
BLOCK = 500_000
# Roughness relative to the mass of a knot that keeps the normal equations solvable where a ray sees nothing.
SMALLEST_STIFFNESS = SLACK


def placed(design: DesignSpec, at: Mapping[str, float]) -> DesignSpec:
    """The design as it is at one value of its conditions.

    A track gives its rays there, as an explicit table with one sensor per ray. Other designs are bolted onto what
    moves: the named coordinate of every origin becomes the value, and directions and gates stay.

    Arguments:
        design: Any design.
        at: Values by dimension, as {"x_m": 0.37}.

    Raises:
        ConfigError: A track without a value of its dimension, or one beyond its ends; a name that is no coordinate.
    """
    if design.track is not None:
        # The rays of a track at a position, as a scan with an explicit table
        unknown = [name for name in at if name != design.track.dimension and at[name] != design.at.get(name)]
        if unknown:
            raise ConfigError(
                f"the track of {design.name} does not follow {condition_text({unknown[0]: at[unknown[0]]})}",
                where="--at",
                allowed=design.track.dimension,
            )
        if design.track.dimension not in at:
            first, last = travels(design.track)
            raise ConfigError(
                f"{design.name} has rays for every {design.track.dimension}: say where",
                where="--at",
                allowed=f"{design.track.dimension} from {first:g} to {last:g}",
                hint=f"give --at {design.track.dimension}={(first + last) / 2:g}",
            )
        value = float(at[design.track.dimension])
        azimuth, elevation, gate = interpolated(design.track, value)
        move = {DIMENSIONS.index(design.track.dimension): value}
        means = np.array([sensor.origin_m for sensor in design.sensors], dtype=np.float64)
        table = Rays.from_angles(
            _moved(means[design.track.sensor], move), azimuth, elevation, gate, design.track.sensor
        )
        sensors = tuple(
            _turned(
                sensor, design.track, value, np.flatnonzero(design.track.sensor == index), (azimuth, elevation, gate)
            )
            for index, sensor in enumerate(design.sensors)
        )
        return replace(design, sensors=sensors, ray_table=table, track=None, at={**design.at, **at})
    moves = _moves(design, at)
    table = design.ray_table
    if table is not None:
        table = replace(table, origin_m=_moved(table.origin_m, moves))
    sensors = tuple(_bolted(sensor, moves) for sensor in design.sensors)
    return replace(design, sensors=sensors, ray_table=table, at={**design.at, **at})


def moved(rays: Rays, design: DesignSpec, at: Mapping[str, float]) -> Rays:
    """Rays of a design that is no track, with every origin's named coordinate at a value.

    Raises:
        ConfigError: A name that is no coordinate of the origin, at another value than the design's own.
    """
    return replace(rays, origin_m=_moved(rays.origin_m, _moves(design, at)))


def travelled(space: DesignSpace, layout: str) -> int:
    """The one condition that is free, which must be a coordinate of the origin, the others fixed.

    Arguments:
        space: The design space.
        layout: That needs it, for messages.

    Raises:
        ConfigError: It is not so.
    """
    names = [DIMENSIONS[index] for index in space.conditioned]
    if len(names) != 1 or names[0] not in TRAVELLED:
        raise ConfigError(
            f"no track along {', '.join(names) or 'no condition'}: a track follows one coordinate of the origin",
            where=f"--layout {layout}",
            hint="give --at " + " --at ".join(f"{name}=VALUE" for name in names) if names else None,
        )
    free = [DIMENSIONS[index] for index in range(3) if index in space.free and DIMENSIONS[index] != names[0]]
    if free:
        raise ConfigError(
            f"rays along {names[0]} start at one place beside it, but {', '.join(free)} is free",
            where=f"--layout {layout}",
            hint=f"learn with --set space.{free[0]}=VALUE, or give --at {names[0]}=VALUE",
        )
    return space.conditioned[0]


def track_of(dimension: int, knots: Sequence[float], tables: Sequence[Rays], ends: tuple[float, float]) -> Track:
    """The track of rays that are given at knots; beyond the first and last knot they stay as they are there.

    Ray n is at each knot the one that aims nearest to where it aimed at the knot before, all rays of a sensor together.

    Arguments:
        dimension: Index of the condition.
        knots: Distinct condition values, P of them.
        tables: As many rays of each sensor at each of them, in the order of their sensors.
        ends: From where to where the track leads, which holds the knots.
    """
    order = np.argsort(knots)
    rays = [tables[order[0]]]
    for place in order[1:]:
        aims = [one.direction * one.gate_m.mean(axis=1, keepdims=True) for one in (rays[-1], tables[place])]
        sensor, taken = rays[-1].sensor, []
        for index in np.unique(sensor):
            own = np.flatnonzero(sensor == index)
            taken.append(own[_assigned(aims[0][own], aims[1][own])])
        rays.append(tables[place].subset(np.concatenate(taken)))
    places = np.array(knots, dtype=np.float64)[order]
    if ends[0] < places[0]:
        places, rays = np.append(ends[0], places), [rays[0], *rays]
    if ends[1] > places[-1]:
        places, rays = np.append(places, ends[1]), [*rays, rays[-1]]
    return Track(
        dimension=DIMENSIONS[dimension],
        knots=places,
        azimuth_rad=np.unwrap(np.stack([one.azimuth_rad for one in rays]), axis=0),
        elevation_rad=np.stack([one.elevation_rad for one in rays]),
        gate_m=np.stack([one.gate_m for one in rays]),
        sensor=rays[0].sensor.astype(np.int64),
    )


def interpolated(track: Track, at: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth and elevation (N,) [rad] and gates (N, 2) [m] at one position; exactly the knot's at a knot.

    Raises:
        ConfigError: The position lies beyond the track's ends, or is no number.
    """
    first, last = travels(track)
    if not (math.isfinite(at) and first <= at <= last):
        raise ConfigError(
            f"{track.dimension}={at:g} lies beyond the ends of the track",
            where="--at",
            allowed=f"{first:g} to {last:g}",
        )
    right = int(np.clip(np.searchsorted(track.knots, at), 1, len(track.knots) - 1))
    share = (at - track.knots[right - 1]) / (track.knots[right] - track.knots[right - 1])

    def between(values: np.ndarray) -> np.ndarray:
        return (1 - share) * values[right - 1] + share * values[right]

    return between(track.azimuth_rad), between(track.elevation_rad), between(track.gate_m)


def boresight_azimuth(unrolled_rad: float) -> float:
    """An azimuth as it is written: as it stands within a turn of 0, else in [0, 2 pi) [rad]."""
    within = -2 * math.pi < unrolled_rad < 2 * math.pi
    return float(unrolled_rad if within else wrap_turn(wrap_angle(np.float64(unrolled_rad))))


def travels(track: Track) -> tuple[float, float]:
    """The ends of a track [m]."""
    return float(track.knots[0]), float(track.knots[-1])


def _turned(
    sensor: Sensor, track: Track, value: float, rays: np.ndarray, looks: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Sensor:
    """A sensor at a position; where one ray is all it fires, its boresight and gate are the ray's."""
    here = _bolted(sensor, {DIMENSIONS.index(track.dimension): value})
    if len(rays) != 1:
        return here
    azimuth, elevation, gate = (values[rays[0]] for values in looks)
    start, end = gate
    return replace(
        here,
        azimuth_rad=boresight_azimuth(azimuth),
        elevation_rad=float(elevation),
        range_m=float(start + end) / 2,
        spread_range_m=float(end - start) / (2 * interval_factor(sensor.level)),
    )


def _bolted(sensor: Sensor, moves: Mapping[int, float]) -> Sensor:
    """A sensor whose origin has these coordinates, without spread along them."""
    covariance = np.array(sensor.origin_covariance_m2, dtype=np.float64)
    for axis in moves:
        covariance[axis, :] = covariance[:, axis] = 0.0
    return replace(sensor, origin_m=_moved(sensor.origin_m, moves), origin_covariance_m2=covariance)


def _moves(design: DesignSpec, at: Mapping[str, float]) -> dict[int, float]:
    """The coordinates of origins that change. Only origins move; a design for one direction is not one for another."""
    for name, value in at.items():
        if name not in DIMENSIONS:
            raise ConfigError(
                f"{name!r} is not a dimension of the design space", where="--at", allowed=", ".join(DIMENSIONS)
            )
        if not math.isfinite(value):
            raise ConfigError(f"{name}={value}", where="--at", allowed="a finite number")
        if name not in TRAVELLED and design.at.get(name) != value:
            raise ConfigError(
                f"{design.name} cannot be moved to {name}={value:g}",
                where="--at",
                allowed=condition_text({name: design.at[name]}) if name in design.at else ", ".join(TRAVELLED),
                hint=f"lidardesign fit RUN --at {name}={value:g}",
            )
    return {DIMENSIONS.index(name): float(value) for name, value in at.items() if name in TRAVELLED}


def _moved(origin_m: np.ndarray, moves: Mapping[int, float]) -> np.ndarray:
    moved = np.array(origin_m, dtype=np.float64)
    for axis, value in moves.items():
        moved[..., axis] = value
    return moved


@dataclass(frozen=True, eq=False)
class TrackSamples:
    """Weighted samples along a condition, and the knots that they lie between.

    Arguments:
        points: Design points, shape (M, 6).
        weights: Summing to 1, shape (M,).
        left: The knot on the left of each sample, shape (M,).
        share: How far it is from there to the next knot, 0 to 1, shape (M,).
        knots: Shape (P,).
        dimension: Index of the condition.
        space: The design space.
    """

    points: np.ndarray
    weights: np.ndarray
    left: np.ndarray
    share: np.ndarray
    knots: np.ndarray
    dimension: int
    space: DesignSpace

    @classmethod
    def of(
        cls, points: np.ndarray, weights: np.ndarray, knots: np.ndarray, dimension: int, space: DesignSpace
    ) -> TrackSamples:
        """Samples with weights that need not sum to 1, none of them beyond the first or last of ascending knots."""
        values = points[:, dimension]
        left = np.clip(np.searchsorted(knots, values, side="right") - 1, 0, len(knots) - 2)
        share = np.clip((values - knots[left]) / (knots[left + 1] - knots[left]), 0.0, 1.0)
        return cls(points, weights / weights.sum(), left, share, knots, dimension, space)

    def near(self, knot: int, reach: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Samples within `reach` knots of one, and their hat function's weights times their own, shape (W,)."""
        hat = 1 - np.abs(self.left + self.share - knot) / reach
        chosen = np.flatnonzero(hat > 0)
        return chosen, self.weights[chosen] * hat[chosen]

    def between(self, values: np.ndarray, labels: np.ndarray) -> np.ndarray:
        """Knot values (P, N, ...) of each sample's ray at its own condition, shape (M, ...)."""
        share = self.share.reshape(-1, *[1] * (values.ndim - 2))
        return (1 - share) * values[self.left, labels] + share * values[self.left + 1, labels]


def aimed_rays(along: TrackSamples, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """What the rays aim at, relative to the sensor, at the knots (P, N, 3), and the ray of each sample (M,)."""
    features = Features.of(along.points, along.weights, Axes.of(along.space), along.space)
    surface = ray_features(features) - along.points[:, :3]
    power = (AZIMUTH in along.space.free) + (ELEVATION in along.space.free)
    mass = along.weights * np.linalg.norm(surface, axis=1) ** power
    weighted = replace(along, weights=mass / mass.sum())
    centres = _started(weighted, surface, count, generator)
    labels, distance = _nearest(along, surface, centres)
    nearest_m = SMALLEST_DISTANCE * float(weighted.weights @ distance)
    stiffness = ROUGHNESS / max(float(weighted.weights @ distance), ROUNDING) / (count * len(along.knots))
    cost = math.inf
    for _ in range(SWEEPS):
        before, cost = cost, _cost(weighted, distance, centres, stiffness)
        if before - cost <= SMALLEST_GAIN * cost:
            break
        pulls = weighted.weights / np.maximum(distance, max(nearest_m, ROUNDING))
        centres = _smoothed(along, surface, pulls, labels, centres, stiffness)
        labels, distance = _nearest(along, surface, centres)
    # Rays by where they look on average: an order that does not depend on the seeding
    azimuth, elevation = angles(centres.mean(axis=0))
    order = np.lexsort((azimuth, np.round(elevation, ORDER_DECIMALS)))
    return centres[:, order], np.argsort(order)[labels]


def _cost(along: TrackSamples, distance: np.ndarray, centres: np.ndarray, stiffness: float) -> float:
    """What every sweep lowers: the weighted mean distance and the cost of bends [m]."""
    bends = np.square(np.diff(centres, n=2, axis=0)).sum()
    return float(along.weights @ distance) + stiffness / 2 * float(bends)


def _started(along: TrackSamples, surface: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Lloyd's cells at each knot, each begun at its neighbour's, from the best known knot outward: (P, N, 3)."""
    near = [along.near(knot) for knot in range(len(along.knots))]
    windows = [(surface[chosen], weights) for chosen, weights in near]
    first = int(np.argmax([effective_count(weights) for _, weights in windows]))
    centres = np.empty((len(windows), count, 3))
    centres[first] = _best_start(*windows[first], count, generator)
    outward = [(knot - 1, knot) for knot in range(first + 1, len(windows))]
    outward += [(knot + 1, knot) for knot in reversed(range(first))]
    for before, knot in outward:
        points, weights = windows[knot]
        centres[knot] = centres[before]
        if len(points) > count and weights.max(initial=0.0) > 0:
            fresh, _ = lloyd(points, weights, count, generator, iterations=LLOYD_ITERATIONS, start=centres[before])
            centres[knot] = _matched(centres[before], fresh)
    return centres


def _matched(before: np.ndarray, fresh: np.ndarray) -> np.ndarray:
    """Centres (N, 3) in the order in which all of them together moved least: emptied cells may change places."""
    return fresh[_assigned(before, fresh)]


def _assigned(before: np.ndarray, fresh: np.ndarray) -> np.ndarray:
    """Which fresh point (N, 3) each point before (N, 3) becomes, so that the squares of all moves sum to the least."""
    # slow to import
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(np.square(before[:, None] - fresh[None]).sum(axis=2))[1]


def _best_start(points: np.ndarray, weights: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Lloyd's cells with the smallest sum of distances among several seedings, shape (N, 3)."""
    best, least = np.empty(0), math.inf
    for _ in range(STARTS):
        centres, labels = lloyd(points, weights, count, generator, iterations=LLOYD_ITERATIONS)
        cost = float(weights @ np.linalg.norm(points - centres[labels], axis=1))
        if cost < least:
            best, least = centres, cost
    return best


def _nearest(along: TrackSamples, surface: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ray that aims nearest to each sample at the sample's own condition, and its distance, shape (M,)."""
    labels = np.empty(len(surface), dtype=np.int64)
    order = np.argsort(along.left, kind="stable")
    starts = np.searchsorted(along.left[order], np.arange(len(along.knots)))
    size = max(BLOCK // centres.shape[1], 1)
    for knot, (first, last) in enumerate(itertools.pairwise(starts)):
        for start in range(first, last, size):
            part = order[start : min(start + size, last)]
            labels[part] = _nearest_between(surface[part], along.share[part, None], centres[knot], centres[knot + 1])
    return labels, np.linalg.norm(along.between(centres, labels) - surface, axis=1)


def _nearest_between(surface: np.ndarray, share: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The nearest ray of samples (W, 3) between two knots with aims (N, 3): |c|^2 - 2 y c decides, shape (W,)."""
    squares = np.stack([(left * left).sum(axis=1), (left * right).sum(axis=1), (right * right).sum(axis=1)])
    hats = np.concatenate([(1 - share) ** 2, 2 * share * (1 - share), share**2], axis=1)
    # one matrix product: its factors are as long as a sample's hats and points, not as the rays are many
    sides = np.concatenate([hats, -2 * (1 - share) * surface, -2 * share * surface], axis=1)
    return (sides @ np.concatenate([squares, left.T, right.T])).argmin(axis=1)


def _smoothed(
    along: TrackSamples,
    surface: np.ndarray,
    pulls: np.ndarray,
    labels: np.ndarray,
    centres: np.ndarray,
    stiffness: float,
) -> np.ndarray:
    """The knots' best aims for given cells and weights: a least-squares problem per ray, shape (P, N, 3)."""
    knots, count, _ = centres.shape
    rows, share = labels * knots + along.left, along.share
    matrix = np.zeros(count * knots * knots)
    for down, down_share in ((0, 1 - share), (1, share)):
        for across, across_share in ((0, 1 - share), (1, share)):
            place = (rows + down) * knots + along.left + across
            matrix += np.bincount(place, pulls * down_share * across_share, len(matrix))
    size = count * knots
    right = [
        np.bincount(rows, pulls * (1 - share) * column, size) + np.bincount(rows + 1, pulls * share * column, size)
        for column in surface.T
    ]
    normal = matrix.reshape(count, knots, knots)
    # a ray that sees nothing anywhere stays where it was
    still = SMALLEST_STIFFNESS * stiffness
    # The quadratic form of summed squared second differences, shape (P, P)
    second = np.diff(np.eye(knots), n=2, axis=0)
    normal += stiffness * (second.T @ second) + still * np.eye(knots)
    wanted = np.stack(right, axis=-1).reshape(count, knots, 3) + still * centres.transpose(1, 0, 2)
    return np.linalg.solve(normal, wanted).transpose(1, 0, 2)
