"""Parts as components of fixed shape: their field of view and gate are what they are, only the pose is free.

A part's field of view and range cannot be narrowed; only outside the design space's range, where no task has anything,
does its read-out stop. It may be mounted upright or turned by a quarter about its boresight. A component's roll stays
within an eighth of a turn, so a part that is turned is a component whose two spreads are exchanged. What a part can
see, and which of its rays look at something, is asked of its pattern.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from lidardesign.design.catalog.library import Pose
from lidardesign.design.catalog.part import Part, to_angles, to_directions
from lidardesign.design.constraints.document import SensorRules
from lidardesign.design.mixture.bounds import Bounds
from lidardesign.design.mixture.features import Axes
from lidardesign.design.sensor import boresight_frame, boresight_of
from lidardesign.numerics import SLACK
from lidardesign.space import RANGE, DesignSpace, angles, observed_point

# A line scanner's field has no height; as a component it has this one, which a density can be fitted with.
LEAST_FIELD_RAD = math.radians(1.0)
# A ray counts as coming near what is this close to it: a line scanner's beam is as high.
LEAST_REACH_RAD = 0.005
# Rays are worth firing that see this share of what the part could see: the rest are strays.
SEEN_SHARE = 0.99
# Of so many things in view the nearest says how far from them a ray looks.
NEAR_POINTS = 400
BOUNDED = ("field_of_view.horizontal_deg", "field_of_view.vertical_deg", "gate.start_m", "gate.end_m", "gate.width_m")
# What bounds fix of a component that is a part.
SHAPE_BOUNDS = (
    "spread_low", "spread_high", "start_low", "start_high", "end_low", "end_high", "width_low", "width_high",
)  # fmt: skip


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

    @property
    def field_of_view_rad(self) -> tuple[float, float]:
        """Full horizontal and vertical angles of the component."""
        horizontal, vertical = self.part.field_of_view_rad
        return (vertical, horizontal) if self.turned else (horizontal, vertical)

    def spread_rad(self, interval: float, axes: Axes) -> np.ndarray:
        """Internal standard deviations, horizontal and vertical, shape (2,)."""
        return np.maximum(self.field_of_view_rad, LEAST_FIELD_RAD) / (2 * interval * np.array([axes.angle_scale, 1.0]))

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


def shaped_bounds(bounds: Bounds, shapes: Sequence[PartShape | None], axes: Axes) -> Bounds:
    """Bounds whose components have the shapes of parts and nothing else; None leaves one as it was."""
    columns = {name: np.array(getattr(bounds, name), dtype=np.float64) for name in SHAPE_BOUNDS}
    for row, shape in enumerate(shapes):
        if shape is not None:
            spread, (start, end) = shape.spread_rad(bounds.interval, axes), shape.gate_m
            values = (spread, spread, start, start, end, end, end - start, end - start)
            for name, value in zip(SHAPE_BOUNDS, values, strict=True):
                columns[name][row] = value
    return replace(bounds, **columns)


def in_part_view(part: Part, directions: np.ndarray) -> np.ndarray:
    """Which unit vectors in a part's frame its rays come near to, (N, 3) to bool (N,).

    Its field of view and half a cell around it: the field of a line scanner has no height.
    """
    columns, rows = part.grid
    horizontal, vertical = part.field_of_view_rad
    reach = np.maximum(np.array([horizontal / columns, vertical / rows]) / 2, LEAST_REACH_RAD)
    offset = to_angles(part.projection, directions) - np.array(part.centre_rad)
    half = np.array([horizontal, vertical]) / 2 + reach
    if part.view.shape == "ellipse":
        return np.square(offset / half).sum(axis=1) <= 1
    return (np.abs(offset) <= half).all(axis=1)


def useful_ray_filter(
    part: Part, pose: Pose, points: np.ndarray, weights: np.ndarray, *, least: int = 0
) -> Callable[[np.ndarray], np.ndarray]:
    """Which rays of a part at a pose look where scene points are: unit vectors (N, 3) of the world to bool (N,).

    The fewest that are nearest to 99 % of the weight that the part has in view; none where nothing is.

    Arguments:
        part: The part.
        pose: Where it stands.
        points: Design points that observe the scene points, shape (M, 6).
        weights: Non-negative, shape (M,).
        least: So many rays in any case, where something is in view: then those that look nearest to it, too.
    """
    from scipy.spatial import cKDTree

    offset = observed_point(points) - pose.origin_m
    range_m = np.linalg.norm(offset, axis=1)
    kept = (range_m > 0) & (weights > 0)
    looking = offset[kept] / range_m[kept, None]
    seen = in_part_view(part, looking @ pose.frame.T)
    looking, mass = looking[seen], weights[kept][seen]

    def wanted(directions: np.ndarray) -> np.ndarray:
        mask = np.zeros(len(directions), dtype=bool)
        if len(looking):
            share = np.bincount(cKDTree(directions).query(looking)[1], mass, minlength=len(directions))
            order = np.argsort(-share, kind="stable")
            enough = int(np.searchsorted(np.cumsum(share[order]), SEEN_SHARE * mass.sum())) + 1
            mask[order[:enough]] = True
            mask &= share > 0
            lacking = min(least, len(directions)) - int(mask.sum())
            if lacking > 0:
                others = np.flatnonzero(~mask)
                away = cKDTree(looking[:: -(-len(looking) // NEAR_POINTS)]).query(directions[others])[0]
                mask[others[np.argsort(away, kind="stable")[:lacking]]] = True
        return mask

    return wanted


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
