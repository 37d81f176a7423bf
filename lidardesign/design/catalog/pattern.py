"""Where the rays of a part go, in its own frame: x forward, y to the left (growing azimuth), z up.

A field of view is an interval of two angles. What they mean depends on the part: equal angles from the forward axis
(`tangent`: zones behind a wide lens, rosettes), azimuth and elevation (`sphere`: whatever turns or steps), or angles
in the horizontal and the vertical plane (`plane`: a camera whose pixels are even on its focal plane).
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from lidardesign.design.catalog.statements import Even, FieldOfView, Pixels, Rings, Rosette, Zones, ray_count
from lidardesign.design.grid import low_discrepancy
from lidardesign.numerics import COARSE_SLACK, sphere_exp, sphere_log
from lidardesign.space import direction

Projection = Literal["tangent", "sphere", "plane"]
FULL_TURN_DEG = 360.0


def projection_of(pattern: Any, view: FieldOfView) -> Projection:
    """What the two angles of a part's field of view are."""
    if isinstance(pattern, Pixels):
        return "plane"
    if isinstance(pattern, Zones | Rosette) or (isinstance(pattern, Even) and view.shape == "ellipse"):
        return "tangent"
    return "sphere"


def to_angles(projection: Projection, directions: np.ndarray) -> np.ndarray:
    """The two angles of unit vectors in the part's frame: (N, 3) to (N, 2) [rad]."""
    if projection == "tangent":
        return sphere_log(directions)
    x, y, z = directions.T
    if projection == "sphere":
        return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1)
    # what is behind a camera has angles beyond a right one, which no field of it has
    return np.stack([np.arctan2(y, x), np.arctan2(z, x)], axis=1)


def to_directions(projection: Projection, angles: np.ndarray) -> np.ndarray:
    """Unit vectors in the part's frame at two angles: (N, 2) [rad] to (N, 3)."""
    if projection == "tangent":
        return sphere_exp(angles)
    if projection == "sphere":
        return direction(angles[:, 0], angles[:, 1])
    plane = np.concatenate([np.ones((len(angles), 1)), np.tan(angles)], axis=1)
    return plane / np.linalg.norm(plane, axis=1, keepdims=True)


def pattern_directions(pattern: Any, view: FieldOfView, rate_hz: float) -> np.ndarray:
    """The unit vectors of a frame in the part's frame, in the order in which they fire, shape (M, 3)."""
    return to_directions(projection_of(pattern, view), np.radians(_angles_deg(pattern, view, rate_hz)))


def _angles_deg(pattern: Any, view: FieldOfView, rate_hz: float) -> np.ndarray:
    if isinstance(pattern, Rosette):
        return _rosette(pattern, rate_hz)
    if isinstance(pattern, Even):
        return _even(pattern.rays, view)
    if isinstance(pattern, Rings):
        return _rings(pattern, view)
    across, up = _centres(*view.azimuth, pattern.columns), _centres(*view.elevation, pattern.rows)
    if isinstance(pattern, Pixels):
        across, up = _focal_plane(*view.azimuth, pattern.columns), _focal_plane(*view.elevation, pattern.rows)
    return _row_by_row(across, up)


def _row_by_row(across: np.ndarray, up: np.ndarray) -> np.ndarray:
    return np.stack([np.tile(across, len(up)), np.repeat(up, len(across))], axis=1)


def _centres(low: float, high: float, count: int) -> np.ndarray:
    """Centres of equal cells of an interval: never on its ends, shape (count,)."""
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _focal_plane(low_deg: float, high_deg: float, count: int) -> np.ndarray:
    """Angles of pixels that are even on a plane, shape (count,) [degrees]."""
    low, high = math.tan(math.radians(low_deg)), math.tan(math.radians(high_deg))
    return np.degrees(np.arctan(_centres(low, high, count)))


def _rings(pattern: Rings, view: FieldOfView) -> np.ndarray:
    """Column by column, as a head turns; all beams of a column fire at about the same time."""
    elevations = pattern.elevations_deg or _ends_included(*view.elevation, pattern.rings or 1)
    low, high = view.azimuth
    whole = high - low >= FULL_TURN_DEG - COARSE_SLACK
    across = _centres(low, high, pattern.columns) if whole else _ends_included(low, high, pattern.columns)
    return np.stack([np.repeat(across, len(elevations)), np.tile(elevations, pattern.columns)], axis=1)


def _ends_included(low: float, high: float, count: int) -> np.ndarray:
    return np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2])


def _rosette(pattern: Rosette, rate_hz: float) -> np.ndarray:
    """Thin prisms: each adds a fixed deflection in the direction in which it stands (first order in the wedge)."""
    count = ray_count(pattern, rate_hz)
    time_s = np.arange(count) / pattern.points_per_s
    angles = np.zeros((count, 2))
    for turns_hz, deflection_deg in zip(pattern.rotor_hz, pattern.deflection_deg, strict=True):
        phase = 2 * np.pi * turns_hz * time_s
        angles += deflection_deg * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    return angles


def _even(count: int, view: FieldOfView) -> np.ndarray:
    """Points that fill the field evenly per solid angle (a disc in its tangent plane), shape (count, 2) [degrees]."""
    unit = low_discrepancy(count, 2)
    (left, right), (bottom, top) = view.azimuth, view.elevation
    if view.shape == "ellipse":
        radius, turn = np.sqrt(unit[:, 0]), 2 * np.pi * unit[:, 1]
        middle = np.array([left + right, bottom + top]) / 2
        half = np.array([right - left, top - bottom]) / 2
        return middle + half * radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    low, high = math.sin(math.radians(bottom)), math.sin(math.radians(top))
    up = np.degrees(np.arcsin(np.clip(low + (high - low) * unit[:, 1], -1.0, 1.0)))
    return np.stack([left + (right - left) * unit[:, 0], up], axis=1)


def inside(view: FieldOfView, projection: Projection, directions: np.ndarray) -> np.ndarray:
    """Which unit vectors in the part's frame lie in its field of view, ends included: (N, 3) to bool (N,)."""
    angles = np.degrees(to_angles(projection, directions))
    low = np.array([view.azimuth[0], view.elevation[0]])
    high = np.array([view.azimuth[1], view.elevation[1]])
    if view.shape == "ellipse":
        half = np.maximum((high - low) / 2, COARSE_SLACK)
        return np.square((angles - (low + high) / 2) / half).sum(axis=1) <= 1 + COARSE_SLACK
    within = (angles >= low - COARSE_SLACK) & (angles <= high + COARSE_SLACK)
    return within.all(axis=1)
