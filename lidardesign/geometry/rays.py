"""Rays that a design fires and the returns that its receiver reports.

What rays meet: the first hit of each, or all surfaces along them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK


class Outcome(IntEnum):
    """What became of one ray; a gate is closed at its start and open at its end."""

    RETURN = 0
    OCCLUDED = 1
    AFTER_GATE = 2
    MISS = 3
    NOT_DETECTED = 4


@dataclass(frozen=True, eq=False)
class Rays:
    """An explicit ray list.

    Arguments:
        origin_m: Where rays start [m], shape (N, 3).
        direction: Unit vectors, shape (N, 3).
        gate_m: Start and end of the interval each ray listens in [m], shape (N, 2).
        sensor: The index of the sensor that fires it, shape (N,).
        time_s: When it fires within the frame [s], shape (N,).

    Raises:
        ConfigError: Non-finite values, directions that are not unit vectors, reversed or negative gates.
    """

    origin_m: np.ndarray
    direction: np.ndarray
    gate_m: np.ndarray
    sensor: np.ndarray
    time_s: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.origin_m)
        for name, tail, dtype in (
            ("origin_m", (3,), np.float64),
            ("direction", (3,), np.float64),
            ("gate_m", (2,), np.float64),
            ("sensor", (), np.int64),
            ("time_s", (), np.float64),
        ):
            values = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if values.shape != (count, *tail):
                raise ConfigError(f"shape {values.shape}", where=f"rays.{name}", allowed=f"{(count, *tail)}")
            if not np.isfinite(values).all():
                raise ConfigError("values are NaN or infinite", where=f"rays.{name}")
            object.__setattr__(self, name, values)
        lengths = np.linalg.norm(self.direction, axis=1)
        if count and np.abs(lengths - 1).max() > COARSE_SLACK:
            raise ConfigError("directions are not unit vectors", where="rays.direction")
        if count and (self.gate_m[:, 0].min() < 0 or (self.gate_m[:, 1] < self.gate_m[:, 0]).any()):
            raise ConfigError("a gate is negative or ends before it starts", where="rays.gate_m")

    def __len__(self) -> int:
        return len(self.origin_m)

    def subset(self, keep: np.ndarray) -> Rays:
        """The rays at an index or mask."""
        return Rays(self.origin_m[keep], self.direction[keep], self.gate_m[keep], self.sensor[keep], self.time_s[keep])


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


class Crossings(NamedTuple):
    """All surfaces that rays pass, as flat lists: ray (K,), range (K,) [m], |cosine| with the normal (K,)."""

    row: np.ndarray
    range_m: np.ndarray
    cosine: np.ndarray
