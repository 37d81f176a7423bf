"""Methods whose rays follow from their number: layouts, with one gate or a gate per ray, and most rays in a bandwidth.

A design has one list of rays. Where a task's scenes are seen from several condition values (a robot's positions), it
has one list per value; all have the same number of rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidardesign.limits import MOST_RAYS
from lidardesign.methods.fields import even_placement
from lidardesign.methods.returns import RAY_AXES, whole_range
from lidardesign.problem.method import Method
from lidardesign.problem.problem import DesignResult, Problem, ray_design
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import Positions
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.space import AZIMUTH, ELEVATION, DesignSpace

# Layouts are compared on this many training scenes: enough to tell a good one from a bad one, at a fraction of the
# held-out scenes' cost.
JUDGED_SCENES = 8
# Bandwidth grows almost in proportion to the number of rays: a few steps find the largest number that fits.
FIRST_GUESS, MOST_STEPS = 64, 8


def rays_at(points: np.ndarray, gate_m: np.ndarray) -> Rays:
    """Rays of one sensor at (x, y, z, azimuth, elevation), shape (N, 5 or 6), with one gate (2,) or each its own [m].

    They fire one after another over a frame, as a design's do.
    """
    gates_m = np.broadcast_to(gate_m, (len(points), 2)).copy()
    return Rays.from_angles(points[:, :3], points[:, AZIMUTH], points[:, ELEVATION], gates_m, np.zeros(len(points)))


class Site(NamedTuple):
    """A design space that rays are laid out in.

    Arguments:
        space: The design space at a condition value.
        number: The index of that value.
        draw: The number of the draw, for layouts that are drawn anew.
    """

    space: DesignSpace
    number: int = 0
    draw: int = 0


@dataclass(frozen=True, eq=False)
class Layout:
    """A layout of any number of rays.

    Arguments:
        name: For messages.
        lay_out: Points (x, y, z, azimuth, elevation) of any number, and their gates or the one of all of them [m]:
            (count, site) to (count, 5), and (count, 2) or (2,).
    """

    name: str
    lay_out: Callable[[int, Site], tuple[np.ndarray, np.ndarray]]
    _known: dict[tuple[DesignSpace, int], Rays] = field(default_factory=dict, repr=False)

    def positions(self, spaces: Sequence[DesignSpace], count: int, draw: int = 0) -> Positions:
        """Exactly `count` rays in each of the spaces."""
        known = {} if draw else self._known
        for number, space in enumerate(spaces):
            if (space, count) not in known:
                known[space, count] = rays_at(*self.lay_out(count, Site(space, number, draw)))
        return tuple(known[space, count] for space in spaces)

    def within(self, problem: Problem) -> Positions | None:
        """As many rays as a problem asks for, or as fit in its bandwidth; None beyond `MOST_RAYS`."""
        spaces, count = problem.world.spaces, problem.rays
        if count is None:
            count = most_within(
                lambda count: mean_mbps(self.positions(spaces, count), problem.readout), problem.limit_mbps
            )
        return None if count is None else self.positions(spaces, count, problem.draw)


@dataclass(frozen=True, eq=False)
class LaidOut(Method):
    """A method whose rays follow from their number: of several layouts the best one on training scenes.

    Arguments:
        name, summary, is_redrawn: See `Method`.
        layouts: Its layouts for a problem; none where training scenes return nothing.
    """

    name: str
    summary: str
    layouts: Callable[[Problem], Sequence[Layout]]
    is_redrawn: bool = False

    def design(self, problem: Problem) -> DesignResult | None:
        """See `Method`."""
        world = problem.world
        layouts = world.known((self.name, problem.gates), lambda: self.layouts(problem) or [even_layout(world.space)])
        found = [layout.within(problem) for layout in layouts]
        options = {(layout.name, len(one[0])): one for layout, one in zip(layouts, found, strict=True) if one}
        if len(options) < len(layouts):
            return None
        best, *others = options
        if others:
            losses: dict[tuple[str, int], float] = world.known((self.name, "losses"), dict)
            unknown = {key: one for key, one in options.items() if key not in losses}
            with phase("baselines"):
                tried = world.losses([*unknown.values()], JUDGED_SCENES, problem.compared.devices)
            losses.update(zip(unknown, tried, strict=True))
            best = min(options, key=losses.__getitem__)
        return DesignResult(ray_design(self.name, options[best], world))


def even_layout(space: DesignSpace) -> Layout:
    """Rays even on the sphere over the whole design space, with the whole range as their gate."""

    def lay_out(count: int, site: Site) -> tuple[np.ndarray, np.ndarray]:
        return even_placement(site.space.low[:RAY_AXES], site.space.high[:RAY_AXES], count), whole_range(space)

    return Layout("even", lay_out)


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
