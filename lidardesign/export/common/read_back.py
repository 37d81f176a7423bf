"""What the numbers in an exported file lose: it is read back and compared with what was written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lidardesign.design.sensor import Sensor
from lidardesign.errors import DataError
from lidardesign.estimates import ROUNDING, Estimate
from lidardesign.geometry.rays import Rays
from lidardesign.space import direction


def rays_rounding(written: Rays, found: Rays, path: Path, *, times: bool = True) -> dict[str, Estimate]:
    """The largest differences of rays that were read back, ray by ray.

    Arguments:
        written: What went into the file.
        found: What came out of it.
        path: The file, for errors.
        times: Whether the format holds firing times.

    Raises:
        DataError: The file holds other rays.
    """
    if len(written) != len(found) or (written.sensor != found.sensor).any():
        raise DataError(
            f"does not hold what was written: {len(found)} of {len(written)} rays came back, or in another order",
            where=str(path),
            hint="export it again, to another disk",
        )
    origin = np.linalg.norm(found.origin_m - written.origin_m, axis=1)
    errors = {
        "origin_m": _largest(origin, "m"),
        "direction_rad": _largest(angles_between(found.direction, written.direction), "rad"),
        "gate_m": _largest(np.abs(found.gate_m - written.gate_m), "m"),
    }
    return {**errors, "time_s": _largest(np.abs(found.time_s - written.time_s), "s")} if times else errors


def sensors_rounding(written: Sequence[Sensor], found: Sequence[Sensor], path: Path) -> dict[str, Estimate]:
    """The largest differences of sensors that were read back, sensor by sensor.

    Raises:
        DataError: The file holds another number of sensors.
    """
    if len(written) != len(found):
        raise DataError(
            f"does not hold what was written: {len(found)} of {len(written)} sensors came back", where=str(path)
        )

    def differences(read: Callable[[Sensor], object]) -> np.ndarray:
        return np.array([np.subtract(read(new), read(old)) for old, new in zip(written, found, strict=True)])

    boresights = [
        direction(*(np.array([getattr(one, name) for one in sensors]) for name in ("azimuth_rad", "elevation_rad")))
        for sensors in (written, found)
    ]
    origin = np.linalg.norm(differences(lambda one: one.origin_m), axis=1)
    spread = differences(lambda one: (one.spread_horizontal_rad, one.spread_vertical_rad))
    gate = differences(lambda one: (one.range_m, one.spread_range_m))
    return {
        "origin_m": _largest(origin, "m"),
        "direction_rad": _largest(angles_between(*boresights), "rad"),
        "spread_rad": _largest(np.abs(spread), "rad"),
        "range_m": _largest(np.abs(gate), "m"),
        "weight": _largest(np.abs(differences(lambda one: one.weight)), ""),
    }


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between unit vectors (N, 3) [rad], exact for the smallest too: 2 arcsin(|a - b| / 2), shape (N,)."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(first - second, axis=1) / 2, 1.0))


def _largest(differences: np.ndarray, unit: str) -> Estimate:
    return Estimate(None, float(differences.max(initial=0.0)), unit, ROUNDING)
