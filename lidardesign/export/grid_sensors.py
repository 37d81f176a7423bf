"""Sensors that can only fire even grids: which grid stands for a sensor's rays, and what that costs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.export.even_grid import ON_GRID_RAD, EvenGrid, nearest_grid
from lidardesign.export.poses import Mount, design_losses, gate_losses, origin_losses
from lidardesign.simulate.returns import Rays

# So many sensors are told apart in the notes.
TOLD = 4


def grid_of(mount: Mount) -> EvenGrid:
    """The even grid that stands for the rays of a mount."""
    return nearest_grid(mount.azimuth_rad, mount.elevation_rad)


def grid_sensor_losses(design: Design, mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of what sensors with one place, one gate and an even grid of rays cannot hold."""
    notes = [
        *design_losses(design, mounted),
        *grid_losses(mounted, rays),
        *origin_losses(mounted),
        *gate_losses(mounted),
    ]
    return [*notes, "firing times are not held"]


def grid_losses(mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of rays that are not on an even grid: how many, what replaces them, and how far off that is."""
    off: list[tuple[Mount, EvenGrid, np.ndarray]] = []
    for mount in mounted:
        grid = grid_of(mount)
        distance = grid.distance_rad(mount.azimuth_rad, mount.elevation_rad)
        if distance.max() > ON_GRID_RAD or len(grid) != len(mount.ray):
            off.append((mount, grid, distance))
    if not off:
        return []
    count = sum(int((distance > ON_GRID_RAD).sum()) for _, _, distance in off)
    worst = math.degrees(max(float(distance.max()) for _, _, distance in off))
    grids = ", ".join(f"{grid.columns} x {grid.rows} of {mount.name}" for mount, grid, _ in off[:TOLD])
    more = f", and those of {len(off) - TOLD} more sensors" if len(off) > TOLD else ""
    fired = len(rays) + sum(len(grid) - len(mount.ray) for mount, grid, _ in off)
    total = "" if fired == len(rays) else f", {fired} rays in all"
    return [
        f"{count} of {len(rays)} rays are not on an even grid of azimuth and elevation; replaced by even grids "
        f"({grids}{more}){total}: off by at most {worst:.2g} deg"
    ]
