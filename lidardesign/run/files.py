"""Files that are either whole or absent.

A temporary file names its process, and is removed once that process is gone.

One writer per run folder: a lock of the operating system, which frees it however its process ends.

The lock file names who holds it; it is there for as long as it is held.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

from lidardesign.errors import ConfigError, DataError
from lidardesign.run.inputs import RECORD, STATE, check_file, parse_json, read_file

HOST_DIGITS = 8


def is_gone(pid: int) -> bool:
    """True where no process of this computer has an id; False where that cannot be found out."""
    if os.name != "posix":  # elsewhere the question ends the process
        return False
    try:
        os.kill(pid, 0)
    except OSError as error:
        return isinstance(error, ProcessLookupError)
    except OverflowError:
        return True
    return False


@functools.cache
def host_mark() -> str:
    """A short name of this computer that fits into any file name."""
    return hashlib.sha256(socket.gethostname().encode(errors="surrogateescape")).hexdigest()[:HOST_DIGITS]


TEMPORARY_SUFFIX = ".tmp"
# Of a temporary file's name, which file systems limit to 255 bytes.
NAME_BYTES = 100
# .NAME.HOST-PROCESS.RANDOM.tmp
_TEMPORARY = re.compile(r"\..+\.(?:(?P<host>[0-9a-f]+)-)?(?P<pid>\d+)\.[0-9a-f]+\.tmp", re.DOTALL)


def write_atomic(path: Path, content: bytes | str) -> None:
    """Write a file so that a reader, or a crash at any time, finds the old content or the new one.

    The content goes to a temporary file in the same folder, is flushed to the disk, and takes the name by a
    rename. Leftovers of killed writers of the same file are removed. A pipe or a device (as /dev/stdout) is written
    straight.

    Arguments:
        path: The file; missing folders are made.
        content: Bytes, or text that is encoded as UTF-8.

    Raises:
        DataError: The disk is full, the folder is read-only, or anything else the system reports.
        BrokenPipeError: The reader of a pipe ended.
    """
    path = Path(path)
    if path.is_symlink() and (path.is_file() or not path.exists()):
        path = Path(os.path.realpath(path))  # a rename would replace the link
    # names of files may be no UTF-8; they are shown escaped then
    payload = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise DataError("is a folder", where=str(path), hint="give the name of a file")
        if path.exists() and not path.is_file():
            _write_straight(path, payload)
        else:
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
            # Make the rename itself durable, where the system can open folders
            with contextlib.suppress(OSError):
                descriptor = os.open(path.parent, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise _unwritten(path, error) from error


def _write_straight(path: Path, payload: bytes) -> None:
    """Write to a pipe or a device; a pipe without a reader is an error, not waited for."""
    descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    os.set_blocking(descriptor, True)
    with open(descriptor, "wb") as file:
        file.write(payload)


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
    return DataError(
        f"cannot be written: {error.strerror or error}", where=str(path), hint="check the folder and the space left"
    )


def temporary_beside(path: Path) -> Path:
    """A unique temporary path beside a file, named after its computer and process."""
    name = os.fsdecode(os.fsencode(path.name)[:NAME_BYTES])
    return path.with_name(f".{name}.{host_mark()}-{os.getpid()}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")


def _remove_abandoned(temporary: Path) -> None:
    """Remove the temporary files of the same target that processes of this computer left when they were killed."""
    beginning = temporary.name.rsplit("-", 1)[0]
    for name in os.listdir(temporary.parent):
        found = _TEMPORARY.fullmatch(name) if name.startswith(beginning) else None
        if found and is_gone(int(found["pid"])):
            with contextlib.suppress(OSError):
                temporary.with_name(name).unlink()


def is_temporary(name: str) -> bool:
    """True for the name of a writer's temporary file."""
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
    check_file(path, STATE)
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", where=str(path)) from error


FILE_NAME = ".lock"


def check_lock(run: Path) -> None:
    """Refuse a lock that is no regular file: opening a link would truncate its target.

    Raises:
        DataError: A folder, a link, a pipe or a device stands where the lock would be.
    """
    path = Path(run) / FILE_NAME
    if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
        raise DataError("is not a regular file, as a lock must be", where=str(path), hint="remove it")


@contextlib.contextmanager
def run_lock(run: Path, *, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a run folder's lock; the file of a killed process does not block it.

    Temporary files that a killed writer left in the folder are removed once the lock is held.

    Arguments:
        run: The run folder.
        wait_s: Time to wait for another writer [s]; commands that write one file hold the lock for an instant.

    Raises:
        ConfigError: Another process writes this run.
        DataError: The folder cannot be written.
    """
    from filelock import FileLock, Timeout

    path = Path(run) / FILE_NAME
    check_lock(run)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=wait_s)
    except Timeout:
        raise ConfigError(
            f"{writer(run) or 'another process'} is writing this run",
            where=str(run),
            hint="wait for it, or use another --out",
        ) from None
    except OSError as error:
        raise DataError(f"cannot be locked: {error.strerror or error}", where=str(path)) from error
    try:
        with contextlib.suppress(OSError):  # a lock without a name holds as well
            path.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}), encoding="utf-8")
        remove_stray_temporaries(Path(run))
        yield
    finally:
        # removed while held, so that a process that opened it meanwhile finds it gone
        with contextlib.suppress(OSError):
            path.unlink()
        lock.release()


def writer(run: Path) -> str | None:
    """The process that holds a run's lock, in words; None where there is none, or it is dead."""
    if not os.path.lexists(Path(run) / FILE_NAME):
        return None
    try:
        holder = parse_json(read_file(Path(run) / FILE_NAME, RECORD))
        pid, host = int(holder["pid"]), str(holder["host"])
    except (DataError, ValueError, TypeError, KeyError):
        return "another process"
    return None if host == socket.gethostname() and is_gone(pid) else f"process {pid} on {host}"
