"""Isaac Sim from version 5 on: an OmniLidar prim per sensor in USD, in its text form.

A lidar has one emitter state: an emitter per ray at its azimuth (x forward, y at +90 degrees, z up) and elevation in
degrees, its firing time in the frame, and the number of its range. Ranges are the different gates of the sensor, so
gates of single rays are held. All emitters are one line: nothing says that rays lie in rows.

Attributes have the names and types of OmniSensorGenericLidarCoreAPI. `reportRateBaseHz` became `patternFiringRateHz` in
version 6: both are written. Each prim is posed by translate and orient ops below one Xform, in metres, z up.

NVIDIA's documentation wants a sensor's near range above its range offset and its least distance between echos, which
are 0, so gates start at a millimetre or more. What a range resolution of 0 does is not documented: 0.1 mm is
written.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError
from lidardesign.export.mounts import Mount, design_losses, fire_times_s, mounts, origin_losses
from lidardesign.export.names import renamed_note
from lidardesign.geometry.rays import Rays
from lidardesign.run.files import write_atomic

NANOSECONDS_PER_SECOND = 1_000_000_000
# Isaac counts nanoseconds of a frame as signed 32-bit numbers, and frames per second as whole numbers.
SLOWEST_HZ = 1
LEAST_START_M, RESOLUTION_M = 0.001, 0.0001
# Returns of less than a tenth are lost beyond this range, or beyond the last gate.
LEAST_REFLECTANCE, LEAST_REFLECTANCE_RANGE_M = 0.1, 270.0


CORE = "omni:sensor:Core:"
STATE = f"{CORE}emitterState:s001:"
SCHEMAS = ("OmniSensorGenericLidarCoreAPI", "OmniSensorGenericLidarCoreEmitterStateAPI:s001")
ROOT_PRIM = "Lidar"


def write_isaac_usd(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the layer, atomically; returns notes of what the format cannot hold.

    Raises:
        ConfigError: Fewer than one frame per second.
    """
    whole_hz = round(rate_hz)
    if whole_hz < SLOWEST_HZ:
        raise ConfigError(
            f"{rate_hz:g} frames per second", where="--rate-hz", allowed=f"at least {SLOWEST_HZ}, a whole number"
        )
    mounted = mounts(design, rays)
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
    notes = [*design_losses(design, mounted), *origin_losses(mounted)]
    if whole_hz != rate_hz:
        notes.append(f"frame rates there are whole numbers: {rate_hz:g} Hz is {whole_hz} Hz")
    near = sum(one.gate_m[0] < LEAST_START_M for one in mounted)
    if near:
        notes.append(
            f"gates of {near} of {len(mounted)} sensors start below {LEAST_START_M:g} m: they start there, for Isaac's "
            "near ranges are above 0"
        )
    notes.append("angles and lengths are kept in single precision, firing times in whole nanoseconds")
    return [*notes, *renamed_note([one.sensor.name for one in mounted], [one.name for one in mounted])]


def quoted(text: str) -> str:
    """Text as a string of USD's text form: printable ASCII and Unicode in double quotes, the rest escaped.

    Line ends and other control characters become spaces, as one line is one attribute.
    """
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _prim(mount: Mount, rays: Rays, rate_hz: int) -> list[str]:
    return [
        f'    def OmniLidar "{mount.name}" (',
        f"        displayName = {quoted(mount.sensor.name)}",
        f"        prepend apiSchemas = {json.dumps(SCHEMAS)}",
        "    )",
        "    {",
        *(f"        {kind} {name} = {value}" for kind, name, value in _attributes(mount, rays, rate_hz)),
        f"        double3 xformOp:translate = {_vector(mount.origin_m)}",
        f"        quatd xformOp:orient = {_vector(mount.quaternion)}",
        '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
        "    }",
    ]


def _attributes(mount: Mount, rays: Rays, rate_hz: int) -> list[tuple[str, str, str]]:
    """Type, name and value of what holds for all emitters of a sensor, then of the arrays of their state."""
    count, (near, far) = len(mount.ray), np.maximum(mount.gate_m, LEAST_START_M).tolist()
    ranges, range_id = np.unique(np.maximum(rays.gate_m[mount.ray], LEAST_START_M), axis=0, return_inverse=True)
    fire_time_ns = np.floor(fire_times_s(rays, rate_hz)[mount.ray] * NANOSECONDS_PER_SECOND).astype(np.int64)
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
        ("uint", "rangeCount", str(len(ranges))),
        ("float[]", "rangesMinM", _singles(ranges[:, 0])),
        ("float[]", "rangesMaxM", _singles(ranges[:, 1])),
        # a design says nothing of errors: there are none
        *(("float", f"{axis}Error{what}", "0") for axis in ("azimuth", "elevation") for what in ("Mean", "Std")),
        ("float", "rangeAccuracyM", "0"),
        ("float", "rangeResolutionM", _single(RESOLUTION_M)),
        ("float", "minReflectance", _single(LEAST_REFLECTANCE)),
        ("float", "minReflectionRangeM", _single(max(LEAST_REFLECTANCE_RANGE_M, far))),
    ]
    state = [
        ("float[]", "azimuthDeg", _singles(np.degrees(mount.azimuth_rad))),
        ("float[]", "elevationDeg", _singles(np.degrees(mount.elevation_rad))),
        ("uint[]", "fireTimeNs", json.dumps(fire_time_ns.tolist())),
        # counted from 1
        ("uint[]", "channelId", json.dumps(list(range(1, count + 1)))),
        ("uint[]", "rangeId", json.dumps(range_id.reshape(-1).tolist())),
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
