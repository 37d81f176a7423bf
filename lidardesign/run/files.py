"""Files that are either whole or absent, and folders that are the old or the new one, or name what is unfinished.

What is temporary names its process, and is removed once that process is gone.

One writer per run folder: a lock of the operating system, which frees it however its process ends.

The lock file names who holds it; it is there for as long as it is held.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import glob
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lidardesign.errors import ConfigError, DataError
from lidardesign.run.clock import WAIT_S
from lidardesign.run.inputs import RECORD, STATE, UNFINISHED, check_file, parse_json, read_file, unfinished_names

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
            try:
                _write_new(temporary, payload)
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


def _write_new(path: Path, payload: bytes) -> None:
    """Write a file that is not there yet, to the disk."""
    with path.open("xb") as file:
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())


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
    """A unique temporary path beside a path, named after its computer and process.

    What processes of this computer that were killed left of the same kind is removed.
    """
    beginning = f".{os.fsdecode(os.fsencode(path.name)[:NAME_BYTES])}.{host_mark()}-"
    remove_strays(path.parent.glob(f"{glob.escape(beginning)}*{TEMPORARY_SUFFIX}"))
    return path.with_name(f"{beginning}{os.getpid()}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it."""
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)


# Most names in a note; the rest is counted.
MOST_NAMED = 6
# Of the system call renameat2: paths as they are, and both of them exchanged.
_FROM_HERE, _EXCHANGE = -100, 2


def write_folder(path: Path, files: Mapping[str, bytes]) -> list[str]:
    """Write a set of files as a folder, of which a reader, or a kill at any time, finds the old or the new one.

    They are written to a folder beside it, which takes its place in one step. A folder that also holds other files, or
    is a mount point or the working folder, stays: its files are replaced one by one while `UNFINISHED` names them.

    Arguments:
        path: The folder; missing folders are made.
        files: Content by name; names of files in subfolders have forward slashes.

    Returns:
        A note if it holds other files, as of an earlier export; they stay.

    Raises:
        DataError: A file has that name, the folder cannot be written, or another process is writing it.
    """
    place = Path(os.path.realpath(path))
    try:
        entries = list(os.scandir(place)) if place.exists() else []
        whole = not place.exists() or (
            all(entry.name in files and entry.is_file(follow_symlinks=False) for entry in entries)
            and os.access(place.parent, os.W_OK)
            and not is_held(place)
        )
        folder = temporary_beside(place)
        if not whole:
            folder = temporary_beside(place / UNFINISHED)
        try:
            for name, content in files.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                _write_new(folder / name, content)
            if not (whole and _takes_place(folder, place)):
                _move_files(folder, place, files)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise _unwritten(path, error) from error
    tops = {UNFINISHED, *(Path(name).parts[0] for name in files)}
    others = sorted(entry.name for entry in entries if entry.name not in tops and entry.name[0] != ".")
    note = f"the folder also holds {len(others)} other files, which stay as they are: {named(others)}"
    return [note] if others else []


def named(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if names[MOST_NAMED:] else "")


def is_held(folder: Path) -> bool:
    """True for a mount point, and where this process works inside a folder: another one cannot take its place."""
    return os.path.ismount(folder) or Path.cwd().is_relative_to(os.path.realpath(folder))


def _takes_place(folder: Path, place: Path) -> bool:
    """Put a folder in place of one with some of its files; False where that has to stay."""
    if not place.exists():
        os.rename(folder, place)
        return True
    names, old, new = {*os.listdir(folder)}, place.stat(), folder.stat()
    # whose it is, and who may read it, stays
    alike = (old.st_uid, old.st_gid, old.st_mode) == (new.st_uid, new.st_gid, new.st_mode)
    if not (alike and exchange(folder, place)):
        return False
    for name in {*os.listdir(folder)} - names:  # it came meanwhile
        os.rename(folder / name, place / name)
    return True


def exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; False where the system, or the file system, cannot."""
    call = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    return call is not None and not call(_FROM_HERE, os.fsencode(one), _FROM_HERE, os.fsencode(other), _EXCHANGE)


def _move_files(folder: Path, place: Path, names: Collection[str]) -> None:
    """Move files from one folder to another; a file that lists them is there, and locked, until all of them are."""
    from filelock import FileLock

    marker = place / UNFINISHED
    if in_the_way := [name for name in names if (place / name).is_dir()]:
        raise DataError(f"{named(in_the_way)}: is a folder", where=str(place), hint="move it, or give another place")
    with FileLock(marker, timeout=WAIT_S):
        left = [name for name in unfinished_names(place) if name not in names]
        marker.write_text("\n".join([*names, *left]), encoding="utf-8")
        for name in names:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / name, os.path.realpath(place / name))
        # removed while locked, so that a process that opened it meanwhile finds it gone
        marker.write_text("\n".join(left), encoding="utf-8") if left else marker.unlink()


def is_temporary(name: str) -> bool:
    """True for the name of a writer's temporary file."""
    return _TEMPORARY.fullmatch(name) is not None


def remove_strays(paths: Iterable[Path]) -> None:
    """Remove what is temporary among some paths, unless it is of a process of this computer that still runs.

    That of other computers is removed too: where they may be at work, leave it out.
    """
    for path in paths:
        found = _TEMPORARY.fullmatch(path.name)
        if found and (found["host"] != host_mark() or is_gone(int(found["pid"]))):
            with contextlib.suppress(OSError):
                remove(path)


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
        remove_strays([*path.parent.glob(f".*{TEMPORARY_SUFFIX}"), *path.parent.glob(f"*/.*{TEMPORARY_SUFFIX}")])
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
