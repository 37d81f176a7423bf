"""Files that are either whole or absent: atomic writes and content hashes."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
from pathlib import Path

from lidardesign.errors import DataError

TEMPORARY_SUFFIX = ".tmp"
CHUNK_BYTES = 1 << 20


def write_atomic(path: Path, content: bytes | str) -> None:
    """Write a file so that a reader, or a crash at any time, finds the old content or the new one.

    The content goes to a temporary file in the same folder, is flushed to the disk, and takes the name by a
    rename. A pipe or a device (as /dev/stdout) is written straight.

    Arguments:
        path: The file; missing folders are made.
        content: Bytes, or text that is encoded as UTF-8.

    Raises:
        DataError: The disk is full, the folder is read-only, or anything else the system reports.
    """
    path = Path(path)
    payload = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise DataError("is a folder", where=str(path), hint="give the name of a file")
        if path.exists() and not path.is_file():
            path.write_bytes(payload)
        else:
            _replace(path, payload)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(
            f"cannot be written: {reason}", where=str(path), hint="check the folder and the space left"
        ) from error


def _replace(path: Path, payload: bytes) -> None:
    temporary = path.with_name(f".{path.name[:100]}.{os.getpid()}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")
    try:
        with temporary.open("xb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable, where the system can open folders."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_stray_temporaries(folder: Path) -> list[Path]:
    """Remove temporary files that a killed process left in a folder; returns what was removed.

    Call it only while no other process writes there (the run's lock is held).
    """
    removed = []
    for stray in sorted(Path(folder).glob(f".*{TEMPORARY_SUFFIX}")):
        with contextlib.suppress(OSError):
            stray.unlink()
            removed.append(stray)
    return removed


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's content as 64 hexadecimal digits.

    Raises:
        DataError: The file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with Path(path).open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                digest.update(chunk)
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", where=str(path)) from error
    return digest.hexdigest()
