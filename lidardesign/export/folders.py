"""Formats of several files: a folder whose files are each whole or absent."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from lidardesign.errors import DataError
from lidardesign.run.files import write_atomic

# So many names of other files are told, the rest is counted.
MOST_NAMED = 5


def write_folder(path: Path, files: Mapping[str, bytes]) -> list[str]:
    """Write a folder of files, each atomically; returns a note where it also holds others, as of an earlier export.

    Raises:
        DataError: There is a file of that name, or the system reports anything else.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise DataError(
            "is a file, and this format is a folder of files", where=str(path), hint="give the name of a folder"
        )
    for name, content in files.items():
        write_atomic(path / name, content)
    others = sorted(entry.name for entry in path.iterdir() if entry.name not in files and entry.name[0] != ".")
    if not others:
        return []
    named = ", ".join(others[:MOST_NAMED]) + (", ..." if len(others) > MOST_NAMED else "")
    return [f"the folder also holds {len(others)} other files, which stay as they are: {named}"]
