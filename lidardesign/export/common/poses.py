"""Sensors and rays as other programs hold them: at mounting poses, or by the places where rays start.

A mount has the sensor's place and boresight frame: x forward, y to the left (growing azimuth), z up. By fixed axes
(URDF, SDF) its rotation is roll = the sensor's roll, pitch = -elevation, yaw = azimuth. The rays are given in that
frame. What formats lose becomes notes (`*_losses`); what their numbers lose is measured by reading files back
(`*_rounding`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.errors import DataError
from lidardesign.estimates import ROUNDING, Estimate
from lidardesign.export.common.names import identifiers
from lidardesign.geometry.rays import DEFAULT_RATE_HZ, Rays
from lidardesign.numerics import SLACK
from lidardesign.space import angles, direction


def rays_rounding(written: Rays, found: Rays, path: Path, *, times: bool = True) -> dict[str, Estimate]:
    """The largest differences of rays that were read back, ray by ray.

    Arguments:
        written: What went into the file.
        found: What came out of it.
        path: The file, for errors.
        times: Whether the format holds firing times.

    Raises:
        DataError: The file holds other rays.
    """
    if len(written) != len(found) or (written.sensor != found.sensor).any():
        raise DataError(
            f"does not hold what was written: {len(found)} of {len(written)} rays came back, or in another order",
            where=str(path),
            hint="export it again, to another disk",
        )
    errors = {
        "origin_m": _largest(np.linalg.norm(found.origin_m - written.origin_m, axis=1), "m"),
        "direction_rad": _largest(angles_between(found.direction, written.direction), "rad"),
        "gate_m": _largest(np.abs(found.gate_m - written.gate_m), "m"),
    }
    return {**errors, "time_s": _largest(np.abs(found.time_s - written.time_s), "s")} if times else errors


def sensors_rounding(written: Sequence[Sensor], found: Sequence[Sensor], path: Path) -> dict[str, Estimate]:
    """The largest differences of sensors that were read back, sensor by sensor.

    Raises:
        DataError: The file holds another number of sensors.
    """
    require_sensors(len(written), len(found), path)

    def differences(read: Callable[[Sensor], object]) -> np.ndarray:
        return np.array([np.subtract(read(new), read(old)) for old, new in zip(written, found, strict=True)])

    boresights = [
        direction(*(np.array([getattr(one, name) for one in sensors]) for name in ("azimuth_rad", "elevation_rad")))
        for sensors in (written, found)
    ]
    origin = np.linalg.norm(differences(lambda one: one.origin_m), axis=1)
    spread = differences(lambda one: (one.spread_horizontal_rad, one.spread_vertical_rad))
    return {
        "origin_m": _largest(origin, "m"),
        "direction_rad": _largest(angles_between(*boresights), "rad"),
        "spread_rad": _largest(np.abs(spread), "rad"),
        "range_m": _largest(np.abs(differences(lambda one: (one.range_m, one.spread_range_m))), "m"),
        "weight": _largest(np.abs(differences(lambda one: one.weight)), ""),
    }


def require_sensors(written: int, found: int, path: Path) -> None:
    """Refuse a file that holds another number of sensors than were written.

    Raises:
        DataError: It does.
    """
    if found != written:
        raise DataError(f"does not hold what was written: {found} of {written} sensors came back", where=str(path))


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between unit vectors (N, 3) [rad], exact for the smallest too: 2 arcsin(|a - b| / 2), shape (N,)."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(first - second, axis=1) / 2, 1.0))


def _largest(differences: np.ndarray, unit: str) -> Estimate:
    return Estimate(None, float(differences.max(initial=0.0)), unit, ROUNDING)


# Origins and gates closer than this are the same.
SAME_M = SLACK


@dataclass(frozen=True, eq=False)
class Mount:
    """One sensor where it is mounted, and what it fires.

    Arguments:
        name: An identifier, unique in the design.
        sensor: What is mounted.
        origin_m: The mean of where its rays start, shape (3,).
        ray: Indices of its rays, shape (N,), N >= 1.
        azimuth_rad, elevation_rad: Of its rays in its frame, azimuths from -pi to pi, shape (N,).
        gate_m: The narrowest gate that holds those of all its rays, start and end.
        spread_m: How far from its place its rays start at most.
        gate_excess_m: How much wider than a ray's own gate `gate_m` is at most.
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
        """About the fixed axes x, y, z, in this order."""
        return self.sensor.roll_rad, -self.sensor.elevation_rad, self.sensor.azimuth_rad

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The rotation from its frame to the world as (w, x, y, z)."""
        return quaternion(*self.roll_pitch_yaw_rad)


def mounts(design: DesignSpec, rays: Rays) -> list[Mount]:
    """The sensors of a design that fire rays, in their order."""
    names = identifiers([sensor.name for sensor in design.sensors])
    order = np.argsort(rays.sensor, kind="stable")
    edges = np.searchsorted(rays.sensor[order], np.arange(len(design.sensors) + 1))
    return [
        _mount(name, sensor, rays, order[edges[index] : edges[index + 1]])
        for index, (name, sensor) in enumerate(zip(names, design.sensors, strict=True))
        if edges[index] < edges[index + 1]
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
    """The unit quaternion (w, x, y, z) of rotations about the fixed axes x, y, z, in this order."""
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
    """When rays fire in a frame of another rate than they were laid out for [s]."""
    return rays.time_s * (DEFAULT_RATE_HZ / rate_hz)


def design_losses(design: DesignSpec, mounted: Sequence[Mount]) -> list[str]:
    """What no format of mounted sensors holds of a design, and sensors that fire nothing."""
    notes = ["weights, spreads and origin covariances of the sensors are lost", *constraint_losses(design)]
    silent = len(design.sensors) - len(mounted)
    if silent:
        notes.append(f"{silent} of {len(design.sensors)} sensors fire no ray and are left out")
    return notes


def constraint_losses(design: DesignSpec) -> list[str]:
    """What no format but ours holds of a design."""
    return ["the constraints of the design are lost"] if design.constraints else []


def origin_losses(mounted: Sequence[Mount]) -> list[str]:
    """What formats lose in which all rays of a sensor start at one place."""
    spread = [one for one in mounted if one.spread_m > SAME_M]
    if not spread:
        return []
    rays, worst = sum(len(one.ray) for one in spread), max(one.spread_m for one in spread)
    return [
        f"{rays} rays of {len(spread)} sensors start all over them: they start at their middle, up to {worst:.3g} m off"
    ]


def gate_losses(mounted: Sequence[Mount]) -> list[str]:
    """What formats lose in which all rays of a sensor have one gate."""
    wider = [one for one in mounted if one.gate_excess_m > SAME_M]
    if not wider:
        return []
    worst = max(one.gate_excess_m for one in wider)
    return [
        f"the rays of {len(wider)} of {len(mounted)} sensors have gates of their own: the sensor's is the narrowest "
        f"that holds them all, up to {worst:.3g} m wider"
    ]


@dataclass(frozen=True, eq=False)
class ReadMount:
    """What was read back of one mount: its place, unit vectors of its rays (M, 3), its gate; NaN is not held."""

    origin_m: np.ndarray
    direction: np.ndarray
    gate_m: tuple[float, float]


def mounts_rounding(
    rays: Rays, mounted: Sequence[Mount], found: Sequence[ReadMount], path: Path
) -> dict[str, Estimate]:
    """The largest differences from what one place, one gate and other rays make of a sensor's.

    A direction is off by the angle to the nearest ray that its sensor fires.

    Raises:
        DataError: Another number of sensors was read back.
    """
    from scipy.spatial import cKDTree

    require_sensors(len(mounted), len(found), path)
    origin, ray, gate = [0.0], [0.0], [0.0]
    for mount, held in zip(mounted, found, strict=True):
        origin.append(float(np.linalg.norm(rays.origin_m[mount.ray] - held.origin_m, axis=1).max()))
        looking = rays.direction[mount.ray]
        nearest = held.direction[cKDTree(held.direction).query(looking)[1]]
        ray.append(float(angles_between(looking, nearest).max()))
        gate.append(float(np.nanmax(np.abs(rays.gate_m[mount.ray] - np.array(held.gate_m)), initial=0.0)))
    return {
        "origin_m": Estimate(None, max(origin), "m", ROUNDING),
        "direction_rad": Estimate(None, max(ray), "rad", ROUNDING),
        "gate_m": Estimate(None, max(gate), "m", ROUNDING),
        "rays": Estimate(None, float(abs(sum(len(held.direction) for held in found) - len(rays))), "", ROUNDING),
    }


# Rays as read from one part of a file: indices of shape (K,), origins, directions (K, 3) and gates (K, 2).
Part = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Place:
    """Rays of one sensor that start at one place.

    Arguments:
        name: An identifier, unique in the design: that of the sensor, numbered where it has several places.
        mount: The sensor.
        origin_m: The place [m], shape (3,).
        ray: Indices of its rays in their order, shape (K,).
    """

    name: str
    mount: Mount
    origin_m: np.ndarray
    ray: np.ndarray


def places(mounted: Sequence[Mount], rays: Rays) -> list[Place]:
    """The places of all sensors, by sensor and then in the order in which they first fire."""
    found = []
    for mount in mounted:
        origins, first, place = np.unique(rays.origin_m[mount.ray], axis=0, return_index=True, return_inverse=True)
        place = place.reshape(-1)
        members = np.split(mount.ray[np.argsort(place, kind="stable")], np.cumsum(np.bincount(place))[:-1])
        for number, here in enumerate(np.argsort(first)):
            name = mount.name if len(origins) == 1 else f"{mount.name}_place_{number}"
            found.append(Place(name, mount, origins[here], members[here]))
    return found


def require_rays(design: DesignSpec, rays: Rays, what: str) -> None:
    """Refuse a design without rays, for a format that is made of them.

    Raises:
        DataError: There are none.
    """
    if not len(rays):
        raise DataError(f"has no rays, and {what} holds nothing else", where=design.name, hint="give --rays N")


def rays_of_parts(written: Rays, parts: Sequence[Part], where: str) -> Rays:
    """Rays that were read part by part, in the order of those that were written, with their sensors and times.

    Raises:
        DataError: The parts are not the rays.
    """
    index = np.concatenate([part[0] for part in parts]) if parts else np.zeros(0, dtype=np.int64)
    same = all(len(part[0]) == len(value) for part in parts for value in part[1:])
    if not same or not np.array_equal(np.sort(index), np.arange(len(written))):
        raise DataError("does not hold what was written", where=where, hint="export it again, to another disk")
    order = np.argsort(index)
    origin, looking, gate = (np.concatenate([part[k] for part in parts])[order] for k in (1, 2, 3))
    return Rays(origin, looking, gate, written.sensor, written.time_s)
