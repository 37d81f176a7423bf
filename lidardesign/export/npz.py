"""The ray list as numpy arrays, one per column, with the sensors' names; holds no Python objects."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.columns import losses, ray_columns, rays_of
from lidardesign.export.read_back import rays_rounding
from lidardesign.run.files import write_atomic
from lidardesign.simulate.returns import Rays


def write(design: Design, rays: Rays, path: Path) -> list[str]:
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
    try:
        # numpy leaves a damaged file open where it opened it itself
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return rays_of(dict(arrays), path)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"cannot be read as numpy arrays: {error}", where=str(path)) from error


def rounding(design: Design, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose: nothing, they are kept bit for bit."""
    return rays_rounding(rays, read(path), path)
