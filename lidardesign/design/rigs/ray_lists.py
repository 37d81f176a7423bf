"""Ray lists: rays as columns of numbers, in the CSV and NPZ files that `export` writes; a file may have fewer columns.

A ray needs a direction: azimuth and elevation, or a vector of any length. Where it starts, when it listens and which
sensor fires it may be left out; how far it is heard only where that is known from elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidardesign.design.rigs.rig import LARGEST_TABLE_BYTES, Rig, RigSensor, number_of
from lidardesign.design.sensor import MOST_RAYS
from lidardesign.errors import DataError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.run.arrays import NUMERIC_KINDS, csv_rows, read_npz
from lidardesign.space import MOST_TURNS, angles, direction

ORIGIN = ("origin_x_m", "origin_y_m", "origin_z_m")
VECTOR = ("direction_x", "direction_y", "direction_z")
RADIANS, DEGREES = ("azimuth_rad", "elevation_rad"), ("azimuth_deg", "elevation_deg")
START, END, SENSOR, TIME = "gate_start_m", "gate_end_m", "sensor", "time_s"
NAMES = "sensor_names"
COLUMNS = (*ORIGIN, *VECTOR, *RADIANS, *DEGREES, START, END, SENSOR, TIME)
LOOKS = (VECTOR, RADIANS, DEGREES)
# Directions that are given twice may differ by what rounding to six digits leaves [rad].
AGREEMENT_RAD = 10 * COARSE_SLACK
# Firing times that are even within this share of their span are what every design has.
EVEN_TIMES = COARSE_SLACK
LONGEST_CELL = 100


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
    times = columns.numbers.get(TIME, np.zeros(1))
    even = np.linspace(times[0], times[-1], len(times))
    if np.abs(times - even).max() > EVEN_TIMES * max(abs(times[-1] - times[0]), np.abs(times).max()):
        notes.append(f"{TIME} is not held: rays fire evenly over a frame, in the order of the file")
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


def read_ray_csv(path: Path) -> Rig:
    """The sensors of a ray list; a column `sensor` of whole numbers counts from 0, any other holds names.

    Raises:
        DataError: The file cannot be read, or a cell cannot be used; with file, line and column.
    """
    rows = csv_rows(path, LARGEST_TABLE_BYTES)
    if not rows:
        raise DataError("is empty", where=str(path), allowed="a header and one ray per line")
    (header_line, header), *body = rows
    names = tuple(cell.strip() for cell in header)
    check_names(names, f"{path}:{header_line}")
    if not body:
        raise DataError("has a header but no ray", where=str(path))
    if len(body) > MOST_RAYS:
        raise DataError(f"{len(body)} rays", where=str(path), allowed=f"at most {MOST_RAYS}")
    for line, row in body:
        if len(row) != len(names):
            allowed = f"{len(names)}: {', '.join(names)}"
            raise DataError(f"{len(row)} columns", where=f"{path}:{line}", allowed=allowed)

    def locate(row: int, name: str) -> str:
        return f"{path}:{body[row][0]}:{names.index(name) + 1}"

    cells = dict(zip(names, zip(*(row for _, row in body), strict=True), strict=True))
    labels = [cell.strip() for cell in cells.pop(SENSOR, ("0",) * len(body))]
    if "" in labels:
        raise DataError("sensor is empty", where=locate(labels.index(""), SENSOR), allowed="a number or a name")
    indices = np.array([number_of(label) for label in labels], dtype=np.float64)
    if np.isfinite(indices).all() and (indices >= 0).all() and (indices % 1 == 0).all():
        found, sensor = np.unique(indices, return_inverse=True)
        sensor_names = tuple(f"sensor_{int(index) + 1}" for index in found)
    else:
        sensor_names = tuple(dict.fromkeys(labels))
        number_of_name = {name: number for number, name in enumerate(sensor_names)}
        sensor = np.array([number_of_name[label] for label in labels])
    numbers = {}
    for name, column in cells.items():
        values = np.array([number_of(cell) for cell in column], dtype=np.float64)
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            shown = repr(column[row][:LONGEST_CELL])
            raise DataError(f"{name} is {shown}", where=locate(row, name), allowed="a finite number")
        numbers[name] = values
    return rig_of_columns(RayColumns(numbers, sensor.reshape(-1), sensor_names, locate), "rays CSV")


def read_ray_npz(path: Path) -> Rig:
    """The sensors of a ray list; `sensor` holds indices into `sensor_names`, where there are names.

    Raises:
        DataError: The file cannot be read, or an array cannot be used.
    """
    arrays = read_npz(path, kinds=NUMERIC_KINDS + "U", hint="export it again, or write it with numpy.savez")
    names = arrays.pop(NAMES, None)
    check_names(tuple(arrays), str(path))
    shapes = {name: values.shape for name, values in arrays.items()}
    shape = next(iter(shapes.values()))
    if len(shape) != 1 or len(set(shapes.values())) > 1 or not 1 <= shape[0] <= MOST_RAYS:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(f"shapes {found}", where=str(path), allowed=f"one length from 1 to {MOST_RAYS} for all columns")

    def locate(row: int, name: str) -> str:
        return f"{path}: {name}[{row}]"

    numbers = {}
    for name, values in arrays.items():
        if values.dtype.kind not in "iuf":
            raise DataError(f"{name} is of type {values.dtype}", where=str(path), allowed="real numbers")
        numbers[name] = values.astype(np.float64)
        if not np.isfinite(numbers[name]).all():
            row = int(np.argmin(np.isfinite(numbers[name])))
            found = f"{name} is {numbers[name][row]}"
            raise DataError(found, where=locate(row, name), allowed="a finite number")
    indices = numbers.pop(SENSOR, np.zeros(shape))
    if (indices < 0).any() or (indices % 1 != 0).any():
        raise DataError(f"{SENSOR} is no whole number of 0 or more", where=str(path))
    used, sensor = np.unique(indices, return_inverse=True)
    if names is None:
        sensor_names = tuple(f"sensor_{int(index) + 1}" for index in used)
    elif names.ndim != 1 or names.dtype.kind != "U" or used[-1] >= len(names):
        allowed = f"text, at least {int(used[-1]) + 1} names"
        raise DataError(f"{NAMES} has shape {names.shape} and type {names.dtype}", where=str(path), allowed=allowed)
    else:
        sensor_names = tuple(str(names[int(index)]) for index in used)
    return rig_of_columns(RayColumns(numbers, sensor.reshape(-1), sensor_names, locate), "rays NPZ")
