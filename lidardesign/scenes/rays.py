"""Rays that a design fires, what they meet, and the returns that its receiver reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.space import angles, direction

# Frames per second where nothing else is said.
DEFAULT_RATE_HZ = 10.0


def fire_times(count: int, rate_hz: float) -> np.ndarray:
    """When each ray fires in its frame, i / (n * rate), shape (n,) [s]."""
    return np.arange(count) / (max(count, 1) * rate_hz)


class Outcome(IntEnum):
    """What became of one ray; a gate is closed at its start and open at its end."""

    RETURN = 0
    OCCLUDED = 1
    AFTER_GATE = 2
    MISS = 3
    NOT_DETECTED = 4


@dataclass(frozen=True, eq=False)
class Rays:
    """An explicit list of rays, in the order in which they fire.

    Arguments:
        origin_m: Where rays start [m], shape (N, 3).
        direction: Unit vectors, shape (N, 3).
        gate_m: Start and end of the interval each ray listens in [m], shape (N, 2).
        sensor: The index of the sensor that fires it, shape (N,).
        time_s: When it fires within the frame [s], shape (N,).
        angles_rad: The azimuths and elevations that directions were made from, shape (N, 2); None where they follow
            from the directions. Files hold angles: reading and writing them again changes no digit.

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

    def __post_init__(self) -> None:
        count = len(self.origin_m)
        for name, tail, dtype in (
            ("origin_m", (3,), np.float64),
            ("direction", (3,), np.float64),
            ("gate_m", (2,), np.float64),
            ("sensor", (), np.int64),
            ("time_s", (), np.float64),
            *([] if self.angles_rad is None else [("angles_rad", (2,), np.float64)]),
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
        """Rays whose angles (N,) keep every digit, evenly over a frame at the default rate."""
        looking = direction(azimuth_rad, elevation_rad)
        times = fire_times(len(looking), DEFAULT_RATE_HZ)
        return cls(origin_m, looking, gate_m, sensor, times, np.stack([azimuth_rad, elevation_rad], axis=1))

    @classmethod
    def joined(cls, parts: Sequence[Rays]) -> Rays:
        """Several lists as one, one after the other, with angles as they follow from directions."""
        names = ("origin_m", "direction", "gate_m", "sensor", "time_s")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    @property
    def azimuth_rad(self) -> np.ndarray:
        """Shape (N,)."""
        return angles(self.direction)[0] if self.angles_rad is None else self.angles_rad[:, 0]

    @property
    def elevation_rad(self) -> np.ndarray:
        """Shape (N,)."""
        return angles(self.direction)[1] if self.angles_rad is None else self.angles_rad[:, 1]

    def as_angles(self) -> Rays:
        """These rays as a file holds them: directions are those of their own angles, and may differ by rounding."""
        return Rays.from_angles(self.origin_m, *angles(self.direction), self.gate_m, self.sensor)

    def __len__(self) -> int:
        return len(self.origin_m)

    def subset(self, keep: np.ndarray) -> Rays:
        """The rays at an index or mask."""
        return Rays(*(None if column is None else column[keep] for column in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Returns:
    """What the receiver reports, one entry per ray.

    Arguments:
        rays: The rays that were fired.
        outcome: Values of `Outcome`, shape (N,).
        range_m: The measured one-way range [m], NaN without a return, shape (N,).
        body: Index of the body that was hit inside the gate, shape (N,); -1 without a return, and where a detector took
            noise for one. For scoring only.
        frame: The scene's time frame that they were measured in.
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
        """How many rays met each outcome, by lower-case name."""
        return {outcome.name.lower(): int((self.outcome == outcome).sum()) for outcome in Outcome}


@dataclass(frozen=True, eq=False)
class Hits:
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
        """So many misses."""
        return cls(np.full(count, np.inf), np.full(count, -1, dtype=np.int64), np.zeros((count, 3)))

    @classmethod
    def joined(cls, parts: Sequence[Hits]) -> Hits:
        """Several lists as one, one after the other."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))

    def subset(self, chosen: np.ndarray | slice) -> Hits:
        """The hits at an index or mask."""
        return Hits(*(column[chosen] for column in vars(self).values()))


class Crossings(NamedTuple):
    """All surfaces that rays pass, as flat lists: ray (K,), range (K,) [m], |cosine| with the normal (K,)."""

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
