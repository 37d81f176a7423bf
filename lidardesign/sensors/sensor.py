"""A sensor: origin, boresight, field of view and gate.

It is one component of a mixture over design space, a product q(d) = N(x) N(u) N(r): the origin with its covariance, the
direction in the tangent plane of the boresight, the range. Tangent coordinates u = (horizontal, vertical) are true
angles (azimuthal equidistant): a direction at the angle t from the boresight has |u| = t. Densities are per solid
angle, so the tangent map's Jacobian t / sin t is part of them. (Paper, section 5, with the angle on the sphere instead
of in azimuth and elevation.) A field of view and a gate are the intervals that hold the design's level of each
marginal: with z standard deviations on each side, field of view = 2 z spread and gate = mean range -+ z spread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any

import numpy as np

from lidardesign.numerics import sphere_exp, sphere_log
from lidardesign.space import angles, direction

DEFAULT_LEVEL = 0.95
# Rounds in which a boresight moves to the middle of its field: away from the poles it rests after two or three.
CENTRING_ROUNDS = 8


def interval_factor(level: float) -> float:
    """The number of standard deviations on each side of the mean that hold `level` of a normal distribution."""
    return NormalDist().inv_cdf((1 + level) / 2)


def boresight_frame(
    azimuth_rad: float | np.ndarray, elevation_rad: float | np.ndarray, roll_rad: float | np.ndarray = 0.0
) -> np.ndarray:
    """Rows forward, horizontal, vertical of boresights, (...) each to (..., 3, 3).

    Horizontal is the direction of growing azimuth, vertical that of growing elevation, both turned by the
    roll about the boresight (right-handed). At the poles the azimuth fixes the frame, so it stays defined.
    """
    sin_a, cos_a = np.sin(azimuth_rad), np.cos(azimuth_rad)
    sin_e, cos_e = np.sin(elevation_rad), np.cos(elevation_rad)
    sin_r, cos_r = np.sin(roll_rad)[..., None], np.cos(roll_rad)[..., None]
    forward = np.stack([cos_e * cos_a, cos_e * sin_a, sin_e], axis=-1)
    horizontal = np.stack([-sin_a, cos_a, np.zeros_like(sin_a)], axis=-1)
    vertical = np.stack([-sin_e * cos_a, -sin_e * sin_a, cos_e], axis=-1)
    return np.stack([forward, cos_r * horizontal + sin_r * vertical, cos_r * vertical - sin_r * horizontal], axis=-2)


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


def centred_boresight(frame: np.ndarray, tangent: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation of the middle of a field, of angles (N, 2) from the boresight of a frame [rad]."""
    middle = (tangent.min(axis=0) + tangent.max(axis=0)) / 2
    azimuth, elevation = angles(tangent_directions(frame, middle[None])[0])
    return float(azimuth), float(elevation)


@dataclass(frozen=True, eq=False)
class Sensor:
    """One mixture component, read as a physical sensor.

    Arguments:
        name: Unique within its design.
        weight: Share of the rays, 0 to 1, where rays are even.
        origin_m: Its origin, or the mean of a region [m], shape (3,).
        azimuth_rad, elevation_rad, roll_rad: The boresight.
        field_of_view_rad: Full horizontal and vertical angles in the boresight's tangent plane.
        gate_m: Start and end of its gate.
        origin_covariance_m2: Of the origins of its rays where they start all over a region [m^2], shape (3, 3); None
            where they start at one place.
        part: The name of its part in the catalogue, where it is one.
    """

    name: str
    weight: float
    origin_m: np.ndarray
    azimuth_rad: float
    elevation_rad: float
    roll_rad: float
    field_of_view_rad: tuple[float, float]
    gate_m: tuple[float, float]
    origin_covariance_m2: np.ndarray | None = None
    part: str | None = None

    @cached_property
    def frame(self) -> np.ndarray:
        """Rows forward, horizontal, vertical, shape (3, 3)."""
        return boresight_frame(self.azimuth_rad, self.elevation_rad, self.roll_rad)

    @property
    def boresight(self) -> np.ndarray:
        """The unit vector that it points along, shape (3,)."""
        return direction(self.azimuth_rad, self.elevation_rad)

    @property
    def covariance_m2(self) -> np.ndarray:
        """Of the origins of its rays, shape (3, 3); zeros at one place [m^2]."""
        return np.zeros((3, 3)) if self.origin_covariance_m2 is None else self.origin_covariance_m2

    @property
    def region_m(self) -> float:
        """Standard deviation of the origins of its rays along their longest principal axis; 0 at one place [m]."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance_m2)[-1]), 0.0))

    def tangent_of(self, directions: np.ndarray) -> np.ndarray:
        """Angles from the boresight of unit vectors (N, 3), shape (N, 2) [rad]; 0 where its field has no width."""
        tangent = tangent_coordinates(self.frame, directions)
        fan = np.array(self.field_of_view_rad) > 0
        # in a fan of rays only the angle along the fan counts
        tangent[:, ~fan & fan.any()] = 0.0
        return tangent

    def as_text(self) -> dict[str, str]:
        """Cells of a table for people, by heading: part, place, pose in degrees, field of view and gate."""
        turned = {"azimuth": self.azimuth_rad, "elevation": self.elevation_rad, "roll": self.roll_rad}
        # adding zero takes the sign from a rounded -0
        place = " ".join(f"{round(float(value), 3) + 0.0:.3f}" for value in self.origin_m)
        return {
            "sensor": self.name if self.part is None else f"{self.name} {self.part}",
            "origin [m]": f"{place}, spread {self.region_m:.3f}" if self.region_m > 0 else place,
            **{f"{name} [deg]": f"{round(math.degrees(angle), 2) + 0.0:.2f}" for name, angle in turned.items()},
            "field of view [deg]": " x ".join(f"{math.degrees(angle):.2f}" for angle in self.field_of_view_rad),
            "gate [m]": " - ".join(f"{end:.3f}" for end in self.gate_m),
        }

    def as_dict(self) -> dict[str, Any]:
        """The plain values of files and JSON."""
        covariance = self.origin_covariance_m2
        region = {} if covariance is None else {"covariance": [[float(v) for v in row] for row in covariance]}
        return {
            "name": self.name,
            **({} if self.part is None else {"part": self.part}),
            "weight": float(self.weight),
            "origin_m": {"mean": [float(v) for v in self.origin_m], **region},
            "boresight": {
                "azimuth_rad": float(self.azimuth_rad),
                "elevation_rad": float(self.elevation_rad),
                "roll_rad": float(self.roll_rad),
            },
            "field_of_view_rad": dict(zip(("horizontal", "vertical"), map(float, self.field_of_view_rad), strict=True)),
            "gate_m": dict(zip(("start", "end"), map(float, self.gate_m), strict=True)),
        }
