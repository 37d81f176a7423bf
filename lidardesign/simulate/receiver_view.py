"""What a fixed receiver looks at: directions in its own frame, as angles about its upright and its lateral axis.

The receiver stands upright: its lateral axis is horizontal, wherever it looks. A field of view is the pyramid of the
points whose two angles are both within half of its extents, as behind the rectangular stop of a camera.
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.scene import Receiver


def receiver_axes(receiver: Receiver) -> np.ndarray:
    """Boresight, lateral (to its left) and upright axis as rows, shape (3, 3); x, y, z where it looks along x."""
    sin_a, cos_a = math.sin(receiver.azimuth_rad), math.cos(receiver.azimuth_rad)
    sin_e, cos_e = math.sin(receiver.elevation_rad), math.cos(receiver.elevation_rad)
    return np.array(
        [[cos_e * cos_a, cos_e * sin_a, sin_e], [-sin_a, cos_a, 0.0], [-sin_e * cos_a, -sin_e * sin_a, cos_e]]
    )


def angles_in_view(receiver: Receiver, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a receiver sees points (..., 3) [m]: horizontal and vertical angle [rad] and distance [m], each (...).

    Angles are signed turns from the boresight about the upright axis (left is positive) and about the lateral axis
    (up is positive), beyond a quarter turn for what lies behind.
    """
    offset = np.asarray(points, dtype=np.float64) - np.asarray(receiver.origin_m)
    ahead, left, up = np.moveaxis(offset @ receiver_axes(receiver).T, -1, 0)
    return np.arctan2(left, ahead), np.arctan2(up, ahead), np.linalg.norm(offset, axis=-1)


def in_view(receiver: Receiver, points: np.ndarray) -> np.ndarray:
    """Which points (..., 3) lie in a receiver's field of view and interval of ranges, ends included, shape (...)."""
    horizontal, vertical, distance_m = angles_in_view(receiver, points)
    low_m, high_m = receiver.range_m
    inside = (np.abs(horizontal) <= receiver.horizontal_rad / 2) & (np.abs(vertical) <= receiver.vertical_rad / 2)
    return inside & (distance_m >= low_m) & (distance_m <= high_m)
