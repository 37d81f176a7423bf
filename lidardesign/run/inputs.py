"""Limits of input files: one table of their sizes, and one way to open them.

Only regular files are opened: a pipe, a device or a socket could block or never end. Sizes are checked before
memory is taken.
"""

from __future__ import annotations

import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidardesign.errors import ConfigError, DataError

HEAD_BYTES = 4096
FILE_HINT = "give a file"
POINTER = b"version https://git-lfs.github.com/spec/"
# In a folder whose files are only partly those of a new set: their names, one a line.
UNFINISHED = "lidardesign-unfinished.txt"


@dataclass(frozen=True)
class Kind:
    """A kind of input file.

    Arguments:
        name: Its name for people.
        most_bytes: Largest size of the file.
        unpacked_bytes: Largest size of its content when unpacked; None: nothing is packed.
        error: Exception class for a file that cannot be used.
    """

    name: str
    most_bytes: int
    unpacked_bytes: int | None = None
    error: type[ConfigError | DataError] = DataError


YAML = Kind("configurations, constraints, detectors, parts: YAML", 1_000_000, error=ConfigError)
DESIGN = Kind("designs: YAML", 64_000_000, error=ConfigError)
XML = Kind("robots, rigs: MJCF, URDF, SDF", 16_000_000)
ROBOT_FILES = Kind("all files of a robot together", 512_000_000)
TABLE = Kind("poses, joint positions: CSV", 64_000_000)
RAY_TABLE = Kind("rays, sensors: CSV", 128_000_000)
ARRAYS = Kind("rays, joint positions: NPZ", 256_000_000, 256_000_000)
# Ten million samples, the most that a run may have, take 640 MB.
SAMPLES = Kind("samples of a run: NPZ", 1_000_000_000, 1_000_000_000)
CAPTURE = Kind("captures: NPZ, MAT", 512_000_000, 512_000_000)
MESH = Kind("meshes: GLB, glTF and its buffers, OBJ, OFF, PLY, STL", 512_000_000)
HEAD_MODEL = Kind("head models: HDF5", 1 << 30, 512_000_000)
STATE = Kind("checkpoints: safetensors", 1 << 30)
RECORD = Kind("manifests, progress: JSON", 64_000_000)
KINDS = (YAML, DESIGN, XML, ROBOT_FILES, TABLE, RAY_TABLE, ARRAYS, SAMPLES, CAPTURE, MESH, HEAD_MODEL, STATE, RECORD)
# Of rows of any table, the header included, and of its columns.
MOST_ROWS, MOST_COLUMNS = 1_000_001, 2_000


def size_text(size: float) -> str:
    """A number of bytes for people, as 64 MB."""
    unit = next((unit for unit in ((1e9, "GB"), (1e6, "MB")) if size >= unit[0]), (1, "bytes"))
    return f"{size / unit[0]:.4g} {unit[1]}"


def check_file(path: Path | str, kind: Kind, *, allowed: str | None = None, hint: str | None = None) -> int:
    """The size of a file [bytes], checked to be a regular file within its kind's limit.

    Raises:
        DataError, ConfigError: By the kind: it is missing, no regular file, too large, or of an unfinished set.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise kind.error(f"cannot be read: {reason}", where=str(path), allowed=allowed, hint=hint) from None
    if stat.S_ISDIR(status.st_mode):
        raise kind.error("cannot be read: it is a folder", where=str(path), allowed=allowed or "a file", hint=hint)
    if not stat.S_ISREG(status.st_mode):
        raise kind.error("is not a regular file", where=str(path), allowed=allowed, hint=hint or FILE_HINT)
    check_bytes(status.st_size, kind, str(path))
    if os.path.basename(path) in unfinished_names(Path(path).parent):
        raise kind.error(
            f"is of a set that is unfinished: only some of the files in {UNFINISHED} were replaced",
            where=str(path),
            hint="write them again",
        )
    return status.st_size


def unfinished_names(folder: Path) -> list[str]:
    """The names of the files of a set in a folder that was left unfinished; none where all are whole."""
    marker = folder / UNFINISHED
    return marker.read_text(encoding="utf-8", errors="replace").splitlines() if marker.is_file() else []


def check_bytes(size: int, kind: Kind, where: str, *, unpacked: bool = False) -> None:
    """Refuse more bytes than a kind of file may have.

    Raises:
        DataError, ConfigError: By the kind.
    """
    most = (kind.unpacked_bytes or 0) if unpacked else kind.most_bytes
    if size > most:
        what = "its unpacked data take" if unpacked else "the file is too large:"
        raise kind.error(f"{what} {size_text(size)}", where=where, allowed=f"at most {size_text(most)} ({kind.name})")


def read_file(path: Path | str, kind: Kind, *, allowed: str | None = None, hint: str | None = None) -> bytes:
    """All bytes of a file.

    Raises:
        DataError, ConfigError: As of `check_file`, or it cannot be read.
    """
    content = _read(path, kind, kind.most_bytes + 1, allowed, hint)
    check_bytes(len(content), kind, str(path))
    if content.startswith(POINTER):
        raise kind.error("is a pointer of Git LFS, not the file itself", where=str(path), hint="git lfs pull")
    return content


def read_head(path: Path | str, kind: Kind, *, hint: str | None = None) -> bytes:
    """The first bytes of a file, by which its format is recognised.

    Raises:
        DataError, ConfigError: As of `read_file`.
    """
    return _read(path, kind, HEAD_BYTES, None, hint)


def _read(path: Path | str, kind: Kind, most_bytes: int, allowed: str | None, hint: str | None) -> bytes:
    check_file(path, kind, allowed=allowed, hint=hint)
    try:
        with open(path, "rb") as file:
            return file.read(most_bytes)
    except OSError as error:
        raise kind.error(
            f"cannot be read: {error.strerror or error}", where=str(path), allowed=allowed, hint=hint
        ) from None


def parse_json(content: bytes | str) -> Any:
    """A JSON document.

    Raises:
        ValueError: It is none, is no UTF-8, or is nested so deep that it cannot be read.
    """
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("nested too deep") from None
