"""Isaac Sim before version 5: one lidar profile per sensor as JSON, and where they are mounted.

The folder has NAME.json for each sensor, which Isaac finds by that name in its folder of lidar configurations, and
`mounts.json`: names, places [m] and quaternions (w, x, y, z), as its command that creates a lidar takes them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import write_folder
from lidardesign.export.common.poses import Mount, mounts
from lidardesign.export.isaac import FoundSensor, emitters_of, found_emitters, losses, profile_rounding, whole_rate_hz
from lidardesign.geometry.rays import Rays
from lidardesign.geometry.rotation import rotations_of_quaternions

MOUNTS = "mounts.json"
# No sensor's file is called so.
MOUNTS_NAME = "mounts"
# What a profile must have and a design says nothing of: those of NVIDIA's example of a solid-state lidar.
OPTICS = {
    "effectiveApertureSize": 0.0145,
    "focusDistM": 0.16,
    "avgPowerW": 0.002,
    "minReflectance": 0.1,
    "wavelengthNm": 1550.0,
    "pulseTimeNs": 6,
}
LEAST_REFLECTANCE_RANGE_M = 270.0


def write(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the folder's files, each atomically; returns notes of what the format cannot hold.

    Raises:
        DataError: The path is a file, or cannot be written to.
    """
    mounted, whole_hz = mounts(design, rays), whole_rate_hz(rate_hz)
    files = {f"{file_name(mount)}.json": _profile(mount, rays, whole_hz) for mount in mounted}
    files[MOUNTS] = {"design": design.name, "sensors": [_placed(mount) for mount in mounted]}
    notes = write_folder(path, {name: f"{json.dumps(value, indent=1)}\n".encode() for name, value in files.items()})
    optics = "power, aperture, wavelength and least reflectance are those of NVIDIA's example: a design has none"
    return [*losses(design, mounted, rate_hz), f"a profile has no pose: places stand in {MOUNTS}", optics, *notes]


def rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose.

    Raises:
        DataError: A file is missing, or holds no such profile.
    """
    mounted = mounts(design, rays)
    try:
        placed = json.loads((path / MOUNTS).read_text(encoding="utf-8"))["sensors"]
        found = [_found(one, path) for one in placed]
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"holds no profiles of lidars: {error!r}", where=str(path)) from error
    return profile_rounding(rays, mounted, found, path)


def file_name(mount: Mount) -> str:
    """What the profile of a sensor is called, without its suffix."""
    return f"{mount.name}_lidar" if mount.name.lower() == MOUNTS_NAME else mount.name


def _placed(mount: Mount) -> dict[str, Any]:
    return {
        "config": file_name(mount),
        "name": mount.sensor.name,
        "translation_m": mount.origin_m.tolist(),
        "orientation_wxyz": list(mount.quaternion),
    }


def _profile(mount: Mount, rays: Rays, rate_hz: int) -> dict[str, Any]:
    held, count = emitters_of(mount, rays, rate_hz), len(mount.ray)
    near, far = mount.gate_m
    state = {
        "azimuthDeg": [float(str(value)) for value in held.azimuth_deg],
        "elevationDeg": [float(str(value)) for value in held.elevation_deg],
        "fireTimeNs": held.fire_time_ns.tolist(),
        # counted from 0 in this form, from 1 in USD
        "channelId": list(range(count)),
        "rangeId": held.range_id.tolist(),
        "bank": [0] * count,
    }
    profile = {
        "scanType": "solidState",
        "intensityProcessing": "normalization",
        "rotationDirection": "CW",
        "rayType": "IDEALIZED",
        "nearRangeM": near,
        "farRangeM": far,
        # returns nearer than this are lost
        "minDistBetweenEchos": 0.0,
        "rangeResolutionM": 0.0,
        "rangeAccuracyM": 0.0,
        **OPTICS,
        "minReflectanceRange": max(LEAST_REFLECTANCE_RANGE_M, far),
        "maxReturns": 1,
        "scanRateBaseHz": float(rate_hz),
        "reportRateBaseHz": rate_hz,
        "numberOfEmitters": count,
        "numberOfChannels": count,
        "rangeCount": len(held.ranges_m),
        "ranges": [{"min": start, "max": end} for start, end in held.ranges_m.tolist()],
        "azimuthErrorMean": 0.0,
        "azimuthErrorStd": 0.0,
        "elevationErrorMean": 0.0,
        "elevationErrorStd": 0.0,
        "stateResolutionStep": 1,
        "numLines": 1,
        "numRaysPerLine": [count],
        "emitterStateCount": 1,
        "emitterStates": [state],
        "intensityMappingType": "LINEAR",
    }
    return {
        "class": "sensor",
        "type": "lidar",
        "name": mount.sensor.name,
        "driveWorksId": "GENERIC",
        "profile": profile,
    }


def _found(placed: dict[str, Any], folder: Path) -> FoundSensor:
    profile = json.loads((folder / f"{placed['config']}.json").read_text(encoding="utf-8"))["profile"]
    ranges = [[one["min"], one["max"]] for one in profile["ranges"]]
    return FoundSensor(
        np.array(placed["translation_m"]),
        rotations_of_quaternions(np.array(placed["orientation_wxyz"])),
        profile["scanRateBaseHz"],
        found_emitters(profile["emitterStates"][0], ranges),
    )
