"""Simulators of driving as JSON: CARLA and ASAM OSI.

CARLA: a sensor.lidar.ray_cast per sensor, with its blueprint's attributes and its transform, as JSON.

`attributes` are the text that `blueprint.set_attribute` takes; `transform` is in CARLA's left-handed frame: x forward,
y to the right, z up, in metres and degrees. With the world's fixed time step of `fixed_delta_seconds`, every frame has
all rays once: azimuths are swept from minus half of `horizontal_fov` on, so the mount is turned by half a step. The
next frame begins where a product of single-precision numbers ends: where it falls short of the field of view by its
rounding, the first column looks to the other edge. Frequency and field are written so that it does not.

ASAM OSI: a SensorViewConfiguration with one LidarSensorViewConfiguration per sensor, as protobuf writes it in JSON.

Every sensor stands at its mounting position (x forward, y to the left, z up; yaw, then pitch, then roll), and its rays
are unit vectors in its own frame with the microsecond in which each fires. Rays of one sensor that start at several
places become as many configurations.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError
from lidardesign.export.mounts import (
    EvenGrid,
    Mount,
    Place,
    by_channel,
    design_losses,
    fire_times_s,
    grid_of,
    grid_sensor_losses,
    mounts,
    places,
    require_rays,
)
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import FULL_TURN, HALF_DIGITS
from lidardesign.run.files import write_atomic
from lidardesign.space import angles

MIRROR = np.diag([1.0, -1.0, 1.0])
# A sweep of one column is as narrow as its field of view is written.
NARROWEST_DEG = 0.001
# Unreal's frames last from half a millisecond to 0.4 s; it makes others so.
SLOWEST_HZ, FASTEST_HZ = 2.5, 2000.0
# How many single-precision numbers around the field of view and the frequency are tried, the nearest first.
TRIED_FIELDS, TRIED_RATES = (sorted(range(-most, most + 1), key=abs) for most in (4000, 3))


def write_carla(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold.

    Raises:
        ConfigError: A frame rate that Unreal's frames do not have; at those, CARLA's whole numbers of points per second
            are the rays of a frame.
    """
    if not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
        raise ConfigError(
            f"{rate_hz:g}", where="--rate-hz", allowed=f"{SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz, the frames of CARLA"
        )
    design, rays = by_channel(design, rays)
    mounted = mounts(design, rays)
    document = {
        "design": design.name,
        "fixed_delta_seconds": 1 / rate_hz,
        "sensors": [_blueprint(one, rate_hz) for one in mounted],
    }
    write_atomic(path, json.dumps(document, indent=1) + "\n")
    notes = grid_sensor_losses(design, mounted, rays)
    late = [one.gate_m[0] for one in mounted if one.gate_m[0] > 0]
    if late:
        notes.append(
            f"CARLA has no gate start: {len(late)} of {len(mounted)} sensors also see what is nearer than theirs, of "
            f"{min(late):.3g} to {max(late):.3g} m"
        )
    return [*notes, "every frame has all rays once where the world's fixed_delta_seconds is that of the file"]


def _blueprint(mount: Mount, rate_hz: float) -> dict[str, Any]:
    grid = grid_of(mount)
    # from one azimuth to the next; 0 for one column
    step_rad = (grid.azimuth_rad[1] - grid.azimuth_rad[0]) / max(grid.columns - 1, 1)
    turn_hz, field_deg = _sweep(max(math.degrees(step_rad) * grid.columns, NARROWEST_DEG), rate_hz)
    low_deg, high_deg = (math.degrees(value) for value in grid.elevation_rad)
    attributes = {
        "channels": str(grid.rows),
        "range": repr(mount.gate_m[1]),
        "points_per_second": str(round(len(grid) * rate_hz)),
        "rotation_frequency": repr(turn_hz),
        "upper_fov": repr(high_deg),
        "lower_fov": repr(low_deg),
        "horizontal_fov": repr(field_deg),
        # a design says nothing of the noise: every ray that hits is reported, where it hits
        "dropoff_general_rate": "0.0",
        "dropoff_zero_intensity": "0.0",
        "noise_stddev": "0.0",
        # at every frame: an interval of the same length leaves frames out by its rounding
        "sensor_tick": "0.0",
        "role_name": mount.name,
    }
    location = dict(zip("xyz", (MIRROR @ mount.origin_m).tolist(), strict=True))
    return {
        "id": mount.name,
        "name": mount.sensor.name,
        "type": "sensor.lidar.ray_cast",
        "attributes": attributes,
        "transform": {"location": location, "rotation": _rotation(mount, grid, field_deg)},
    }


def _sweep(field_deg: float, rate_hz: float) -> tuple[float, float]:
    """The rotation frequency [Hz] and the field of view [deg] of which CARLA sweeps just the whole in a frame."""
    field, rate, step_s = (np.float32(value) for value in (field_deg, rate_hz, 1 / rate_hz))
    fields = (field.view(np.int32) + np.array(TRIED_FIELDS, dtype=np.int32)).view(np.float32)
    rates = (rate.view(np.int32) + np.array(TRIED_RATES, dtype=np.int32)).view(np.float32)
    whole = rates * fields[:, None] * step_s == fields[:, None]
    nearest = np.argwhere(whole)[0] if whole.any() else (0, 0)
    return float(rates[nearest[1]]), float(fields[nearest[0]])


def _rotation(mount: Mount, grid: EvenGrid, field_deg: float) -> dict[str, float]:
    """Pitch, yaw and roll [deg] of a mount, turned about its own z so that CARLA's sweep is the grid."""
    # swept to the right from minus half of the field: the grid's azimuths grow to the left
    turn_rad = math.radians(field_deg) / 2 - grid.azimuth_rad[1]
    cos_t, sin_t = math.cos(turn_rad), math.sin(turn_rad)
    turned = np.array([[cos_t, -sin_t, 0.0], [sin_t, cos_t, 0.0], [0.0, 0.0, 1.0]])
    forward, side, up = (MIRROR @ mount.sensor.frame.T @ MIRROR @ turned).T
    flat = math.hypot(forward[0], forward[1])
    # straight up or down, yaw and roll are one angle
    level = flat > HALF_DIGITS
    yaw = math.atan2(forward[1], forward[0]) if level else math.atan2(-side[0], side[1])
    roll = math.atan2(-side[2], up[2]) if level else 0.0
    return {
        "pitch": math.degrees(math.atan2(forward[2], flat)),
        "yaw": math.degrees(yaw),
        "roll": math.degrees(roll),
    }


MICROSECONDS_PER_S = 1e6
NANOSECONDS_PER_S = 10**9


def write_osi(design: DesignSpec, rays: Rays, path: Path, rate_hz: float) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the file cannot be written.
    """
    require_rays(design, rays, "a lidar's configuration")
    # uint32 there: every frame rate that exports take has fewer microseconds in a frame; the last are not rounded into
    # the next frame
    times_us = np.rint(fire_times_s(rays, rate_hz) * MICROSECONDS_PER_S)
    times_us = np.minimum(times_us, math.ceil(MICROSECONDS_PER_S / rate_hz) - 1)
    cycle_ns = round(NANOSECONDS_PER_S / rate_hz)
    mounted = mounts(design, rays)
    found = places(mounted, rays)
    seconds, nanoseconds = divmod(cycle_ns, NANOSECONDS_PER_S)
    whole = {
        "range": float(rays.gate_m[:, 1].max()),
        # 64-bit integers are text in protobuf's JSON
        "updateCycleTime": {"seconds": str(seconds), "nanos": nanoseconds},
        "lidarSensorViewConfiguration": [
            _configuration(number, one, rays, times_us) for number, one in enumerate(found)
        ],
    }
    write_atomic(path, json.dumps(whole, indent=1) + "\n")
    notes = [
        "gates are lost: `range` is the end of the last one",
        "firing times are whole microseconds",
        "names are lost: sensor_id numbers the configurations, in the order of the sensors",
    ]
    if len(found) > len(mounted):
        notes.append(f"rays of {len(mounted)} sensors start at {len(found)} places: each is a configuration of its own")
    return [*notes, *design_losses(design, mounted)]


def _configuration(number: int, place: Place, rays: Rays, times_us: np.ndarray) -> dict[str, Any]:
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
