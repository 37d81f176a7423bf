"""Even grids of azimuth and elevation in a sensor's frame: what simulators of scanning sensors fire.

Rays of any layout are replaced by the grid of about as many rays that is nearest to them. Azimuth and elevation are
those of the sensor's own frame: x forward, y to the left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.export.common.poses import Mount, angles_between, design_losses, gate_losses, origin_losses
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import COARSE_SLACK
from lidardesign.space import direction

# Rays nearer to a grid than this are on it: files hold some seven digits.
ON_GRID_RAD = COARSE_SLACK
# A grid has up to a tenth more or fewer rays than what it stands for.
MOST_CHANGED = 10
# Numbers of rows around that of square cells that are tried.
TRIED_ROWS = 24


@dataclass(frozen=True)
class EvenGrid:
    """Rows at even elevations, each with the same even azimuths; first and last rays are on the bounds.

    Arguments:
        columns, rows: How many azimuths and elevations.
        azimuth_rad: The first and the last azimuth.
        elevation_rad: The lowest and the highest elevation.
    """

    columns: int
    rows: int
    azimuth_rad: tuple[float, float]
    elevation_rad: tuple[float, float]

    def __len__(self) -> int:
        return self.columns * self.rows

    def directions(self) -> np.ndarray:
        """Unit vectors row by row upwards, each row by growing azimuth, shape (rows * columns, 3)."""
        azimuth = np.linspace(*self.azimuth_rad, self.columns)
        elevation = np.linspace(*self.elevation_rad, self.rows)
        return direction(np.tile(azimuth, self.rows), np.repeat(elevation, self.columns))

    def distance_rad(self, azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
        """How far rays are from the grid's ray in whose cell they lie, shape (N,)."""
        nearest = direction(
            _nearest(cut_behind(azimuth_rad), self.azimuth_rad, self.columns),
            _nearest(elevation_rad, self.elevation_rad, self.rows),
        )
        return angles_between(nearest, direction(azimuth_rad, elevation_rad))


def nearest_grid(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> EvenGrid:
    """The grid of about as many rays that is nearest to given ones in the mean square; at least one ray."""
    azimuth_rad = cut_behind(azimuth_rad)
    count = len(azimuth_rad)
    shapes = [(rows, max(round(count / rows), 1)) for rows in _row_counts(azimuth_rad, elevation_rad)]
    most = max(count // MOST_CHANGED, 1)
    grids = [
        EvenGrid(columns, rows, _fitted(azimuth_rad, columns), _fitted(elevation_rad, rows))
        for rows, columns in shapes
        if abs(rows * columns - count) <= most
    ]

    def misfit(grid: EvenGrid) -> float:
        square = float(np.square(grid.distance_rad(azimuth_rad, elevation_rad)).mean())
        # rounding is no reason for another number of rays
        return square + ON_GRID_RAD**2 * abs(len(grid) - count)

    return min(grids, key=misfit)


def cut_behind(azimuth_rad: np.ndarray) -> np.ndarray:
    """Azimuths from -pi up to below pi; what is straight behind to rounding is at -pi."""
    start = -np.pi - ON_GRID_RAD
    there = (azimuth_rad >= start) & (azimuth_rad < start + 2 * np.pi)
    # what already exists stays as it is, to the last bit
    return np.where(there, azimuth_rad, np.mod(azimuth_rad - start, 2 * np.pi) + start)


def _row_counts(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> list[int]:
    """Numbers of rows that are tried: around square cells, and as many as there are distinct elevations."""
    count = len(azimuth_rad)
    width = float(np.ptp(azimuth_rad) * np.cos(np.mean(elevation_rad)))
    square = math.sqrt(count * float(np.ptp(elevation_rad)) / width) if width > 0 else float(count)
    low = max(min(max(round(square), 1), count) - TRIED_ROWS // 2, 1)
    tried = set(range(low, min(low + TRIED_ROWS, count) + 1))
    azimuths, elevations = (
        len(np.unique(np.round(values / ON_GRID_RAD / 2))) for values in (azimuth_rad, elevation_rad)
    )
    return sorted({1, *tried, elevations, max(round(count / max(azimuths, 1)), 1)})


def _fitted(values: np.ndarray, count: int) -> tuple[float, float]:
    """The first and last of `count` even values that are nearest to given ones in the mean square."""
    low, high = float(values.min()), float(values.max())
    if count == 1 or low == high:
        middle = float(values.mean())
        return middle, middle
    index = np.rint((values - low) / (high - low) * (count - 1))
    spread = index - index.mean()
    step = float(spread @ (values - values.mean()) / (spread @ spread))
    first = float(values.mean() - step * index.mean())
    return first, first + step * (count - 1)


def _nearest(values: np.ndarray, bounds: tuple[float, float], count: int) -> np.ndarray:
    low, high = bounds
    if count == 1 or low == high:
        return np.full(len(values), low)
    index = np.clip(np.rint((values - low) / (high - low) * (count - 1)), 0, count - 1)
    return low + index * ((high - low) / (count - 1))


# So many sensors are named in the notes.
MOST_NAMED = 4


def grid_of(mount: Mount) -> EvenGrid:
    """The even grid that stands for the rays of a mount."""
    return nearest_grid(mount.azimuth_rad, mount.elevation_rad)


def by_channel(design: DesignSpec, rays: Rays) -> tuple[DesignSpec, Rays]:
    """A design of sensors that spin with a sensor for each of their channels, whose rings are even grids; others."""
    if design.layout != "spinning":
        return design, rays
    rings = np.column_stack([rays.sensor, rays.elevation_rad])
    found, channel = np.unique(rings, axis=0, return_inverse=True)
    owners = [design.sensors[int(owner)] for owner in found[:, 0]]
    sensors = tuple(replace(one, name=f"{one.name} channel {number}") for number, one in enumerate(owners))
    return replace(design, sensors=sensors), replace(rays, sensor=channel.reshape(-1))


def grid_sensor_losses(design: DesignSpec, mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of what sensors with one place, one gate and an even grid of rays cannot hold."""
    notes = [
        *design_losses(design, mounted),
        *grid_losses(mounted, rays),
        *origin_losses(mounted),
        *gate_losses(mounted),
    ]
    if design.layout == "spinning":
        notes.append("every channel is a sensor of its own: an even ring")
    return [*notes, "firing times are lost"]


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
    grids = ", ".join(f"{grid.columns} x {grid.rows} of {mount.name}" for mount, grid, _ in off[:MOST_NAMED])
    more = f", and those of {len(off) - MOST_NAMED} more sensors" if len(off) > MOST_NAMED else ""
    fired = len(rays) + sum(len(grid) - len(mount.ray) for mount, grid, _ in off)
    total = "" if fired == len(rays) else f", {fired} rays in all"
    return [
        f"{count} of {len(rays)} rays are not on an even grid of azimuth and elevation; replaced by even grids "
        f"({grids}{more}){total}: off by at most {worst:.2g} deg"
    ]
