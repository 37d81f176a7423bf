"""The columns of a ray list, with their units in their names: shared by the csv and npz formats."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.sensor import MOST_RAYS, DesignSpec
from lidardesign.errors import ConfigError, DataError
from lidardesign.geometry.rays import Rays
from lidardesign.space import FARTHEST_M, angles

# Unit vectors, however they were rounded; frames are far shorter.
LONGEST_DIRECTION, LATEST_S = 2.0, 1e9


def ray_columns(rays: Rays) -> dict[str, np.ndarray]:
    """Columns by name, each of shape (N,), in the order in which they are written."""
    azimuth, elevation = angles(rays.direction)
    return {
        "origin_x_m": rays.origin_m[:, 0],
        "origin_y_m": rays.origin_m[:, 1],
        "origin_z_m": rays.origin_m[:, 2],
        "direction_x": rays.direction[:, 0],
        "direction_y": rays.direction[:, 1],
        "direction_z": rays.direction[:, 2],
        "azimuth_rad": azimuth,
        "elevation_rad": elevation,
        "gate_start_m": rays.gate_m[:, 0],
        "gate_end_m": rays.gate_m[:, 1],
        "sensor": rays.sensor,
        "time_s": rays.time_s,
    }


def rays_of(columns: Mapping[str, np.ndarray], path: Path) -> Rays:
    """The ray list of columns that were read from a file.

    Raises:
        DataError: A column is missing, or its values are none that rays have.
    """
    try:
        origin, ray = (
            np.stack([columns[f"{name}_{axis}"] for axis in axes], axis=1)
            for name, axes in (("origin", ("x_m", "y_m", "z_m")), ("direction", ("x", "y", "z")))
        )
        gate = np.stack([columns["gate_start_m"], columns["gate_end_m"]], axis=1)
        _check_numbers(origin, ray, gate, columns["sensor"], columns["time_s"])
        return Rays(origin, ray, gate, columns["sensor"], columns["time_s"])
    except (KeyError, ValueError, ConfigError) as error:
        raise DataError(f"holds no ray list: {error}", where=str(path)) from error


def _check_numbers(origin: Any, ray: Any, gate: Any, sensor: Any, time: Any) -> None:
    """Refuse numbers that cannot be, before anything is computed of them.

    Raises:
        ValueError: They are none, or far beyond what rays have; sensors that are no whole numbers.
    """
    for name, values, most in (
        ("origin", origin, FARTHEST_M), ("direction", ray, LONGEST_DIRECTION), ("gate", gate, FARTHEST_M),
        ("sensor", sensor, MOST_RAYS), ("time", time, LATEST_S),
    ):  # fmt: skip
        if values.dtype.kind not in "iuf" or not (np.abs(values.astype(np.float64)) <= most).all():
            raise ValueError(f"a number of {name} is none, or beyond {most:g}")
    if (np.asarray(sensor) % 1 != 0).any() or (np.asarray(sensor) < 0).any():
        raise ValueError("a sensor is no whole number of 0 or more")


def losses(design: DesignSpec) -> list[str]:
    """What a ray list says nothing of."""
    notes = ["sensors appear by index only: their weights, spreads and origin covariances are not held"]
    if design.constraints:
        notes.append("the constraints of the design are not held")
    return notes
