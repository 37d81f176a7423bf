"""Tables: rays as CSV or numpy arrays with units in the columns' names; sensors as the research code's CSV."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lidardesign.design.rigs.ray_lists import read_sensor_csv, write_sensor_csv
from lidardesign.design.sensor import MOST_RAYS, DesignSpec
from lidardesign.errors import ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.poses import constraint_losses, rays_rounding, sensors_rounding
from lidardesign.geometry.rays import Rays
from lidardesign.run.arrays import NUMERIC_KINDS
from lidardesign.run.arrays import read_npz as read_arrays
from lidardesign.run.files import write_atomic
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


def rays_of_columns(columns: Mapping[str, np.ndarray], path: Path) -> Rays:
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
        sensor, time = columns["sensor"], columns["time_s"]
        for name, values, most in (
            ("origin", origin, FARTHEST_M), ("direction", ray, LONGEST_DIRECTION), ("gate", gate, FARTHEST_M),
            ("sensor", sensor, MOST_RAYS), ("time", time, LATEST_S),
        ):  # fmt: skip
            if values.dtype.kind not in "iuf" or not (np.abs(values.astype(np.float64)) <= most).all():
                raise ValueError(f"a number of {name} is none, or beyond {most:g}")
        if (sensor % 1 != 0).any() or (sensor < 0).any():
            raise ValueError("a sensor is not a whole number of 0 or more")
        return Rays(origin, ray, gate, sensor, time)
    except (KeyError, ValueError, ConfigError) as error:
        raise DataError(f"holds no ray list: {error}", where=str(path)) from error


def ray_list_losses(design: DesignSpec) -> list[str]:
    """What a ray list says nothing of."""
    notes = ["names, weights, spreads and origin covariances of the sensors are lost: rows have their numbers"]
    return notes + constraint_losses(design)


def write_csv(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write one ray per row, every number with all its digits; returns notes of what the format cannot hold."""
    columns = ray_columns(rays)
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    write_atomic(path, "\n".join(lines) + "\n")
    return ray_list_losses(design)


def read_csv(path: Path) -> Rays:
    """The rays of a file that `write_csv` made.

    Raises:
        DataError: The file cannot be read, or holds no such table.
    """
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines()
        names = header.split(",")
        values = np.array([line.split(",") for line in lines], dtype=np.float64).reshape(-1, len(names))
    except (OSError, ValueError) as error:
        raise DataError(f"cannot be read as a ray list: {error}", where=str(path)) from error
    return rays_of_columns(dict(zip(names, values.T, strict=True)), path)


def csv_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose."""
    return rays_rounding(rays, read_csv(path), path)


def write_npz(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write an array per column, and the sensors' names; returns notes of what the format cannot hold."""
    buffer = io.BytesIO()
    names = np.array([sensor.name for sensor in design.sensors], dtype=np.str_)
    np.savez(buffer, **ray_columns(rays), sensor_names=names)
    write_atomic(path, buffer.getvalue())
    return ray_list_losses(design)


def read_npz(path: Path) -> Rays:
    """The rays of a file that `write_npz` made.

    Raises:
        DataError: The file cannot be read, or holds no such arrays.
    """
    return rays_of_columns(read_arrays(path, kinds=NUMERIC_KINDS + "U", hint="export it again"), path)


def npz_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose: nothing, they are kept bit for bit."""
    return rays_rounding(rays, read_npz(path), path)


def write_sensors_csv(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the sensors, not the rays; returns notes of what the format cannot hold."""
    notes = write_sensor_csv(design, path)
    return [*notes, f"the {len(rays)} rays are lost"] if len(rays) else notes


def sensors_csv_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose; spreads of rolled sensors are those along azimuth and elevation."""
    return sensors_rounding(design.sensors, read_sensor_csv(path).sensors, path)
