"""What is scored: the rays that a design fires at all condition values, with the light of its parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.rays.information import features_of
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.adaptive import mapped
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.calibration import with_part_light
from lidardesign.simulate.plan import Planner
from lidardesign.task import Task

Positions = tuple[Rays, ...]  # one list of rays per condition value, in the task's order


def fired(
    design: DesignSpec,
    count: int | None = None,
    conditions: Sequence[Mapping[str, float]] = ({},),
    planner: Planner | None = None,
    task: Task | None = None,
) -> Positions:
    """The rays of a design at condition values, or of its patterns that follow what they see: all that is scored.

    Arguments:
        design: The design.
        count: Rays per frame; None: its own number.
        conditions: The condition values.
        planner: Of the detector that its parts are lit for; None: rays have no light of their own.
        task: In whose scenes patterns follow what they see; None: the best single pattern fires.

    Raises:
        ConfigError: It cannot fire so many rays, or its rays end before one of the values.
    """
    name = design.condition
    if name is not None:
        first, last = design.patterns[-1].ends
        beyond = [one[name] for one in conditions if name in one and not first <= one[name] <= last]
        if beyond:
            raise ConfigError(
                f"its rays go from {name}={first:g} to {last:g}, but designs are evaluated at {beyond[0]:g} too",
                where=f"design {design.name}",
                hint="fit a design of the whole way: lidardesign fit RUN",
            )
    adaptive = None if task is None else design.following(design.count if count is None else count)
    positions = (
        tuple(design.rays(count, at=at or None) for at in conditions)
        if adaptive is None
        else adaptive.rays(features_of(task))
    )
    if planner is None:
        return positions
    return mapped(positions, lambda rays: with_part_light(rays, design, planner.detector))


def without_each(positions: Positions, sensors: int) -> list[Positions]:
    """The rays that are left without each of a number of sensors, one after the other."""
    return [tuple(rays.subset(np.flatnonzero(rays.sensor != lost)) for rays in positions) for lost in range(sensors)]


class Devices(NamedTuple):
    """The devices that the rays of a baseline are of: as many as those of the design beside it.

    Arguments:
        number: Each fires every so many-th ray.
        light: Of their emitters as a multiple of the detector's, the mean over the design's rays; None: 1.
    """

    number: int = 1
    light: float | None = None

    @classmethod
    def of(cls, positions: Positions) -> Devices:
        """The devices of a design by its rays."""
        rays = Rays.joined(positions)
        return cls(max(len(np.unique(rays.sensor)), 1), None if rays.light is None else float(rays.light.mean()))


ONE_DEVICE = Devices()


def assign_devices(positions: Positions, devices: Devices) -> Positions:
    """Rays of one sensor as rays of devices; those that have sensors keep them."""
    if devices == ONE_DEVICE or any(rays.sensor.any() for rays in positions):
        return positions
    return tuple(
        replace(
            rays,
            sensor=np.arange(len(rays)) % devices.number,
            light=None if devices.light is None else np.full(len(rays), devices.light),
        )
        for rays in positions
    )
