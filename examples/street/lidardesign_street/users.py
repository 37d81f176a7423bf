"""Which road users a set of returns shows."""

from __future__ import annotations

import numpy as np
from lidardesign import Scene

# So many returns, and a road user is found.
FEWEST_RETURNS = 5
# A return no further than this from the box of a road user is of it, but for those of the ground [m].
NEAR_M, RAISED_M = 0.05, 0.1


def on_users(scene: Scene, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points (N, 3) [m] are in the boxes of which road users: indices of users and points, (K,) each."""
    raised = np.flatnonzero(points_m[:, 2] > RAISED_M)
    away = np.abs(points_m[raised] - scene.truth["centre_m"][:, None]) - scene.truth["half_m"][:, None]
    user, point = np.nonzero((away <= NEAR_M).all(axis=2))
    return user, raised[point]


def distances_m(scene: Scene) -> np.ndarray:
    """How far road users are from the middle of the own car, (U,) [m]."""
    return np.hypot(*scene.truth["centre_m"][:, :2].T)
