"""A problem: how many rays, in which bandwidth, for which world; and the design that a method makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from lidardesign.errors import InfeasibleError
from lidardesign.formats.rig import RigSensor, sensor_of
from lidardesign.problem.world import World
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import ONE_DEVICE, Devices, Positions
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec, Gates
from lidardesign.sensors.pattern import Pattern

NOTHING_FITS = "not one ray fits"


class Fired(NamedTuple):
    """The number of rays of a design compared with, and their bandwidth [Mbit/s]."""

    rays: int
    mbps: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """What a design stands beside; fairness alone depends on it.

    Arguments:
        designs: The designs.
        fired: Rays and bandwidth of each at its numbers of rays.
        starts: The rays of the first one by their number.
        counts: All numbers of rays that are compared.
        devices: As many as the design with the most has.
        refit: The first design fitted anew without occlusion, with so many rays within a bandwidth [Mbit/s] or without
            a limit; None where its run is not at hand.
    """

    designs: Sequence[DesignSpec] = ()
    fired: Sequence[Fired] = ()
    starts: Mapping[int, Positions] = field(default_factory=dict)
    counts: Sequence[int] = ()
    devices: Devices = ONE_DEVICE
    refit: Callable[[int, float | None], DesignSpec] | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """What a design is made for.

    Arguments:
        world: The training scenes that it may be made and tried in.
        rays: Rays per frame; None: as many as fit in `limit_mbps`.
        limit_mbps: The largest bandwidth [Mbit/s].
        readout: The read-out model.
        gates: Whether rays may have gates of their own.
        compared: What it stands beside.
        config: Settings of the method.
        draw: The number of the draw, of methods that draw another design for every scene.
    """

    world: World
    rays: int | None = None
    limit_mbps: float = math.inf
    readout: Bandwidth = field(default_factory=Bandwidth)
    gates: Gates = "sensor"
    compared: Comparison = field(default_factory=Comparison)
    config: Any = None
    draw: int = 0

    @property
    def asked(self) -> int:
        """The number of rays, or that of the largest design of this bandwidth that it stands beside."""
        of_limit = (one.rays for one in self.compared.fired if one.mbps == self.limit_mbps)
        return max(of_limit, default=0) if self.rays is None else self.rays


class DesignResult(NamedTuple):
    """The design that a method makes.

    Arguments:
        design: The design.
        notes: Lines for people.
    """

    design: DesignSpec
    notes: tuple[str, ...] = ()


def ray_design(
    name: str, lists: Sequence[Rays], world: World, provenance: Mapping[str, Any] | None = None
) -> DesignSpec:
    """The design that fires a list of rays at each condition value of a world, to the last bit.

    Arguments:
        name: Its name.
        lists: The rays at each value, of equal numbers of each sensor.
        world: The world.
        provenance: Facts for people.

    Raises:
        InfeasibleError: There is no ray.
    """
    first = lists[0]
    if not len(first):
        raise InfeasibleError(NOTHING_FITS, conflicts=["budget.bandwidth_mbps"])
    numbers, sensor = np.unique(first.sensor, return_inverse=True)
    rigs = []
    for number in range(len(numbers)):
        own = first.subset(np.flatnonzero(sensor == number))
        rigs.append(RigSensor(f"s{number}", own.origin_m, own.azimuth_rad, own.elevation_rad, own.gate_m))
    sensors = tuple(sensor_of(one, one.name, len(first)) for one in rigs)
    knots = [value for condition in world.conditions for value in condition.values()] if len(lists) > 1 else []
    order = np.argsort(knots) if knots else [0]
    pattern = Pattern.stacked(
        [replace(lists[place], sensor=sensor) for place in order],
        next(iter(world.conditions[0])) if knots else None,
        sorted(knots),
    )
    return DesignSpec(name, sensors, layout="fixed", patterns=(pattern,), provenance=dict(provenance or {}))
