"""A design: sensors, and the patterns that they fire.

Chosen rays have a pattern for each number of rays that they were chosen for. Even rays follow from the sensors at any
number. Real parts and spinning sensors have one pattern, of which an even subset may be fired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.sensors.adaptive import AdaptivePatterns
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import TRAVELLED, Pattern, even_rays, even_subset, with_coordinates
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, boresight_of
from lidardesign.space import DIMENSIONS

# Chosen on training scenes, even in fields of view, rings of sensors that turn, and what real parts have.
LayoutName = Literal["chosen", "even", "spinning", "fixed"]
# Those in which sensors are fitted: the rays of real parts are what they are.
FITTED_LAYOUTS: tuple[LayoutName, ...] = ("chosen", "even", "spinning")
# Whether every ray has its sensor's gate or its own.
Gates = Literal["sensor", "ray"]


@dataclass(frozen=True, eq=False)
class DesignSpec:
    """A LiDAR system: sensors, the patterns that they fire, and its provenance.

    Arguments:
        name: The file's stem, the row's name in tables.
        sensors: At least one.
        layout: `chosen`: rays chosen on training scenes; `even`: a grid in each field of view; `spinning`: chosen
            rings; `fixed`: the rays of real parts or of a rig.
        patterns: Its rays, by ascending number; none of the layout `even`.
        constraints: The constraint document that it satisfies (plain values).
        certificates: Bounds on each choice of rays, one entry per number of rays.
        provenance: Command, seed, run and versions, for people.
        level: The share of each marginal that fields of view and gates hold.
        at: The condition values that the design is for, where it is for one, as {"x_m": 0.37}.
        mount: The body of a robot that it is on, in whose frame places and directions are; None: in the world.
        adaptive: Patterns that follow what they see, with as many rays as one of `patterns`; None without.
    """

    name: str
    sensors: tuple[Sensor, ...]
    layout: LayoutName = "even"
    patterns: tuple[Pattern, ...] = ()
    constraints: dict[str, Any] = field(default_factory=dict)
    certificates: tuple[dict[str, Any], ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)
    level: float = DEFAULT_LEVEL
    at: Mapping[str, float] = field(default_factory=dict)
    mount: str | None = None
    adaptive: AdaptivePatterns | None = None

    @property
    def frame(self) -> str:
        """The frame of its origins and directions, in words: the world's, or that of a robot's body."""
        return "the world's frame" if self.mount is None else f"the frame of the robot's body {self.mount!r}"

    @property
    def weights(self) -> np.ndarray:
        """Shares of the rays, shape (S,), summing to 1."""
        weights = np.array([sensor.weight for sensor in self.sensors], dtype=np.float64)
        return weights / weights.sum()

    @property
    def count(self) -> int | None:
        """The number of rays that it is meant to fire: that of its largest pattern, or its budget; None: any."""
        return len(self.patterns[-1]) if self.patterns else (self.constraints.get("budget") or {}).get("rays")

    @property
    def counts(self) -> list[int] | None:
        """The numbers of rays that it was chosen for, ascending; None where it can fire others."""
        return [len(pattern) for pattern in self.patterns] if self.layout == "chosen" else None

    @property
    def spins(self) -> bool:
        """True where its sensors spin: every channel is a ring."""
        return self.layout == "spinning"

    @property
    def size(self) -> int | None:
        """The number of rays of its fixed pattern, of which it may fire an even subset; None where it has none."""
        return None if self.layout in ("chosen", "even") else self.count

    @property
    def condition(self) -> str | None:
        """The condition along which its rays differ, as "x_m"; None where they do not."""
        return self.patterns[-1].dimension if self.patterns else None

    @property
    def has_gates_per_ray(self) -> bool:
        """True where rays of one sensor have different gates."""
        return any(pattern.gates == "ray" for pattern in self.patterns)

    def pattern(self, count: int) -> Pattern | None:
        """The pattern with `count` rays; None where it has none."""
        return next((pattern for pattern in self.patterns if len(pattern) == count), None)

    def following(self, count: int) -> AdaptivePatterns | None:
        """The patterns with `count` rays that follow what they see; None without."""
        return self.adaptive if self.adaptive is not None and len(self.adaptive) == count else None

    def rays_per_sensor(self, count: int | None = None) -> np.ndarray | None:
        """Rays of each sensor, of `count` or of its own number, shape (S,); None where that is open."""
        count = self.count if count is None else count
        if count is None:
            return None
        pattern = self.pattern(count)
        if pattern is not None:
            return pattern.per_sensor(len(self.sensors))
        return split_budget(self.weights if self.size is None else self._own_counts, count, each=self.size is None)

    @property
    def _own_counts(self) -> np.ndarray:
        """Rays of each sensor in its largest pattern, shape (S,)."""
        return self.patterns[-1].per_sensor(len(self.sensors))

    def rays(self, count: int | None = None, at: Mapping[str, float] | None = None) -> Rays:
        """The rays that it fires, evenly over a frame: the one source of a design's rays.

        Arguments:
            count: Rays per frame; None takes its own number.
            at: Condition values, as {"x_m": 0.37}: patterns along a condition are evaluated, others are moved.

        Raises:
            ConfigError: It cannot fire so many rays, has no number of its own, or cannot be at this condition.
        """
        count = self.count if count is None else count
        if count is None:
            raise ConfigError("the design names no number of rays", where=self.name, hint="give --rays N")
        here = self.at_condition(at or {}) if at or self.condition else self
        pattern = here.pattern(count)
        if pattern is not None:
            return pattern.at()
        if self.layout == "even":
            return even_rays(here.sensors, split_budget(self.weights, count, each=True))
        if self.size is not None and count <= self.size:
            table = here.patterns[-1].at()
            shares = split_budget(self._own_counts, count)
            own = [np.flatnonzero(table.sensor == index) for index in range(len(shares))]
            chosen = [rows[even_subset(table.direction[rows], int(n))] for rows, n in zip(own, shares, strict=True)]
            return replace(table.subset(np.sort(np.concatenate(chosen))), time_s=fire_times(count, DEFAULT_RATE_HZ))
        if self.counts is not None:
            raise ConfigError(
                f"no choice of {count} rays",
                where=self.name,
                allowed=", ".join(map(str, self.counts)),
                hint=f"lidardesign fit RUN --rays {count}",
            )
        raise ConfigError(
            f"{count} rays, but the design's fixed pattern has {self.size}",
            where=self.name,
            allowed=f"at most {self.size}",
            hint="a design of more parts: lidardesign catalog show NAME --rays N --out FILE",
        )

    def remounted(self, index: int, origin_m: np.ndarray, frame: np.ndarray) -> DesignSpec:
        """The design with one sensor at another pose, to which its rays and their gates go with it.

        Certificates are of other rays, and are left out.

        Arguments:
            index: The sensor.
            origin_m: Its new place, shape (3,) [m].
            frame: Its new axes, rows forward, horizontal, vertical, shape (3, 3).
        """
        old = self.sensors[index]
        turn, after_m = frame.T @ old.frame, np.array(origin_m, dtype=np.float64)
        covariance = old.origin_covariance_m2
        azimuth, elevation, roll = boresight_of(frame)
        new = replace(
            old, origin_m=after_m, azimuth_rad=azimuth, elevation_rad=elevation, roll_rad=roll,
            origin_covariance_m2=None if covariance is None else turn @ covariance @ turn.T,
        )  # fmt: skip
        patterns, adaptive = (
            tuple(pattern.remounted(index, old.origin_m, after_m, turn) for pattern in every)
            for every in (self.patterns, () if self.adaptive is None else self.adaptive.patterns)
        )
        sensors = (*self.sensors[:index], new, *self.sensors[index + 1 :])
        follows = None if self.adaptive is None else replace(self.adaptive, patterns=adaptive)
        return replace(self, sensors=sensors, patterns=patterns, adaptive=follows, certificates=())

    def at_condition(self, at: Mapping[str, float]) -> DesignSpec:
        """The design at one value of its conditions, with patterns of one knot.

        Patterns along a condition are evaluated there. Other designs are moved: the named coordinate of every origin
        becomes the value; directions and gates stay, and certificates, which are of other rays then, are left out.

        Raises:
            ConfigError: A name that is no coordinate, a value beyond the ends of a pattern, or none where rays differ.
        """
        for name, value in at.items():
            if name not in DIMENSIONS:
                raise ConfigError(
                    f"{name!r} is not a dimension of the design space", where="--at", allowed=", ".join(DIMENSIONS)
                )
            if not math.isfinite(value):
                raise ConfigError(f"{name}={value}", where="--at", allowed="a finite number")
            allowed = TRAVELLED if self.condition is None else (self.condition,)
            if name not in allowed and self.at.get(name) != value:
                raise ConfigError(
                    f"{self.name} cannot be moved to {name}={value:g}",
                    where="--at",
                    allowed=f"{name}={self.at[name]:g}" if name in self.at else ", ".join(allowed),
                    hint=f"lidardesign fit RUN --at {name}={value:g}",
                )
        here = {**self.at, **at}
        moves = {DIMENSIONS.index(name): float(value) for name, value in at.items() if name in TRAVELLED}
        sensors = tuple(replace(sensor, origin_m=with_coordinates(sensor.origin_m, moves)) for sensor in self.sensors)
        if self.condition is None:
            patterns = tuple(
                replace(pattern, origin_m=with_coordinates(pattern.origin_m, moves)) for pattern in self.patterns
            )
        else:
            patterns = tuple(Pattern.of(pattern.at(at.get(self.condition))) for pattern in self.patterns)
        kept = self.certificates if here == self.at or self.condition is not None else ()
        return replace(self, sensors=sensors, patterns=patterns, at=here, certificates=kept)


# A bound that leaves more of the loss open than this certifies nothing that anyone would act on.
MOST_GAP = 0.5
