"""The bounds that every parameter of every component must keep, as arrays: what the M-step works with.

Angles are internal ones (see `features`); gates and fields of view are bounds on reported intervals, which
the factor z = `interval_factor(level)` ties to means and spreads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from lidardesign.design.mixture.features import Features
from lidardesign.numerics import wrap_angle

# Smallest standard deviations relative to the spread of all data: below it a component has collapsed on a
# duplicate. In angle and range separately, and per origin axis. Where the data themselves do not vary, their scale
# is a share of the space (see `features`), so that no length stands here that would be coarse in a small world.
RELATIVE_FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of K components; low and high arrays of shape (K,) where not said otherwise.

    Arguments:
        interval: z, the standard deviations on each side of a mean that an interval spans.
        origin_low, origin_high: Box of the mean origin [m], shape (K, 3).
        free_low, free_high: Boxes one of which holds the interval of the origin along each axis, shape (K, M, 3) [m].
        origin_spread: Largest standard deviation of the origin along any direction [m].
        origin_thickness: Largest standard deviation of the origin along its thinnest direction [m].
        azimuth_centre, azimuth_half: Interval of the boresight's azimuth on the circle [rad].
        elevation_low, elevation_high: Of the boresight [rad].
        spread_low, spread_high: Angular standard deviations, horizontal and vertical, shape (K, 2) [rad].
        start_low, start_high, end_low, end_high, width_low, width_high: Of the gate [m].
    """

    interval: float
    origin_low: np.ndarray
    origin_high: np.ndarray
    free_low: np.ndarray
    free_high: np.ndarray
    origin_spread: np.ndarray
    origin_thickness: np.ndarray
    azimuth_centre: np.ndarray
    azimuth_half: np.ndarray
    elevation_low: np.ndarray
    elevation_high: np.ndarray
    spread_low: np.ndarray
    spread_high: np.ndarray
    start_low: np.ndarray
    start_high: np.ndarray
    end_low: np.ndarray
    end_high: np.ndarray
    width_low: np.ndarray
    width_high: np.ndarray

    def __len__(self) -> int:
        return len(self.origin_low)

    def take(self, rows: np.ndarray) -> Bounds:
        """The bounds of some components, in their order."""
        arrays = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "interval"}
        return replace(self, **arrays)

    def narrowed(self, width_m: float) -> Bounds:
        """The same with gates no wider than a common cap [m], never below a component's least width.

        A gate that must start early and end late has a least width, too.
        """
        least = np.maximum(self.width_low, self.end_low - self.start_high)
        return replace(self, width_high=np.maximum(np.minimum(self.width_high, width_m), least))

    @classmethod
    def unbounded(cls, count: int, interval: float) -> Bounds:
        """Bounds that bind nowhere."""
        low, high = np.full(count, -math.inf), np.full(count, math.inf)
        return cls(
            interval=interval,
            origin_low=np.full((count, 3), -math.inf),
            origin_high=np.full((count, 3), math.inf),
            free_low=np.full((count, 1, 3), -math.inf),
            free_high=np.full((count, 1, 3), math.inf),
            origin_spread=high,
            origin_thickness=high,
            azimuth_centre=np.zeros(count),
            azimuth_half=np.full(count, math.pi),
            elevation_low=np.full(count, -math.pi / 2),
            elevation_high=np.full(count, math.pi / 2),
            spread_low=np.zeros((count, 2)),
            spread_high=np.full((count, 2), math.pi / interval),
            start_low=low,
            start_high=high,
            end_low=low,
            end_high=high,
            width_low=np.zeros(count),
            width_high=high,
        )


@dataclass(frozen=True)
class Floors:
    """Smallest standard deviations: of the origin and the range [m], of angles [rad]."""

    origin_m: float
    angle_rad: float
    range_m: float

    @classmethod
    def of(cls, features: Features) -> Floors:
        """Floors relative to the scale of the data."""
        count = len(features.axes.origin)
        origin = float(features.scale[:count].min()) if count else 1.0
        reach = float(features.scale[-1]) if features.axes.range else 1.0
        return cls(RELATIVE_FLOOR * origin, RELATIVE_FLOOR * features.angular_scale, RELATIVE_FLOOR * reach)


def clip_azimuth(azimuth_rad: np.ndarray, bounds: Bounds) -> np.ndarray:
    """The nearest admissible azimuth on the circle, shape (K,) [rad]."""
    offset = wrap_angle(azimuth_rad - bounds.azimuth_centre)
    free = bounds.azimuth_half >= math.pi
    clipped = bounds.azimuth_centre + np.clip(offset, -bounds.azimuth_half, bounds.azimuth_half)
    return np.where(free, azimuth_rad, clipped)
