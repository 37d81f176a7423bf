"""Rotation matrices of angles and quaternions, what a fixed receiver looks at, and ranges from a path of light.

The receiver stands upright: its lateral axis is horizontal, wherever it looks. A field of view is the pyramid of the
points whose two angles, about its upright and its lateral axis, are both within half of its extents, as behind the
rectangular stop of a camera.

Light that leaves o along v, meets a surface at range r and goes on to a receiver at x has the path
L = r + |o + r v - x|. With b = x - o: r = (L / 2) (1 - (|b| / L)^2) / (1 - b.v / L). For b = 0 it is L / 2 exactly.
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Receiver


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
    inside = (np.abs(horizontal) <= receiver.horizontal_rad / 2) & (np.abs(vertical) <= receiver.vertical_rad / 2)
    return inside & (distance_m >= receiver.range_m[0]) & (distance_m <= receiver.range_m[1])


def path_of_range(rays: Rays, receiver: Receiver | None, range_m: np.ndarray) -> np.ndarray:
    """Half the whole path of light that meets a surface at ranges (N,) along rays, shape (N,) [m]."""
    if receiver is None:
        return range_m
    points = rays.origin_m + range_m[:, None] * rays.direction
    back_m = np.linalg.norm(points - np.asarray(receiver.origin_m), axis=1)
    return np.where(_at_the_receiver(rays, receiver), range_m, (range_m + back_m) / 2)


def range_of_path(rays: Rays, receiver: Receiver | None, path_m: np.ndarray) -> np.ndarray:
    """Ranges along rays whose light took half paths (N,), shape (N,) [m]; the inverse of `path_of_range`.

    A path shorter than the way from the emitter to the receiver has no range: NaN.
    """
    if receiver is None:
        return path_m
    baseline = np.asarray(receiver.origin_m) - rays.origin_m
    whole = 2 * path_m
    with np.errstate(divide="ignore", invalid="ignore"):
        short = np.linalg.norm(baseline, axis=1) / whole
        along = np.einsum("nk,nk->n", baseline, rays.direction) / whole
        solved = path_m * ((1 - short) * (1 + short)) / (1 - along)
    return np.where(_at_the_receiver(rays, receiver), path_m, np.where(short < 1, solved, np.nan))


def path_windows(rays: Rays, receiver: Receiver | None) -> np.ndarray:
    """The gates of rays as intervals of half paths, shape (N, 2) [m]: a path grows with its range."""
    return np.stack([path_of_range(rays, receiver, np.ascontiguousarray(end)) for end in rays.gate_m.T], axis=1)


def _at_the_receiver(rays: Rays, receiver: Receiver) -> np.ndarray:
    """Which rays start where the receiver is: there nothing needs to be solved."""
    return (rays.origin_m == np.asarray(receiver.origin_m)).all(axis=1)


def rotation_of_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """The rotation about the fixed axes x, then y, then z, as URDF, SDF and ROS mean it, shape (3, 3)."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll_rad, pitch_rad, yaw_rad))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    return np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]]) @ about_y @ about_x


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """The rotation of a quaternion of any length above 0, shape (3, 3); columns are the axes.

    Raises:
        ValueError: It has no length.
    """
    quaternion = np.array([w, x, y, z], dtype=np.float64)
    largest = np.abs(quaternion).max()
    if largest == 0:
        raise ValueError("a quaternion has no length")
    # the largest first, so that squares neither vanish nor overflow
    quaternion /= largest
    w, x, y, z = quaternion / np.linalg.norm(quaternion, axis=-1)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
