"""The rows of a CSV file that somebody else wrote, with their lines."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from lidardesign.errors import DataError


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
