"""Candidates of baselines: layouts of any number of rays, with one gate or a gate per ray, in a bandwidth.

A design has one list of rays. Where a task's scenes are seen from several condition values (a robot's positions), it
has one list per value; all have the same number of rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from lidardesign.limits import MOST_RAYS
from lidardesign.scenes.rays import Rays, fire_times
from lidardesign.scoring.fired import Positions
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction

# A gate without width receives nothing, since gates are open at their end. Ranges that never vary get the width
# of the default 100 ps bin around them.
SMALLEST_GATE_M = 0.015
# Bandwidth grows almost in proportion to the number of rays: a few steps find the largest number that fits.
FIRST_GUESS, MOST_STEPS = 64, 8


def rays_at(points: np.ndarray, gate_m: np.ndarray) -> Rays:
    """Rays of one sensor at (x, y, z, azimuth, elevation), shape (N, 5 or 6), with one gate (2,) or each its own [m].

    They fire one after another over a frame, as a design's do.
    """
    return Rays(
        origin_m=points[:, :3],
        direction=direction(points[:, AZIMUTH], points[:, ELEVATION]),
        gate_m=np.broadcast_to(gate_m, (len(points), 2)).copy(),
        sensor=np.zeros(len(points)),
        time_s=fire_times(len(points), Bandwidth().rate_hz),
    )


def opened_gate(start_m: float | np.ndarray, end_m: float | np.ndarray) -> np.ndarray:
    """Gates that include both their ends, shape (..., 2) [m]; those without width get `SMALLEST_GATE_M`."""
    start, end = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    around = np.maximum(0.0, start - SMALLEST_GATE_M / 2)
    wide = end > start
    return np.stack(
        [np.where(wide, start, around), np.where(wide, np.nextafter(end, np.inf), around + SMALLEST_GATE_M)], axis=-1
    )


class LayoutSite(NamedTuple):
    """A design space and a scene that rays are laid out for.

    Arguments:
        space: The design space at a condition value.
        number: The index of that value.
        scene: The number of the held-out scene, for layouts drawn anew in each.
    """

    space: DesignSpace
    number: int = 0
    scene: int = 0


class Candidate(Protocol):
    """A layout of a baseline; `drawn_anew` is true where it differs from scene to scene."""

    name: str
    drawn_anew: bool

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> Positions:
        """Exactly `count` rays in each of the spaces."""

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> Positions | None:
        """As many rays as fit in a bandwidth [Mbit/s], the same number in each space; empty where not one fits.

        None where more than `MOST_RAYS` fit.
        """


@dataclass(frozen=True, eq=False)
class BaselineLayout:
    """A layout of any number of rays.

    Arguments:
        name: For messages.
        lay_out: Points (x, y, z, azimuth, elevation) of any number, and their gates or the one of all of them [m]:
            (count, site) to (count, 5), and (count, 2) or (2,).
        drawn_anew: Whether the points differ from scene to scene.
    """

    name: str
    lay_out: Callable[[int, LayoutSite], tuple[np.ndarray, np.ndarray]]
    drawn_anew: bool = False
    _known: dict[tuple[DesignSpace, int], Rays] = field(default_factory=dict, repr=False)

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> Positions:
        """See `Candidate`."""
        known = {} if self.drawn_anew else self._known
        for number, space in enumerate(spaces):
            if (space, count) not in known:
                known[space, count] = rays_at(*self.lay_out(count, LayoutSite(space, number, scene)))
        return tuple(known[space, count] for space in spaces)

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> Positions | None:
        """See `Candidate`."""
        count = most_within(lambda count: mean_mbps(self.positions(spaces, count), bandwidth), limit_mbps)
        return None if count is None else self.positions(spaces, count)


def most_within(mbps_of: Callable[[int], float], limit_mbps: float) -> int | None:
    """The most rays within a bandwidth that a few proportional steps find; None where they are more than `MOST_RAYS`.

    Arguments:
        mbps_of: Gives the bandwidth of a number of rays [Mbit/s].
        limit_mbps: The bandwidth [Mbit/s].
    """
    count, low, high = FIRST_GUESS, 0, math.inf
    for _ in range(MOST_STEPS):
        cost = mbps_of(count)
        low, high = (count, high) if cost <= limit_mbps else (low, count)
        if high - low <= 1 or cost == limit_mbps:
            break
        guess = math.floor(count * limit_mbps / cost) if cost > 0 else 2 * count
        if guess > MOST_RAYS:
            return None
        count = int(min(max(guess, low + 1), high - 1))
    return low


def whole_range(space: DesignSpace) -> np.ndarray:
    """The gate over all of a space's range, shape (2,) [m]."""
    return opened_gate(space.low[RANGE], space.high[RANGE])
