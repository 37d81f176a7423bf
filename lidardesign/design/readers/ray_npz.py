"""A ray list as numpy arrays, one per column, as `export --format npz` writes them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lidardesign.design.readers.ray_columns import SENSOR, RayColumns, check_names, rig_of_columns
from lidardesign.design.readers.rig import Rig
from lidardesign.design.sensor import MOST_RAYS
from lidardesign.errors import DataError
from lidardesign.run.npz import NUMERIC_KINDS, read_npz

KIND = "rays NPZ"
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

    numbers = {name: _numbers(values, name, path) for name, values in arrays.items()}
    sensor, sensor_names = _sensors(numbers.pop(SENSOR, np.zeros(count)), names, path)
    return rig_of_columns(RayColumns(numbers, sensor, sensor_names, locate), KIND)


def _count(arrays: Mapping[str, np.ndarray], path: Path) -> int:
    """The number of rays, which all arrays share."""
    shapes = {name: values.shape for name, values in arrays.items()}
    count = next(iter(shapes.values()))
    if len(count) != 1 or len(set(shapes.values())) > 1 or not 1 <= count[0] <= MOST_RAYS:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(f"shapes {found}", where=str(path), allowed=f"one length from 1 to {MOST_RAYS} for all columns")
    return count[0]


def _numbers(values: np.ndarray, name: str, path: Path) -> np.ndarray:
    """The finite numbers of a column, shape (N,) float64."""
    if values.dtype.kind not in "iuf":
        raise DataError(f"{name} is of type {values.dtype}", where=str(path), allowed="real numbers")
    numbers = values.astype(np.float64)
    wrong = ~np.isfinite(numbers)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(f"{name} is {numbers[row]}", where=f"{path}: {name}[{row}]", allowed="a finite number")
    return numbers


def _sensors(values: np.ndarray, names: np.ndarray | None, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
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
