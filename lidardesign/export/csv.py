"""The ray list as text: one ray per row under a header with units, every number with all its digits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.columns import losses, ray_columns, rays_of
from lidardesign.export.common.read_back import rays_rounding
from lidardesign.geometry.rays import Rays
from lidardesign.run.files import write_atomic


def write(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    columns = ray_columns(rays)
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    write_atomic(path, "\n".join(lines) + "\n")
    return losses(design)


def read(path: Path) -> Rays:
    """The rays of a file that `write` made.

    Raises:
        DataError: The file cannot be read, or holds no such table.
    """
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines()
        names = header.split(",")
        values = np.array([line.split(",") for line in lines], dtype=np.float64).reshape(-1, len(names))
    except (OSError, ValueError) as error:
        raise DataError(f"cannot be read as a ray list: {error}", where=str(path)) from error
    return rays_of(dict(zip(names, values.T, strict=True)), path)


def rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose."""
    return rays_rounding(rays, read(path), path)
