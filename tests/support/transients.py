"""Rays for the light-transport simulator, where it can run."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lidardesign.geometry.rays import Rays
from lidardesign.simulate.light_transport import process
from lidardesign.simulate.light_transport.transport import available

needs_simulator = pytest.mark.skipif(
    not available(), reason=f"the light-transport simulator cannot run here: {process.missing()}"
)


def spiral(count: int, half_angle_rad: float, axis: tuple[float, ...] = (1.0, 0.0, 0.0)) -> np.ndarray:
    """Directions even in solid angle in a cone, shape (count, 3)."""
    number = np.arange(count)
    ahead = 1 - (1 - math.cos(half_angle_rad)) * (number + 0.5) / count
    turn, across = number * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - ahead**2)
    forward = np.asarray(axis) / np.linalg.norm(axis)
    left = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    left /= np.linalg.norm(left)
    up = np.cross(forward, left)
    return ahead[:, None] * forward + across[:, None] * (np.cos(turn)[:, None] * left + np.sin(turn)[:, None] * up)


def rays_from(origin_m: tuple[float, ...], direction: np.ndarray, far_m: float = 10.0) -> Rays:
    count = len(direction)
    zeros = np.zeros(count)
    gate_m = np.tile([0.0, far_m], (count, 1))
    return Rays(np.tile(np.asarray(origin_m, dtype=float), (count, 1)), direction, gate_m, zeros, zeros)
