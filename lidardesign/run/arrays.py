"""Archives of numpy arrays and rows of CSV, read without running anything in them.

Archives take no more memory than they truly need. The header of every array is read first: objects (pickles) are
refused, and so is one that promises more data than it has. numpy itself would make room for the promise before it finds
that the data is missing.
"""

from __future__ import annotations

import csv
import io
import math
import warnings
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from lidardesign.errors import DataError, LidardesignError

NUMERIC_KINDS = "buif"
LARGEST_BYTES = 1 << 30
LARGEST_HEADER_BYTES = 10_000
Result = TypeVar("Result")


def read_npz(
    path: Path, *, kinds: str = NUMERIC_KINDS, hint: str = "write it with numpy.savez"
) -> dict[str, np.ndarray]:
    """All arrays of a file by name.

    Arguments:
        path: The file.
        kinds: Letters of the numpy kinds that it may hold.
        hint: What to do with a damaged file.

    Raises:
        DataError: The file cannot be read, is damaged or too large, or holds something else.
    """
    return guarded(lambda: _read(path, kinds, hint), path, hint)


def guarded(read: Callable[[], Result], path: Path, hint: str) -> Result:
    """What a reader of a file gives; whatever it raises on garbage becomes a `DataError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    except LidardesignError:
        raise
    # readers raise anything on garbage: OSError, struct.error, zlib.error, TypeError, IndexError, TokenError
    except Exception as error:
        reason = (str(error) or "no reason given").splitlines()[0]
        raise DataError(
            f"cannot be read as {path.suffix} ({type(error).__name__}: {reason})",
            where=str(path),
            hint=f"it may be damaged or cut short: {hint}",
        ) from error


def _read(path: Path, kinds: str, hint: str) -> dict[str, np.ndarray]:
    where = str(path)
    with path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            raise DataError("is no .npz file, or one cut short", where=where, hint=hint)
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            check_size((member.file_size for member in members), where)
            return {
                member.filename.removesuffix(".npy"): _array(archive, member, kinds, where, hint) for member in members
            }


def check_size(sizes: Iterable[int], where: str, what: str = "all data") -> None:
    """Refuse more bytes than any file of this program needs.

    Raises:
        DataError: They are more than 1 GiB together.
    """
    size = sum(sizes)
    if size > LARGEST_BYTES:
        raise DataError(
            f"{what} takes {size / 2**30:.1f} GiB",
            where=where,
            allowed=f"at most {LARGEST_BYTES / 2**30:g} GiB",
            hint="keep fewer bins, fewer pixels or a smaller type, as uint16",
        )


def check_kind(dtype: np.dtype, name: str, where: str, kinds: str = NUMERIC_KINDS) -> None:
    """Refuse what holds no plain values.

    Raises:
        DataError: An array of Python objects, or of another kind than those allowed.
    """
    if dtype.kind == "O":
        raise DataError(
            f"{name!r} holds Python objects", where=where, allowed="arrays of numbers: no file is unpickled"
        )
    if dtype.kind not in kinds:
        raise DataError(f"{name!r} is of type {dtype}", where=where, allowed="real numbers")


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, kinds: str, where: str, hint: str) -> np.ndarray:
    """One array, once its header is found to tell the truth about its data."""
    name = member.filename.removesuffix(".npy")
    if name == member.filename:
        raise DataError(f"holds {member.filename!r}, which is no array", where=where, allowed="arrays of numpy.savez")
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file, max_header_size=LARGEST_HEADER_BYTES)
        check_kind(dtype, name, where, kinds)
        data = member.file_size - file.tell()
        if math.prod(shape) * dtype.itemsize != data:
            raise DataError(f"{name!r} of shape {shape} has {data} bytes of data", where=where, hint=hint)
    # the size that the archive states is no more than a promise either: reading stops where the data does
    return np.load(io.BytesIO(archive.read(member)), allow_pickle=False, max_header_size=LARGEST_HEADER_BYTES)


def csv_rows(path: Path, largest_bytes: int) -> list[tuple[int, list[str]]]:
    """The line and the cells of every row that is not blank, the header first.

    Raises:
        DataError: The file cannot be read, is larger than that, is no UTF-8 text, or no CSV.
    """
    try:
        size = path.stat().st_size
        if size > largest_bytes:
            raise DataError(f"has {size} bytes", where=str(path), allowed=f"at most {largest_bytes}")
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", where=str(path)) from None
    except UnicodeDecodeError:
        raise DataError("is not UTF-8 text", where=str(path)) from None
    # `splitlines` would also part names at the line ends of other scripts
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        return [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except csv.Error as error:
        raise DataError(f"is no CSV: {error}", where=f"{path}:{reader.line_num}") from None
