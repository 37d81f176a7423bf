"""A rig as a file of another program describes it, and the design that fires exactly its rays.

The rays are the pattern of the layout `fixed`; boresight, field of view and gate of a sensor are those
that hold all of its rays.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run.validation import is_name
from lidardesign.run.yaml import plain_number
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern
from lidardesign.sensors.sensor import MOST_RAYS, Sensor, boresight_frame, tangent_coordinates, tangent_directions
from lidardesign.space import FARTHEST_M, FULL_TURN, angles, direction

# Rounds in which a boresight moves to the middle of its field: away from the poles it rests after two or three.
CENTRING_ROUNDS = 8
# Rays of a whole turn cancel: so short a mean of unit vectors says nothing of where a sensor looks.
SHORTEST_MEAN = 1e-3
# More sensors than any rig has; each takes a row in every table.
MOST_SENSORS = 10_000


@dataclass(frozen=True)
class Aim:
    """Where a sensor looks and how wide, where its file says so.

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
        name: As the file has it; it need not be unique.
        origin_m: Shape (N, 3).
        azimuth_rad, elevation_rad: Shape (N,).
        gate_m: Shape (N, 2); an end that the file does not say is infinite.
        order: The places of the rays in the file, shape (N,); None: after those of the sensors before.
        aim: What the file says of its field; None: what its rays fill.
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
    """What a file describes.

    Arguments:
        kind: What sort of file it is, for people.
        sensors: Its sensors, each with a ray at least.
        notes: What the file does not say, and what of it a design does not hold; one line each.
        end_hint: How the file says how far a ray is heard.
    """

    kind: str
    sensors: Sequence[RigSensor]
    notes: Sequence[str]
    end_hint: str


def rig_design(rig: Rig, path: Path, reach_m: float | None) -> DesignSpec:
    """The design that fires the rays of a rig.

    Arguments:
        rig: What the file describes.
        path: The file; the design takes its stem as its name.
        reach_m: How far rays are heard whose file does not say so [m].

    Raises:
        DataError: No ray, too many, numbers that rays cannot have, or a gate without an end where no reach is given.
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
            hint=f"{rig.end_hint}; or name a run that does: lidardesign evaluate RUN {quote(path.name)}",
        )
    if unknown:
        notes.append(
            f"the file does not say how far {unknown} of {total} rays reach; {reach_m:g} m, as far as any may be"
        )
    gated = []
    for one in rig.sensors:
        start, end = one.gate_m.T
        # gates without an end get the reach, and none ends before it starts
        end = end if reach_m is None else np.where(np.isinf(end), np.maximum(reach_m, start), end)
        gated.append(replace(one, gate_m=np.stack([start, end], axis=1)))
        _check_numbers(gated[-1], path)
    # sensors that share a name are numbered, and those whose name a design could not have
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
    columns = ("origin_m", "azimuth_rad", "elevation_rad", "gate_m")
    ordered = (np.concatenate([getattr(one, name) for one in gated])[order] for name in columns)
    return DesignSpec(
        path.stem,
        tuple(_sensor(one, name, total) for one, name in zip(gated, names, strict=True)),
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
        found = f"a gate of {one.name!r} starts at {start:g} m and ends at {end:g} m"
        raise DataError(found, where=str(path), allowed="an end beyond the start")


def number_of(text: str) -> float | None:
    """The number that a cell holds; None where it is none."""
    try:
        return plain_number(text)
    except ValueError:
        return None


def _sensor(one: RigSensor, name: str, total: int) -> Sensor:
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
    """The boresight in the middle of unit vectors, shape (N, 3), and the field of view that holds all of them.

    Where they go all around, the sensor looks along +x.
    """
    mean = directions.mean(axis=0)
    if np.linalg.norm(mean) < SHORTEST_MEAN:
        mean = np.array([1.0, 0.0, 0.0])
    tried = []
    for _ in range(CENTRING_ROUNDS):
        azimuth, elevation = (float(angle) for angle in angles(mean))
        frame = boresight_frame(azimuth, elevation)
        seen = tangent_coordinates(frame, directions)
        reach = np.abs(seen).max(axis=0)
        tried.append(Aim(azimuth, elevation, 0.0, (2 * float(reach[0]), 2 * float(reach[1]))))
        mean = tangent_directions(frame, (seen.min(axis=0) + seen.max(axis=0))[None] / 2)[0]
    # near a pole the frame turns with the boresight, and no round need be the best
    return min(tried, key=lambda aim: aim.field_rad[0] * aim.field_rad[1])
