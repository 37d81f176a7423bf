"""Rays as columns of numbers, as `export --format csv` and `npz` write them; a file may have fewer.

A ray needs a direction: azimuth and elevation, or a vector of any length. Where it starts, when it listens and which
sensor fires it may be left out; how far it is heard only where that is known from elsewhere.

A ray list as text: one ray per line under a header that names its columns.

A ray list as numpy arrays, one per column, as `export --format npz` writes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidardesign.design.rigs.rig import Rig, RigSensor
from lidardesign.design.sensor import MOST_RAYS
from lidardesign.errors import DataError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.run.arrays import NUMERIC_KINDS, csv_rows, read_npz
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


CSV_KIND = "rays CSV"
# A million rays of twelve columns with all their digits.
LARGEST_BYTES = 256_000_000
LONGEST_CELL = 100
Locate = Callable[[int, str], str]


def read_ray_csv(path: Path) -> Rig:
    """The sensors of a ray list; a column `sensor` of whole numbers counts from 0, any other holds names.

    Raises:
        DataError: The file cannot be read, or a cell cannot be used; with file, line and column.
    """
    rows, lines = _rows(path)
    names = tuple(cell.strip() for cell in rows[0])
    check_names(names, f"{path}:{lines[0]}")
    body, lines = rows[1:], lines[1:]
    if not body:
        raise DataError("has a header but no ray", where=str(path))
    if len(body) > MOST_RAYS:
        raise DataError(f"{len(body)} rays", where=str(path), allowed=f"at most {MOST_RAYS}")
    for row, line in zip(body, lines, strict=True):
        if len(row) != len(names):
            allowed = f"{len(names)}: {', '.join(names)}"
            raise DataError(f"{len(row)} columns", where=f"{path}:{line}", allowed=allowed)

    def locate(row: int, name: str) -> str:
        return f"{path}:{lines[row]}:{names.index(name) + 1}"

    cells = dict(zip(names, zip(*body, strict=True), strict=True))
    sensor, sensor_names = _sensors(cells.pop(SENSOR, ("0",) * len(body)), locate)
    numbers = {name: _numbers(column, name, locate) for name, column in cells.items()}
    return rig_of_columns(RayColumns(numbers, sensor, sensor_names, locate), CSV_KIND)


def _rows(path: Path) -> tuple[list[list[str]], list[int]]:
    """The cells of every line that is not blank, the header first, and the lines' numbers."""
    rows = csv_rows(path, LARGEST_BYTES)
    if not rows:
        raise DataError("is empty", where=str(path), allowed="a header and one ray per line")
    lines, cells = zip(*rows, strict=True)
    return list(cells), list(lines)


def _numbers(cells: Sequence[str], name: str, locate: Locate) -> np.ndarray:
    """The finite numbers of a column, shape (N,)."""
    values = np.array([_number(cell) for cell in cells])
    wrong = ~np.isfinite(values)
    if wrong.any():
        row = int(np.argmax(wrong))
        shown = repr(cells[row][:LONGEST_CELL])
        raise DataError(f"{name} is {shown}", where=locate(row, name), allowed="a finite number")
    return values


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _sensors(cells: Sequence[str], locate: Locate) -> tuple[np.ndarray, tuple[str, ...]]:
    """The sensor of every ray (N,) and the sensors' names: by number, or as they are named, in order of appearance."""
    texts = [cell.strip() for cell in cells]
    if "" in texts:
        raise DataError("sensor is empty", where=locate(texts.index(""), SENSOR), allowed="a number or a name")
    values = np.array([_number(text) for text in texts])
    if np.isfinite(values).all() and (values >= 0).all() and (values % 1 == 0).all():
        found, index = np.unique(values, return_inverse=True)
        return index.reshape(-1), tuple(f"sensor_{int(value) + 1}" for value in found)
    named = {name: number for number, name in enumerate(dict.fromkeys(texts))}
    return np.array([named[text] for text in texts]), tuple(named)


NPZ_KIND = "rays NPZ"
NAMES = "sensor_names"


def read_ray_npz(path: Path) -> Rig:
    """The sensors of a ray list; `sensor` holds indices into `sensor_names`, where there are names.

    Raises:
        DataError: The file cannot be read, or an array cannot be used.
    """
    arrays = read_npz(path, kinds=NUMERIC_KINDS + "U", hint="export it again, or write it with numpy.savez")
    names = arrays.pop(NAMES, None)
    check_names(tuple(arrays), str(path))
    count = _count(arrays, path)

    def locate(row: int, name: str) -> str:
        return f"{path}: {name}[{row}]"

    numbers = {name: _archive_numbers(values, name, path) for name, values in arrays.items()}
    sensor, sensor_names = _archive_sensors(numbers.pop(SENSOR, np.zeros(count)), names, path)
    return rig_of_columns(RayColumns(numbers, sensor, sensor_names, locate), NPZ_KIND)


def _count(arrays: Mapping[str, np.ndarray], path: Path) -> int:
    """The number of rays, which all arrays share."""
    shapes = {name: values.shape for name, values in arrays.items()}
    count = next(iter(shapes.values()))
    if len(count) != 1 or len(set(shapes.values())) > 1 or not 1 <= count[0] <= MOST_RAYS:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(f"shapes {found}", where=str(path), allowed=f"one length from 1 to {MOST_RAYS} for all columns")
    return count[0]


def _archive_numbers(values: np.ndarray, name: str, path: Path) -> np.ndarray:
    """The finite numbers of a column, shape (N,) float64."""
    if values.dtype.kind not in "iuf":
        raise DataError(f"{name} is of type {values.dtype}", where=str(path), allowed="real numbers")
    numbers = values.astype(np.float64)
    wrong = ~np.isfinite(numbers)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(f"{name} is {numbers[row]}", where=f"{path}: {name}[{row}]", allowed="a finite number")
    return numbers


def _archive_sensors(values: np.ndarray, names: np.ndarray | None, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The sensor of every ray (N,) and the names of those that fire one."""
    if (values < 0).any() or (values % 1 != 0).any():
        raise DataError(f"{SENSOR} is no whole number of 0 or more", where=str(path))
    found, index = np.unique(values, return_inverse=True)
    if names is None:
        return index.reshape(-1), tuple(f"sensor_{int(value) + 1}" for value in found)
    if names.ndim != 1 or names.dtype.kind != "U" or found[-1] >= len(names):
        allowed = f"text, at least {int(found[-1]) + 1} names"
        raise DataError(f"{NAMES} has shape {names.shape} and type {names.dtype}", where=str(path), allowed=allowed)
    return index.reshape(-1), tuple(str(names[int(value)]) for value in found)
