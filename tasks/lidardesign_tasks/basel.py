"""Morphable models in the HDF5 layout of the Basel Face Model: versions 0.8 and 0.9, and the research layout.

Layout: `shape/model/{mean (3V,), pcaBasis (3V, K), pcaVariance (K,)}`, `shape/representer/cells (3, T)`, with
or without the `shape/` in front; in old files triangles are in `representer/reference-mesh/triangle-list`. In
version 0.9 the basis is orthonormal, in 0.8 it is multiplied by the standard deviations, as its norms show.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lidardesign import DataError, inputs

Unit = Literal["auto", "mm", "cm", "m"]
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
LAYOUT = "the HDF5 layout of the Basel Face Model"
# Largest value of a file, larger than any head in any unit.
LARGEST_VALUE = 1e12
CELL_NAMES = ("representer/cells", "representer/reference-mesh/triangle-list")
# tolerance of the norms of basis columns, by single precision and file rounding
NORM_TOLERANCE = 1e-2
# plausible extents of a head or bust, by unit, for files without a unit
EXTENTS = {"m": (0.05, 1.5), "cm": (5.0, 60.0), "mm": (60.0, 1500.0)}


@dataclass(frozen=True, eq=False)
class MorphableModel:
    """A linear model of shapes, in metres and the file's axes: x to the head's left, y up, z out of the face.

    Arguments:
        mean: Vertices of the mean shape [m], shape (V, 3).
        modes: Displacements per standard deviation [m], shape (K, V, 3).
        faces: Vertex indices, shape (T, 3).
        notes: Findings and assumptions of reading, one line each.
    """

    mean: np.ndarray
    modes: np.ndarray
    faces: np.ndarray
    notes: tuple[str, ...] = ()

    def shape(self, coefficients: np.ndarray) -> np.ndarray:
        """Vertices of the shape with standardised coefficients (K,): mean + sum_k c_k mode_k, (V, 3) [m]."""
        return self.mean + np.tensordot(coefficients, self.modes[: len(coefficients)], axes=1)


def load_model(path: str | Path, *, unit: Unit = "auto", modes: int | None = None) -> MorphableModel:
    """Load and check a morphable model.

    Arguments:
        path: An HDF5 file in the Basel layout.
        unit: The file's unit of length; `auto` reads it from the file or, failing that, from the head's size.
        modes: Largest number of modes to keep.

    Raises:
        DataError: The file is missing, not HDF5, lacks a dataset, or one has wrong shapes or values.
    """
    import h5py

    path = Path(path)
    inputs.check_file(path, inputs.HEAD_MODEL, hint=f"give a morphable model in {LAYOUT}")
    try:
        with h5py.File(path, "r") as file:
            return _read(_File(file, str(path)), unit, modes)
    # h5py says KeyError, RuntimeError or ValueError where links or headers inside a file are broken
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"is not a readable HDF5 file ({reason})", where=str(path), allowed=LAYOUT) from error


class _File:
    """Checked access to the datasets of an open HDF5 file."""

    def __init__(self, file: Any, where: str) -> None:
        self.file, self.where = file, where
        self.prefix = "shape/" if "shape" in file else ""
        self.unpacked = 0

    def fail(self, name: str, found: str, allowed: str | None = None) -> DataError:
        return DataError(found, where=f"{self.where}: dataset {self.prefix}{name}", allowed=allowed)

    def numbers(self, name: str, *alternatives: str) -> np.ndarray:
        """The first dataset of the given names that exists, as finite numbers."""
        import h5py

        present = [n for n in (name, *alternatives) if self.prefix + n in self.file]
        if not present:
            raise self.fail(name, "is missing", LAYOUT)
        dataset = self.file[self.prefix + present[0]]
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf" or dataset.shape is None:
            raise self.fail(present[0], "is not an array of numbers")
        if dataset.file != self.file or dataset.external or dataset.is_virtual:
            raise self.fail(present[0], "is stored in another file", "all data in one file")
        self.unpacked += dataset.size * np.dtype(np.float64).itemsize
        inputs.check_bytes(
            self.unpacked, inputs.HEAD_MODEL, f"{self.where}: dataset {self.prefix}{present[0]}", unpacked=True
        )
        try:
            values = np.asarray(dataset[()])
        except OSError as error:
            raise self.fail(present[0], f"is damaged ({str(error).splitlines()[0]})") from error
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise self.fail(present[0], f"{int((~np.isfinite(values)).sum())} values are NaN or infinite")
        largest = max(float(values.max(initial=0)), -float(values.min(initial=0)))
        if largest > LARGEST_VALUE:
            raise self.fail(present[0], f"reaches {largest:.3g}", f"at most {LARGEST_VALUE:g}")
        return values


def _read(file: _File, unit: Unit, modes: int | None) -> MorphableModel:
    mean = file.numbers("model/mean").astype(np.float64).reshape(-1)
    if mean.size == 0 or mean.size % 3:
        raise file.fail("model/mean", f"has {mean.size} values", "x, y, z of every vertex")
    variance = file.numbers("model/pcaVariance").astype(np.float64).reshape(-1)
    basis = file.numbers("model/pcaBasis")
    if basis.shape != (mean.size, variance.size) or not variance.size:
        raise file.fail(
            "model/pcaBasis",
            f"has the shape {basis.shape}",
            f"({mean.size}, {variance.size}), as mean and variance",
        )
    if variance.min() < 0:
        raise file.fail("model/pcaVariance", f"has the negative value {variance.min():.3g}", "0 or more")
    kept = variance.size if modes is None else min(modes, variance.size)
    notes: list[str] = []
    scale = METRES[_unit(file, mean.reshape(-1, 3), unit, notes)]
    scaled = _per_deviation(file, basis[:, :kept].astype(np.float64), np.sqrt(variance[:kept]), notes)
    shapes = np.ascontiguousarray(scaled.T).reshape(kept, -1, 3)
    return MorphableModel(scale * mean.reshape(-1, 3), scale * shapes, _faces(file, mean.size // 3), tuple(notes))


def _per_deviation(file: _File, basis: np.ndarray, deviation: np.ndarray, notes: list[str]) -> np.ndarray:
    """The basis multiplied by the standard deviations, which it already is in files of version 0.8."""
    norms, used = np.linalg.norm(basis, axis=0), deviation > 0
    if np.abs(norms[used] - 1).max(initial=0) < NORM_TOLERANCE:
        return basis * deviation
    if np.abs(norms[used] / deviation[used] - 1).max(initial=0) < NORM_TOLERANCE:
        notes.append("the basis is already multiplied by the standard deviations (version 0.8)")
        return basis
    raise file.fail(
        "model/pcaBasis",
        f"has columns of length {norms.min():.3g} to {norms.max():.3g}",
        "length 1 (version 0.9) or the square root of pcaVariance (version 0.8)",
    )


def _faces(file: _File, vertices: int) -> np.ndarray:
    name = next((n for n in CELL_NAMES if file.prefix + n in file.file), CELL_NAMES[0])
    cells = file.numbers(name)
    if cells.ndim != 2 or 3 not in cells.shape or (cells.dtype.kind == "f" and (cells % 1).any()):
        raise file.fail(name, f"has the shape {cells.shape} and type {cells.dtype}", "(3, T) whole numbers")
    faces = (cells.T if cells.shape[0] == 3 else cells).astype(np.int64)
    if faces.min() < 0 or faces.max() >= vertices:
        raise file.fail(name, f"names vertex {faces.max()} (or a negative one)", f"0 to {vertices - 1}")
    return faces.astype(np.int32)


def _unit(file: _File, mean: np.ndarray, unit: Unit, notes: list[str]) -> str:
    """Unit of length: as configured, as in the file, or inferred from the head's size."""
    if unit != "auto":
        return unit
    for place in (file.file, file.file.get("shape"), file.file.get(file.prefix + "representer")):
        said = place.attrs.get("unit") if place is not None else None
        said = said.decode(errors="replace") if isinstance(said, bytes) else said
        if isinstance(said, str) and said.strip() in METRES:
            return said.strip()
    if file.prefix + "representer/length-unit" in file.file:
        lengths = file.numbers("representer/length-unit").reshape(-1)
        length = float(lengths[0]) if lengths.size else 0.0
        named = [name for name, metres in METRES.items() if np.isclose(length, metres)]
        if not named:
            raise file.fail("representer/length-unit", f"is {length} m", "0.001, 0.01 or 1")
        return named[0]
    extent = float((mean.max(axis=0) - mean.min(axis=0)).max())
    for name, (low, high) in EXTENTS.items():
        if low <= extent < high:
            notes.append(f"the file names no unit; a head {extent:.3g} units tall is taken as {name}")
            return name
    raise DataError(
        f"names no unit, and a head {extent:.3g} units tall fits none",
        where=file.where,
        hint="set unit to mm, cm or m",
    )
