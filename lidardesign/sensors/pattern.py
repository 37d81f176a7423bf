"""A pattern: the rays that a design fires for one number of rays, at one place or along a condition.

Along a condition, as the position of a robot, a pattern is given at knots. Ray n is the same ray at all of them; in
between its origin, its angles and its gate are linear. So it passes through the knots exactly, and keeps every bound
on elevation, azimuth, start, end and width that both neighbouring knots keep: each is a convex set per ray.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.scenes.rays import Rays
from lidardesign.space import DIMENSIONS

# Conditions that a sensor can travel along: where a ray starts, not where it looks.
TRAVELLED = DIMENSIONS[:3]


@dataclass(frozen=True, eq=False)
class Pattern:
    """The rays of a design at the knots of a condition, in the order in which they fire; one knot without a condition.

    Arguments:
        origin_m: Where rays start [m], shape (P, N, 3).
        azimuth_rad, elevation_rad: Where they look, shape (P, N); azimuths are unrolled along the knots.
        gate_m: From where to where they listen [m], shape (P, N, 2).
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
        columns = (rays.origin_m, rays.azimuth_rad, rays.elevation_rad, rays.gate_m)
        return cls(*(column[None] for column in columns), rays.sensor)

    @classmethod
    def along(cls, dimension: str, knots: Sequence[float], lists: Sequence[Rays], ends: tuple[float, float]) -> Pattern:
        """The pattern of lists of rays at knots; beyond the first and last knot rays stay as they are there.

        Ray n is at each knot the one that aims nearest to where it aimed at the knot before, all of a sensor together.

        Arguments:
            dimension: The condition.
            knots: Distinct values of it, P of them.
            lists: As many rays of each sensor at each of them.
            ends: From where to where the pattern leads, which holds the knots.
        """
        order = np.argsort(knots)
        rays = [lists[order[0]]]
        for place in order[1:]:
            aims = [one.direction * one.gate_m.mean(axis=1, keepdims=True) for one in (rays[-1], lists[place])]
            before, after = rays[-1].sensor, lists[place].sensor
            taken = np.empty(len(before), dtype=np.intp)
            for sensor in np.unique(before):
                mine, theirs = np.flatnonzero(before == sensor), np.flatnonzero(after == sensor)
                taken[mine] = theirs[_assigned(aims[0][mine], aims[1][theirs])]
            rays.append(lists[place].subset(taken))
        places = np.array(knots, dtype=np.float64)[order].tolist()
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
            rays[0].sensor,
            dimension,
            tuple(places),
        )

    def __len__(self) -> int:
        """The number of rays per frame."""
        return len(self.sensor)

    @property
    def ends(self) -> tuple[float, float]:
        """From where to where it leads along its condition."""
        return self.knots[0], self.knots[-1]

    @property
    def gates(self) -> str:
        """Whether two rays of one sensor have different gates anywhere: "ray", else "sensor"."""
        _, first, sensor = np.unique(self.sensor, return_index=True, return_inverse=True)
        return "ray" if (self.gate_m != self.gate_m[:, first[sensor]]).any() else "sensor"

    def per_sensor(self, sensors: int) -> np.ndarray:
        """How many rays each of so many sensors fires, shape (S,)."""
        return np.bincount(self.sensor, minlength=sensors)

    def at(self, value: float | None = None) -> Rays:
        """The rays at a value of the condition, exactly the knot's at a knot; without a condition the only ones.

        Raises:
            ConfigError: The pattern has a condition and no value is given, or one beyond its ends.
        """
        if self.dimension is None:
            return Rays.from_angles(
                self.origin_m[0], self.azimuth_rad[0], self.elevation_rad[0], self.gate_m[0], self.sensor
            )
        first, last = self.ends
        if value is None:
            middle = (first + last) / 2
            raise ConfigError(
                f"rays differ along {self.dimension}",
                where="--at",
                allowed=f"{self.dimension} from {first:g} to {last:g}",
                hint=f"give --at {self.dimension}={middle:g}",
            )
        if not (math.isfinite(value) and first <= value <= last):
            raise ConfigError(
                f"{self.dimension}={value:g} is beyond the ends of the pattern",
                where="--at",
                allowed=f"{first:g} to {last:g}",
            )
        right = int(np.clip(np.searchsorted(self.knots, value), 1, len(self.knots) - 1))
        share = (value - self.knots[right - 1]) / (self.knots[right] - self.knots[right - 1])
        columns = (self.origin_m, self.azimuth_rad, self.elevation_rad, self.gate_m)
        origin_m, *rest = ((1 - share) * column[right - 1] + share * column[right] for column in columns)
        origin_m[:, DIMENSIONS.index(self.dimension)] = value
        return Rays.from_angles(origin_m, *rest, self.sensor)

    def moved(self, values: Mapping[int, float]) -> Pattern:
        """The pattern with these coordinates of all origins, by their index."""
        return replace(self, origin_m=with_coordinates(self.origin_m, values))


def with_coordinates(origin_m: np.ndarray, values: Mapping[int, float]) -> np.ndarray:
    """Origins (..., 3) with these coordinates, by their index [m]."""
    moved = np.array(origin_m, dtype=np.float64)
    for axis, value in values.items():
        moved[..., axis] = value
    return moved


def _assigned(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which point after (N, 3) each point before (N, 3) becomes, so that the squares of all moves sum to the least."""
    # slow to import
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(np.square(before[:, None] - after[None]).sum(axis=2))[1]
