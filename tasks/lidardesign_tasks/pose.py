"""Small random rigid motions of bodies between scenes."""

from __future__ import annotations

import numpy as np

from lidardesign.scenes.scene import rigid

LARGEST_DEVIATIONS = 2.5  # jitter is normal, clipped at this many standard deviations


def rotation_matrix(rotation_rad: np.ndarray) -> np.ndarray:
    """The 3x3 rotation about a vector by its length [rad] (Rodrigues' formula)."""
    angle = float(np.linalg.norm(rotation_rad))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(rotation_rad) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def jittered_pose(
    generator: np.random.Generator, rotation_deg: float, translation_m: float, centre_m: np.ndarray
) -> np.ndarray:
    """A 4x4 pose: a normal random rotation about a centre and a normal random shift, per axis.

    Arguments:
        generator: The random generator.
        rotation_deg: Standard deviation of the rotation about each axis [degrees].
        translation_m: Standard deviation of the shift along each axis [m].
        centre_m: Centre of the rotation [m], shape (3,).
    """
    draws = np.clip(generator.normal(size=(2, 3)), -LARGEST_DEVIATIONS, LARGEST_DEVIATIONS)
    rotation = rotation_matrix(np.deg2rad(rotation_deg) * draws[0])
    return rigid(rotation, translation_m * draws[1] + centre_m - rotation @ centre_m)
