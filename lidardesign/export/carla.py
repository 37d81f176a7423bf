"""CARLA: a sensor.lidar.ray_cast per sensor, with its blueprint's attributes and its transform, as JSON.

`attributes` are the text that `blueprint.set_attribute` takes; `transform` is in CARLA's left-handed frame: x forward,
y to the right, z up, in metres and degrees. With the world's fixed time step of `fixed_delta_seconds`, every frame has
all rays once: azimuths are swept from minus half of `horizontal_fov` on, so the mount is turned by half a step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.even_grid import EvenGrid, grid_of, grid_sensor_losses
from lidardesign.export.common.poses import Mount, ReadMount, mounts, mounts_rounding
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import HALF_DIGITS
from lidardesign.run.files import write_atomic
from lidardesign.space import direction

MIRROR = np.diag([1.0, -1.0, 1.0])
# A sweep of one column is as narrow as its field of view is written.
NARROWEST_DEG = 0.001


def write_carla(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold.

    Raises:
        ConfigError: A frame rate at which CARLA's whole number of points per second is not the rays of a frame.
    """
    mounted = mounts(design, rays)
    for mount in mounted:
        grid = grid_of(mount)
        if round(round(len(grid) * rate_hz) / rate_hz / grid.rows) != grid.columns:
            raise ConfigError(
                f"{rate_hz:g} frames of {len(grid)} rays per second are no whole number of points per second, as CARLA "
                f"counts them ({mount.name})",
                where="--rate-hz",
                allowed="a rate at which they are, as one of 1 or more",
            )
    document = {
        "design": design.name,
        "fixed_delta_seconds": 1 / rate_hz,
        "sensors": [_sensor(one, rate_hz) for one in mounted],
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


def carla_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """How far the rays that CARLA fires are from the design's; its sensors have no gate start, so only ends count.

    Raises:
        DataError: The file holds no such sensors.
    """
    mounted = mounts(design, rays)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        found = [_held(one, document["fixed_delta_seconds"]) for one in document["sensors"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"holds no lidars: {error!r}", where=str(path)) from error
    return mounts_rounding(rays, mounted, found, path)


def _sensor(mount: Mount, rate_hz: float) -> dict[str, Any]:
    grid = grid_of(mount)
    field_deg = max(math.degrees(grid.azimuth_step_rad) * grid.columns, NARROWEST_DEG)
    low_deg, high_deg = (math.degrees(value) for value in grid.elevation_rad)
    attributes = {
        "channels": str(grid.rows),
        "range": repr(mount.gate_m[1]),
        "points_per_second": str(round(len(grid) * rate_hz)),
        "rotation_frequency": repr(float(rate_hz)),
        "upper_fov": repr(high_deg),
        "lower_fov": repr(low_deg),
        "horizontal_fov": repr(field_deg),
        # a design says nothing of the noise: every ray that hits is reported, where it hits
        "dropoff_general_rate": "0.0",
        "dropoff_zero_intensity": "0.0",
        "noise_stddev": "0.0",
        "sensor_tick": repr(1 / rate_hz),
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


def _axes(rotation: Mapping[str, float]) -> np.ndarray:
    """The matrix of CARLA's transforms, whose columns are forward, right and up: a roll lowers the right side."""
    pitch, yaw, roll = (math.radians(rotation[name]) for name in ("pitch", "yaw", "roll"))
    cos_p, sin_p, cos_y, sin_y = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    cos_r, sin_r = math.cos(roll), math.sin(roll)
    return np.array(
        [
            [cos_p * cos_y, cos_y * sin_p * sin_r - sin_y * cos_r, -cos_y * sin_p * cos_r - sin_y * sin_r],
            [cos_p * sin_y, sin_y * sin_p * sin_r + cos_y * cos_r, -sin_y * sin_p * cos_r + cos_y * sin_r],
            [sin_p, -cos_p * sin_r, cos_p * cos_r],
        ]
    )


def _held(sensor: Mapping[str, Any], step_s: float) -> ReadMount:
    attributes = sensor["attributes"]
    rows = int(attributes["channels"])
    columns = round(float(attributes["points_per_second"]) * step_s / rows)
    field, high, low = (math.radians(float(attributes[f"{name}_fov"])) for name in ("horizontal", "upper", "lower"))
    swept = -field / 2 + np.arange(columns) * field / columns
    local = direction(np.tile(swept, rows), np.repeat(np.linspace(high, low, rows), columns))
    location = np.array([sensor["transform"]["location"][axis] for axis in "xyz"])
    world = local @ _axes(sensor["transform"]["rotation"]).T @ MIRROR
    return ReadMount(MIRROR @ location, world, (math.nan, float(attributes["range"])))
