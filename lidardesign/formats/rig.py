"""Rigs of other programs: the design that fires exactly the rays of a rig, and the constraints of designs like it.

The rays are the pattern of the layout `fixed`; boresight, field of view and gate of a sensor are those that contain all
of its rays. Designs like a rig have as many sensors at the same positions, with fields of view and gates no wider, and
as many rays. The user's own constraints take precedence: of two bounds on one number theirs is taken, and any bound on
positions replaces those of the rig. Boresights are left to the fit.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.constraints.document import Constraints, SensorConstraints
from lidardesign.constraints.origins import axes_outside, place_text, snap_place_to_space
from lidardesign.errors import ConfigError, DataError, InfeasibleError, pasted
from lidardesign.limits import MOST_FITTED, MOST_RAYS
from lidardesign.numerics import SLACK
from lidardesign.run.validation import is_name
from lidardesign.run.yaml import merged, plain_number
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern
from lidardesign.sensors.sensor import (
    CENTRING_ROUNDS,
    DEFAULT_LEVEL,
    Sensor,
    boresight_frame,
    centred_boresight,
    interval_factor,
    tangent_coordinates,
)
from lidardesign.space import DIMENSIONS, FARTHEST_M, FULL_TURN, DesignSpace, angles, direction

# Rays of a whole turn cancel: a shorter mean of unit vectors does not define a boresight.
SHORTEST_MEAN = 1e-3
# Upper limit of sensors; each takes a row in every table.
MOST_SENSORS = 10_000
# Rays of one direction, or of directions that differ by rounding, have no field of view that could be a bound; those of
# a fan have one in their plane, and this one across it.
SMALLEST_FIELD_DEG = 1e-3
PLACES = ("fixed_m", "low_m", "high_m", "mounts_m")  # keys of constraints on positions of sensors
SHARED = tuple(SensorConstraints.model_fields)  # keys of constraints on all sensors
MOST_NAMED = 4  # sensors in a message


@dataclass(frozen=True)
class Aim:
    """Boresight and field of view of a sensor.

    Arguments:
        azimuth_rad, elevation_rad, roll_rad: The boresight.
        field_rad: Full horizontal and vertical angles.
    """

    azimuth_rad: float
    elevation_rad: float
    roll_rad: float
    field_rad: tuple[float, float]


@dataclass(frozen=True, eq=False)
class RigSensor:
    """The rays of one sensor of a rig, in the world's frame.

    Arguments:
        name: Name in the file, which need not be unique.
        origin_m: Origins, shape (N, 3).
        azimuth_rad, elevation_rad: Angles, shape (N,).
        gate_m: Gates, shape (N, 2); an end missing in the file is infinite.
        order: Positions of the rays in the file, shape (N,); None: after those of the sensors before.
        aim: Boresight and field of view in the file; None: those that contain its rays.
    """

    name: str
    origin_m: np.ndarray
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    gate_m: np.ndarray
    order: np.ndarray | None = None
    aim: Aim | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig as read from a file.

    Arguments:
        kind: Kind of the file, for messages.
        sensors: Its sensors, each with at least one ray.
        notes: Missing values of the file, and parts of it that a design cannot hold; one line each.
        end_hint: Hint on how to give the ends of gates in the file.
    """

    kind: str
    sensors: Sequence[RigSensor]
    notes: Sequence[str] = ()
    end_hint: str = "give their ends in the file"


def indices_by_owner(owners: np.ndarray, count: int) -> list[np.ndarray]:
    """Indices of the entries (N,) of each of so many owners, in their order."""
    return np.split(np.argsort(owners, kind="stable"), np.cumsum(np.bincount(owners, minlength=count))[:-1])


def rig_design(rig: Rig, path: Path, reach_m: float | None) -> DesignSpec:
    """The design that fires exactly the rays of a rig.

    Arguments:
        rig: The rig.
        path: The file; the design takes its stem as its name.
        reach_m: End of gates without one in the file [m].

    Raises:
        DataError: No ray, too many, invalid numbers, or a gate without an end where no reach is given.
    """
    total = sum(len(one.azimuth_rad) for one in rig.sensors)
    if not (1 <= total <= MOST_RAYS and len(rig.sensors) <= MOST_SENSORS):
        raise DataError(
            f"describes {total} rays of {len(rig.sensors)} sensors",
            where=str(path),
            allowed=f"1 to {MOST_RAYS} rays, at most {MOST_SENSORS} sensors",
        )
    notes = [*rig.notes]
    unknown = sum(int(np.isinf(one.gate_m[:, 1]).sum()) for one in rig.sensors)
    if unknown and reach_m is None:
        raise DataError(
            f"does not say how far {unknown} of its {total} rays reach",
            where=str(path),
            hint=f"{rig.end_hint}; or name a run that does: lidardesign evaluate RUN {pasted(path)}",
        )
    if unknown:
        notes.append(
            f"the file does not say how far {unknown} of {total} rays reach; set to {reach_m:g} m, the farthest allowed"
        )
    gated = []
    for one in rig.sensors:
        start, end = one.gate_m.T
        # gates without an end get the reach, and none ends before it starts
        end = end if reach_m is None else np.where(np.isinf(end), np.maximum(reach_m, start), end)
        gated.append(replace(one, gate_m=np.stack([start, end], axis=1)))
        _check_numbers(gated[-1], path)
    # repeated names are numbered, and names that a design cannot have are replaced
    usable = [one.name if is_name(one.name) else f"sensor_{index + 1}" for index, one in enumerate(gated)]
    often, taken, names = Counter(usable), set(usable), []
    for name in usable:
        chosen, number = name, 1
        while often[name] > 1 and chosen in taken:
            chosen, number = f"{name}_{number}", number + 1
        taken.add(chosen)
        names.append(chosen)
    counts = [len(one.azimuth_rad) for one in gated]
    before = np.concatenate([[0], np.cumsum(counts)[:-1]])
    places = [
        first + np.arange(count) if one.order is None else one.order
        for one, first, count in zip(gated, before, counts, strict=True)
    ]
    order = np.argsort(np.concatenate(places), kind="stable")
    ordered = (
        np.concatenate([getattr(one, name) for one in gated])[order]
        for name in ("origin_m", "azimuth_rad", "elevation_rad", "gate_m")
    )
    return DesignSpec(
        path.stem,
        tuple(sensor_of(one, name, total) for one, name in zip(gated, names, strict=True)),
        layout="fixed",
        patterns=(Pattern.of(Rays.from_angles(*ordered, sensor=np.repeat(np.arange(len(gated)), counts)[order])),),
        provenance={"source": path.name, "format": rig.kind, "notes": notes},
    )


def _check_numbers(one: RigSensor, path: Path) -> None:
    for name, values, low in (("place", one.origin_m, -FARTHEST_M), ("gate", one.gate_m, 0.0)):
        wrong = ~((values >= low) & (values <= FARTHEST_M))
        if wrong.any():
            raise DataError(
                f"a {name} of {one.name!r} is {values[wrong].flat[0]:g} m",
                where=str(path),
                allowed=f"{low:g} to {FARTHEST_M:g} m",
            )
    without_width = one.gate_m[:, 1] <= one.gate_m[:, 0]
    if without_width.any():
        start, end = one.gate_m[without_width][0]
        raise DataError(
            f"a gate of {one.name!r} starts at {start:g} m and ends at {end:g} m",
            where=str(path),
            allowed="an end beyond the start",
        )


def number_of(text: str) -> float | None:
    """The number in a cell, or None."""
    try:
        return plain_number(text)
    except ValueError:
        return None


def sensor_of(one: RigSensor, name: str, total: int) -> Sensor:
    """The sensor that fires the rays of a rig's, under a name, with its share of all rays."""
    single = Aim(float(one.azimuth_rad[0]), float(one.elevation_rad[0]), 0.0, (0.0, 0.0))
    count = len(one.azimuth_rad)
    aim = one.aim or (single if count == 1 else aim_of(direction(one.azimuth_rad, one.elevation_rad)))
    start, end = float(one.gate_m[:, 0].min()), float(one.gate_m[:, 1].max())
    away = one.origin_m - one.origin_m[0]
    still = not away.any()
    return Sensor(
        name=name,
        weight=count / total,
        origin_m=one.origin_m[0].copy() if still else one.origin_m.mean(axis=0),
        azimuth_rad=aim.azimuth_rad,
        elevation_rad=aim.elevation_rad,
        roll_rad=aim.roll_rad,
        field_of_view_rad=(min(aim.field_rad[0], FULL_TURN), min(aim.field_rad[1], FULL_TURN)),
        gate_m=(start, end),
        origin_covariance_m2=None if still else np.cov(away.T, bias=True),
    )


def aim_of(directions: np.ndarray) -> Aim:
    """Boresight in the middle of unit vectors, shape (N, 3), and the field of view that contains all of them.

    Where they cover a whole turn, the boresight is about +x.
    """
    mean = directions.mean(axis=0)
    if np.linalg.norm(mean) < SHORTEST_MEAN:
        mean = np.array([1.0, 0.0, 0.0])
    azimuth, elevation = (float(angle) for angle in angles(mean))
    tried = []
    for _ in range(CENTRING_ROUNDS):
        frame = boresight_frame(azimuth, elevation)
        seen = tangent_coordinates(frame, directions)
        reach = np.abs(seen).max(axis=0)
        tried.append(Aim(azimuth, elevation, 0.0, (2 * float(reach[0]), 2 * float(reach[1]))))
        azimuth, elevation = centred_boresight(frame, seen)
    # near a pole the frame turns with the boresight, and no round need be the best
    return min(tried, key=lambda aim: aim.field_rad[0] * aim.field_rad[1])


def rig_constraints(
    rig: DesignSpec, space: DesignSpace, asked: Constraints, *, rays: int | None, hint: str | None = None
) -> Constraints:
    """Constraints of designs like a rig, completed by the user's own, which take precedence.

    Arguments:
        rig: The rig's design.
        space: The design space; a coordinate that is a condition stays open, as sensors move along it.
        asked: The user's constraints.
        rays: The user's number of rays from elsewhere; None: the rig's own is a bound.
        hint: Hint where the rig's sensors are outside the space.

    Raises:
        ConfigError: More sensors than a fit takes.
        InfeasibleError: A sensor of the rig is outside the space, and the user constrains no position.
    """
    if len(rig.sensors) > MOST_FITTED:
        raise ConfigError(
            f"{len(rig.sensors)} sensors", where=f"--like {rig.name}", allowed=f"at most {MOST_FITTED}",
            hint="rays that belong together need one name in the column `sensor`",
        )  # fmt: skip
    own = asked.as_document()
    shared = {key: own[key] for key in SHARED if key in own}
    given = own.get("each", [])
    each = [*given, *({} for _ in rig.sensors[len(given) :])]
    document: dict[str, Any] = {
        # count, and min with max, exclude one another
        "sensors": own.get("sensors", {"count": len(rig.sensors)}),
        "budget": {"rays": rig.count} if rig.count and rays is None else {},
    }
    result = merged(document, {key: own[key] for key in own if key not in ("sensors", "each")})
    like = [_of_sensor(sensor, space) for sensor in rig.sensors]
    # entries beyond the rig's sensors are kept: the check of contradictions reports too many
    like += [{} for _ in each[len(like) :]]
    wanted = [merged(shared, entry) for entry in each]
    placed = [any(key in entry.get("origin", {}) for key in PLACES) for entry in wanted]
    _check_places(rig, space, placed, hint)
    for bounds in itertools.compress(like, placed):
        bounds.pop("origin", None)
    result["each"] = [merged(bounds, entry) for bounds, entry in zip(like, wanted, strict=True)]
    return Constraints.from_mapping(result, where=f"--like {rig.name}")


def _check_places(rig: DesignSpec, space: DesignSpace, placed: Sequence[bool], hint: str | None) -> None:
    """Refuse a rig with sensors outside the design space, unless the user constrains their positions."""
    boxes = {sensor.name: _box(sensor) for sensor, own in zip(rig.sensors, placed, strict=False) if not own}
    beyond = {name: axes for name, box in boxes.items() if (axes := axes_outside(*box, space))}
    if not beyond:
        return
    name = next(iter(beyond))
    more = f" (and {len(beyond) - 1} more of its sensors elsewhere, too)" if len(beyond) > 1 else ""
    raise InfeasibleError(
        f"the run's sensors stand at {place_text(space.low[:3], space.high[:3])}; the rig's {name} at "
        f"{place_text(*boxes[name])}{more}",
        conflicts=[*(f"space.{DIMENSIONS[axis]}" for axis in beyond[name]), f"--like {rig.name}"],
        where=f"--like {rig.name}",
        hint=hint or "learn with a design space that contains the rig's places",
    )


def _of_sensor(sensor: Sensor, space: DesignSpace) -> dict[str, Any]:
    """Bounds of a sensor's position (a point or a box, open along conditions), field of view and gate."""
    low, high = _box(sensor)
    place = snap_place_to_space(sensor.origin_m, space)
    moving = [axis for axis in range(3) if DIMENSIONS[axis] in space.condition]
    bounds: dict[str, Any] = {"origin": {"fixed_m": place}}
    if moving or (low != high).any():
        low, high = np.minimum(low, place), np.maximum(high, place)
        for axis in moving:
            low[axis], high[axis] = space.low[axis], space.high[axis]
        bounds["origin"] = {key: [float(v) for v in corner] for key, corner in (("low_m", low), ("high_m", high))}
        if sensor.region_m > 0:
            bounds["origin"]["spread_m"] = {"max": sensor.region_m}
    widths = dict(zip(("horizontal_deg", "vertical_deg"), map(math.degrees, sensor.field_of_view_rad), strict=True))
    if max(widths.values()) > SMALLEST_FIELD_DEG:
        narrow = {axis: {"max": max(width, SMALLEST_FIELD_DEG)} for axis, width in widths.items() if width < 360}
        bounds.update({"field_of_view": narrow} if narrow else {})
    start, end = sensor.gate_m
    if end - start > SLACK:
        bounds["gate"] = {"width_m": {"max": end - start}}
    return bounds


def _box(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box of a sensor's origins, (3,) each [m]."""
    half = interval_factor(DEFAULT_LEVEL) * np.sqrt(np.maximum(np.diag(sensor.covariance_m2), 0.0))
    return sensor.origin_m - half, sensor.origin_m + half


def moved_notes(rig: DesignSpec, space: DesignSpace, constraints: Constraints) -> list[str]:
    """Note of the sensors of a rig that are moved slightly to a fixed position of the space."""
    moved = []
    for sensor, one in zip(rig.sensors, constraints.each, strict=False):
        place = snap_place_to_space(sensor.origin_m, space)
        off = float(np.abs(np.subtract(place, sensor.origin_m)).max())
        # other constraints on positions, and conditions, are no move
        if off > SLACK and one.origin.fixed_m == place:
            moved.append((sensor.name, 1e3 * off))
    if not moved:
        return []
    names = ", ".join(name for name, _ in moved[:MOST_NAMED]) + ", ..." * (len(moved) > MOST_NAMED)
    return [
        f"{names}: {max(off for _, off in moved):.2g} mm from where the run's sensors stand: treated as standing there"
    ]


def rig_notes(rig: DesignSpec, constraints: Constraints, asked: Constraints) -> list[str]:
    """Lines that describe the constraints of designs like a rig."""
    sensors, own = len(rig.sensors), asked.as_document()
    has_rays = constraints.budget.rays is not None and asked.budget.rays is None
    rays = f", {constraints.budget.rays} rays" if has_rays else ""
    lines = [
        f"like {rig.name}: {sensors} sensor{'s' * (sensors > 1)}{rays}, at its places, fields of view and gates "
        "no wider"
    ]
    single = sum(max(sensor.field_of_view_rad) <= math.radians(SMALLEST_FIELD_DEG) for sensor in rig.sensors)
    if single:
        lines.append(f"{single} of {sensors} sensors have no field of view: that of the fit is not bounded")
    if own:
        lines.append(f"your own constraints take precedence: {', '.join(sorted(own))}")
    return lines
