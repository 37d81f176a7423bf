"""What a baseline may take: layouts of any number of rays, even placements, and what dense rays see of training scenes.

A design has one list of rays. Where a task's scenes are seen from several condition values (a robot's positions), it
has one list per value; all have the same number of rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.layouts.grid import grid_tangent, low_discrepancy
from lidardesign.design.sensor import MOST_RAYS
from lidardesign.errors import ConfigError
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Rays, fire_times
from lidardesign.numerics import EPSILON, wrap_turn
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, FULL_TURN, RANGE, DesignSpace, direction, observed_point

RAY_AXES = 5  # x, y, z, azimuth, elevation: everything but the range
# A gate without width hears nothing, since gates are open at their end. Ranges that never vary get the width
# of the default 100 ps bin around them.
SMALLEST_GATE_M = 0.015


def even_unit(count: int, extents: np.ndarray) -> np.ndarray:
    """Exactly `count` even points in the unit cube of the axes given by their extents, shape (count, k).

    No axis gives equal points, one a cell-centred line, two a cell-centred grid with cells as square as
    whole rays allow, more a low-discrepancy sequence.
    """
    if len(extents) == 2:
        return grid_tangent(float(extents[0]), float(extents[1]), count) / extents + 0.5
    if len(extents) == 1:
        return (np.arange(count)[:, None] + 0.5) / count
    return low_discrepancy(count, len(extents))


def even_placement(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """Even points over the axes of a box that have a width, shapes (5,), (5,) to (count, 5).

    Two axes in the same unit (two lengths, or azimuth and elevation) get square cells in that unit; a length
    beside an angle gets cells that are square relative to the box.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    free = np.flatnonzero(high > low)
    extents = (high - low)[free]
    if len(free) == 2 and (free[0] < AZIMUTH) != (free[1] < AZIMUTH):
        extents = np.ones(2)
    points = np.tile(low, (count, 1))
    points[:, free] += even_unit(count, extents) * (high - low)[free]
    return np.clip(points, low, high)


def rays_at(points: np.ndarray, gate_m: np.ndarray) -> Rays:
    """Rays of one sensor at (x, y, z, azimuth, elevation), shape (N, 5 or 6), all with one gate (2,) [m].

    They fire one after another over a frame, as a design's do.
    """
    return Rays(
        origin_m=points[:, :3],
        direction=direction(points[:, AZIMUTH], points[:, ELEVATION]),
        gate_m=np.tile(gate_m, (len(points), 1)),
        sensor=np.zeros(len(points)),
        time_s=fire_times(len(points), Bandwidth().rate_hz),
    )


def opened_gate(start_m: float, end_m: float) -> np.ndarray:
    """A gate that hears both its ends, shape (2,) [m]; one without width gets `SMALLEST_GATE_M`."""
    if end_m > start_m:
        return np.array([start_m, np.nextafter(end_m, np.inf)])
    start = max(0.0, start_m - SMALLEST_GATE_M / 2)
    return np.array([start, start + SMALLEST_GATE_M])


RaysPerCondition = tuple[Rays, ...]  # one list of rays per condition value, in the task's order


class LayoutSite(NamedTuple):
    """Where and for which scene rays are laid out.

    Arguments:
        space: The design space at a condition value.
        number: Which of the values it is.
        scene: The held-out scene, for what is drawn anew in each.
    """

    space: DesignSpace
    number: int = 0
    scene: int = 0


class Candidate(Protocol):
    """One layout that a baseline may take; `drawn_anew` says whether it differs from scene to scene."""

    name: str
    drawn_anew: bool

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> RaysPerCondition:
        """Exactly `count` rays in each of the spaces."""

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> RaysPerCondition:
        """As many rays as fit in a bandwidth [Mbit/s], the same number in each space; none where not one fits."""


@dataclass(frozen=True, eq=False)
class BaselineLayout:
    """A layout whose rays all have one gate.

    Arguments:
        name: For messages.
        place: Even or random points (x, y, z, azimuth, elevation) of any number, (count, site) to (count, 5).
        gate_m: The gate of all its rays, shape (2,).
        drawn_anew: Whether the points differ from scene to scene.
    """

    name: str
    place: Callable[[int, LayoutSite], np.ndarray]
    gate_m: np.ndarray
    drawn_anew: bool = False

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> RaysPerCondition:
        """See `Candidate`."""
        sites = (LayoutSite(space, number, scene) for number, space in enumerate(spaces))
        return tuple(rays_at(self.place(count, site), self.gate_m) for site in sites)

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> RaysPerCondition:
        """See `Candidate`.

        Raises:
            ConfigError: More rays than any sensor fires fit in.
        """
        count = rays_within(
            limit_mbps,
            bandwidth,
            self.gate_m,
            before="baselines of ",
            hint="narrow the design's gates: they are far longer than the task's ranges",
        )
        return self.positions(spaces, count)


def rays_within(
    limit_mbps: float,
    bandwidth: Bandwidth,
    gate_m: np.ndarray,
    *,
    before: str = "",
    after: str = "",
    hint: str | None = None,
) -> int:
    """The number of rays with one gate (2,) [m] that fit in a bandwidth [Mbit/s].

    Raises:
        ConfigError: They are more than any sensor fires; the words before and after their number say whose they are.
    """
    width_m = np.diff(gate_m)
    # the ratio of two multiples of one bin may lie an ulp below a whole number
    count = math.floor(limit_mbps / bandwidth.mbps_of_widths(width_m) * (1 + EPSILON))
    if count > MOST_RAYS:
        raise ConfigError(
            f"a design of {limit_mbps:.3g} Mbit/s compares with {before}{count:.3g} rays{after}",
            where="bandwidth",
            allowed=f"at most {MOST_RAYS:,} rays",
            hint=hint,
        )
    while count and bandwidth.mbps_of_widths(width_m, count) > limit_mbps:
        count -= 1
    return count


def mean_mbps(positions: RaysPerCondition, bandwidth: Bandwidth) -> float:
    """What reading rays out costs, averaged over condition values [Mbit/s]."""
    return math.fsum(bandwidth.mbps(rays) for rays in positions) / len(positions)


def whole_range(space: DesignSpace) -> np.ndarray:
    """The gate that hears all of a space's range, shape (2,) [m]."""
    return opened_gate(space.low[RANGE], space.high[RANGE])


def central(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the central 99 % of each column, (N, ...) to two of shape (...)."""
    tail = (1 - 0.99) / 2
    low, high = np.quantile(values, [tail, 1 - tail], axis=0)
    return low, np.maximum(low, high)


DENSE_RAYS = 4096  # per scene and frame: the ends of the central 99 % then rest on 20 rays in each
MOST_VIEWS = 128  # scenes times frames that are looked at: evenly spread where there are more


@dataclass(frozen=True, eq=False)
class Observed:
    """What rays return on targets.

    Arguments:
        points: Design points with a return, the azimuth unrolled to one arc, shape (K, 6).
        hits_m: Where they hit, shape (K, 3).
    """

    points: np.ndarray
    hits_m: np.ndarray


class TrainingViews:
    """The training scenes at up to `MOST_VIEWS` of their frames, evenly spread over scenes and time.

    Arguments:
        space: The design space.
        train: The training scenes.
    """

    def __init__(self, space: DesignSpace, train: Sequence[Scene]) -> None:
        self.space, self.train = space, train

    @cached_property
    def casters(self) -> list[tuple[Scene, SceneCaster]]:
        """A caster per scene and frame, built once."""
        return [(self.train[i], SceneCaster(self.train[i], frame)) for i, frame in spread_frames(self.train)]

    def hits(self, points: np.ndarray) -> Observed:
        """What rays at (N, 5 or 6) return on targets inside the space's range, over all views."""
        lowest, highest = whole_range(self.space)
        looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
        kept = [np.zeros((0, 6))]
        for scene, caster in self.casters:
            found = caster.first_hit(points[:, :3], looking)
            target = np.array([*(body.is_target for body in scene.bodies), False])[found.body]
            seen = target & (found.range_m >= lowest) & (found.range_m < highest)
            kept.append(np.column_stack([points[seen, :RAY_AXES], found.range_m[seen]]))
        design = np.concatenate(kept)
        hits_m = observed_point(design)
        if self.space.full_azimuth:
            design[:, AZIMUTH] = unrolled(design[:, AZIMUTH])
        return Observed(design, hits_m)

    def missing_returns(self, lists: Sequence[RaysPerCondition]) -> list[float]:
        """The share of rays without a return inside their gate, over all views."""
        return [self._missing(positions) for positions in lists]

    def _missing(self, positions: RaysPerCondition) -> float:
        returned = fired = 0
        for rays in positions:
            for _, caster in self.casters:
                range_m = caster.first_hit(rays.origin_m, rays.direction).range_m
                returned += int(((range_m >= rays.gate_m[:, 0]) & (range_m < rays.gate_m[:, 1])).sum())
                fired += len(rays)
        return 1.0 - returned / max(fired, 1)


def spread_frames(scenes: Sequence[Scene], most: int = MOST_VIEWS) -> list[tuple[int, int]]:
    """All (scene, frame), or `most` of them evenly spread."""
    every = [(index, frame) for index, scene in enumerate(scenes) for frame in range(scene.frames)]
    if len(every) <= most:
        return every
    # the middles of equal shares: no scene's first frame is favoured
    return [every[int((i + 0.5) * len(every) / most)] for i in range(most)]


def dense_points(space: DesignSpace) -> np.ndarray:
    """Dense rays over the space, even in its own measure, shape (DENSE_RAYS, 6)."""
    unit = np.full((DENSE_RAYS, len(space.free)), -1.0)
    axes = [i for i, dimension in enumerate(space.free) if dimension != RANGE]
    unit[:, axes] = 2 * low_discrepancy(DENSE_RAYS, len(axes)) - 1
    return space.from_unit(unit)


def unrolled(azimuth_rad: np.ndarray) -> np.ndarray:
    """Azimuths moved by whole turns onto one arc that starts behind the widest gap, shape (K,)."""
    if not len(azimuth_rad):
        return azimuth_rad
    turned = np.sort(wrap_turn(azimuth_rad))
    gaps = np.diff(np.append(turned, turned[0] + FULL_TURN))
    return wrap_turn(azimuth_rad, turned[(int(np.argmax(gaps)) + 1) % len(turned)])
