"""Rays as columns of numbers, as `export --format csv` and `npz` write them; a file may have fewer.

A ray needs a direction: azimuth and elevation, or a vector of any length. Where it starts, when it listens and which
sensor fires it may be left out; how far it is heard only where that is known from elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from lidardesign.design.readers.rig import Rig, RigSensor
from lidardesign.errors import DataError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.space import MOST_TURNS, angles, direction

ORIGIN = ("origin_x_m", "origin_y_m", "origin_z_m")
VECTOR = ("direction_x", "direction_y", "direction_z")
RADIANS, DEGREES = ("azimuth_rad", "elevation_rad"), ("azimuth_deg", "elevation_deg")
START, END, SENSOR, TIME = "gate_start_m", "gate_end_m", "sensor", "time_s"
COLUMNS = (*ORIGIN, *VECTOR, *RADIANS, *DEGREES, START, END, SENSOR, TIME)
LOOKS = (VECTOR, RADIANS, DEGREES)
# Directions that are given twice may differ by what rounding to six digits leaves [rad].
AGREEMENT_RAD = 10 * COARSE_SLACK
# Firing times that are even within this share of their span are what every design has.
EVEN_TIMES = COARSE_SLACK


@dataclass(frozen=True, eq=False)
class RayColumns:
    """Columns of a file, checked to be there and of one length.

    Arguments:
        numbers: Finite numbers by column, shape (N,) each.
        sensor: The index of each ray's sensor, shape (N,), from 0 without gaps.
        names: The sensors' names.
        locate: The position of a row in a column, as `file:line:column`.
    """

    numbers: Mapping[str, np.ndarray]
    sensor: np.ndarray
    names: tuple[str, ...]
    locate: Callable[[int, str], str]

    def refuse(self, wrong: np.ndarray, name: str, message: str, allowed: str) -> None:
        """Raise for the first row of a mask, shape (N,), if there is one."""
        if wrong.any():
            row = int(np.argmax(wrong))
            found = f"{name} is {self.numbers[name][row]:g}: {message}"
            raise DataError(found, where=self.locate(row, name), allowed=allowed)


def check_names(names: tuple[str, ...], where: str) -> None:
    """Refuse columns that are no ray's, and a choice of them that leaves a direction or a place half said.

    Raises:
        DataError: See above.
    """
    unknown = [name for name in names if name not in COLUMNS]
    twice = sorted({name for name in names if names.count(name) > 1})
    if unknown or twice:
        found = f"unknown columns {', '.join(map(repr, unknown))}" if unknown else f"{', '.join(twice)} given twice"
        raise DataError(found, where=where, allowed=", ".join(COLUMNS))
    for group in (ORIGIN, *LOOKS):
        given = [name for name in group if name in names]
        if given and len(given) < len(group):
            missing = ", ".join(name for name in group if name not in given)
            raise DataError(f"{', '.join(given)} without {missing}", where=where, allowed=", ".join(group))
    if not any(group[0] in names for group in LOOKS):
        allowed = " or ".join(", ".join(group) for group in LOOKS)
        raise DataError("no column says where rays look", where=where, allowed=allowed)


def rig_of_columns(columns: RayColumns, kind: str) -> Rig:
    """The sensors of a ray list.

    Raises:
        DataError: Numbers that no ray has, or directions that contradict each other.
    """
    azimuth, elevation = _angles(columns)
    count = len(azimuth)
    origin = np.zeros((count, 3))
    notes = []
    if ORIGIN[0] in columns.numbers:
        origin = np.stack([columns.numbers[name] for name in ORIGIN], axis=1)
    else:
        notes.append("where rays start is not said: all start at the world's origin")
    start = columns.numbers.get(START)
    if start is None:
        start = np.zeros(count)
        notes.append("when gates start is not said: rays are heard from 0 m on")
    else:
        columns.refuse(start < 0, START, "negative", "0 m or more")
    end = columns.numbers.get(END, np.full(count, np.inf))
    if END in columns.numbers:
        columns.refuse(end < start, END, "before the gate's start", "at least the gate's start")
    notes += _notes_of_times(columns)
    gate = np.stack([start, end], axis=1)
    order = np.argsort(columns.sensor, kind="stable")
    rays_of = np.split(order, np.cumsum(np.bincount(columns.sensor, minlength=len(columns.names)))[:-1])
    sensors = [
        RigSensor(name, origin[rays], azimuth[rays], elevation[rays], gate[rays], order=rays)
        for name, rays in zip(columns.names, rays_of, strict=True)
    ]
    return Rig(kind, sensors, notes, f"add a column {END}")


def _angles(columns: RayColumns) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation of every ray (N,) [rad], those in radians bit for bit where they are given."""
    found: dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]] = {}
    numbers = columns.numbers
    if RADIANS[0] in numbers:
        found[RADIANS] = numbers[RADIANS[0]], numbers[RADIANS[1]]
    if DEGREES[0] in numbers:
        found[DEGREES] = np.radians(numbers[DEGREES[0]]), np.radians(numbers[DEGREES[1]])
    for names, (azimuth, elevation) in found.items():
        unit = "rad" if names is RADIANS else "degrees"
        right = math.pi / 2 if names is RADIANS else 90.0
        columns.refuse(np.abs(azimuth) > 2 * math.pi * MOST_TURNS, names[0], "too many turns", "an angle in " + unit)
        beyond = np.abs(elevation) > math.pi / 2 + COARSE_SLACK
        columns.refuse(beyond, names[1], f"no elevation in {unit}", f"{-right:g} to {right:g}")
        found[names] = azimuth, np.clip(elevation, -math.pi / 2, math.pi / 2)
    if VECTOR[0] in numbers:
        vectors = np.stack([numbers[name] for name in VECTOR], axis=1)
        largest = np.abs(vectors).max(axis=1)
        columns.refuse(largest == 0, VECTOR[0], "a direction without length", "a vector of any length above 0")
        found[VECTOR] = angles(vectors / largest[:, None])
    (first, chosen), *others = found.items()
    for names, other in others:
        away = np.linalg.norm(direction(*chosen) - direction(*other), axis=1)
        columns.refuse(away > AGREEMENT_RAD, names[0], f"another direction than {first[0]} says", "one direction")
    return chosen


def _notes_of_times(columns: RayColumns) -> list[str]:
    """A note where rays do not fire evenly over their frame, in the order in which they stand."""
    times = columns.numbers.get(TIME)
    if times is None or len(times) < 2:
        return []
    even = np.linspace(times[0], times[-1], len(times))
    if np.abs(times - even).max() <= EVEN_TIMES * max(abs(times[-1] - times[0]), np.abs(times).max()):
        return []
    return [f"{TIME} is not held: rays fire evenly over a frame, in the order of the file"]
