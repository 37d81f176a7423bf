"""The arrays of a `.npz` or MATLAB `.mat` file, read without running anything that is in it.

Names, types and sizes are looked at before any data is read: objects, cells and structures are refused, and so is more
data than a stated size, packed or not.

Arrays of numbers in MATLAB files of versions 4 to 7, read here: no other reader stands up to damaged ones.

SciPy's was measured to end the whole process on some, by a segmentation fault in compiled code. What a capture needs
of the format is little: full real arrays of numbers, packed or not. All else is refused by its class.

Version 5 (MATLAB's "MAT-File Format", chapter 1): 128 bytes of header, then elements of a type, a number of bytes and
data that is padded to 8 bytes; up to 4 bytes of data may share 8 with a short tag. An array is an element of elements:
flags, dimensions, name, real part. Version 4 has matrices of 5 numbers of 4 bytes, a name and data.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run import arrays as npz
from lidardesign.run.arrays import check_kind, check_size, guarded, read_npz

HEADER_BYTES = 128
# Version 1.0 and a mark by which byte orders are told apart, at the end of the header.
ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
COMPRESSED, MATRIX = 15, 14
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1"}
NUMBERS = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
OTHERS = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", 16: "function", 17: "opaque"}
COMPLEX, LOGICAL = 0x0800, 0x0200
STORED_4 = ("f8", "f4", "i4", "i2", "u2", "u1")
MOST_DIMENSIONS = 32
# Numbers of a version 4 header are smaller than this; text, as version 5 begins with, is not.
MOST_KINDS_4 = 5000


class _Element(NamedTuple):
    """The type of an element, and its data."""

    kind: int
    data: memoryview


def read_matlab(content: bytes, where: str) -> dict[str, np.ndarray]:
    """All arrays of a file by name, at least two-dimensional, in MATLAB's shapes.

    Arguments:
        content: The whole file.
        where: The file's name.

    Raises:
        DataError: It is damaged, too large, or holds other things than real arrays of numbers.
    """
    found: dict[str, np.ndarray] = {}
    order = ORDERS.get(content[124:HEADER_BYTES])
    for name, array in _version_4(content, where) if order is None else _version_5(content, order, where):
        found[name] = array
        check_size((array.nbytes for array in found.values()), where)
    return found


def _damaged(where: str) -> DataError:
    return DataError("is no MATLAB file, or a damaged one", where=where, hint="write it again with save or savemat")


def _version_5(content: bytes, order: str, where: str) -> Iterator[tuple[str, np.ndarray]]:
    room = npz.LARGEST_BYTES
    for element in _elements(memoryview(content)[HEADER_BYTES:], order, where, padded=False):
        if element.kind == COMPRESSED:
            unpacked = _unpacked(element.data, room, where)
            room -= len(unpacked)
            (element,) = _elements(memoryview(unpacked), order, where)
        if element.kind != MATRIX:
            raise _damaged(where)
        yield _matrix(element.data, order, where)


def _unpacked(data: memoryview, room: int, where: str) -> bytes:
    """What was packed, as long as there is room for it."""
    stream = zlib.decompressobj()
    unpacked = stream.decompress(data, room)
    if stream.unconsumed_tail:
        check_size([npz.LARGEST_BYTES + 1], where)
    if not stream.eof:
        raise _damaged(where)
    return unpacked


def _elements(data: memoryview, order: str, where: str, *, padded: bool = True) -> Iterator[_Element]:
    """The elements of a stretch of bytes; those on the top of a file have no padding where they are packed."""
    while len(data):
        if len(data) < 8:
            raise _damaged(where)
        kind, size = struct.unpack_from(order + "II", data)
        if kind >> 16:
            # a short one: its size and up to 4 bytes of data share its 8 bytes
            kind, size = kind & 0xFFFF, kind >> 16
            start, end = 4, 8
            if size > 4:
                raise _damaged(where)
        else:
            start = 8
            end = start + size + (0 if kind == COMPRESSED and not padded else -size % 8)
        if start + size > len(data):
            raise _damaged(where)
        yield _Element(kind, data[start : start + size])
        data = data[end:]


def _matrix(data: memoryview, order: str, where: str) -> tuple[str, np.ndarray]:
    """Name and values of an array of numbers."""
    parts = list(_elements(data, order, where))
    if len(parts) < 3 or parts[0].kind != 6 or len(parts[0].data) < 8 or parts[1].kind != 5:
        raise _damaged(where)
    flags = struct.unpack_from(order + "I", parts[0].data)[0]
    name = bytes(parts[2].data).decode("latin-1")
    kind = NUMBERS.get(flags & 0xFF)
    if kind is None or flags & COMPLEX:
        shown = OTHERS.get(flags & 0xFF, "complex array" if kind else "thing of an unknown class")
        raise refused(name, shown, where)
    shape = tuple(np.frombuffer(parts[1].data, order + "i4").tolist())
    if not 2 <= len(shape) <= MOST_DIMENSIONS or min(shape) < 0 or len(parts) != 4 or parts[3].kind not in STORED:
        raise _damaged(where)
    values = np.frombuffer(parts[3].data, order + STORED[parts[3].kind])
    if math.prod(shape) != len(values):
        raise DataError(f"{name!r} of shape {shape} has {len(values)} numbers", where=where, hint="write it again")
    return name, values.astype("?" if flags & LOGICAL else kind).reshape(shape, order="F")


def refused(name: str, kind: str, where: str) -> DataError:
    """The error that something in a file is no full array of real numbers."""
    allowed, hint = "full numeric arrays", "save arrays, not structures"
    return DataError(f"{name!r} is a MATLAB {kind}", where=where, allowed=allowed, hint=hint)


def _kinds_4(content: memoryview, order: str) -> tuple[int, int] | None:
    """Storage and class of a version 4 matrix, None where the number that says so is none."""
    kinds = struct.unpack_from(order + "i", content)[0]
    machine, rest = divmod(kinds, 1000)
    if not 0 <= kinds < MOST_KINDS_4 or machine != (order == ">") or rest >= 10 * len(STORED_4) or rest % 10 > 2:
        return None
    return rest // 10, rest % 10


def _version_4(content: bytes, where: str) -> Iterator[tuple[str, np.ndarray]]:
    data = memoryview(content)
    while len(data):
        order = next((o for o in "<>" if len(data) >= 20 and _kinds_4(data, o) is not None), None)
        if order is None:
            raise _damaged(where)
        storage, kind = _kinds_4(data, order)
        rows, columns, has_imaginary, length = struct.unpack_from(order + "4i", data, 4)
        stored = np.dtype(order + STORED_4[storage])
        end = 20 + length + rows * columns * stored.itemsize
        if min(rows, columns, length) < 0 or end > len(data):
            raise _damaged(where)
        name = bytes(data[20 : 20 + length]).rstrip(b"\x00").decode("latin-1")
        if kind or has_imaginary:
            raise refused(name, ("complex array", "char", "sparse")[kind], where)
        values = np.frombuffer(data[20 + length : end], stored)
        yield name, values.astype(stored.newbyteorder("=")).reshape((rows, columns), order="F")
        data = data[end:]


SUFFIXES = (".npz", ".mat")
INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
MATLAB_NUMBERS = ("double", "single", "logical", *INTEGERS)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file by name, numbers only; MATLAB's come as MATLAB shows them, at least two-dimensional.

    Raises:
        DataError: The file is missing, damaged, too large, or holds something else than arrays of numbers.
    """
    path, where = Path(path), str(path)
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(f"has the suffix {path.suffix!r}", where=where, allowed=", ".join(SUFFIXES))
    try:
        size = path.stat().st_size if path.is_file() else None
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror or error})", where=where) from error
    if size is None:
        raise DataError("no such file", where=where, hint="check the path")
    check_size([size], where, "the file")
    if not size:
        raise DataError("is an empty file", where=where)
    if path.suffix.lower() == ".npz":
        return read_npz(path)
    return guarded(lambda: _read_matlab(path), path, "write it again")


def _read_matlab(path: Path) -> dict[str, np.ndarray]:
    """MATLAB's files: 7.3 is HDF5, what is older has a format of its own."""
    import h5py

    return _read_hdf5(path) if h5py.is_hdf5(path) else read_matlab(path.read_bytes(), str(path))


def _check_class(name: str, kind: str, where: str) -> None:
    if kind not in MATLAB_NUMBERS:
        raise refused(name, kind, where)


def _read_hdf5(path: Path) -> dict[str, np.ndarray]:
    """MATLAB 7.3: HDF5, with the axes of every array in reverse."""
    import h5py

    with h5py.File(path, "r") as file:
        links = {name: file.get(name, getlink=True) for name in file if not name.startswith("#")}
        outside = [name for name, link in links.items() if not isinstance(link, h5py.HardLink)]
        if outside:
            raise DataError(f"{outside[0]!r} is a link to another file or place", where=str(path))
        datasets = {name: file[name] for name in links}
        for name, dataset in datasets.items():
            _check_dataset(name, dataset, str(path))
        check_size((dataset.nbytes for dataset in datasets.values()), str(path))
        return {name: np.asarray(dataset[()]).T for name, dataset in datasets.items()}


def _check_dataset(name: str, dataset: Any, where: str) -> None:
    import h5py

    if not isinstance(dataset, h5py.Dataset):
        _check_class(name, "structure", where)
    if "MATLAB_class" not in dataset.attrs:
        raise DataError(
            f"{name!r} was not written by MATLAB, so the order of its axes is unknown",
            where=where,
            hint="write .npz from Python, or use scipy.io.savemat",
        )
    kind = dataset.attrs["MATLAB_class"]
    _check_class(name, kind.decode() if isinstance(kind, bytes) else str(kind), where)
    check_kind(dataset.dtype, name, where)
    if dataset.is_virtual or dataset.external:
        raise DataError(f"{name!r} keeps its data in another file", where=where)
