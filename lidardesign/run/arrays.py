"""Archives of numpy arrays and rows of CSV, read without running anything in them; and CSV as it is written.

The header of every array is read first: objects (pickles) are refused, and so is an array with less data than its shape
needs, for which numpy would allocate memory before it finds the data missing.
"""

from __future__ import annotations

import csv
import io
import math
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from lidardesign.errors import DataError, LidardesignError
from lidardesign.run.inputs import ARRAYS, MOST_COLUMNS, MOST_ROWS, Kind, check_bytes, check_file, read_file

NUMERIC_KINDS = "buif"
LARGEST_HEADER_BYTES = 10_000
# Marks at the end of an archive, and the largest size of its list of arrays.
END_MARK, END_MARK_64 = b"PK\5\6", b"PK\6\7"
END_BYTES, LARGEST_LIST_BYTES = 1 << 16, 1_000_000
Result = TypeVar("Result")


def read_npz(
    path: Path, kind: Kind = ARRAYS, *, kinds: str = NUMERIC_KINDS, hint: str = "write it with numpy.savez"
) -> dict[str, np.ndarray]:
    """All arrays of a file by name.

    Arguments:
        path: The file.
        kind: The kind of file, which limits its size.
        kinds: Letters of the numpy kinds that it may hold.
        hint: The remedy for a damaged file.

    Raises:
        DataError: The file cannot be read, is damaged or too large, or holds something else.
    """
    check_file(path, kind)
    return guarded(lambda: _read(path, kind, kinds, hint), path, hint)


def guarded(read: Callable[[], Result], path: Path, hint: str) -> Result:
    """The result of a reader of a file; any exception it raises becomes a `DataError`."""
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


def _read(path: Path, kind: Kind, kinds: str, hint: str) -> dict[str, np.ndarray]:
    where = str(path)
    with path.open("rb") as file:
        _check_list(file, where, hint)
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            check_bytes(sum(member.file_size for member in members), kind, where, unpacked=True)
            return {
                member.filename.removesuffix(".npy"): _array(archive, member, kinds, where, hint) for member in members
            }


def _check_list(file: BinaryIO, where: str, hint: str) -> None:
    """Refuse a file that is no archive, or whose list of arrays is too large.

    Raises:
        DataError: It is no archive, or lists too many arrays.
    """
    if not zipfile.is_zipfile(file):
        raise DataError("is not an .npz file, or is cut short", where=where, hint=hint)
    file.seek(-min(file.seek(0, io.SEEK_END), END_BYTES), io.SEEK_END)
    end = file.read()
    size = int.from_bytes(end[end.rfind(END_MARK) + 12 :][:4], "little")
    if size > LARGEST_LIST_BYTES or END_MARK_64 in end:
        raise DataError("lists too many arrays", where=where, allowed="a few thousand arrays", hint=hint)


def check_kind(dtype: np.dtype, name: str, where: str, kinds: str = NUMERIC_KINDS) -> None:
    """Refuse an array type that holds no plain values.

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
    """An array of an archive, whose header was checked against the size of its data."""
    name = member.filename.removesuffix(".npy")
    if name == member.filename:
        raise DataError(
            f"holds {member.filename!r}, which is not an array", where=where, allowed="arrays of numpy.savez"
        )
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file, max_header_size=LARGEST_HEADER_BYTES)
        check_kind(dtype, name, where, kinds)
        data = member.file_size - file.tell()
        if math.prod(shape) * dtype.itemsize != data:
            raise DataError(f"{name!r} of shape {shape} has {data} bytes of data", where=where, hint=hint)
    # the archive may overstate its size, too: memory grows with the data read
    with archive.open(member) as file:
        array = np.lib.format.read_array(file, allow_pickle=False, max_header_size=LARGEST_HEADER_BYTES)
    if array.dtype.kind == "U":
        letters = np.frombuffer(array.tobytes(), dtype=f"{array.dtype.byteorder}u4")
        if (letters > sys.maxunicode).any():
            raise DataError(f"{name!r} holds letters that do not exist", where=where, hint=hint)
    return array


def csv_rows(path: Path, kind: Kind) -> list[tuple[int, list[str]]]:
    """The line and the cells of every row that is not blank, the header first.

    Raises:
        DataError: The file cannot be read, has more bytes, rows or columns than it may, is no UTF-8 text, or no CSV.
    """
    # `splitlines` would also part names at the line ends of other scripts
    text = io.TextIOWrapper(io.BytesIO(read_file(path, kind)), encoding="utf-8-sig", newline="")
    reader = csv.reader(text, strict=True)
    rows: list[tuple[int, list[str]]] = []
    try:
        for number, cells in enumerate(reader):  # rows of nothing count too: they take as long to read
            if len(cells) > MOST_COLUMNS or number == MOST_ROWS:
                found = f"has {len(cells)} columns" if len(cells) > MOST_COLUMNS else f"has more than {MOST_ROWS} rows"
                allowed = f"at most {MOST_COLUMNS} columns and {MOST_ROWS} rows, the header included"
                raise DataError(found, where=f"{path}:{reader.line_num}", allowed=allowed)
            if any(cell.strip() for cell in cells):
                rows.append((reader.line_num, cells))
    except UnicodeDecodeError:
        raise DataError("is not UTF-8 text", where=str(path)) from None
    except csv.Error as error:
        raise DataError(f"is not CSV: {error}", where=f"{path}:{reader.line_num}") from None
    return rows


def csv_table(rows: Iterable[Iterable[object]]) -> str:
    """The text of a CSV file of rows of cells, the header first."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
