"""A sensor is one mixture component over design space; a design is a list of them with a ray layout.

A component is a product q(d) = N(x) N(u) N(r): the origin with its full covariance, the direction in the
tangent plane of the boresight, the range. Tangent coordinates u = (horizontal, vertical) are true angles
(azimuthal equidistant): a direction at the angle t from the boresight has |u| = t. Densities are per
solid angle, so the tangent map's Jacobian t / sin t is part of them. (Paper, section 5, with the angle on
the sphere instead of in azimuth and elevation.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from lidardesign.numerics import sphere_exp, sphere_log
from lidardesign.scenes.rays import Rays
from lidardesign.space import angles, direction

DEFAULT_LEVEL = 0.95
# Beyond these an interval is next to nothing, or next to everything, of a normal distribution.
LEVELS = (0.01, 0.999999)
# Returns of so many fill some 100 MB per scene; no scanner fires more in a frame.
MOST_RAYS = 1_000_000
LayoutName = Literal["grid", "density", "scan", "distributed", "selected", "spinning", "fixed"]
# Those in which sensors are fitted: the rays of real parts are what they are.
FITTED_LAYOUTS: tuple[LayoutName, ...] = ("grid", "density", "scan", "distributed", "selected", "spinning")
# Under this key of its provenance a design with chosen rays says how far from the best each choice may be.
CERTIFICATES = "certificates"
# Whether every ray has its sensor's gate or its own.
Gates = Literal["sensor", "ray"]


def interval_factor(level: float) -> float:
    """The number of standard deviations on each side of the mean that hold `level` of a normal distribution."""
    return NormalDist().inv_cdf((1 + level) / 2)


def boresight_frame(azimuth_rad: float, elevation_rad: float, roll_rad: float = 0.0) -> np.ndarray:
    """Rows forward, horizontal, vertical of a boresight, shape (3, 3).

    Horizontal is the direction of growing azimuth, vertical that of growing elevation, both turned by the
    roll about the boresight (right-handed). At the poles the azimuth fixes the frame, so it stays defined.
    """
    sin_a, cos_a = math.sin(azimuth_rad), math.cos(azimuth_rad)
    sin_e, cos_e = math.sin(elevation_rad), math.cos(elevation_rad)
    forward = np.array([cos_e * cos_a, cos_e * sin_a, sin_e])
    horizontal = np.array([-sin_a, cos_a, 0.0])
    vertical = np.array([-sin_e * cos_a, -sin_e * sin_a, cos_e])
    sin_r, cos_r = math.sin(roll_rad), math.cos(roll_rad)
    return np.stack([forward, cos_r * horizontal + sin_r * vertical, cos_r * vertical - sin_r * horizontal])


def boresight_of(frame: np.ndarray) -> tuple[float, float, float]:
    """Azimuth, elevation and roll of a frame with the rows forward, horizontal, vertical; undoes `boresight_frame`."""
    azimuth, elevation = (float(value) for value in angles(frame[0]))
    upright = boresight_frame(azimuth, elevation)
    return azimuth, elevation, math.atan2(float(frame[1] @ upright[2]), float(frame[1] @ upright[1]))


def tangent_coordinates(frame: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Angles (horizontal, vertical) of unit vectors from a boresight: (3, 3), (N, 3) to (N, 2) [rad]."""
    return sphere_log(directions @ frame.T)


def tangent_directions(frame: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Unit vectors at angles (horizontal, vertical) from a boresight: (3, 3), (N, 2) to (N, 3)."""
    return sphere_exp(tangent) @ frame


@dataclass(frozen=True, eq=False)
class Coupling:
    """How a ray follows from where it starts inside its sensor: conditional means are linear, spreads constant.

    With x the origin and u = (horizontal, vertical) the tangent angles of a ray, both relative to the sensor's means:
    E[u | x] = direction_per_m @ x, and E[range | x, u] = mean + range_per_m @ x + range_per_rad @ u.

    Arguments:
        direction_per_m: Shape (2, 3) [rad / m].
        range_per_m: Shape (3,).
        range_per_rad: Shape (2,) [m / rad].
        spread_rad: Standard deviations of the tangent angles that the origin leaves, shape (2,).
        spread_m: Standard deviation of the range that origin and direction leave.
    """

    direction_per_m: np.ndarray
    range_per_m: np.ndarray
    range_per_rad: np.ndarray
    spread_rad: np.ndarray
    spread_m: float

    def as_dict(self) -> dict[str, Any]:
        """The plain values of the design file."""
        return {
            "direction_rad_per_m": [[float(v) for v in row] for row in self.direction_per_m],
            "range_m_per_m": [float(v) for v in self.range_per_m],
            "range_m_per_rad": [float(v) for v in self.range_per_rad],
            "spread_rad": [float(v) for v in self.spread_rad],
            "spread_m": float(self.spread_m),
        }


@dataclass(frozen=True, eq=False)
class Sensor:
    """One mixture component, read as a physical sensor.

    Arguments:
        name: Unique within its design.
        weight: Share of the rays, 0 to 1.
        origin_m: Mean origin [m], shape (3,).
        origin_covariance_m2: Covariance of the origin [m^2], shape (3, 3); zero along fixed axes.
        azimuth_rad, elevation_rad, roll_rad: The boresight.
        spread_horizontal_rad, spread_vertical_rad: Standard deviations in the boresight's tangent plane.
        range_m, spread_range_m: Mean and standard deviation of the range.
        level: The share of each marginal that its reported interval holds.
        rays: Rays per frame, where the design fixes them.
        coupling: How direction and range follow from the origin; None where they are independent.
        part: The part of the catalogue that it is, where it is one.
    """

    name: str
    weight: float
    origin_m: np.ndarray
    origin_covariance_m2: np.ndarray
    azimuth_rad: float
    elevation_rad: float
    roll_rad: float
    spread_horizontal_rad: float
    spread_vertical_rad: float
    range_m: float
    spread_range_m: float
    level: float = DEFAULT_LEVEL
    rays: int | None = None
    coupling: Coupling | None = None
    part: str | None = None

    @cached_property
    def frame(self) -> np.ndarray:
        """Rows forward, horizontal, vertical, shape (3, 3)."""
        return boresight_frame(self.azimuth_rad, self.elevation_rad, self.roll_rad)

    @property
    def field_of_view_rad(self) -> tuple[float, float]:
        """Full horizontal and vertical angles that hold `level` of the rays each."""
        width = 2 * interval_factor(self.level)
        return width * self.spread_horizontal_rad, width * self.spread_vertical_rad

    @property
    def gate_m(self) -> tuple[float, float]:
        """Start and end of the range interval that holds `level` of the returns."""
        half = interval_factor(self.level) * self.spread_range_m
        return max(self.range_m - half, 0.0), self.range_m + half

    @property
    def travel_m(self) -> tuple[float, np.ndarray]:
        """How far it moves to reach its origins: the interval of `level` along their longest principal axis.

        Length [m] and unit vector, shape (3,), whose largest entry is positive; zeros for a fixed origin. A
        sensor whose origin is longer than it is thick is one that moves: a scanner on a rail or a gantry.
        """
        values, axes = np.linalg.eigh(np.asarray(self.origin_covariance_m2, dtype=np.float64))
        if values[-1] <= 0:
            return 0.0, np.zeros(3)
        axis = axes[:, -1] * np.copysign(1.0, axes[np.abs(axes[:, -1]).argmax(), -1])
        return 2 * interval_factor(self.level) * math.sqrt(values[-1]), axis

    @property
    def boresight(self) -> np.ndarray:
        """The unit vector that it points along, shape (3,)."""
        return direction(self.azimuth_rad, self.elevation_rad)

    def as_text(self) -> dict[str, str]:
        """Cells of a table for people, by heading: part, place, pose in degrees, field of view and gate."""
        turned = {"azimuth": self.azimuth_rad, "elevation": self.elevation_rad, "roll": self.roll_rad}
        travel_m, _ = self.travel_m
        # adding zero takes the sign from a rounded -0
        place = " ".join(f"{round(float(value), 3) + 0.0:.3f}" for value in self.origin_m)
        return {
            "sensor": self.name if self.part is None else f"{self.name} {self.part}",
            "origin [m]": f"{place}, travel {travel_m:.3f}" if travel_m > 0 else place,
            **{f"{name} [deg]": f"{round(math.degrees(angle), 2) + 0.0:.2f}" for name, angle in turned.items()},
            "field of view [deg]": " x ".join(f"{math.degrees(angle):.2f}" for angle in self.field_of_view_rad),
            "gate [m]": " - ".join(f"{end:.3f}" for end in self.gate_m),
        }

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON and YAML form of a sensor."""
        horizontal, vertical = self.field_of_view_rad
        start, end = self.gate_m
        length, along = self.travel_m
        return {
            "name": self.name,
            **({} if self.part is None else {"part": self.part}),
            "weight": float(self.weight),
            "origin_m": {
                "mean": [float(v) for v in self.origin_m],
                "covariance": [[float(v) for v in row] for row in self.origin_covariance_m2],
            },
            "travel_m": {"length": float(length), "direction": [float(v) for v in along]},
            "boresight": {
                "azimuth_rad": float(self.azimuth_rad),
                "elevation_rad": float(self.elevation_rad),
                "roll_rad": float(self.roll_rad),
            },
            "field_of_view_rad": {"horizontal": float(horizontal), "vertical": float(vertical)},
            "gate_m": {"start": float(start), "end": float(end)},
            "spread": {
                "horizontal_rad": float(self.spread_horizontal_rad),
                "vertical_rad": float(self.spread_vertical_rad),
                "range_m": float(self.spread_range_m),
            },
            "coupling": None if self.coupling is None else self.coupling.as_dict(),
            "rays": self.rays,
        }


@dataclass(frozen=True, eq=False)
class Track:
    """Rays that vary smoothly along one condition, as a robot's position: given at knots, linear in between.

    Ray n is the same ray at all knots. Its origin is its sensor's mean origin, with `dimension` at the condition.

    Arguments:
        dimension: The condition's name, as "x_m".
        knots: Ascending condition values, shape (P,).
        azimuth_rad, elevation_rad: Shape (P, N); azimuths are unrolled along the knots.
        gate_m: Shape (P, N, 2).
        sensor: Index of the sensor of each ray, shape (N,).
    """

    dimension: str
    knots: np.ndarray
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    gate_m: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True, eq=False)
class DesignSpec:
    """A LiDAR system: sensors, how its rays are laid out, and where it came from.

    Arguments:
        name: The file's stem, the row's name in tables.
        sensors: At least one.
        layout: `grid`, `density`, `scan`, `distributed`, `selected`: rays chosen on training scenes, `spinning`: rings
            chosen so, or `fixed`: the rays of its table, as real parts fire them.
        rays: Rays per frame that it was made for; None leaves the budget to `evaluate`.
        ray_table: The explicit rays of every layout but `grid`.
        further_tables, further_tracks: Of the layout `selected`, the rays that were chosen at other numbers of rays.
        constraints: The constraint document that it satisfies (plain values).
        provenance: Command, seed, run and versions, for people.
        level: The share of each marginal that intervals hold.
        track: The rays along a condition, where the design is for all its values.
        at: The condition values that the design is for, where it is for one, as {"x_m": 0.37}.
        gates: Whether its rays have their sensor's gate or their own at any number of rays; None where its table of
            rays tells, or where it is as usual in its layout.
        mount: The body of a robot that it is on, in whose frame places and directions are; None: in the world.
    """

    name: str
    sensors: tuple[Sensor, ...]
    layout: LayoutName = "grid"
    rays: int | None = None
    ray_table: Rays | None = None
    constraints: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    level: float = DEFAULT_LEVEL
    track: Track | None = None
    at: Mapping[str, float] = field(default_factory=dict)
    gates: Gates | None = None
    mount: str | None = None
    further_tables: tuple[Rays, ...] = ()
    further_tracks: tuple[Track, ...] = ()

    @property
    def frame(self) -> str:
        """The frame of its places and directions, in words: the world's, or that of a robot's body."""
        return "the world's frame" if self.mount is None else f"the frame of the robot's body {self.mount!r}"

    @property
    def weights(self) -> np.ndarray:
        """Shares of the rays, shape (G,), summing to 1."""
        weights = np.array([sensor.weight for sensor in self.sensors], dtype=np.float64)
        return weights / weights.sum()

    @property
    def table_gates(self) -> Gates | None:
        """The gates that two rays of one sensor in its table tell of; None without such two."""
        table = self.ray_table
        if table is None:
            return None
        _, first, sensor = np.unique(table.sensor, return_index=True, return_inverse=True)
        if len(first) == len(sensor):
            return None
        return "ray" if (table.gate_m != table.gate_m[first[sensor]]).any() else "sensor"
