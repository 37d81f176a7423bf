"""Isaac Sim from version 5 on: an OmniLidar prim per sensor, in USD's text form.

Attributes have the names and types of OmniSensorGenericLidarCoreAPI. `reportRateBaseHz` became `patternFiringRateHz` in
version 6: both are written. Each prim is posed by translate and orient ops below one Xform, in metres, z up.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.poses import Mount, mounts
from lidardesign.export.isaac import (
    Emitters,
    FoundSensor,
    emitters_of,
    found_emitters,
    losses,
    profile_rounding,
    whole_rate_hz,
)
from lidardesign.geometry.rays import Rays
from lidardesign.geometry.rotation import rotations_of_quaternions
from lidardesign.run.files import write_atomic

CORE = "omni:sensor:Core:"
STATE = f"{CORE}emitterState:s001:"
SCHEMAS = ("OmniSensorGenericLidarCoreAPI", "OmniSensorGenericLidarCoreEmitterStateAPI:s001")
ROOT = "Lidar"
_PRIM = re.compile(r'^    def OmniLidar "(?P<name>[^"]*)"')
_ATTRIBUTE = re.compile(r"^        (?:uniform )?(?P<type>[a-z0-9]+(?:\[\])?) (?P<name>[\w:]+) = (?P<value>.*)$")


def write(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the layer, atomically; returns notes of what the format cannot hold."""
    mounted, whole_hz = mounts(design, rays), whole_rate_hz(rate_hz)
    lines = [
        "#usda 1.0",
        "(",
        f'    defaultPrim = "{ROOT}"',
        "    metersPerUnit = 1",
        '    upAxis = "Z"',
        ")",
        "",
        f'def Xform "{ROOT}" (',
        f"    displayName = {quoted(design.name)}",
        ")",
        "{",
    ]
    for mount in mounted:
        lines += _prim(mount, rays, whole_hz)
    write_atomic(path, "\n".join([*lines, "}"]) + "\n")
    return losses(design, mounted, rate_hz)


def rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose.

    Raises:
        DataError: The file cannot be read, or holds other prims.
    """
    mounted = mounts(design, rays)
    try:
        found = [_found(values) for values in _prims(path.read_text(encoding="utf-8").splitlines())]
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
    schemas = json.dumps(SCHEMAS)
    lines = [f'    def OmniLidar "{mount.name}" (', f"        displayName = {quoted(mount.sensor.name)}"]
    lines += [f"        prepend apiSchemas = {schemas}", "    )", "    {"]
    held = emitters_of(mount, rays, rate_hz)
    attributes = [*_core(mount, held, rate_hz), *_state(held)]
    lines += [f"        {kind} {name} = {value}" for kind, name, value in attributes]
    lines += [
        f"        double3 xformOp:translate = {_vector(mount.origin_m)}",
        f"        quatd xformOp:orient = {_vector(mount.quaternion)}",
        '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
    ]
    return [*lines, "    }"]


def _core(mount: Mount, held: Emitters, rate_hz: int) -> list[tuple[str, str, str]]:
    """Type, name and value of what holds for all emitters of a sensor."""
    count, (near, far) = len(mount.ray), mount.gate_m
    values: list[tuple[str, str, str]] = [
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
    ]
    named = ("string", "omni:sensor:marketName", quoted(mount.sensor.name))
    return [
        named,
        ("float", "omni:sensor:tickRate", str(rate_hz)),
        *((kind, CORE + name, value) for kind, name, value in values),
    ]


def _state(held: Emitters) -> list[tuple[str, str, str]]:
    """Type, name and value of the arrays of one emitter state."""
    count = len(held.azimuth_deg)
    values = [
        ("float[]", "azimuthDeg", _singles(held.azimuth_deg)),
        ("float[]", "elevationDeg", _singles(held.elevation_deg)),
        ("uint[]", "fireTimeNs", json.dumps(held.fire_time_ns.tolist())),
        # counted from 1
        ("uint[]", "channelId", json.dumps(list(range(1, count + 1)))),
        ("uint[]", "rangeId", json.dumps(held.range_id.tolist())),
        ("uint[]", "bank", json.dumps([0] * count)),
    ]
    return [(kind, STATE + name, value) for kind, name, value in values]


def _single(value: float) -> str:
    return str(np.float32(value))


def _singles(values: Iterable[float]) -> str:
    return f"[{', '.join(map(_single, values))}]"


def _vector(values: Iterable[float]) -> str:
    return f"({', '.join(repr(float(value)) for value in values)})"


def _prims(lines: Iterable[str]) -> list[dict[str, str]]:
    """Values by attribute name of each lidar prim of a layer that `write` wrote."""
    found: list[dict[str, str]] = []
    for line in lines:
        attribute = _ATTRIBUTE.match(line)
        if _PRIM.match(line):
            found.append({})
        elif attribute and found:
            found[-1][attribute["name"]] = attribute["value"]
    return found


def _found(values: Mapping[str, str]) -> FoundSensor:
    def array(name: str) -> list[Any]:
        return json.loads(values[name].replace("(", "[").replace(")", "]"))

    ranges = np.stack([array(f"{CORE}rangesMinM"), array(f"{CORE}rangesMaxM")], axis=1)
    state = {name: array(f"{STATE}{name}") for name in ("azimuthDeg", "elevationDeg", "fireTimeNs", "rangeId")}
    return FoundSensor(
        np.array(array("xformOp:translate")),
        rotations_of_quaternions(np.array(array("xformOp:orient"))),
        float(values[f"{CORE}scanRateBaseHz"]),
        found_emitters(state, ranges),
    )
