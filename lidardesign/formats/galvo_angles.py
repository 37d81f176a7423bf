r"""Two-mirror scanners: the optical scan angles of a ray, and its gate as times.

The beam meets the x mirror, then the y mirror. Turning a mirror by an angle turns the beam by twice that angle: the
optical scan angles x and y here are twice the mechanical ones. The x mirror fans the beam out sideways, the y mirror
turns that fan about the sideways axis:

.. math:: v = \cos x \cos y\; f + \sin x\; h + \cos x \sin y\; u

with f the boresight (where x = y = 0), h the direction of growing azimuth and u that of growing elevation, right-handed
and without roll. For mirrors at one place this is exact (two rotations by twice the mirrors' angles); on a flat screen
at the distance D it lands at D tan(x) / cos(y) sideways and D tan(y) upwards, the known pincushion of such scanners.
Light needs 2 range / c forth and back, so gates are two-way times.
"""

from __future__ import annotations

import numpy as np

from lidardesign.numerics import COARSE_SLACK, EPSILON
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import angles

LIMIT_DEG = 20.0
SPEED_OF_LIGHT_M_PER_PS = SPEED_OF_LIGHT_M_S * 1e-12
# Times of whole picoseconds come back from metres a few units in the last place off (1e-8 ps at 10 km).
ROUNDING_PS = COARSE_SLACK
# Boresights are given in so many decimals of a degree, which moves no ray by more than a microdegree.
BORESIGHT_DECIMALS = 6
# Centring converges within a few steps for fields of any size below a hemisphere.
CENTRING_STEPS = 20


def scan_angles_deg(frame: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Optical scan angles (x, y) of unit vectors in a boresight's frame: (3, 3), (N, 3) to (N, 2) [deg]."""
    forward, sideways, upward = (directions @ frame.T).T
    x = np.arctan2(sideways, np.hypot(forward, upward))
    return np.degrees(np.stack([x, np.arctan2(upward, forward)], axis=1))


def scan_directions(frame: np.ndarray, angles_deg: np.ndarray) -> np.ndarray:
    """Unit vectors of optical scan angles (x, y): (3, 3), (N, 2) [deg] to (N, 3); the inverse of `scan_angles_deg`."""
    x, y = np.radians(angles_deg).T
    return np.stack([np.cos(x) * np.cos(y), np.sin(x), np.cos(x) * np.sin(y)], axis=1) @ frame


def degree_frame(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Rows forward, sideways, upward of a boresight [deg], shape (3, 3)."""
    return boresight_frame(np.radians(azimuth_deg), np.radians(elevation_deg))


def middle_boresight_deg(directions: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the boresight from which the largest scan angle of rays (N, 3) is least.

    From the mean direction, the boresight is moved to the middle of the rays' extent in x and y until it stays there.
    """
    mean = directions.mean(axis=0)
    forward = mean if np.linalg.norm(mean) > EPSILON else directions[0]
    found: list[tuple[float, tuple[float, float]]] = []
    for _ in range(CENTRING_STEPS):
        azimuth, elevation = angles(forward)
        centre = (
            round(float(np.degrees(azimuth)), BORESIGHT_DECIMALS),
            round(float(np.degrees(elevation)), BORESIGHT_DECIMALS),
        )
        frame = degree_frame(*centre)
        seen = scan_angles_deg(frame, directions)
        found.append((float(np.abs(seen).max()), centre))
        forward = scan_directions(frame, (seen.min(axis=0) + seen.max(axis=0))[None] / 2)[0]
    return min(found)[1]


def gate_ps(gate_m: np.ndarray) -> np.ndarray:
    """Start and width of gates (N, 2) [m] in whole picoseconds of two-way time, rounded outward, shape (N, 2)."""
    times = 2 * np.asarray(gate_m, dtype=np.float64) / SPEED_OF_LIGHT_M_PER_PS
    start = np.floor(times[:, 0] + ROUNDING_PS)
    end = np.ceil(times[:, 1] - ROUNDING_PS)
    return np.stack([start, np.maximum(end - start, 0)], axis=1).astype(np.int64)


def gate_m(start_width_ps: np.ndarray) -> np.ndarray:
    """Gates (N, 2) [m] of starts and widths of two-way time, shape (N, 2) [ps]."""
    start, width = np.asarray(start_width_ps, dtype=np.float64).T
    return np.stack([start, start + width], axis=1) * SPEED_OF_LIGHT_M_PER_PS / 2
