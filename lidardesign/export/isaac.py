"""What Isaac Sim's lidar profiles hold of a sensor, shared by their JSON and their USD form.

A solid-state lidar with one emitter state: an emitter per ray at its azimuth (x forward, y at +90 degrees, z up) and
elevation in degrees, its firing time in the frame, and the number of its range. Ranges are the different gates of the
sensor, so gates of single rays are held. All emitters are one line: nothing says that rays lie in rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import renamed_note
from lidardesign.export.common.poses import Mount, design_losses, fire_times_s, origin_losses
from lidardesign.export.common.read_back import rays_rounding
from lidardesign.geometry.rays import Rays
from lidardesign.space import direction

NANOSECONDS_PER_SECOND = 1_000_000_000
# Isaac counts nanoseconds of a frame as signed 32-bit numbers, and frames per second as whole numbers.
SLOWEST_HZ = 1


@dataclass(frozen=True, eq=False)
class Emitters:
    """The arrays of one sensor's emitter state.

    Arguments:
        azimuth_deg, elevation_deg: Single precision, as Isaac keeps them, shape (N,).
        fire_time_ns: Whole nanoseconds within the frame, shape (N,).
        range_id: Which range each emitter listens in, shape (N,).
        ranges_m: Starts and ends, shape (R, 2).
    """

    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    fire_time_ns: np.ndarray
    range_id: np.ndarray
    ranges_m: np.ndarray


def emitters_of(mount: Mount, rays: Rays, rate_hz: int) -> Emitters:
    """The emitters of a mounted sensor."""
    ranges, range_id = np.unique(rays.gate_m[mount.ray], axis=0, return_inverse=True)
    time_ns = np.floor(fire_times_s(rays, rate_hz)[mount.ray] * NANOSECONDS_PER_SECOND).astype(np.int64)
    return Emitters(
        np.degrees(mount.azimuth_rad).astype(np.float32),
        np.degrees(mount.elevation_rad).astype(np.float32),
        time_ns,
        range_id.reshape(-1),
        ranges,
    )


def whole_rate_hz(rate_hz: float) -> int:
    """Frames per second as Isaac takes them.

    Raises:
        ConfigError: Fewer than one.
    """
    if round(rate_hz) < SLOWEST_HZ:
        raise ConfigError(
            f"{rate_hz:g} frames per second", where="--rate-hz", allowed=f"at least {SLOWEST_HZ}, a whole number"
        )
    return round(rate_hz)


def losses(design: DesignSpec, mounted: Sequence[Mount], rate_hz: float) -> list[str]:
    """Notes of what Isaac's profiles cannot hold."""
    notes = [*design_losses(design, mounted), *origin_losses(mounted)]
    if whole_rate_hz(rate_hz) != rate_hz:
        notes.append(f"frame rates are whole numbers there: {rate_hz:g} Hz is {whole_rate_hz(rate_hz)} Hz")
    notes.append("angles and lengths are kept in single precision, firing times in whole nanoseconds")
    return [*notes, *renamed_note([one.sensor.name for one in mounted], [one.name for one in mounted])]


@dataclass(frozen=True, eq=False)
class FoundSensor:
    """What was read back of one sensor: its pose, frames per second, and emitters.

    Arguments:
        origin_m: Shape (3,).
        turn: From its frame to the world, shape (3, 3); columns are its axes.
        rate_hz: Frames per second.
        emitters: Its emitters.
    """

    origin_m: np.ndarray
    turn: np.ndarray
    rate_hz: float
    emitters: Emitters


def profile_rounding(
    rays: Rays, mounted: Sequence[Mount], found: Sequence[FoundSensor], path: Path
) -> dict[str, Estimate]:
    """What the written numbers lose, ray by ray.

    Raises:
        DataError: Another number of sensors or rays came back.
    """
    if [len(one.ray) for one in mounted] != [len(one.emitters.azimuth_deg) for one in found]:
        raise DataError("does not hold the sensors and rays that were written", where=str(path))
    origin, ray, gate, time = (
        np.empty_like(values) for values in (rays.origin_m, rays.direction, rays.gate_m, rays.time_s)
    )
    expected = np.empty(len(rays))
    for mount, sensor in zip(mounted, found, strict=True):
        held = sensor.emitters
        angles_rad = (np.radians(values.astype(np.float64)) for values in (held.azimuth_deg, held.elevation_deg))
        origin[mount.ray] = sensor.origin_m
        ray[mount.ray] = direction(*angles_rad) @ sensor.turn.T
        gate[mount.ray] = held.ranges_m[held.range_id]
        time[mount.ray] = held.fire_time_ns / NANOSECONDS_PER_SECOND
        expected[mount.ray] = fire_times_s(rays, sensor.rate_hz)[mount.ray]
    asked = Rays(rays.origin_m, rays.direction, rays.gate_m, rays.sensor, expected)
    return rays_rounding(asked, Rays(origin, ray, np.sort(gate, axis=1), rays.sensor, time), path)


def found_emitters(values: Mapping[str, Any], ranges_m: Any) -> Emitters:
    """The emitters of arrays by Isaac's names.

    Raises:
        KeyError, ValueError: One is missing, or is no array of numbers.
    """
    return Emitters(
        np.array(values["azimuthDeg"], dtype=np.float32),
        np.array(values["elevationDeg"], dtype=np.float32),
        np.array(values["fireTimeNs"], dtype=np.int64),
        np.array(values["rangeId"], dtype=np.int64),
        np.array(ranges_m, dtype=np.float64).reshape(-1, 2),
    )
