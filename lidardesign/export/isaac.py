"""Isaac Sim: a solid-state lidar per sensor, as JSON profiles (before version 5) and as USD prims (from version 5 on).

A lidar has one emitter state: an emitter per ray at its azimuth (x forward, y at +90 degrees, z up) and elevation in
degrees, its firing time in the frame, and the number of its range. Ranges are the different gates of the sensor, so
gates of single rays are held. All emitters are one line: nothing says that rays lie in rows.

JSON: the folder has NAME.json for each sensor, which Isaac finds by that name in its folder of lidar configurations,
and `mounts.json`: names, places [m] and quaternions (w, x, y, z), as its command that creates a lidar takes them.

USD, in its text form: attributes have the names and types of OmniSensorGenericLidarCoreAPI. `reportRateBaseHz` became
`patternFiringRateHz` in version 6: both are written. Each prim is posed by translate and orient ops below one Xform,
in metres, z up.

NVIDIA's documentation wants a sensor's near range above its range offset and its least distance between echos, which
are 0, so gates start at a millimetre or more. What a range resolution of 0 does is not documented: 0.1 mm is
written.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import renamed_note, write_folder
from lidardesign.export.common.poses import Mount, design_losses, fire_times_s, mounts, origin_losses, rays_rounding
from lidardesign.geometry.frames import rotations_of_quaternions
from lidardesign.geometry.rays import Rays
from lidardesign.run.files import write_atomic
from lidardesign.space import direction

NANOSECONDS_PER_SECOND = 1_000_000_000
# Isaac counts nanoseconds of a frame as signed 32-bit numbers, and frames per second as whole numbers.
SLOWEST_HZ = 1
LEAST_START_M, RESOLUTION_M = 0.001, 0.0001
# Returns of less than a tenth are lost beyond this range, or beyond the last gate.
LEAST_REFLECTANCE, LEAST_REFLECTANCE_RANGE_M = 0.1, 270.0


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
    ranges, range_id = np.unique(np.maximum(rays.gate_m[mount.ray], LEAST_START_M), axis=0, return_inverse=True)
    return Emitters(
        np.degrees(mount.azimuth_rad).astype(np.float32),
        np.degrees(mount.elevation_rad).astype(np.float32),
        np.floor(fire_times_s(rays, rate_hz)[mount.ray] * NANOSECONDS_PER_SECOND).astype(np.int64),
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


def isaac_losses(design: DesignSpec, mounted: Sequence[Mount], rate_hz: float) -> list[str]:
    """Notes of what Isaac's profiles cannot hold."""
    notes = [*design_losses(design, mounted), *origin_losses(mounted)]
    if whole_rate_hz(rate_hz) != rate_hz:
        notes.append(f"frame rates there are whole numbers: {rate_hz:g} Hz is {whole_rate_hz(rate_hz)} Hz")
    near = sum(one.gate_m[0] < LEAST_START_M for one in mounted)
    if near:
        notes.append(
            f"gates of {near} of {len(mounted)} sensors start below {LEAST_START_M:g} m: they start there, for Isaac's "
            "near ranges are above 0"
        )
    notes.append("angles and lengths are kept in single precision, firing times in whole nanoseconds")
    return [*notes, *renamed_note([one.sensor.name for one in mounted], [one.name for one in mounted])]


@dataclass(frozen=True, eq=False)
class ReadSensor:
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
    rays: Rays, mounted: Sequence[Mount], found: Sequence[ReadSensor], path: Path
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
    found_rays = Rays(origin, ray, np.sort(gate, axis=1), rays.sensor, time)
    return rays_rounding(replace(rays, time_s=expected), found_rays, path)


def emitters_of_arrays(values: Mapping[str, Any], ranges_m: Any) -> Emitters:
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


MOUNTS = "mounts.json"
# No sensor's file is called so.
MOUNTS_NAME = "mounts"
# What a profile must have and a design says nothing of: those of NVIDIA's example of a solid-state lidar.
OPTICS = {
    "effectiveApertureSize": 0.0145,
    "focusDistM": 0.16,
    "avgPowerW": 0.002,
    "wavelengthNm": 1550.0,
    "pulseTimeNs": 6,
}


def write_isaac_json(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the folder's files, each atomically; returns notes of what the format cannot hold.

    Raises:
        DataError: The path is a file, or cannot be written to.
    """
    mounted, whole_hz = mounts(design, rays), whole_rate_hz(rate_hz)
    files = {f"{file_name(mount)}.json": _profile(mount, rays, whole_hz) for mount in mounted}
    placed = [
        {
            "config": file_name(mount),
            "name": mount.sensor.name,
            "translation_m": mount.origin_m.tolist(),
            "orientation_wxyz": list(mount.quaternion),
        }
        for mount in mounted
    ]
    files[MOUNTS] = {"design": design.name, "sensors": placed}
    notes = write_folder(path, {name: f"{json.dumps(value, indent=1)}\n".encode() for name, value in files.items()})
    optics = "power, aperture, wavelength and least reflectance are those of NVIDIA's example: a design has none"
    return [*isaac_losses(design, mounted, rate_hz), f"a profile has no pose: places stand in {MOUNTS}", optics, *notes]


def isaac_json_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose.

    Raises:
        DataError: A file is missing, or holds no such profile.
    """
    mounted = mounts(design, rays)
    try:
        placed = json.loads((path / MOUNTS).read_text(encoding="utf-8"))["sensors"]
        found = [_read_profile(one, path) for one in placed]
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"holds no profiles of lidars: {error!r}", where=str(path)) from error
    return profile_rounding(rays, mounted, found, path)


def file_name(mount: Mount) -> str:
    """What the profile of a sensor is called, without its suffix."""
    return f"{mount.name}_lidar" if mount.name.lower() == MOUNTS_NAME else mount.name


def _profile(mount: Mount, rays: Rays, rate_hz: int) -> dict[str, Any]:
    held, count = emitters_of(mount, rays, rate_hz), len(mount.ray)
    near, far = np.maximum(mount.gate_m, LEAST_START_M).tolist()
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
        "rangeResolutionM": RESOLUTION_M,
        "rangeAccuracyM": 0.0,
        **OPTICS,
        "minReflectance": LEAST_REFLECTANCE,
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


def _read_profile(placed: dict[str, Any], folder: Path) -> ReadSensor:
    profile = json.loads((folder / f"{placed['config']}.json").read_text(encoding="utf-8"))["profile"]
    return ReadSensor(
        np.array(placed["translation_m"]),
        rotations_of_quaternions(np.array(placed["orientation_wxyz"])),
        profile["scanRateBaseHz"],
        emitters_of_arrays(profile["emitterStates"][0], [[one["min"], one["max"]] for one in profile["ranges"]]),
    )


CORE = "omni:sensor:Core:"
STATE = f"{CORE}emitterState:s001:"
SCHEMAS = ("OmniSensorGenericLidarCoreAPI", "OmniSensorGenericLidarCoreEmitterStateAPI:s001")
ROOT_PRIM = "Lidar"
_PRIM = re.compile(r'^    def OmniLidar "(?P<name>[^"]*)"')
_ATTRIBUTE = re.compile(r"^        (?:uniform )?(?P<type>[a-z0-9]+(?:\[\])?) (?P<name>[\w:]+) = (?P<value>.*)$")


def write_isaac_usd(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the layer, atomically; returns notes of what the format cannot hold."""
    mounted, whole_hz = mounts(design, rays), whole_rate_hz(rate_hz)
    lines = [
        "#usda 1.0",
        "(",
        f'    defaultPrim = "{ROOT_PRIM}"',
        "    metersPerUnit = 1",
        '    upAxis = "Z"',
        ")",
        "",
        f'def Xform "{ROOT_PRIM}" (',
        f"    displayName = {quoted(design.name)}",
        ")",
        "{",
    ]
    for mount in mounted:
        lines += _prim(mount, rays, whole_hz)
    write_atomic(path, "\n".join([*lines, "}"]) + "\n")
    return isaac_losses(design, mounted, rate_hz)


def isaac_usd_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose.

    Raises:
        DataError: The file cannot be read, or holds other prims.
    """
    mounted = mounts(design, rays)
    try:
        found = [_read_prim(values) for values in _prims(path.read_text(encoding="utf-8").splitlines())]
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"holds no such lidars: {error!r}", where=str(path)) from error
    return profile_rounding(rays, mounted, found, path)


def quoted(text: str) -> str:
    """Text as a string of USD's text form: printable ASCII and Unicode in double quotes, the rest escaped.

    Line ends and other control characters become spaces, as one line is one attribute.
    """
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _prim(mount: Mount, rays: Rays, rate_hz: int) -> list[str]:
    attributes = _attributes(mount, emitters_of(mount, rays, rate_hz), rate_hz)
    return [
        f'    def OmniLidar "{mount.name}" (',
        f"        displayName = {quoted(mount.sensor.name)}",
        f"        prepend apiSchemas = {json.dumps(SCHEMAS)}",
        "    )",
        "    {",
        *(f"        {kind} {name} = {value}" for kind, name, value in attributes),
        f"        double3 xformOp:translate = {_vector(mount.origin_m)}",
        f"        quatd xformOp:orient = {_vector(mount.quaternion)}",
        '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
        "    }",
    ]


def _attributes(mount: Mount, held: Emitters, rate_hz: int) -> list[tuple[str, str, str]]:
    """Type, name and value of what holds for all emitters of a sensor, then of the arrays of their state."""
    count, (near, far) = len(mount.ray), np.maximum(mount.gate_m, LEAST_START_M).tolist()
    core = [
        ("token", "scanType", '"SOLID_STATE"'),
        ("token", "rayType", '"IDEALIZED"'),
        ("token", "elementsCoordsType", '"CARTESIAN"'),
        ("token", "outputFrameOfReference", '"SENSOR"'),
        *(("uint", name, str(rate_hz)) for name in ("scanRateBaseHz", "reportRateBaseHz", "patternFiringRateHz")),
        *(("uint", name, str(count)) for name in ("numberOfEmitters", "numberOfChannels")),
        ("uint", "maxReturns", "1"),
        ("uint", "numLines", "1"),
        ("uint[]", "numRaysPerLine", f"[{count}]"),
        ("float", "nearRangeM", _single(near)),
        ("float", "farRangeM", _single(far)),
        # returns nearer than this are lost
        ("float", "minDistBetweenEchosM", "0"),
        ("uint", "rangeCount", str(len(held.ranges_m))),
        ("float[]", "rangesMinM", _singles(held.ranges_m[:, 0])),
        ("float[]", "rangesMaxM", _singles(held.ranges_m[:, 1])),
        # a design says nothing of errors: there are none
        *(("float", f"{axis}Error{what}", "0") for axis in ("azimuth", "elevation") for what in ("Mean", "Std")),
        ("float", "rangeAccuracyM", "0"),
        ("float", "rangeResolutionM", _single(RESOLUTION_M)),
        ("float", "minReflectance", _single(LEAST_REFLECTANCE)),
        ("float", "minReflectionRangeM", _single(max(LEAST_REFLECTANCE_RANGE_M, far))),
    ]
    state = [
        ("float[]", "azimuthDeg", _singles(held.azimuth_deg)),
        ("float[]", "elevationDeg", _singles(held.elevation_deg)),
        ("uint[]", "fireTimeNs", json.dumps(held.fire_time_ns.tolist())),
        # counted from 1
        ("uint[]", "channelId", json.dumps(list(range(1, count + 1)))),
        ("uint[]", "rangeId", json.dumps(held.range_id.tolist())),
        ("uint[]", "bank", json.dumps([0] * count)),
    ]
    return [
        ("string", "omni:sensor:marketName", quoted(mount.sensor.name)),
        ("float", "omni:sensor:tickRate", str(rate_hz)),
        ("double2", "omni:sensor:frameRate", f"({rate_hz}, 1)"),
        *((kind, CORE + name, value) for kind, name, value in core),
        *((kind, STATE + name, value) for kind, name, value in state),
    ]


def _single(value: float) -> str:
    return str(np.float32(value))


def _singles(values: Iterable[float]) -> str:
    return f"[{', '.join(map(_single, values))}]"


def _vector(values: Iterable[float]) -> str:
    return f"({', '.join(repr(float(value)) for value in values)})"


def _prims(lines: Iterable[str]) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    for line in lines:
        attribute = _ATTRIBUTE.match(line)
        if _PRIM.match(line):
            found.append({})
        elif attribute and found:
            found[-1][attribute["name"]] = attribute["value"]
    return found


def _read_prim(values: Mapping[str, str]) -> ReadSensor:
    def array(name: str) -> list[Any]:
        return json.loads(values[name].replace("(", "[").replace(")", "]"))

    ranges = np.stack([array(f"{CORE}rangesMinM"), array(f"{CORE}rangesMaxM")], axis=1)
    state = {name: array(f"{STATE}{name}") for name in ("azimuthDeg", "elevationDeg", "fireTimeNs", "rangeId")}
    return ReadSensor(
        np.array(array("xformOp:translate")),
        rotations_of_quaternions(np.array(array("xformOp:orient"))),
        float(values[f"{CORE}scanRateBaseHz"]),
        emitters_of_arrays(state, ranges),
    )
