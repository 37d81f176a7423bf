"""Simulators with lidars of their own: CARLA and ASAM OSI as JSON, Isaac Sim as USD.

CARLA: a sensor.lidar.ray_cast per sensor, with its blueprint's attributes and its transform, as JSON.

`attributes` are the text that `blueprint.set_attribute` takes; `transform` is in CARLA's left-handed frame: x forward,
y to the right, z up, in metres and degrees. With the world's fixed time step of `fixed_delta_seconds`, every frame has
all rays once: azimuths are swept from minus half of `horizontal_fov` on, so the mount is turned by half a step. The
sweep of a frame is a product of single-precision numbers: where rounding makes it smaller than the field of view, the
first column of the next frame is at the other edge. Frequency and field are chosen so that it is exact.

ASAM OSI: a SensorViewConfiguration with one LidarSensorViewConfiguration per sensor, as protobuf writes it in JSON.

Every sensor has its mounting position (x forward, y to the left, z up; yaw, then pitch, then roll), and its rays are
unit vectors in its own frame with firing times in microseconds. Rays of one sensor with several origins become as many
configurations.

Isaac Sim from version 5 on: an OmniLidar prim per sensor in USD, in its text form.

A lidar has one emitter state: an emitter per ray at its azimuth (x forward, y at +90 degrees, z up) and elevation in
degrees, its firing time in the frame, and the index of its range. Ranges are the different gates of the sensor, so
gates of single rays are kept. All emitters are one line, as rays need not lie in rows.

Attributes have the names and types of OmniSensorGenericLidarCoreAPI. `reportRateBaseHz` became `patternFiringRateHz` in
version 6: both are written. Each prim is posed by translate and orient ops below one Xform, in metres, z up.

NVIDIA's documentation requires a sensor's near range above its range offset and its least distance between echos, which
are 0, so gates start at a millimetre or more. A range resolution of 0 is not documented: 0.1 mm is written.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError, check_number
from lidardesign.formats import RATE, RAYS, Format, WriteOptions
from lidardesign.formats.mounts import (
    EvenGrid,
    Mount,
    Place,
    channel_mounts,
    design_losses,
    fire_times_s,
    grid_of,
    grid_sensor_losses,
    mounts,
    near_losses,
    origin_losses,
    places,
    require_rays,
)
from lidardesign.formats.names import renamed_note
from lidardesign.numerics import FULL_TURN, HALF_DIGITS
from lidardesign.run.files import write_atomic
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import angles

MIRROR = np.diag([1.0, -1.0, 1.0])
# Field of view of a sweep of one column [deg].
NARROWEST_DEG = 0.001
# Unreal limits frames to between half a millisecond and 0.4 s.
SLOWEST_HZ, FASTEST_HZ = 2.5, 2000.0
# Offsets, in units in the last place, of the fields of view and frequencies that are tried, the nearest first.
TRIED_FIELDS, TRIED_RATES = (sorted(range(-most, most + 1), key=abs) for most in (4000, 3))


def write_carla(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold.

    Raises:
        ConfigError: A frame rate that Unreal's frames do not have; at those, CARLA's whole numbers of points per second
            are the rays of a frame.
    """
    check_number(options.rate_hz, "--rate-hz", SLOWEST_HZ, FASTEST_HZ)
    design, rays, mounted = channel_mounts(design, rays)
    document = {
        "design": design.name,
        "fixed_delta_seconds": 1 / options.rate_hz,
        "sensors": [_blueprint(one, options.rate_hz) for one in mounted],
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


CARLA = Format(
    "carla",
    ".carla.json",
    "attributes and transform of a ray_cast lidar per sensor",
    write_carla,
    reader="a script that sets blueprint attributes",
    checked="names and types against CARLA's documented ones; its sweep in a twin",
    holds=frozenset({RAYS, RATE}),
)


def _blueprint(mount: Mount, rate_hz: float) -> dict[str, Any]:
    grid = grid_of(mount)
    # from one azimuth to the next; 0 for one column
    step_rad = (grid.azimuth_rad[1] - grid.azimuth_rad[0]) / max(grid.columns - 1, 1)
    turn_hz, field_deg = _sweep(max(math.degrees(step_rad) * grid.columns, NARROWEST_DEG), rate_hz)
    low_deg, high_deg = (math.degrees(value) for value in grid.elevation_rad)
    return {
        "id": mount.name,
        "name": mount.sensor.name,
        "type": "sensor.lidar.ray_cast",
        "attributes": {
            "channels": str(grid.rows),
            "range": repr(mount.gate_m[1]),
            "points_per_second": str(round(len(grid) * rate_hz)),
            "rotation_frequency": repr(turn_hz),
            "upper_fov": repr(high_deg),
            "lower_fov": repr(low_deg),
            "horizontal_fov": repr(field_deg),
            # a design has no noise: every hit is reported, at its exact range
            "dropoff_general_rate": "0.0",
            "dropoff_zero_intensity": "0.0",
            "noise_stddev": "0.0",
            # at every frame: an interval of the same length leaves frames out by its rounding
            "sensor_tick": "0.0",
            "role_name": mount.name,
        },
        "transform": {
            "location": _vector(MIRROR @ mount.origin_m),
            "rotation": _rotation(mount, grid, field_deg),
        },
    }


def _sweep(field_deg: float, rate_hz: float) -> tuple[float, float]:
    """Rotation frequency [Hz] and field of view [deg] with which CARLA sweeps exactly the field in a frame."""
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
    # straight up or down, yaw and roll are the same angle
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


def write_osi(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the file cannot be written.
    """
    require_rays(design, rays, "a lidar's configuration")
    # uint32 there: every allowed frame rate has fewer microseconds in a frame; the last are not rounded into
    # the next frame
    times_us = np.rint(fire_times_s(rays, options.rate_hz) * MICROSECONDS_PER_S)
    times_us = np.minimum(times_us, math.ceil(MICROSECONDS_PER_S / options.rate_hz) - 1)
    mounted = mounts(design, rays)
    found = places(mounted, rays)
    seconds, nanoseconds = divmod(round(NANOSECONDS_PER_S / options.rate_hz), NANOSECONDS_PER_S)
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


OSI = Format(
    "osi",
    ".osi.json",
    "a lidar configuration per sensor: mounting position, unit vectors, microseconds",
    write_osi,
    reader="sensor models and simulators of ASAM OSI",
    checked="parsed by protobuf, with ASAM's own bindings where they are",
    holds=frozenset({RAYS, RATE}),
)


def _configuration(number: int, place: Place, rays: Rays, times_us: np.ndarray) -> dict[str, Any]:
    """Configuration of the rays of one origin, with fields of view that contain all of them."""
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


# Isaac has nanoseconds of a frame as signed 32-bit numbers, and frames per second as whole numbers.
SLOWEST_ISAAC_HZ = 1
LEAST_START_M, RESOLUTION_M = 0.001, 0.0001
# Returns of less than a tenth are lost beyond this range, or beyond the last gate.
LEAST_REFLECTANCE, LEAST_REFLECTANCE_RANGE_M = 0.1, 270.0


CORE = "omni:sensor:Core:"
STATE = f"{CORE}emitterState:s001:"
SCHEMAS = ("OmniSensorGenericLidarCoreAPI", "OmniSensorGenericLidarCoreEmitterStateAPI:s001")
ROOT_PRIM = "Lidar"


def write_isaac_usd(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the layer, atomically; returns notes of what the format cannot hold.

    Raises:
        ConfigError: Fewer than one frame per second.
    """
    whole_hz = round(options.rate_hz)
    if whole_hz < SLOWEST_ISAAC_HZ:
        raise ConfigError(
            f"{options.rate_hz:g} frames per second",
            where="--rate-hz",
            allowed=f"at least {SLOWEST_ISAAC_HZ}, a whole number",
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
        lines += [
            f'    def OmniLidar "{mount.name}" (',
            f"        displayName = {quoted(mount.sensor.name)}",
            f"        prepend apiSchemas = {json.dumps(SCHEMAS)}",
            "    )",
            "    {",
            *(f"        {kind} {name} = {value}" for kind, name, value in _attributes(mount, rays, whole_hz)),
            f"        double3 xformOp:translate = {_tuple(mount.origin_m)}",
            f"        quatd xformOp:orient = {_tuple(mount.quaternion)}",
            '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
            "    }",
        ]
    write_atomic(path, "\n".join([*lines, "}"]) + "\n")
    notes = [*design_losses(design, mounted), *origin_losses(mounted)]
    if whole_hz != options.rate_hz:
        notes.append(f"frame rates there are whole numbers: {options.rate_hz:g} Hz is {whole_hz} Hz")
    starts_m = np.array([one.gate_m[0] for one in mounted])
    return [
        *notes,
        *near_losses(starts_m, LEAST_START_M, "sensors", "Isaac's near ranges are above 0"),
        "angles and lengths are kept in single precision, firing times in whole nanoseconds",
        *renamed_note([one.sensor.name for one in mounted], [one.name for one in mounted]),
    ]


ISAAC_USD = Format(
    "isaac-usd",
    ".usda",
    "an OmniLidar per sensor, gates per ray",
    write_isaac_usd,
    reader="Isaac Sim from 5 on",
    checked="opened with OpenUSD; types, tokens and lengths as its schema has them",
    holds=frozenset({RAYS, RATE}),
)


def quoted(text: str) -> str:
    """Text as a string of USD's text form: printable ASCII and Unicode in double quotes, the rest escaped.

    Line ends and other control characters become spaces, as one line is one attribute.
    """
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _attributes(mount: Mount, rays: Rays, rate_hz: int) -> list[tuple[str, str, str]]:
    """Type, name and value of the attributes of a sensor, then of its emitters' arrays."""
    count, (near, far) = len(mount.ray), np.maximum(mount.gate_m, LEAST_START_M).tolist()
    ranges, range_id = np.unique(np.maximum(rays.gate_m[mount.ray], LEAST_START_M), axis=0, return_inverse=True)
    fire_time_ns = np.floor(fire_times_s(rays, rate_hz)[mount.ray] * NANOSECONDS_PER_S).astype(np.int64)
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
        # a design has no errors
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


def _tuple(values: Iterable[float]) -> str:
    return f"({', '.join(repr(float(value)) for value in values)})"
