"""One writer per run folder: a lock file that names its process."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lidardesign.errors import ConfigError, DataError
from lidardesign.run.files import is_gone, remove_stray_temporaries, started, temporary_beside

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

FILE_NAME = ".lock"
RETRY_S = 0.05


@contextlib.contextmanager
def run_lock(run: Path, *, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a run folder's lock; a lock that a dead process left is taken over.

    Temporary files that a killed writer left in the folder are removed once the lock is held.

    Arguments:
        run: The run folder.
        wait_s: How long to wait for another writer: commands that write one file hold the lock for an instant.

    Raises:
        ConfigError: Another living process writes this run.
        DataError: The folder cannot be written.
    """
    path = Path(run) / FILE_NAME
    owner = _owner()
    try:
        _acquire(path, owner, time.monotonic() + wait_s)
    except OSError as error:
        raise DataError(f"cannot be locked: {error.strerror or error}", where=str(path)) from error
    try:
        remove_stray_temporaries(Path(run))
        yield
    finally:
        if _read(path) == owner:
            with contextlib.suppress(OSError):
                path.unlink()


def writer(run: Path) -> str | None:
    """Who is writing a run at this moment; None where nobody is, or only a dead process's lock is left."""
    path = Path(run) / FILE_NAME
    if not path.exists():
        return None
    holder = _read(path)
    return None if _is_stale(holder) or not path.exists() else _name(holder)


def _acquire(path: Path, owner: dict[str, Any], deadline: float) -> None:
    while not _create(path, owner):
        holder = _read(path)
        if holder is None and not path.exists():
            continue  # it was released meanwhile
        if _is_stale(holder):
            _take_away(path)
        elif time.monotonic() < deadline:
            time.sleep(RETRY_S)
        else:
            raise _locked(path, holder)


def _create(path: Path, owner: dict[str, Any]) -> bool:
    """Make the lock with its owner's name in it, in one step: a kill leaves no lock that names nobody.

    Returns:
        False where there is one already.
    """
    temporary = temporary_beside(path)
    try:
        with temporary.open("x", encoding="utf-8") as file:
            json.dump(owner, file)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError:  # a file system without hard links
            return _create_plainly(path, owner)
    finally:
        temporary.unlink(missing_ok=True)
    return True


def _create_plainly(path: Path, owner: dict[str, Any]) -> bool:
    try:
        with path.open("x", encoding="utf-8") as file:
            json.dump(owner, file)
    except FileExistsError:
        return False
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return True


def _take_away(path: Path) -> None:
    """Remove a stale lock; of several processes that found it, only one, and never the lock of the next owner."""
    with contextlib.suppress(FileNotFoundError), path.open("r+b") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.path.samestat(os.fstat(file.fileno()), path.stat()) and _is_stale(_parsed(file.read())):
            path.unlink()


def _locked(path: Path, holder: dict[str, Any] | None) -> ConfigError:
    return ConfigError(
        f"{_name(holder)} is writing this run",
        where=str(path.parent),
        hint=f"wait for it, or use another --out; if it is gone, remove {path}",
    )


def _name(holder: dict[str, Any] | None) -> str:
    return f"process {holder.get('pid')} on {holder.get('host')}" if holder else "another process"


def _owner() -> dict[str, Any]:
    return {"pid": os.getpid(), "host": socket.gethostname(), "started": started(os.getpid())}


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return _parsed(path.read_bytes())
    except OSError:
        return None


def _parsed(content: bytes) -> dict[str, Any] | None:
    try:
        holder = json.loads(content)
    except ValueError:
        return None
    return holder if isinstance(holder, dict) else None


def _is_stale(holder: dict[str, Any] | None) -> bool:
    """Whether a lock's process is known to be gone; one on another computer never is."""
    if holder is None or holder.get("host") != socket.gethostname():
        return False
    pid = holder.get("pid")
    if not isinstance(pid, int) or pid <= 0:
        return False
    return is_gone(pid) or holder.get("started") != started(pid)
