"""The ray list as numpy arrays, one per column, with the sensors' names; holds no Python objects."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.estimates import Estimate
from lidardesign.export.common.columns import losses, ray_columns, rays_of
from lidardesign.export.common.read_back import rays_rounding
from lidardesign.geometry.rays import Rays
from lidardesign.run.arrays import NUMERIC_KINDS, read_npz
from lidardesign.run.files import write_atomic


def write(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    buffer = io.BytesIO()
    names = np.array([sensor.name for sensor in design.sensors], dtype=np.str_)
    np.savez(buffer, **ray_columns(rays), sensor_names=names)
    write_atomic(path, buffer.getvalue())
    return losses(design)


def read(path: Path) -> Rays:
    """The rays of a file that `write` made.

    Raises:
        DataError: The file cannot be read, or holds no such arrays.
    """
    return rays_of(read_npz(path, kinds=NUMERIC_KINDS + "U", hint="export it again"), path)


def rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose: nothing, they are kept bit for bit."""
    return rays_rounding(rays, read(path), path)
