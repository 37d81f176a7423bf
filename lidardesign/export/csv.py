"""The ray list as text: one ray per row under a header with units, every number with all its digits."""

from __future__ import annotations

from pathlib import Path

from lidardesign.design.sensor import Design
from lidardesign.export.columns import losses, ray_columns
from lidardesign.run.files import write_atomic
from lidardesign.simulate.returns import Rays


def write(design: Design, rays: Rays, path: Path) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    columns = ray_columns(rays)
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    write_atomic(path, "\n".join(lines) + "\n")
    return losses(design)
