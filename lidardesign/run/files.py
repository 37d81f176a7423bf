"""Files that are either whole or absent: atomic writes and content hashes."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
from pathlib import Path

from lidardesign.errors import DataError
from lidardesign.run.processes import host_mark, is_gone

TEMPORARY_SUFFIX = ".tmp"
CHUNK_BYTES = 1 << 20
# Of a temporary file's name, which file systems limit to 255 bytes.
NAME_BYTES = 100
# .NAME.HOST-PROCESS.RANDOM.tmp
_TEMPORARY = re.compile(r"\..+\.(?:(?P<host>[0-9a-f]+)-)?(?P<pid>\d+)\.[0-9a-f]+\.tmp", re.DOTALL)


def write_atomic(path: Path, content: bytes | str) -> None:
    """Write a file so that a reader, or a crash at any time, finds the old content or the new one.

    The content goes to a temporary file in the same folder, is flushed to the disk, and takes the name by a
    rename. What killed writers of the same file left is removed. A pipe or a device (as /dev/stdout) is written
    straight.

    Arguments:
        path: The file; missing folders are made.
        content: Bytes, or text that is encoded as UTF-8.

    Raises:
        DataError: The disk is full, the folder is read-only, or anything else the system reports.
    """
    path = Path(path)
    # names of files may be no UTF-8; they are shown escaped then
    payload = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise DataError("is a folder", where=str(path), hint="give the name of a file")
        if path.exists() and not path.is_file():
            path.write_bytes(payload)
        else:
            _replace(path, payload)
    except OSError as error:
        raise _unwritten(path, error) from error


def append_line(path: Path, line: str) -> None:
    """Add a line to a file that grows; a kill leaves at most the last one cut.

    Raises:
        DataError: As of `write_atomic`.
    """
    try:
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
    except OSError as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: OSError) -> DataError:
    reason = error.strerror or str(error)
    return DataError(f"cannot be written: {reason}", where=str(path), hint="check the folder and the space left")


def temporary_beside(path: Path) -> Path:
    """A name in the folder of a file that no other writer uses and that tells whose it is."""
    name = os.fsdecode(os.fsencode(path.name)[:NAME_BYTES])
    return path.with_name(f".{name}.{host_mark()}-{os.getpid()}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")


def _replace(path: Path, payload: bytes) -> None:
    temporary = temporary_beside(path)
    _remove_abandoned(temporary)
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


def _remove_abandoned(temporary: Path) -> None:
    """Remove the temporary files of the same target that processes of this computer left when they were killed."""
    beginning = temporary.name.rsplit("-", 1)[0]
    for name in os.listdir(temporary.parent):
        found = _TEMPORARY.fullmatch(name) if name.startswith(beginning) else None
        if found and is_gone(int(found["pid"])):
            with contextlib.suppress(OSError):
                temporary.with_name(name).unlink()


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable, where the system can open folders."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def is_temporary(name: str) -> bool:
    """Whether a file of this name is one that a writer makes before the file itself."""
    return _TEMPORARY.fullmatch(name) is not None


def remove_stray_temporaries(folder: Path) -> list[Path]:
    """Remove temporary files that killed processes left in a folder and its subfolders; returns what was removed.

    Call it only while no other computer writes there (the run's lock is held).
    """
    removed = []
    for stray in sorted([*Path(folder).glob(f".*{TEMPORARY_SUFFIX}"), *Path(folder).glob(f"*/.*{TEMPORARY_SUFFIX}")]):
        found = _TEMPORARY.fullmatch(stray.name)
        at_work = found and found["host"] == host_mark() and not is_gone(int(found["pid"]))
        if found and not at_work:
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
