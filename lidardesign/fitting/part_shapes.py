"""Parts as components of fixed shape: their field of view and gate are what they are, only the pose is free.

A part's field of view and range cannot be narrowed; only outside the design space's range, where no task has anything,
does its read-out stop. It may be mounted upright or turned by a quarter about its boresight. A component's roll stays
within an eighth of a turn, so a part that is turned is a component whose two spreads are exchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from lidardesign.constraints.document import SensorRules
from lidardesign.mixture.features import Axes
from lidardesign.numerics import SLACK
from lidardesign.parts.catalogue import Pose
from lidardesign.parts.part import Part, to_angles, to_directions
from lidardesign.sensors.sensor import boresight_frame, boresight_of
from lidardesign.space import RANGE, DesignSpace, angles

BOUNDED = ("field_of_view.horizontal_deg", "field_of_view.vertical_deg", "gate.start_m", "gate.end_m", "gate.width_m")


@dataclass(frozen=True, eq=False)
class PartShape:
    """A part in one of its two ways to be mounted.

    Arguments:
        part: The part.
        turned: Whether its horizontal angle runs along the component's vertical one.
        gate_m: The ranges that it measures inside the design space.
    """

    part: Part
    turned: bool
    gate_m: tuple[float, float]

    def pose(self, origin_m: np.ndarray, azimuth_rad: float, elevation_rad: float, roll_rad: float, axes: Axes) -> Pose:
        """The part's pose where its component has an origin and a boresight: the centre of its field looks there.

        Across a plane in which the design space holds all rays, its row or column nearest to the centre looks there.
        """
        roll_rad = roll_rad + math.pi / 2 if self.turned else roll_rad
        frame = boresight_frame(*self._aimed(axes)).T @ boresight_frame(azimuth_rad, elevation_rad, roll_rad)
        return Pose(np.asarray(origin_m, dtype=np.float64), *boresight_of(frame))

    def _aimed(self, axes: Axes) -> tuple[float, float]:
        """Azimuth and elevation, in the part's frame, of what looks along the component's boresight."""
        part = self.part
        if axes.angular == 2:
            return part.centre_rad
        held = [not axes.vertical, not axes.horizontal] if self.turned else [not axes.horizontal, not axes.vertical]
        found = np.array(part.centre_rad)
        every = to_angles(part.projection, part.directions)
        for axis in np.flatnonzero(held):
            found[axis] = every[np.abs(every[:, axis] - found[axis]).argmin(), axis]
        azimuth, elevation = angles(to_directions(part.projection, found[None]))
        return float(azimuth[0]), float(elevation[0])


def gate_inside(part: Part, space: DesignSpace) -> tuple[float, float] | None:
    """The ranges of a part inside a design space's [m], its own where that has one; None where they do not meet."""
    near, far = part.range_m
    if RANGE not in space.free:
        return (near, far) if near <= space.low[RANGE] < far else None
    start, end = max(near, space.low[RANGE]), min(far, space.high[RANGE])
    return (start, end) if start < end else None


def shapes_of(part: Part, space: DesignSpace) -> list[PartShape]:
    """The ways to mount a part: none where it measures nothing inside the space, one where both angles are equal."""
    gate = gate_inside(part, space)
    if gate is None:
        return []
    horizontal, vertical = part.field_of_view_rad
    return [PartShape(part, turned, gate) for turned in ((False, True) if horizontal != vertical else (False,))]


def broken_keys(shape: PartShape, rules: SensorRules) -> set[str]:
    """Keys of the constraints that a part does not keep."""
    start, end = shape.gate_m
    values = (*(math.degrees(angle) for angle in shape.part.field_of_view_rad), start, end, end - start)
    broken = set()
    for key, value in zip(BOUNDED, values, strict=True):
        bounds = attrgetter(key)(rules)
        if bounds.min is not None and value < bounds.min * (1 - SLACK):
            broken.add(f"{key}.min")
        if bounds.max is not None and value > bounds.max * (1 + SLACK):
            broken.add(f"{key}.max")
    return broken
