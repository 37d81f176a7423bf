"""The columns of a ray list, with their units in their names: shared by the csv and npz formats."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.errors import ConfigError, DataError
from lidardesign.simulate.returns import Rays
from lidardesign.space import angles


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
        return Rays(origin, ray, gate, columns["sensor"], columns["time_s"])
    except (KeyError, ValueError, ConfigError) as error:
        raise DataError(f"holds no ray list: {error}", where=str(path)) from error


def losses(design: Design) -> list[str]:
    """What a ray list says nothing of."""
    notes = ["sensors appear by index only: their weights, spreads and origin covariances are not held"]
    if design.constraints:
        notes.append("the constraints of the design are not held")
    return notes
