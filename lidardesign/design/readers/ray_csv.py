"""A ray list as text: one ray per line under a header that names its columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lidardesign.design.readers.ray_columns import SENSOR, RayColumns, check_names, rig_of_columns
from lidardesign.design.readers.rig import Rig
from lidardesign.design.sensor import MOST_RAYS
from lidardesign.errors import DataError
from lidardesign.run.csv_rows import csv_rows

KIND = "rays CSV"
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
    return rig_of_columns(RayColumns(numbers, sensor, sensor_names, locate), KIND)


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
