"""Rays for the light-transport simulator, where it can run."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lidardesign.scenes.rays import Rays, receiver_axes
from lidardesign.scenes.scene import Receiver
from lidardesign.simulate.light_transport import transport as process
from lidardesign.simulate.light_transport.transport import Lights, Transients
from support.rays import rays_along


@cache
def no_simulator() -> str | None:
    """Reason why the light-transport simulator cannot run here, or None: a library of the system may be missing too."""
    reason = process.missing()
    code = "import drjit, mitsuba; mitsuba.set_variant('llvm_ad_mono'); import mitransient"
    environment = {**os.environ, process.LLVM_VARIABLE: str(process.llvm_library())}
    if reason is None:
        command = [sys.executable, "-c", code]
        begun = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        reason = begun.stderr.splitlines()[-1] if begun.returncode else None
    return reason and f"the light-transport simulator cannot run here: {reason}"


needs_simulator = pytest.mark.skipif(no_simulator() is not None, reason=str(no_simulator()))


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
    return rays_along(direction, (0.0, far_m), origin_m)


def flood(origin_m: np.ndarray, intensity: float = 1.0) -> Lights:
    """Lights at points (M, 3) that shine everywhere alike; 1 W has the intensity 1 / (4 pi)."""
    return Lights.everywhere(origin_m, np.tile([0.0, 0.0, 1.0], (len(origin_m), 1)), intensity)


def spot(origin_m: np.ndarray, direction: np.ndarray, half_angle_rad: float, intensity: float) -> Lights:
    """Lights at points (M, 3) that shine evenly into a cone; 1 W has the intensity 1 / (2 pi (1 - cos))."""
    least_cosine = np.full(len(origin_m), math.cos(half_angle_rad))
    return replace(Lights.everywhere(origin_m, direction, intensity), least_cosine=least_cosine)


def binned(found: Transients) -> np.ndarray:
    """The radiance of every ray in every bin, shape (N, count)."""
    table = np.zeros((len(found.steady), found.bins.count))
    table[found.ray, found.cell] = found.radiance
    return table


def pixel_rays(receiver: Receiver, columns: int, rows: int) -> tuple[Rays, np.ndarray]:
    """A receiver's field of view as a camera's pixels: a ray through each one's centre, and its solid angle [sr].

    Pixels are equal on the image plane; their solid angles add up to the field's.
    """
    half = np.tan([receiver.horizontal_rad / 2, receiver.vertical_rad / 2])
    left, up = (
        (2 * (np.arange(number) + 0.5) / number - 1) * extent
        for number, extent in zip((columns, rows), half, strict=True)
    )
    grid = np.stack(np.meshgrid(left, up, indexing="ij"), axis=-1).reshape(-1, 2)
    ahead = np.concatenate([np.ones((len(grid), 1)), grid], axis=1)
    length = np.linalg.norm(ahead, axis=1)
    area = 4 * half[0] * half[1] / len(grid)
    looking = (ahead / length[:, None]) @ receiver_axes(receiver)
    return rays_along(looking, receiver.range_m, receiver.origin_m), area / length**3
