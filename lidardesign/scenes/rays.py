"""Rays that a design fires, their hits and returns, and rotation matrices.

A fixed receiver is upright: its lateral axis is horizontal in any direction. A field of view is the pyramid of
the points whose two angles, about its upright and its lateral axis, are both within half of its extents, as behind the
rectangular stop of a camera.

Light that leaves o along v, meets a surface at range r and goes on to a receiver at x has the path
L = r + |o + r v - x|. With b = x - o: r = (L / 2) (1 - (|b| / L)^2) / (1 - b.v / L). For b = 0 it is L / 2 exactly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Self

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.scenes.scene import Receiver
from lidardesign.space import angles, direction

# Default frames per second.
DEFAULT_RATE_HZ = 10.0


def fire_times(count: int, rate_hz: float) -> np.ndarray:
    """Firing time of each ray in its frame, i / (n * rate), shape (n,) [s]."""
    return np.arange(count) / (max(count, 1) * rate_hz)


class Outcome(IntEnum):
    """Outcome of a ray; a gate is closed at its start and open at its end."""

    RETURN = 0
    OCCLUDED = 1
    AFTER_GATE = 2
    MISS = 3
    NOT_DETECTED = 4


class FlatLists:
    """Flat lists side by side, as a dataclass that holds arrays of one length alone, or None for some."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def subset(self, chosen: np.ndarray | slice) -> Self:
        """The rows at an index or mask."""
        return type(self)(*(None if column is None else column[chosen] for column in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Several lists as one, one after the other."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


@dataclass(frozen=True, eq=False)
class Rays(FlatLists):
    """An explicit list of rays, in the order in which they fire.

    Arguments:
        origin_m: Origins [m], shape (N, 3).
        direction: Unit vectors, shape (N, 3).
        gate_m: Start and end of each ray's range gate [m], shape (N, 2).
        sensor: Index of each ray's sensor, shape (N,).
        time_s: Firing times within the frame [s], shape (N,).
        angles_rad: Azimuths and elevations that directions were made from, shape (N, 2); None: computed from the
            directions. Files hold angles: reading and writing them again changes no digit.
        light: Light of each ray's emitter as a multiple of its detector's, as of real parts, shape (N,); None: 1.

    Raises:
        ConfigError: Non-finite values, directions that are not unit vectors, reversed or negative gates.

    Example:
        >>> rays = Rays(
        ...     origin_m=np.zeros((2, 3)),
        ...     direction=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        ...     gate_m=np.array([[0.5, 2.0], [0.5, 3.0]]),
        ...     sensor=np.array([0, 0]),
        ...     time_s=np.array([0.0, 0.05]),
        ... )
        >>> len(rays), rays.subset(np.array([1])).gate_m.tolist()
        (2, [[0.5, 3.0]])
    """

    origin_m: np.ndarray
    direction: np.ndarray
    gate_m: np.ndarray
    sensor: np.ndarray
    time_s: np.ndarray
    angles_rad: np.ndarray | None = None
    light: np.ndarray | None = None

    def __post_init__(self) -> None:
        count = len(self.origin_m)
        for name, tail, dtype in (
            ("origin_m", (3,), np.float64),
            ("direction", (3,), np.float64),
            ("gate_m", (2,), np.float64),
            ("sensor", (), np.int64),
            ("time_s", (), np.float64),
            *([] if self.angles_rad is None else [("angles_rad", (2,), np.float64)]),
            *([] if self.light is None else [("light", (), np.float64)]),
        ):
            values = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if values.shape != (count, *tail):
                raise ConfigError(f"shape {values.shape}", where=f"rays.{name}", allowed=f"{(count, *tail)}")
            if not np.isfinite(values).all():
                raise ConfigError("values are NaN or infinite", where=f"rays.{name}")
            object.__setattr__(self, name, values)
        if count and np.abs(np.linalg.norm(self.direction, axis=1) - 1).max() > COARSE_SLACK:
            raise ConfigError("directions are not unit vectors", where="rays.direction")
        if count and (self.gate_m[:, 0].min() < 0 or (self.gate_m[:, 1] < self.gate_m[:, 0]).any()):
            raise ConfigError("a gate is negative or ends before it starts", where="rays.gate_m")

    @classmethod
    def from_angles(
        cls,
        origin_m: np.ndarray,
        azimuth_rad: np.ndarray,
        elevation_rad: np.ndarray,
        gate_m: np.ndarray,
        sensor: np.ndarray,
    ) -> Rays:
        """Rays from angles (N,), which are kept to the last digit, fired evenly over a frame at the default rate."""
        looking = direction(azimuth_rad, elevation_rad)
        return cls(
            origin_m,
            looking,
            gate_m,
            sensor,
            fire_times(len(looking), DEFAULT_RATE_HZ),
            np.stack([azimuth_rad, elevation_rad], axis=1),
        )

    @classmethod
    def joined(cls, parts: Sequence[Rays]) -> Rays:
        """Concatenated lists of rays, with angles computed from directions."""
        names = ("origin_m", "direction", "gate_m", "sensor", "time_s")
        light = [np.ones(len(part)) if part.light is None else part.light for part in parts]
        some = np.concatenate(light) if any(part.light is not None for part in parts) else None
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names), light=some)

    @property
    def azimuth_rad(self) -> np.ndarray:
        """Azimuths [rad], shape (N,)."""
        return angles(self.direction)[0] if self.angles_rad is None else self.angles_rad[:, 0]

    @property
    def elevation_rad(self) -> np.ndarray:
        """Elevations [rad], shape (N,)."""
        return angles(self.direction)[1] if self.angles_rad is None else self.angles_rad[:, 1]

    def as_angles(self) -> Rays:
        """These rays as read from a file: directions computed from their angles, which may differ by rounding."""
        return Rays.from_angles(self.origin_m, *angles(self.direction), self.gate_m, self.sensor)


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of rays, one entry per ray.

    Arguments:
        rays: The fired rays.
        outcome: Values of `Outcome`, shape (N,).
        range_m: The measured one-way range [m], NaN without a return, shape (N,).
        body: Index of the body that was hit inside the gate, shape (N,); -1 without a return and for false alarms. For
            scoring only.
        frame: The time frame of the scene.
    """

    rays: Rays
    outcome: np.ndarray
    range_m: np.ndarray
    body: np.ndarray
    frame: int = 0

    @property
    def returned(self) -> np.ndarray:
        """Mask of the rays with a return, shape (N,)."""
        return self.outcome == Outcome.RETURN

    @property
    def points_m(self) -> np.ndarray:
        """Measured points of the rays with a return, shape (K, 3)."""
        hit = self.returned
        return self.rays.origin_m[hit] + self.range_m[hit, None] * self.rays.direction[hit]

    def counts(self) -> dict[str, int]:
        """Number of rays of each outcome, by lower-case name."""
        return {outcome.name.lower(): int((self.outcome == outcome).sum()) for outcome in Outcome}


@dataclass(frozen=True, eq=False)
class Hits(FlatLists):
    """First hits of N rays.

    Arguments:
        range_m: Distance along the ray [m], infinite on a miss, shape (N,).
        body: Index into the scene's bodies, -1 on a miss, shape (N,).
        normal: Unit surface normal facing the ray's origin, zero on a miss, shape (N, 3).
    """

    range_m: np.ndarray
    body: np.ndarray
    normal: np.ndarray

    @classmethod
    def none(cls, count: int) -> Hits:
        """`count` misses."""
        return cls(np.full(count, np.inf), np.full(count, -1, dtype=np.int64), np.zeros((count, 3)))


class Crossings(NamedTuple):
    """All surfaces that rays cross, as flat lists: ray (K,), range (K,) [m], |cosine| with the normal (K,)."""

    row: np.ndarray
    range_m: np.ndarray
    cosine: np.ndarray


def gate_outcomes(range_m: np.ndarray, gate_m: np.ndarray) -> np.ndarray:
    """Outcomes of first hits: ranges (N,) [m], infinite on a miss, and gates (N, 2) [m] to `Outcome` (N,).

    A gate is closed at its start and open at its end: start <= range < end is a return, a hit before the
    start is an occlusion, one at or behind the end lies after the gate.
    """
    outcome = np.full(len(range_m), Outcome.RETURN, dtype=np.int64)
    outcome[range_m < gate_m[:, 0]] = Outcome.OCCLUDED
    outcome[range_m >= gate_m[:, 1]] = Outcome.AFTER_GATE
    outcome[np.isinf(range_m)] = Outcome.MISS
    return outcome


def receiver_axes(receiver: Receiver) -> np.ndarray:
    """Boresight, lateral (to its left) and upright axis as rows, shape (3, 3); x, y, z where it looks along x."""
    sin_a, cos_a = math.sin(receiver.azimuth_rad), math.cos(receiver.azimuth_rad)
    sin_e, cos_e = math.sin(receiver.elevation_rad), math.cos(receiver.elevation_rad)
    return np.array(
        [[cos_e * cos_a, cos_e * sin_a, sin_e], [-sin_a, cos_a, 0.0], [-sin_e * cos_a, -sin_e * sin_a, cos_e]]
    )


def angles_in_view(receiver: Receiver, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Horizontal and vertical angle [rad] and distance [m] of points (..., 3) [m] from a receiver, each (...).

    Angles are signed turns from the boresight about the upright axis (left is positive) and about the lateral axis
    (up is positive), beyond a quarter turn for points behind it.
    """
    offset = np.asarray(points, dtype=np.float64) - np.asarray(receiver.origin_m)
    ahead, left, up = np.moveaxis(offset @ receiver_axes(receiver).T, -1, 0)
    return np.arctan2(left, ahead), np.arctan2(up, ahead), np.linalg.norm(offset, axis=-1)


def in_view(receiver: Receiver, points: np.ndarray) -> np.ndarray:
    """Mask of points (..., 3) in a receiver's field of view and interval of ranges, ends included, shape (...)."""
    horizontal, vertical, distance_m = angles_in_view(receiver, points)
    inside = (np.abs(horizontal) <= receiver.horizontal_rad / 2) & (np.abs(vertical) <= receiver.vertical_rad / 2)
    return inside & (distance_m >= receiver.range_m[0]) & (distance_m <= receiver.range_m[1])


def path_of_range(rays: Rays, receiver: Receiver | None, range_m: np.ndarray) -> np.ndarray:
    """Half the path of light from the emitter by a surface at ranges (N,) to the receiver, shape (N,) [m]."""
    if receiver is None:
        return range_m
    points = rays.origin_m + range_m[:, None] * rays.direction
    back_m = np.linalg.norm(points - np.asarray(receiver.origin_m), axis=1)
    return np.where(_at_the_receiver(rays, receiver), range_m, (range_m + back_m) / 2)


def range_of_path(rays: Rays, receiver: Receiver | None, path_m: np.ndarray) -> np.ndarray:
    """Ranges along rays from half paths (N,), shape (N,) [m]; the inverse of `path_of_range`.

    A path shorter than the way from the emitter to the receiver has no range: NaN.
    """
    if receiver is None:
        return path_m
    baseline = np.asarray(receiver.origin_m) - rays.origin_m
    whole = 2 * path_m
    with np.errstate(divide="ignore", invalid="ignore"):
        short = np.linalg.norm(baseline, axis=1) / whole
        along = np.einsum("nk,nk->n", baseline, rays.direction) / whole
        solved = path_m * ((1 - short) * (1 + short)) / (1 - along)
    return np.where(_at_the_receiver(rays, receiver), path_m, np.where(short < 1, solved, np.nan))


def path_windows(rays: Rays, receiver: Receiver | None) -> np.ndarray:
    """Gates of rays as intervals of half path, which grows with range, shape (N, 2) [m]."""
    return np.stack([path_of_range(rays, receiver, np.ascontiguousarray(end)) for end in rays.gate_m.T], axis=1)


def _at_the_receiver(rays: Rays, receiver: Receiver) -> np.ndarray:
    """Mask of rays that start at the receiver, shape (N,): half path and range are equal there."""
    return (rays.origin_m == np.asarray(receiver.origin_m)).all(axis=1)


def rotation_of_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """Rotation about the fixed axes x, then y, then z, as in URDF, SDF and ROS, shape (3, 3)."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll_rad, pitch_rad, yaw_rad))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    return np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]]) @ about_y @ about_x


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Rotation of a quaternion of any length above 0, shape (3, 3); columns are the axes.

    Raises:
        ValueError: It has no length.
    """
    quaternion = np.array([w, x, y, z], dtype=np.float64)
    largest = np.abs(quaternion).max()
    if largest == 0:
        raise ValueError("a quaternion has no length")
    # the largest first, so that squares neither vanish nor overflow
    quaternion /= largest
    w, x, y, z = quaternion / np.linalg.norm(quaternion, axis=-1)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
