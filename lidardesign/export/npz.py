"""The ray list as numpy arrays, one per column, with the sensors' names; holds no Python objects."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.export.columns import losses, ray_columns
from lidardesign.run.files import write_atomic
from lidardesign.simulate.returns import Rays


def write(design: Design, rays: Rays, path: Path) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    buffer = io.BytesIO()
    names = np.array([sensor.name for sensor in design.sensors], dtype=np.str_)
    np.savez(buffer, **ray_columns(rays), sensor_names=names)
    write_atomic(path, buffer.getvalue())
    return losses(design)
