"""Tables: rays as CSV or numpy arrays with units in the columns' names; sensors as the research code's CSV."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from lidardesign.design.rigs.ray_lists import write_sensor_csv
from lidardesign.design.sensor import DesignSpec
from lidardesign.export.mounts import constraint_losses
from lidardesign.geometry.rays import Rays
from lidardesign.run.files import write_atomic
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


def write_npz(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write an array per column, and the sensors' names; returns notes of what the format cannot hold."""
    buffer = io.BytesIO()
    names = np.array([sensor.name for sensor in design.sensors], dtype=np.str_)
    np.savez(buffer, **ray_columns(rays), sensor_names=names)
    write_atomic(path, buffer.getvalue())
    return ray_list_losses(design)


def write_sensors_csv(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the sensors, not the rays; returns notes of what the format cannot hold."""
    notes = write_sensor_csv(design, path)
    return [*notes, f"the {len(rays)} rays are lost"] if len(rays) else notes
