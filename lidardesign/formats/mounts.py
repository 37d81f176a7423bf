"""Sensors with their rays at mounting poses or by ray origin, and their approximation by even grids.

A mount has the sensor's position and boresight frame: x forward, y to the left (growing azimuth), z up. By fixed axes
(URDF, SDF) its rotation is roll = the sensor's roll, pitch = -elevation, yaw = azimuth. The rays are given in that
frame. Losses of formats become notes (`*_losses`).

Simulators of scanning sensors fire even grids of azimuth and elevation in the sensor's frame: rays of any layout are
replaced by the nearest grid with about as many rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.errors import DataError
from lidardesign.formats.names import distinct, identifier
from lidardesign.formats.rig import indices_by_owner
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays
from lidardesign.sensors.compare import angles_between
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import Sensor
from lidardesign.space import angles, direction

# Origins and gates closer than this are the same.
SAME_M = SLACK


@dataclass(frozen=True, eq=False)
class Mount:
    """A sensor at its mounting pose, with its rays.

    Arguments:
        name: An identifier, unique in the design.
        sensor: The sensor.
        origin_m: Mean origin of its rays [m], shape (3,).
        ray: Indices of its rays, shape (N,), N >= 1.
        azimuth_rad, elevation_rad: Angles of its rays in its frame, azimuths from -pi to pi, shape (N,).
        gate_m: Start and end of the narrowest gate that contains those of all its rays [m].
        spread_m: Largest distance of a ray's origin from `origin_m` [m].
        gate_excess_m: Largest excess of `gate_m` at an end over a ray's own gate [m].
    """

    name: str
    sensor: Sensor
    origin_m: np.ndarray
    ray: np.ndarray
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    gate_m: tuple[float, float]
    spread_m: float
    gate_excess_m: float

    @property
    def roll_pitch_yaw_rad(self) -> tuple[float, float, float]:
        """Rotation angles about the fixed axes x, y, z, in this order [rad]."""
        return self.sensor.roll_rad, -self.sensor.elevation_rad, self.sensor.azimuth_rad

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Rotation from its frame to the world as a quaternion (w, x, y, z)."""
        return quaternion(*self.roll_pitch_yaw_rad)


def mounts(design: DesignSpec, rays: Rays) -> list[Mount]:
    """Mounts of the sensors of a design that fire rays, in their order."""
    names = distinct([identifier(sensor.name) for sensor in design.sensors], "_")
    return [
        _mount(name, sensor, rays, own)
        for name, sensor, own in zip(names, design.sensors, indices_by_owner(rays.sensor, len(names)), strict=True)
        if len(own)
    ]


def _mount(name: str, sensor: Sensor, rays: Rays, ray: np.ndarray) -> Mount:
    starts = rays.origin_m[ray]
    # a mean of equal numbers need not be that number
    origin = starts[0] if (starts == starts[0]).all() else starts.mean(axis=0)
    azimuth, elevation = angles(rays.direction[ray] @ sensor.frame.T)
    gate = rays.gate_m[ray]
    start, end = float(gate[:, 0].min()), float(gate[:, 1].max())
    return Mount(
        name,
        sensor,
        origin,
        ray,
        np.where(azimuth > np.pi, azimuth - 2 * np.pi, azimuth),
        elevation,
        (start, end),
        float(np.linalg.norm(starts - origin, axis=1).max()),
        float(np.maximum(gate[:, 0] - start, end - gate[:, 1]).max()),
    )


def quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of rotations about the fixed axes x, y, z, in this order."""
    cos_r, sin_r = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cos_p, sin_p = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cos_y, sin_y = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cos_r * cos_p * cos_y + sin_r * sin_p * sin_y,
        sin_r * cos_p * cos_y - cos_r * sin_p * sin_y,
        cos_r * sin_p * cos_y + sin_r * cos_p * sin_y,
        cos_r * cos_p * sin_y - sin_r * sin_p * cos_y,
    )


def fire_times_s(rays: Rays, rate_hz: float) -> np.ndarray:
    """Firing times of rays, rescaled from the default to another frame rate, shape (N,) [s]."""
    return rays.time_s * (DEFAULT_RATE_HZ / rate_hz)


def design_losses(design: DesignSpec, mounted: Sequence[Mount]) -> list[str]:
    """Notes of the losses of every format of mounted sensors, and of sensors without rays."""
    notes = ["weights, fields of view and origin covariances of the sensors are lost"]
    silent = len(design.sensors) - len(mounted)
    if silent:
        notes.append(f"{silent} of {len(design.sensors)} sensors fire no ray and are left out")
    return notes


def origin_losses(mounted: Sequence[Mount]) -> list[str]:
    """Notes of the losses of formats with a single origin per sensor."""
    spread = [one for one in mounted if one.spread_m > SAME_M]
    if not spread:
        return []
    return [
        f"{sum(len(one.ray) for one in spread)} rays of {len(spread)} sensors start beside their sensor's middle: "
        f"moved there, by up to {max(one.spread_m for one in spread):.3g} m"
    ]


def gate_losses(mounted: Sequence[Mount]) -> list[str]:
    """Notes of the losses of formats with a single gate per sensor."""
    wider = [one for one in mounted if one.gate_excess_m > SAME_M]
    if not wider:
        return []
    return [
        f"the rays of {len(wider)} of {len(mounted)} sensors have gates of their own: the sensor's is the narrowest "
        f"that holds them all, up to {max(one.gate_excess_m for one in wider):.3g} m wider"
    ]


@dataclass(frozen=True, eq=False)
class Place:
    """Rays of one sensor with the same origin.

    Arguments:
        name: An identifier, unique in the design: that of the sensor, numbered where it has several origins.
        mount: The sensor.
        origin_m: The origin [m], shape (3,).
        ray: Indices of its rays in their order, shape (K,).
    """

    name: str
    mount: Mount
    origin_m: np.ndarray
    ray: np.ndarray


def places(mounted: Sequence[Mount], rays: Rays) -> list[Place]:
    """Rays of all sensors grouped by origin, by sensor and then in the order in which they first fire."""
    found = []
    for mount in mounted:
        origins, first, place = np.unique(rays.origin_m[mount.ray], axis=0, return_index=True, return_inverse=True)
        own = indices_by_owner(place.reshape(-1), len(origins))
        for number, here in enumerate(np.argsort(first)):
            name = mount.name if len(origins) == 1 else f"{mount.name}_place_{number}"
            found.append(Place(name, mount, origins[here], mount.ray[own[here]]))
    return found


def near_losses(starts_m: np.ndarray, least_m: float, what: str, reason: str) -> list[str]:
    """Note of the gates that start (N,) [m] before the least start of a format."""
    near = np.count_nonzero(starts_m < least_m)
    if not near:
        return []
    return [f"gates of {near} of {len(starts_m)} {what} start below {least_m:g} m: they start there, for {reason}"]


def require_rays(design: DesignSpec, rays: Rays, what: str) -> None:
    """Refuse a design without rays, for a format that needs them.

    Raises:
        DataError: There are none.
    """
    if not len(rays):
        raise DataError(f"has no rays, and {what} holds nothing else", where=design.name, hint="give --rays N")


# Rays nearer to a grid than this are on it: files have about seven digits.
ON_GRID_RAD = COARSE_SLACK
# A grid has up to a tenth more or fewer rays than the list that it replaces.
MOST_CHANGED = 10
# Numbers of rows to try around that of square cells.
TRIED_ROWS = 24


@dataclass(frozen=True)
class EvenGrid:
    """Rows at even elevations, each with the same even azimuths; first and last rays are on the bounds.

    Arguments:
        columns, rows: Numbers of azimuths and elevations.
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
        return direction(
            np.tile(np.linspace(*self.azimuth_rad, self.columns), self.rows),
            np.repeat(np.linspace(*self.elevation_rad, self.rows), self.columns),
        )

    def distance_rad(self, azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
        """Angle between rays and the grid rays of their cells, shape (N,) [rad]."""
        nearest = direction(
            _nearest(cut_behind(azimuth_rad), self.azimuth_rad, self.columns),
            _nearest(elevation_rad, self.elevation_rad, self.rows),
        )
        return angles_between(nearest, direction(azimuth_rad, elevation_rad))


def nearest_grid(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> EvenGrid:
    """The nearest grid to given rays in the mean square, with about as many rays and at least one."""
    azimuth_rad = cut_behind(azimuth_rad)
    count = len(azimuth_rad)
    shapes = [(rows, max(round(count / rows), 1)) for rows in _row_counts(azimuth_rad, elevation_rad)]
    grids = [
        EvenGrid(columns, rows, _fitted(azimuth_rad, columns), _fitted(elevation_rad, rows))
        for rows, columns in shapes
        if abs(rows * columns - count) <= max(count // MOST_CHANGED, 1)
    ]

    def misfit(grid: EvenGrid) -> float:
        square = float(np.square(grid.distance_rad(azimuth_rad, elevation_rad)).mean())
        # rounding must not change the number of rays
        return square + ON_GRID_RAD**2 * abs(len(grid) - count)

    return min(grids, key=misfit)


def cut_behind(azimuth_rad: np.ndarray) -> np.ndarray:
    """Azimuths from -pi up to below pi; azimuths straight behind to rounding become -pi."""
    start = -np.pi - ON_GRID_RAD
    there = (azimuth_rad >= start) & (azimuth_rad < start + 2 * np.pi)
    # azimuths in the interval are kept to the last bit
    return np.where(there, azimuth_rad, np.mod(azimuth_rad - start, 2 * np.pi) + start)


def _row_counts(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> list[int]:
    """Numbers of rows to try: around square cells, and as many as there are distinct elevations."""
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
    """First and last of `count` even values that fit given ones in the least squares."""
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


def grid_of(mount: Mount) -> EvenGrid:
    """The even grid that replaces the rays of a mount."""
    return nearest_grid(mount.azimuth_rad, mount.elevation_rad)


def channel_mounts(design: DesignSpec, rays: Rays) -> tuple[DesignSpec, Rays, list[Mount]]:
    """A design, its rays and mounts; spinning sensors are split into one per channel, whose ring is an even grid."""
    if not design.spins:
        return design, rays, mounts(design, rays)
    rings = np.column_stack([rays.sensor, rays.elevation_rad])
    found, channel = np.unique(rings, axis=0, return_inverse=True)
    owners = [design.sensors[int(owner)] for owner in found[:, 0]]
    sensors = tuple(replace(one, name=f"{one.name} channel {number}") for number, one in enumerate(owners))
    design, rays = replace(design, sensors=sensors), replace(rays, sensor=channel.reshape(-1))
    return design, rays, mounts(design, rays)


def grid_sensor_losses(design: DesignSpec, mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of the losses of formats with one origin, one gate and an even grid per sensor."""
    notes = [
        *design_losses(design, mounted),
        *grid_losses(mounted, rays),
        *origin_losses(mounted),
        *gate_losses(mounted),
    ]
    if design.spins:
        notes.append("every channel is a sensor of its own: an even ring")
    return [*notes, "firing times are lost"]


def grid_losses(mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Note of the rays that are not on an even grid, with their number and the largest angular error."""
    pairs = [(mount, grid_of(mount)) for mount in mounted]
    off = np.array([one for mount, grid in pairs for one in grid.distance_rad(mount.azimuth_rad, mount.elevation_rad)])
    count, fired = int((off > ON_GRID_RAD).sum()), sum(len(grid) for _, grid in pairs)
    if not count and all(len(grid) == len(mount.ray) for mount, grid in pairs):
        return []
    total = "" if fired == len(rays) else f", {fired} rays in all"
    return [
        f"{count} of {len(rays)} rays are not on an even grid of azimuth and elevation; replaced by even grids{total}: "
        f"off by at most {math.degrees(off.max()):.2g} deg"
    ]
