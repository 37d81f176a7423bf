"""Rotation matrices of the angles and quaternions that files hold."""

from __future__ import annotations

import math

import numpy as np


def rotation_of_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """The rotation about the fixed axes x, then y, then z, as URDF, SDF and ROS mean it, shape (3, 3)."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll_rad, pitch_rad, yaw_rad))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return about_z @ about_y @ about_x


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """The rotation of a quaternion of any length above 0, shape (3, 3).

    Raises:
        ValueError: It has no length.
    """
    quaternion = np.array([w, x, y, z], dtype=np.float64)
    largest = np.abs(quaternion).max()
    if largest == 0:
        raise ValueError("a quaternion has no length")
    return rotations_of_quaternions(quaternion / largest)


def rotations_of_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Rotations of quaternions (w, x, y, z) that are not zero: (..., 4) to (..., 3, 3); columns are the axes."""
    w, x, y, z = np.moveaxis(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
