"""The six-dimensional design space of rays: origin, direction and range.

A design point is d = (x, y, z, azimuth, elevation, range) in metres and radians
(Behari et al. 2026, section 3). Densities are stated per *chart volume*: with the
measure `solid_angle` the fifth chart coordinate is sin(elevation), so that
dx dy dz dazimuth dsin(elevation) drange is a volume times a solid angle times a
length, and nothing is singular at the poles; with `angles` it is the elevation
itself, the paper's chart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import FULL_TURN, SLACK, wrap_turn
from lidardesign.run.yaml import plain_number

DIMENSIONS = ("x_m", "y_m", "z_m", "azimuth_rad", "elevation_rad", "range_m")
X, Y, Z, AZIMUTH, ELEVATION, RANGE = range(6)

Measure = Literal["solid_angle", "angles"]
MEASURES = ("solid_angle", "angles")
# A million kilometres: larger lengths are wrong units, and fourth powers of lengths must stay finite.
FARTHEST_M = 1e9
# Between these limits all squares and products in densities are finite, in float32 too.
SHORTEST_M = 1 / FARTHEST_M
# Angles of many turns lose digits; nobody needs more than one.
MOST_TURNS = 100
LARGEST_ANGLE_RAD = MOST_TURNS * FULL_TURN
# Bounds such as 2 pi are written with about ten digits.
ROUNDING_RAD = SLACK


def direction(azimuth_rad: Any, elevation_rad: Any) -> np.ndarray:
    """Unit vectors v = (cos e cos a, cos e sin a, sin e), shape (..., 3)."""
    azimuth, elevation = np.broadcast_arrays(azimuth_rad, elevation_rad)
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)], axis=-1)


def angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth in [0, 2 pi) and elevation in [-pi/2, pi/2] of vectors of any length, shape (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    return wrap_turn(np.arctan2(y, x)), np.arctan2(z, np.hypot(x, y))


def observed_point(points: np.ndarray) -> np.ndarray:
    """The scene points M(d) = x + range * v that design points observe (paper, eq. 2): (..., 6) to (..., 3) [m]."""
    points = np.asarray(points, dtype=np.float64)
    return points[..., :3] + points[..., 5:] * direction(points[..., AZIMUTH], points[..., ELEVATION])


def aim(origins: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Design points that observe `targets` from `origins`: (..., 3), (..., 3) to (..., 6)."""
    origins, targets = np.broadcast_arrays(np.asarray(origins, float), np.asarray(targets, float))
    offset = targets - origins
    azimuth, elevation = angles(offset)
    return np.concatenate(
        [origins, azimuth[..., None], elevation[..., None], np.linalg.norm(offset, axis=-1, keepdims=True)], -1
    )


@dataclass(frozen=True)
class DesignSpace:
    """A box of admissible design points; a dimension with low == high is fixed and leaves the flow.

    Arguments:
        low: Lower bounds in the order of `DIMENSIONS` [m, m, m, rad, rad, m].
        high: Upper bounds. The azimuth interval may start anywhere and spans at most a full turn.
        condition: Names of the dimensions that the density is conditioned on (uniform over their bounds).
        measure: Chart measure of densities; see the module docstring.

    Raises:
        ConfigError: Bounds that are not finite, reversed, or outside their physical range.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    condition: tuple[str, ...] = field(default=())
    measure: Measure = "solid_angle"

    def __post_init__(self) -> None:
        if len(self.low) != 6 or len(self.high) != 6:
            raise ConfigError(f"a design space has 6 bounds each, found {len(self.low)} and {len(self.high)}")
        for name, low, high in zip(DIMENSIONS, self.low, self.high, strict=True):
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ConfigError(f"bounds {low} to {high} are not finite", where=f"space.{name}")
            if low > high:
                raise ConfigError(f"the lower bound {low} is above the upper bound {high}", where=f"space.{name}")
        self._check_physical_ranges()
        unknown = sorted(set(self.condition) - set(DIMENSIONS))
        if unknown:
            raise ConfigError(
                f"unknown dimension {unknown[0]!r}", where="space.condition", allowed=", ".join(DIMENSIONS)
            )
        if len(set(self.condition)) < len(self.condition):
            raise ConfigError("a dimension is given twice", where="space.condition", allowed="each once")
        if self.measure not in MEASURES:
            raise ConfigError(f"unknown measure {self.measure!r}", where="space.measure", allowed=", ".join(MEASURES))

    def _check_physical_ranges(self) -> None:
        if self.high[AZIMUTH] - self.low[AZIMUTH] > FULL_TURN + ROUNDING_RAD:
            raise ConfigError(
                "the azimuth spans more than a full turn", where="space.azimuth_rad", allowed="at most 2 pi"
            )
        if max(-self.low[ELEVATION], self.high[ELEVATION]) > math.pi / 2 + ROUNDING_RAD:
            raise ConfigError(
                f"elevation {self.low[ELEVATION]} to {self.high[ELEVATION]} leaves the sphere",
                where="space.elevation_rad",
                allowed="-pi/2 to pi/2 rad",
            )
        if max(abs(self.low[AZIMUTH]), abs(self.high[AZIMUTH])) > LARGEST_ANGLE_RAD:
            raise ConfigError(
                f"azimuth {self.low[AZIMUTH]} to {self.high[AZIMUTH]} rad is many turns away",
                where="space.azimuth_rad",
                allowed=f"at most {MOST_TURNS} turns from 0",
            )
        for index in (X, Y, Z, RANGE):
            farthest = max(abs(self.low[index]), abs(self.high[index]))
            if farthest > FARTHEST_M:
                raise ConfigError(
                    f"a bound is {farthest:g} m away",
                    where=f"space.{DIMENSIONS[index]}",
                    allowed=f"at most {FARTHEST_M:g} m from the origin",
                )
        if self.low[RANGE] < 0:
            raise ConfigError(f"range {self.low[RANGE]} m is negative", where="space.range_m", allowed="0 or more")

    @cached_property
    def free(self) -> tuple[int, ...]:
        """Indices of the dimensions that are not fixed; elevation bounds with equal sines count as fixed."""
        return tuple(i for i in range(6) if self.low[i] < self.high[i] and self.chart_low[i] < self.chart_high[i])

    @cached_property
    def conditioned(self) -> tuple[int, ...]:
        """Indices of the free dimensions that the density is conditioned on."""
        return tuple(i for i in self.free if DIMENSIONS[i] in self.condition)

    @property
    def turns(self) -> bool:
        """True if both angles are free, so that rays can be aimed at any point."""
        return {AZIMUTH, ELEVATION} <= set(self.free)

    @cached_property
    def full_azimuth(self) -> bool:
        """True if the azimuth covers the full turn, so that it is periodic."""
        return self.high[AZIMUTH] - self.low[AZIMUTH] >= FULL_TURN - ROUNDING_RAD

    @cached_property
    def chart_low(self) -> np.ndarray:
        """Lower bounds in chart coordinates, shape (6,)."""
        return self._chart_bounds(self.low)

    @cached_property
    def chart_high(self) -> np.ndarray:
        """Upper bounds in chart coordinates, shape (6,)."""
        return self._chart_bounds(self.high)

    def _chart_bounds(self, bounds: tuple[float, ...]) -> np.ndarray:
        bounds = np.array(bounds, dtype=np.float64)
        if self.measure == "solid_angle":
            bounds[ELEVATION] = np.sin(bounds[ELEVATION])
        return bounds

    def to_chart(self, points: np.ndarray) -> np.ndarray:
        """Chart coordinates of design points, (..., 6) to (..., 6), with the azimuth wrapped into the bounds."""
        chart = self.wrap(points)
        if self.measure == "solid_angle":
            chart[..., ELEVATION] = np.sin(chart[..., ELEVATION])
        return chart

    def from_chart(self, chart: np.ndarray) -> np.ndarray:
        """Design points of chart coordinates, (..., 6) to (..., 6)."""
        points = np.array(chart, dtype=np.float64)
        if self.measure == "solid_angle":
            points[..., ELEVATION] = np.arcsin(np.clip(points[..., ELEVATION], -1.0, 1.0))
        return points

    def to_unit(self, points: np.ndarray) -> np.ndarray:
        """Free dimensions scaled to [-1, 1]: (..., 6) to (..., len(free))."""
        free = list(self.free)
        low, high = self.chart_low[free], self.chart_high[free]
        return (2 * self.to_chart(points)[..., free] - low - high) / (high - low)

    def from_unit(self, unit: np.ndarray) -> np.ndarray:
        """Design points of unit coordinates, (..., len(free)) to (..., 6); fixed dimensions are exact."""
        unit = np.asarray(unit, dtype=np.float64)
        free = list(self.free)
        chart = np.broadcast_to(self.chart_low, (*unit.shape[:-1], 6)).copy()
        chart[..., free] = self.chart_low[free] + (unit + 1) / 2 * (self.chart_high[free] - self.chart_low[free])
        points = self.from_chart(chart)
        fixed = [i for i in range(6) if i not in self.free]
        points[..., fixed] = np.array(self.low)[fixed]
        return np.clip(points, self.low, self.high)

    def wrap(self, points: np.ndarray) -> np.ndarray:
        """A copy with azimuths outside the bounds moved by whole turns to be nearest to them."""
        points = np.array(points, dtype=np.float64)
        azimuth = points[..., AZIMUTH]
        low, high = self.low[AZIMUTH], self.high[AZIMUTH]
        points[..., AZIMUTH] = np.where(
            (azimuth < low) | (azimuth > high), wrap_turn(azimuth, (low + high) / 2 - math.pi), azimuth
        )
        return points

    def contains(self, points: np.ndarray, tolerance: float = SLACK) -> np.ndarray:
        """Mask of design points inside the box, (..., 6) to (...); the azimuth is periodic."""
        wrapped = self.wrap(points)
        inside = (wrapped >= np.array(self.low) - tolerance) & (wrapped <= np.array(self.high) + tolerance)
        return inside.all(axis=-1)

    def at(self, condition: Mapping[str, float]) -> DesignSpace:
        """The space with conditioning dimensions fixed at values, as {"x_m": 0.37}.

        Raises:
            ConfigError: A name that is no conditioning dimension, or a value outside its bounds.
        """
        low, high = list(self.low), list(self.high)
        for name, value in condition.items():
            if name not in self.condition:
                raise ConfigError(
                    f"{name!r} is not a condition of the density",
                    where="--at",
                    allowed=", ".join(self.condition) or "none: the density has no conditions",
                )
            index = DIMENSIONS.index(name)
            if not self.low[index] <= value <= self.high[index]:
                raise ConfigError(
                    f"{name}={value:g} is outside the design space",
                    where="--at",
                    allowed=f"{self.low[index]:g} to {self.high[index]:g}",
                )
            low[index] = high[index] = float(value)
        return replace(self, low=tuple(low), high=tuple(high))

    def sample(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Design points uniform in the chart measure, shape (count, 6)."""
        return self.from_unit(generator.uniform(-1.0, 1.0, (count, len(self.free))))

    def as_dict(self) -> dict[str, Any]:
        """Bounds by name, as in configuration files."""
        bounds: dict[str, Any] = {
            name: [low, high] for name, low, high in zip(DIMENSIONS, self.low, self.high, strict=True)
        }
        return {**bounds, "condition": list(self.condition), "measure": self.measure}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> DesignSpace:
        """The space of a configuration section: a pair of bounds or one fixed number per dimension."""
        pairs = [values[name] if isinstance(values[name], list | tuple) else [values[name]] * 2 for name in DIMENSIONS]
        return cls(
            low=tuple(float(pair[0]) for pair in pairs),
            high=tuple(float(pair[1]) for pair in pairs),
            condition=tuple(values.get("condition", ())),
            measure=values.get("measure", "solid_angle"),
        )


def condition_values(at: Mapping[str, float] | Sequence[str]) -> dict[str, float]:
    """The values of conditions, as {"x_m": 0.37}, also from texts; the design space checks their names.

    Raises:
        ConfigError: A text is not NAME=VALUE with a finite number, or a name is given twice.
    """
    if isinstance(at, Mapping):
        return dict(at)
    values: dict[str, float] = {}
    for text in at:
        name, equals, value = (part.strip() for part in text.partition("="))
        try:
            number = plain_number(value)
        except ValueError:
            number = math.nan
        if not (name and equals and math.isfinite(number)):
            raise ConfigError(f"{text!r}", where="--at", allowed="NAME=VALUE with a finite number, such as x_m=0.37")
        if name in values:
            raise ConfigError(f"{name} is given twice: {values[name]:g} and {number:g}", where="--at")
        values[name] = number
    return values
