"""A pattern: the rays that a design fires for one number of rays, at one place or along a condition; and even rays.

Along a condition, as the position of a robot, a pattern is given at knots. Ray n is the same ray at all of them; in
between its origin, its angles and its gate are linear. So it passes through the knots exactly, and keeps every bound
on elevation, azimuth, start, end and width that both neighbouring knots keep: each is a convex set per ray.

Even rays are a cell-centred grid of any number in a field of view, points that fill a cube, or subsets of points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.sensors.sensor import Sensor, tangent_directions
from lidardesign.space import DIMENSIONS, angles, direction

# Conditions that a sensor can travel along: where a ray starts, not where it looks.
TRAVELLED = DIMENSIONS[:3]
# Of low-discrepancy points on one and two axes: the golden ratio and the plastic number.
ROOTS = (1.618033988749895, 1.324717957244746)


@dataclass(frozen=True, eq=False)
class Pattern:
    """The rays of a design at the knots of a condition, in the order in which they fire; one knot without a condition.

    Arguments:
        origin_m: Origins of rays [m], shape (P, N, 3).
        azimuth_rad, elevation_rad: Their directions, shape (P, N); azimuths are unrolled along the knots.
        gate_m: Start and end of their gates [m], shape (P, N, 2).
        sensor: The index of the sensor of each ray, shape (N,).
        dimension: The condition, as "x_m"; None without one.
        knots: Its values at the knots, ascending, shape (P,); none without a condition.
    """

    origin_m: np.ndarray
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    gate_m: np.ndarray
    sensor: np.ndarray
    dimension: str | None = None
    knots: tuple[float, ...] = ()

    @classmethod
    def of(cls, rays: Rays) -> Pattern:
        """The pattern of a list of rays."""
        return cls.stacked([rays])

    @classmethod
    def stacked(cls, lists: Sequence[Rays], dimension: str | None = None, knots: Sequence[float] = ()) -> Pattern:
        """The pattern of lists of rays at ascending knots as they are: ray n need not be one ray at all of them."""
        names = ("origin_m", "azimuth_rad", "elevation_rad", "gate_m")
        columns = (np.stack([getattr(rays, name) for rays in lists]) for name in names)
        return cls(*columns, lists[0].sensor, dimension, tuple(map(float, knots)))

    @classmethod
    def along(cls, dimension: str, knots: Sequence[float], lists: Sequence[Rays], ends: tuple[float, float]) -> Pattern:
        """The pattern of lists of rays at knots; beyond the first and last knot rays are constant.

        Rays of neighbouring knots are matched, sensor by sensor, by the least sum of squared distances of aims.

        Arguments:
            dimension: The condition.
            knots: Distinct values of it, P of them.
            lists: The rays at each knot, equal numbers of each sensor.
            ends: First and last value of the pattern, which enclose the knots.
        """
        # slow to import
        from scipy.optimize import linear_sum_assignment

        first, *others = (lists[place] for place in np.argsort(knots))
        rays, places = [first], sorted(map(float, knots))
        for other in others:
            here, there = (one.direction * one.gate_m.mean(axis=1, keepdims=True) for one in (rays[-1], other))
            taken = np.empty(len(first), dtype=np.intp)
            for sensor in np.unique(first.sensor):
                mine, theirs = np.flatnonzero(first.sensor == sensor), np.flatnonzero(other.sensor == sensor)
                moves = np.square(here[mine][:, None] - there[theirs]).sum(axis=2)
                taken[mine] = theirs[linear_sum_assignment(moves)[1]]
            rays.append(other.subset(taken))
        if ends[0] < places[0]:
            places, rays = [float(ends[0]), *places], [rays[0], *rays]
        if ends[1] > places[-1]:
            places, rays = [*places, float(ends[1])], [*rays, rays[-1]]
        origin_m = np.stack([one.origin_m for one in rays])
        origin_m[..., DIMENSIONS.index(dimension)] = np.array(places)[:, None]
        return cls(
            origin_m,
            np.unwrap(np.stack([one.azimuth_rad for one in rays]), axis=0),
            np.stack([one.elevation_rad for one in rays]),
            np.stack([one.gate_m for one in rays]),
            first.sensor,
            dimension,
            tuple(places),
        )

    def __len__(self) -> int:
        """The number of rays per frame."""
        return len(self.sensor)

    @property
    def ends(self) -> tuple[float, float]:
        """The first and last value of its condition."""
        return self.knots[0], self.knots[-1]

    @property
    def gates(self) -> str:
        """The kind of gates: "ray" where rays of one sensor differ at any knot, else "sensor"."""
        _, first, sensor = np.unique(self.sensor, return_index=True, return_inverse=True)
        return "ray" if (self.gate_m != self.gate_m[:, first[sensor]]).any() else "sensor"

    def per_sensor(self, sensors: int) -> np.ndarray:
        """The number of rays of each of `sensors` sensors, shape (S,)."""
        return np.bincount(self.sensor, minlength=sensors)

    def at(self, value: float | None = None) -> Rays:
        """The rays at a value of the condition, exactly the knot's at a knot; without a condition the only ones.

        Raises:
            ConfigError: The pattern has a condition and no value is given, or one beyond its ends.
        """
        columns = (self.origin_m, self.azimuth_rad, self.elevation_rad, self.gate_m)
        if self.dimension is None:
            return Rays.from_angles(*(only for (only,) in columns), self.sensor)
        first, last = self.ends
        if value is None:
            middle = (first + last) / 2
            raise ConfigError(
                f"rays differ along {self.dimension}",
                where="--at",
                allowed=f"{self.dimension} from {first:g} to {last:g}",
                hint=f"give --at {self.dimension}={middle:g}",
            )
        if not first <= value <= last:
            raise ConfigError(
                f"{self.dimension}={value:g} is beyond the ends of the pattern",
                where="--at",
                allowed=f"{first:g} to {last:g}",
            )
        right = int(np.searchsorted(self.knots[1:], value)) + 1
        share = (value - self.knots[right - 1]) / (self.knots[right] - self.knots[right - 1])
        origin_m, *rest = ((1 - share) * column[right - 1] + share * column[right] for column in columns)
        origin_m[:, DIMENSIONS.index(self.dimension)] = value
        return Rays.from_angles(origin_m, *rest, self.sensor)

    def remounted(self, sensor: int, before_m: np.ndarray, after_m: np.ndarray, turn: np.ndarray) -> Pattern:
        """The pattern with the rays of one sensor turned (3, 3) about its place, which goes from (3,) to (3,) [m]."""
        own, places = self.sensor == sensor, len(self.azimuth_rad)
        before, after = (np.tile(place, (places, 1)) for place in (before_m, after_m))
        if self.dimension is not None:
            # along a condition the sensor is at its knots
            before[:, DIMENSIONS.index(self.dimension)] = after[:, DIMENSIONS.index(self.dimension)] = self.knots
        origin_m, looking = self.origin_m.copy(), direction(self.azimuth_rad, self.elevation_rad)
        origin_m[:, own] = (origin_m[:, own] - before[:, None]) @ turn.T + after[:, None]
        azimuth, elevation = self.azimuth_rad.copy(), self.elevation_rad.copy()
        azimuth[:, own], elevation[:, own] = angles(looking[:, own] @ turn.T)
        return replace(self, origin_m=origin_m, azimuth_rad=np.unwrap(azimuth, axis=0), elevation_rad=elevation)


def with_coordinates(origin_m: np.ndarray, values: Mapping[int, float]) -> np.ndarray:
    """Origins (..., 3) with given coordinates, by axis [m]."""
    moved = np.array(origin_m, dtype=np.float64)
    for axis, value in values.items():
        moved[..., axis] = value
    return moved


def even_rays(sensors: Sequence[Sensor], counts: Sequence[int]) -> Rays:
    """An even grid of rays in each sensor's field of view, `counts` of each, with its gate and origin."""
    sensor = np.repeat(np.arange(len(sensors)), counts)
    looking = [
        tangent_directions(one.frame, grid_tangent(*field_on_sphere(one), int(n)))
        for one, n in zip(sensors, counts, strict=True)
    ]
    origin_m = np.array([one.origin_m for one in sensors], dtype=np.float64)[sensor]
    gate_m = np.array([one.gate_m for one in sensors], dtype=np.float64)[sensor]
    return Rays(origin_m, np.concatenate(looking), gate_m, sensor, fire_times(len(sensor), DEFAULT_RATE_HZ))


def field_on_sphere(sensor: Sensor) -> tuple[float, float]:
    """The field of view, shrunk in proportion where its corner would lie beyond the antipode [rad].

    Past the angle pi the tangent plane covers the sphere a second time, so rays there would point elsewhere.
    """
    horizontal, vertical = sensor.field_of_view_rad
    scale = math.pi / max(math.hypot(horizontal, vertical) / 2, math.pi)
    return scale * horizontal, scale * vertical


def grid_tangent(horizontal_rad: float, vertical_rad: float, count: int) -> np.ndarray:
    """Angles of an even grid in a field of view, row by row upwards, shape (count, 2) [rad].

    Cell-centred: ray i of n in a row stands at -FoV/2 + FoV * (i + 1/2) / n, never on the field's edge.
    """
    rows = grid_rows(horizontal_rad, vertical_rad, count)
    across = np.concatenate([(np.arange(n) + 0.5) / n - 0.5 for n in rows])
    up = np.repeat((np.arange(len(rows)) + 0.5) / len(rows) - 0.5, rows)
    return np.stack([horizontal_rad * across, vertical_rad * up], axis=1)


def grid_rows(horizontal_rad: float, vertical_rad: float, count: int) -> np.ndarray:
    """Rays per row of an even grid, int64 (rows,), summing to `count`; no rays are one row of none.

    The number of rows makes the cells as square as whole numbers allow; the rays are spread over the rows as
    evenly as possible, so a budget of k * k in a square field is the regular k by k grid.
    """
    rows = max(_row_count(horizontal_rad, vertical_rad, count), 1)
    # i n / rows rounded half up in whole numbers, without a rounding error
    return np.diff((np.arange(rows + 1, dtype=np.int64) * count + rows // 2) // rows)


def _row_count(horizontal_rad: float, vertical_rad: float, count: int) -> int:
    """The number of rows whose cells are closest to square by ratio; 0 for a field without height."""
    if horizontal_rad <= 0:
        return count * (vertical_rad > 0)
    squared = count * min(count, vertical_rad / horizontal_rad)
    fewer = math.floor(math.sqrt(squared))
    # as the square of the root may round, two rays in a square field would be above each other
    return fewer if squared <= fewer * (fewer + 1) else fewer + 1


def low_discrepancy(count: int, axes: int) -> np.ndarray:
    """Points that fill the unit cube evenly, shape (count, axes).

    Up to two axes the additive recurrence R_k (M. Roberts 2018): its generators are the powers of 1 / phi, with phi
    the root of phi^(k+1) = phi + 1 above 1. Beyond, small multiples of two generators nearly add up to a whole number,
    and points lie on a few lines of that pair of axes (of four axes the first and the third: 1000 points leave 30
    of 100 cells of their square empty); there J. Halton's sequence (1960) in the first primes. The smallest ones are
    the most even: they go to the last axes, which are those of directions.
    """
    if axes > len(ROOTS):
        # slow to import
        from scipy.stats.qmc import Halton

        return Halton(axes, scramble=False).fast_forward(1).random(count)[:, ::-1]
    generators = ROOTS[axes - 1] ** -np.arange(1.0, axes + 1)
    return np.mod(0.5 + np.arange(1, count + 1)[:, None] * generators, 1.0)


def even_subset(points: np.ndarray, count: int) -> np.ndarray:
    """Indices, ascending, of `count` of the points that lie evenly among them: (M, K) to int64 (count,).

    The points are halved along their longest extent until as many groups as wanted are left, each with the same
    number of points but for one; of each the point nearest to its centre stays. Deterministic, and O(M log M).
    """
    if count == len(points):
        return np.arange(count)
    kept: list[int] = []
    groups = [(np.arange(len(points)), count)] if count else []
    while groups:
        members, wanted = groups.pop()
        inside = points[members]
        if wanted == 1:
            kept.append(int(members[np.square(inside - inside.mean(axis=0)).sum(axis=1).argmin()]))
            continue
        # rounded, so that rounding errors do not decide between equal extents and positions
        axis = np.round(np.ptp(inside, axis=0), 9).argmax()
        order = members[np.argsort(np.round(inside[:, axis], 9), kind="stable")]
        first = wanted // 2
        cut = round(len(order) * first / wanted)
        groups += [(order[:cut], first), (order[cut:], wanted - first)]
    return np.sort(np.array(kept, dtype=np.int64))
