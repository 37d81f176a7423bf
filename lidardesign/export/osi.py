"""ASAM OSI: a SensorViewConfiguration with one LidarSensorViewConfiguration per sensor, as protobuf writes it in JSON.

Every sensor stands at its mounting position (x forward, y to the left, z up; yaw, then pitch, then roll), and its rays
are unit vectors in its own frame with the microsecond in which each fires. Rays of one sensor that start at several
places become as many configurations.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.poses import (
    Part,
    Place,
    design_losses,
    fire_times_s,
    mounts,
    places,
    rays_of_parts,
    rays_rounding,
    require_rays,
)
from lidardesign.geometry.frames import rotation_of_rpy
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import FULL_TURN, unit_vectors
from lidardesign.run.files import write_atomic
from lidardesign.space import angles

MICROSECONDS_PER_S = 1e6
NANOSECONDS_PER_S = 10**9
# Timings are uint32.
MOST_US = 2**32 - 1


def write_osi(design: DesignSpec, rays: Rays, path: Path, rate_hz: float) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold.

    Raises:
        ConfigError: Frames that microseconds in 32 bits, or nanoseconds, cannot count.
        DataError: The design has no rays, or the file cannot be written.
    """
    require_rays(design, rays, "a lidar's configuration")
    times_us = np.rint(fire_times_s(rays, rate_hz) * MICROSECONDS_PER_S)
    cycle_ns = round(NANOSECONDS_PER_S / rate_hz)
    if times_us.max() > MOST_US or cycle_ns < 1:
        allowed = f"frames of a nanosecond to an hour: 0.0003 to {NANOSECONDS_PER_S:g}"
        raise ConfigError(f"{rate_hz:g}", where="--rate-hz", allowed=allowed)
    mounted = mounts(design, rays)
    found = places(mounted, rays)
    seconds, nanoseconds = divmod(cycle_ns, NANOSECONDS_PER_S)
    whole = {
        "range": float(rays.gate_m[:, 1].max()),
        # 64-bit integers are text in protobuf's JSON
        "updateCycleTime": {"seconds": str(seconds), "nanos": nanoseconds},
        "lidarSensorViewConfiguration": [_lidar(number, one, rays, times_us) for number, one in enumerate(found)],
    }
    write_atomic(path, json.dumps(whole, indent=1) + "\n")
    notes = [
        "gates are not held: `range` is the end of the last one",
        "names are not held: sensor_id counts the configurations, in the order of the sensors",
    ]
    if len(found) > len(mounted):
        notes.append(f"rays of {len(mounted)} sensors start at {len(found)} places: each is a configuration of its own")
    return [*notes, *design_losses(design, mounted)]


def _lidar(number: int, place: Place, rays: Rays, times_us: np.ndarray) -> dict[str, Any]:
    """The configuration of the rays of one place; its fields of view hold all of them."""
    looking = rays.direction[place.ray] @ place.mount.sensor.frame.T
    azimuth, elevation = angles(looking)
    roll, pitch, yaw = (math.remainder(angle, FULL_TURN) for angle in place.mount.roll_pitch_yaw_rad)
    return {
        "sensorId": {"value": str(number)},
        "mountingPosition": {
            "position": _vector(place.origin_m),
            "orientation": {"roll": roll, "pitch": pitch, "yaw": yaw},
        },
        "fieldOfViewHorizontal": float(2 * np.abs(np.where(azimuth > math.pi, FULL_TURN - azimuth, azimuth)).max()),
        "fieldOfViewVertical": float(2 * np.abs(elevation).max()),
        "maxNumberOfInteractions": 1,
        "numOfPixels": len(place.ray),
        "directions": [_vector(one) for one in looking],
        "timings": times_us[place.ray].astype(np.int64).tolist(),
    }


def _vector(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def read_osi(path: Path, design: DesignSpec, rays: Rays) -> tuple[Rays, float]:
    """The rays of a file that `write_osi` made of a design and its rays, with their own gates, and the frame rate [Hz].

    Raises:
        DataError: The file cannot be read, or holds something else.
    """
    found = places(mounts(design, rays), rays)
    try:
        whole = json.loads(Path(path).read_text(encoding="utf-8"))
        cycle = whole["updateCycleTime"]
        rate_hz = NANOSECONDS_PER_S / (int(cycle["seconds"]) * NANOSECONDS_PER_S + int(cycle["nanos"]))
        lidars = whole["lidarSensorViewConfiguration"]
        parts = [_part(place, lidar, rays) for place, lidar in zip(found, lidars, strict=True)]
        times_us = np.zeros(len(rays))
        for place, lidar in zip(found, lidars, strict=True):
            times_us[place.ray] = lidar["timings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"cannot be read as OSI: {error}", where=str(path), hint="export it again") from error
    read_back = rays_of_parts(rays, parts, str(path))
    held = (read_back.origin_m, read_back.direction, read_back.gate_m, read_back.sensor)
    return Rays(*held, times_us / MICROSECONDS_PER_S), rate_hz


def _part(place: Place, lidar: dict[str, Any], rays: Rays) -> Part:
    mounting = lidar["mountingPosition"]
    turn = rotation_of_rpy(*(mounting["orientation"][name] for name in ("roll", "pitch", "yaw")))
    looking = np.array([[one[axis] for axis in "xyz"] for one in lidar["directions"]]).reshape(-1, 3)
    origin = np.tile([mounting["position"][axis] for axis in "xyz"], (len(looking), 1))
    return place.ray, origin, unit_vectors(looking @ turn.T), rays.gate_m[place.ray]


def osi_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose: times are whole microseconds; gates are not held."""
    found, rate_hz = read_osi(path, design, rays)
    errors = rays_rounding(replace(rays, time_s=fire_times_s(rays, rate_hz)), found, path)
    return {name: errors[name] for name in ("origin_m", "direction_rad", "time_s")}
