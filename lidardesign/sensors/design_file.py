"""The design file: one readable YAML document with units in its keys (schema: design.schema.json).

Of a sensor's spreads and its intervals one is enough. The spread is authoritative: where a file gives both
`spread` and `field_of_view_rad` or `gate_m`, they must agree at the file's level. Where it gives only the
interval, the spread follows, so that people can write designs: with z standard deviations on each side that
hold `level` of a normal distribution, field of view = 2 z spread and gate = mean range -+ z spread, its start
cut at 0. Numbers are written with all their digits: what is loaded is bit for bit what was saved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from lidardesign.errors import ConfigError, page
from lidardesign.layouts.track import TRAVELLED
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.run.clock import phase
from lidardesign.run.files import write_atomic
from lidardesign.run.inputs import DESIGN, RAY_TABLE, read_head
from lidardesign.run.validation import LocateKey, Node
from lidardesign.run.yaml import Document, dump_yaml, load_yaml
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.sensor import (
    DEFAULT_LEVEL,
    LEVELS,
    MOST_RAYS,
    Coupling,
    DesignSpec,
    Gates,
    LayoutName,
    Sensor,
    Track,
    interval_factor,
)
from lidardesign.space import DIMENSIONS, FARTHEST_M, FULL_TURN, LARGEST_ANGLE_RAD

SCHEMA_VERSION = 1
SCHEMA_FILE = Path(__file__).with_name("design.schema.json")
LAYOUTS = get_args(LayoutName)
# Eight numbers a ray stay below the number of values that the YAML reader accepts in one file.
MOST_TABLE_RAYS = 60_000
# How far a written interval may be from the one that the spread gives: digits that a person may have rounded.
AGREEMENT = COARSE_SLACK
# Weights that sum to 1 within this are taken as they stand, so that loading changes no bit.
WEIGHT_SUM_TOLERANCE = SLACK
# How much below zero rounding may push an eigenvalue of a covariance, relative to the largest.
COVARIANCE_ROUNDING = SLACK

OPTIONAL = (
    "name", "layout", "level", "rays", "at", "gates", "ray_table", "further_tables", "track", "further_tracks",
    "mount", "constraints", "provenance",
)  # fmt: skip
SENSOR_OPTIONAL = (
    "name", "part", "weight", "field_of_view_rad", "gate_m", "range_m", "spread", "travel_m", "coupling", "rays",
)  # fmt: skip
TABLE_KEYS = (
    "origin_x_m", "origin_y_m", "origin_z_m", "azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m", "sensor",
)  # fmt: skip
TRACK_KEYS = (
    "dimension", "knots_m", "azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m", "sensor",
)  # fmt: skip
# Four numbers per ray and knot stay below the number of values that the YAML reader accepts in one file.
MOST_TRACK_RAYS = 100_000


def track_document(track: Track) -> dict[str, Any]:
    """The plain document of a track, in the order in which it is written."""
    gate = np.asarray(track.gate_m, dtype=np.float64)
    values = (track.knots, track.azimuth_rad, track.elevation_rad, gate[..., 0], gate[..., 1])
    columns = [np.asarray(value, dtype=np.float64).tolist() for value in values]
    sensor = np.asarray(track.sensor, dtype=np.int64).tolist()
    return dict(zip(TRACK_KEYS, (track.dimension, *columns, sensor), strict=True))


def read_track(node: Node, sensors: int) -> Track:
    """A track of its document, for a design of so many sensors.

    Raises:
        ConfigError: A key is missing, rows differ in length, or knots do not ascend.
    """
    keys = node.mapping(TRACK_KEYS)
    knots = keys["knots_m"].numbers(None, -FARTHEST_M, FARTHEST_M)
    if len(knots) < 2 or (knots[1:] <= knots[:-1]).any():
        raise keys["knots_m"].error("are no knots", allowed="at least two numbers, each above the one before")
    index = np.array([item.integer(0, sensors - 1) for item in keys["sensor"].items()], dtype=np.int64)
    if not len(index):
        raise keys["sensor"].error("is empty", allowed="at least one ray")

    def rows(key: str, low: float = -math.inf, high: float = math.inf) -> np.ndarray:
        items = keys[key].items()
        if len(items) != len(knots):
            raise keys[key].error(f"has {len(items)} rows", allowed=f"{len(knots)}, one per knot")
        return np.stack([item.numbers(len(index), low, high) for item in items])

    azimuth = rows("azimuth_rad", -LARGEST_ANGLE_RAD, LARGEST_ANGLE_RAD)
    elevation = rows("elevation_rad", -math.pi / 2, math.pi / 2)
    start, end = rows("gate_start_m", 0, FARTHEST_M), rows("gate_end_m", 0, FARTHEST_M)
    for knot, ray in np.argwhere(end <= start).tolist():
        raise _no_gate(keys["gate_end_m"].child(knot).child(ray), start[knot, ray])
    return Track(keys["dimension"].choice(TRAVELLED), knots, azimuth, elevation, np.stack([start, end], axis=2), index)


def design_document(design: DesignSpec) -> dict[str, Any]:
    """The plain document of a design, in the order in which it is written."""
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "name": design.name,
        "layout": design.layout,
        "level": float(design.level),
        "rays": None if design.rays is None else int(design.rays),
        # one level holds for the whole file, whatever level a sensor was made at: its spread says what it is
        "sensors": [_sensor_document(replace(sensor, level=design.level)) for sensor in design.sensors],
    }
    if design.ray_table is not None:
        document["ray_table"] = _table_document(design.ray_table)
    if design.further_tables:
        document["further_tables"] = [_table_document(table) for table in design.further_tables]
    if design.track is not None:
        document["track"] = track_document(design.track)
    if design.further_tracks:
        document["further_tracks"] = [track_document(track) for track in design.further_tracks]
    if design.at:
        document["at"] = {name: float(value) for name, value in design.at.items()}
    if design.gates is not None and design.gates != design.table_gates:
        document["gates"] = design.gates
    if design.mount is not None:
        document["mount"] = {"body": design.mount}
    document["constraints"] = design.constraints
    document["provenance"] = design.provenance
    return document


def _table_document(table: Rays) -> dict[str, Any]:
    columns = (*table.origin_m.T, table.azimuth_rad, table.elevation_rad, *table.gate_m.T, table.sensor)
    return {key: column.tolist() for key, column in zip(TABLE_KEYS, columns, strict=True)}


def _sensor_document(sensor: Sensor) -> dict[str, Any]:
    values = sensor.as_dict()
    rays, coupling = values.pop("rays"), values.pop("coupling")
    if values["travel_m"]["length"] == 0:
        del values["travel_m"]
    # the gate's start is cut at 0, so the mean range cannot be told from the gate alone
    coupled = {} if coupling is None else {"coupling": coupling}
    return {**values, "range_m": float(sensor.range_m), **coupled, "rays": None if rays is None else int(rays)}


def save_design(design: DesignSpec, path: Path) -> None:
    """Write a design file, atomically.

    Raises:
        DataError: The file cannot be written.
        NumericalError, ConfigError: See `design_text`.
    """
    write_atomic(Path(path), design_text(design, path))


def design_text(design: DesignSpec, path: Path) -> str:
    """What a design's file holds.

    Raises:
        NumericalError: The design holds a number that is not finite.
        ConfigError: More explicit rays than a file can be read back with.
    """
    explicit = sum(map(len, design.further_tables)) + (0 if design.ray_table is None else len(design.ray_table))
    if explicit > MOST_TABLE_RAYS:
        raise ConfigError(
            f"{explicit} explicit rays",
            where=str(path),
            allowed=f"at most {MOST_TABLE_RAYS}",
            hint="the layout grid needs no table",
        )
    at_knots = sum(track.azimuth_rad.size for track in (design.track, *design.further_tracks) if track is not None)
    if at_knots > MOST_TRACK_RAYS:
        raise ConfigError(
            f"{at_knots} rays at knots of the track",
            where=str(path),
            allowed=f"at most {MOST_TRACK_RAYS}",
            hint="fewer rays per position",
        )
    return dump_yaml(design_document(design))


@phase("designs")
def load_design(path: Path, reach_m: float | None = None) -> DesignSpec:
    """Read a design from a design file, the research code's sensor CSV or a rig of others, told apart by content.

    The design takes the file's stem as its name, as tables name designs by their files. `readers.dispatch` has the
    kinds of files that rigs are read from.

    Arguments:
        path: The file.
        reach_m: How far the rays of a rig are heard where its file does not say so [m].

    Raises:
        DataError: The file cannot be read, or a CSV, an NPZ or an XML file holds what cannot be used (exit 3).
        ConfigError: The file is not YAML, or not a design (exit 2).
    """
    from lidardesign.formats.dispatch import read_rig
    from lidardesign.formats.ray_lists import begins_as_sensor_csv, read_sensor_csv
    from lidardesign.formats.rig import rig_design

    path = Path(path)
    hint = "give a design file, as RUN/designs/NAME.yaml"
    head = read_head(path, RAY_TABLE, hint=hint)
    rig = read_rig(path, head)
    if rig is not None:
        return rig_design(rig, path, reach_m)
    if begins_as_sensor_csv(head):
        return read_sensor_csv(path)
    document = load_yaml(path, DESIGN)
    return replace(design_from_document(document.value, str(path), locate=document.locate), name=path.stem)


def design_from_document(
    document: Any, where: str = "design", *, locate: LocateKey | Document | None = None
) -> DesignSpec:
    """Build a design from its plain document.

    Arguments:
        document: The mapping of a design file.
        where: What to call it in messages.
        locate: Positions of key paths in the file, where there is one.

    Raises:
        ConfigError: A key is missing, unknown, of the wrong kind, or contradicts another.
    """
    if isinstance(locate, Document):
        locate = locate.locate
    root = Node(document, (), locate or (lambda _path: where))
    if not isinstance(root.value, dict) or "sensors" not in root.value:
        raise ConfigError(
            "this is not a design: it has no key `sensors`",
            where=root.locate(()),
            hint=f"{page('design-file.md')} shows a design written by hand",
        )
    version = root.value.get("schema_version", SCHEMA_VERSION)
    if type(version) is not int or version < SCHEMA_VERSION:
        raise root.child("schema_version").wrong(str(SCHEMA_VERSION))
    if version > SCHEMA_VERSION:
        raise root.child("schema_version").error(
            f"is {version}", allowed=str(SCHEMA_VERSION), hint="use a newer version of lidardesign"
        )
    keys = root.mapping(("schema_version", "sensors"), OPTIONAL)
    level = keys["level"].number(*LEVELS) if "level" in keys else DEFAULT_LEVEL
    sensors = _sensors(keys["sensors"], level)
    rays = keys["rays"].integer(1, MOST_RAYS) if "rays" in keys else None
    table = _ray_table(keys["ray_table"], len(sensors)) if "ray_table" in keys else None
    track = read_track(keys["track"], len(sensors)) if "track" in keys else None
    _check_rays(keys, sensors, rays, table, track)
    return DesignSpec(
        name=keys["name"].text() if "name" in keys else Path(where).stem,
        sensors=sensors,
        layout=_layout(keys, track),
        rays=rays,
        ray_table=table,
        constraints=keys["constraints"].plain() if "constraints" in keys else {},
        provenance=keys["provenance"].plain() if "provenance" in keys else {},
        level=level,
        track=track,
        at={name: item.number(-FARTHEST_M, FARTHEST_M) for name, item in keys["at"].mapping((), DIMENSIONS).items()}
        if "at" in keys
        else {},
        mount=keys["mount"].mapping(("body",))["body"].text() if "mount" in keys else None,
        gates=keys["gates"].choice(get_args(Gates)) if "gates" in keys else None,  # type: ignore[arg-type]
        further_tables=tuple(_ray_table(item, len(sensors)) for item in keys["further_tables"].items())
        if "further_tables" in keys
        else (),
        further_tracks=tuple(read_track(item, len(sensors)) for item in keys["further_tracks"].items())
        if "further_tracks" in keys
        else (),
    )


def _layout(keys: Mapping[str, Node], track: Track | None) -> LayoutName:
    """The layout; the rays of a track are a scan at every value of its condition, unless they were chosen."""
    layout: Any = keys["layout"].choice(LAYOUTS) if "layout" in keys else "grid"
    return "scan" if track is not None and layout != "selected" else layout


def _sensors(node: Node, level: float) -> tuple[Sensor, ...]:
    nodes = node.items()
    if not nodes:
        raise node.error("is empty", allowed="at least one sensor")
    sensors = tuple(_sensor(item, index, level) for index, item in enumerate(nodes))
    first: dict[str, int] = {}
    for index, sensor in enumerate(sensors):
        if sensor.name in first:
            raise nodes[index].error(f"has the name of sensors[{first[sensor.name]}], {sensor.name!r}")
        first[sensor.name] = index
    # Sensors with shares that sum to 1: equal where no sensor has a weight, else in their proportion
    given = [item.value.get("weight") is not None for item in nodes]
    if not any(given):
        return tuple(replace(sensor, weight=1 / len(sensors)) for sensor in sensors)
    if not all(given):
        raise nodes[given.index(False)].error("has no weight, but another sensor has", hint="give all weights or none")
    total = math.fsum(sensor.weight for sensor in sensors)
    if not (math.isfinite(total) and total > 0):
        raise node.error(f"has weights that sum to {total}", allowed="a finite sum above 0")
    if abs(total - 1) <= WEIGHT_SUM_TOLERANCE:
        return sensors
    return tuple(replace(sensor, weight=sensor.weight / total) for sensor in sensors)


def _sensor(node: Node, index: int, level: float) -> Sensor:
    keys = node.mapping(("origin_m", "boresight"), SENSOR_OPTIONAL)
    mean, covariance = _origin(keys["origin_m"])
    boresight = keys["boresight"].mapping(("azimuth_rad", "elevation_rad"), ("roll_rad",))
    spreads = keys["spread"].mapping((), ("horizontal_rad", "vertical_rad", "range_m")) if "spread" in keys else {}
    fields = keys["field_of_view_rad"].mapping((), ("horizontal", "vertical")) if "field_of_view_rad" in keys else {}
    full = 2 * interval_factor(level)
    spread_rad = []
    for axis in ("horizontal", "vertical"):
        spread, field = spreads.get(f"{axis}_rad"), fields.get(axis)
        if spread is None and field is None:
            raise node.error(
                f"has neither field_of_view_rad.{axis} nor spread.{axis}_rad", hint="give only one of them"
            )
        widest = FULL_TURN * (1 + AGREEMENT) / full
        spread_rad.append(field.number(0, FULL_TURN) / full if spread is None else spread.number(0, widest))
        if spread is not None and field is not None:
            _agree(field, full * spread_rad[-1], "radians", level)
    range_m, spread_range = _range(node, keys, level)
    sensor = Sensor(
        name=keys["name"].text() if "name" in keys else f"sensor_{index + 1}",
        weight=keys["weight"].number(0) if "weight" in keys else 0.0,
        origin_m=mean,
        origin_covariance_m2=covariance,
        azimuth_rad=boresight["azimuth_rad"].number(-LARGEST_ANGLE_RAD, LARGEST_ANGLE_RAD),
        elevation_rad=boresight["elevation_rad"].number(-math.pi / 2, math.pi / 2),
        roll_rad=boresight["roll_rad"].number(-LARGEST_ANGLE_RAD, LARGEST_ANGLE_RAD)
        if "roll_rad" in boresight
        else 0.0,
        spread_horizontal_rad=spread_rad[0],
        spread_vertical_rad=spread_rad[1],
        range_m=range_m,
        spread_range_m=spread_range,
        level=level,
        rays=keys["rays"].integer(0, MOST_RAYS) if "rays" in keys else None,
        coupling=_coupling(keys["coupling"]) if "coupling" in keys else None,
        part=keys["part"].text() if "part" in keys else None,
    )
    if "travel_m" in keys:
        _check_travel(keys["travel_m"], sensor)
    return sensor


def _coupling(node: Node) -> Coupling:
    keys = node.mapping(("direction_rad_per_m", "range_m_per_m", "range_m_per_rad", "spread_rad", "spread_m"))
    rows = keys["direction_rad_per_m"].items()
    if len(rows) != 2:
        raise keys["direction_rad_per_m"].error(
            f"has {len(rows)} rows", allowed="2 rows (horizontal, vertical) of 3 numbers [rad / m]"
        )
    return Coupling(
        direction_per_m=np.stack([row.numbers(3) for row in rows]),
        range_per_m=keys["range_m_per_m"].numbers(3),
        range_per_rad=keys["range_m_per_rad"].numbers(2),
        spread_rad=keys["spread_rad"].numbers(2, 0),
        spread_m=keys["spread_m"].number(0),
    )


def _check_travel(node: Node, sensor: Sensor) -> None:
    """The travel follows from the origin's covariance; another one would mean a different sensor."""
    keys = node.mapping(("length",), ("direction",))
    found, (expected, _) = keys["length"].number(0), sensor.travel_m
    if abs(found - expected) > AGREEMENT * max(found, expected):
        raise keys["length"].error(
            f"is {found!r} m, but the origin's covariance gives {expected:.9g} at level {sensor.level:g}",
            hint="remove travel_m; it follows from the covariance",
        )
    if "direction" in keys:
        along = keys["direction"].numbers(3)
        # any length will do, and squares of large ones overflow
        along = along / (np.abs(along).max() or 1.0)
        length, variance = np.linalg.norm(along), np.linalg.eigvalsh(sensor.origin_covariance_m2)[-1]
        reached = along @ sensor.origin_covariance_m2 @ along / length**2 if length > 0 else 0.0
        if abs(reached - variance) > AGREEMENT * variance:
            raise keys["direction"].error(
                "is not the direction in which the origin's covariance is longest",
                hint="remove travel_m; it follows from the covariance",
            )


def _origin(node: Node) -> tuple[np.ndarray, np.ndarray]:
    keys = node.mapping(("mean",), ("covariance",))
    mean = keys["mean"].numbers(3, -FARTHEST_M, FARTHEST_M)
    if "covariance" not in keys:
        return mean, np.zeros((3, 3))
    rows = keys["covariance"].items()
    if len(rows) != 3:
        raise keys["covariance"].error(f"has {len(rows)} rows", allowed="3 rows of 3 numbers [m^2]")
    covariance = np.stack([row.numbers(3, -(FARTHEST_M**2), FARTHEST_M**2) for row in rows])
    slack = COVARIANCE_ROUNDING * np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > slack:
        raise keys["covariance"].error("is not symmetric")
    if np.linalg.eigvalsh(covariance).min() < -slack:
        raise keys["covariance"].error("has a negative eigenvalue", allowed="a covariance matrix [m^2]")
    return mean, covariance


def _range(node: Node, keys: dict[str, Node], level: float) -> tuple[float, float]:
    """Mean and spread of the range, from two of mean, spread and gate, or from the gate alone."""
    spreads = keys["spread"].value if "spread" in keys else {}
    spread = keys["spread"].child("range_m").number(0, FARTHEST_M) if spreads.get("range_m") is not None else None
    mean = keys["range_m"].number(0, FARTHEST_M) if "range_m" in keys else None
    half = interval_factor(level)
    if "gate_m" not in keys:
        if spread is None or mean is None:
            raise node.error("has no gate", hint="give gate_m {start, end}, or range_m and spread.range_m")
        if mean + half * spread <= max(mean - half * spread, 0.0):
            raise keys["spread"].child("range_m").error(f"is {spread:g}", allowed="a gate that has a width")
        return mean, spread
    gate = keys["gate_m"].mapping(("start", "end"))
    start, end = gate["start"].number(0, FARTHEST_M), gate["end"].number(0, FARTHEST_M)
    if end <= start:
        raise _no_gate(gate["end"], start)
    if spread is None:
        mean = (start + end) / 2 if mean is None else mean
        spread = max(end - mean, 0.0) / half
    elif mean is None:
        mean = end - half * spread
    _agree(gate["start"], max(mean - half * spread, 0.0), "m", level, scale=end)
    _agree(gate["end"], mean + half * spread, "m", level)
    return mean, spread


def _no_gate(end: Node, start_m: float) -> ConfigError:
    """The error of a gate that ends where or before it starts: nothing is heard in it."""
    return end.error(f"is {end.value:g}, not beyond the gate's start {start_m:g}", allowed="a gate that has a width")


def _agree(node: Node, expected: float, unit: str, level: float, scale: float = 0.0) -> None:
    """Refuse an interval that contradicts the spread, which would mean two different sensors."""
    found = node.number(0)
    if abs(found - expected) > AGREEMENT * max(expected, found, scale):
        raise node.error(
            f"is {found!r} {unit}, but the spread gives {expected:.9g} at level {level:g}",
            hint="remove either of the two; the other follows",
        )


def _ray_table(node: Node, sensors: int) -> Rays:
    keys = node.mapping(TABLE_KEYS)
    count = len(keys["sensor"].items())
    if not count:
        raise keys["sensor"].error("is empty", allowed="at least one ray")
    origin = np.stack([keys[key].numbers(count, -FARTHEST_M, FARTHEST_M) for key in TABLE_KEYS[:3]], axis=1)
    azimuth = keys["azimuth_rad"].numbers(count, -LARGEST_ANGLE_RAD, LARGEST_ANGLE_RAD)
    elevation = keys["elevation_rad"].numbers(count, -math.pi / 2, math.pi / 2)
    start, end = (keys[name].numbers(count, 0, FARTHEST_M) for name in ("gate_start_m", "gate_end_m"))
    for bad in np.flatnonzero(end <= start).tolist():
        raise _no_gate(keys["gate_end_m"].child(bad), start[bad])
    sensor = np.array([item.integer(0, sensors - 1) for item in keys["sensor"].items()], dtype=np.int64)
    return Rays.from_angles(origin, azimuth, elevation, np.stack([start, end], axis=1), sensor)


def _check_rays(
    keys: dict[str, Node],
    sensors: tuple[Sensor, ...],
    rays: int | None,
    table: Rays | None,
    track: Track | None,
) -> None:
    """The places that may count rays must agree, and one of them says where rays go."""
    if table is not None and track is not None:
        raise keys["track"].error("is given beside ray_table", hint="remove either of the two")
    layout = keys["layout"].value if "layout" in keys else None
    if table is None and (layout in ("fixed", "spinning") or (layout == "selected" and track is None)):
        raise keys["layout"].error(f"is {layout}, but there is no ray_table", hint="the layout grid needs none")
    for name in ("further_tables", "further_tracks"):
        if name in keys and layout != "selected":
            raise keys[name].error(f"stand beside the layout {layout or 'grid'}", allowed="the layout selected")
    own = [sensor.rays for sensor in sensors]
    if own and not any(count is None or count for count in own):
        raise keys["sensors"].error("fire no ray", allowed="a sensor whose rays are above 0")
    counts = {
        "rays": rays,
        "the sum of sensors[].rays": None if None in own else sum(own),
        "ray_table": None if table is None else len(table),
        "track": None if track is None else len(track.sensor),
    }
    if len({*counts.values()} - {None}) > 1:
        found = ", ".join(f"{name} {count}" for name, count in counts.items() if count is not None)
        raise keys.get("rays", keys["sensors"]).error(
            f"contradicts another count of rays: {found}", hint="remove all but one"
        )
