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
from lidardesign.run.files import remove_stray_temporaries

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


def _acquire(path: Path, owner: dict[str, Any], deadline: float) -> None:
    while True:
        try:
            with path.open("x", encoding="utf-8") as file:
                json.dump(owner, file)
            return
        except FileExistsError:
            holder = _read(path)
            if _is_stale(holder):
                if _read(path) == holder:  # nobody else has taken it over meanwhile
                    path.unlink(missing_ok=True)
            elif time.monotonic() < deadline:
                time.sleep(RETRY_S)
            else:
                raise _locked(path, holder) from None


def _locked(path: Path, holder: dict[str, Any] | None) -> ConfigError:
    who = f"process {holder.get('pid')} on {holder.get('host')}" if holder else "another process"
    return ConfigError(
        f"{who} is writing this run",
        where=str(path.parent),
        hint=f"wait for it, or use another --out; if it is gone, remove {path}",
    )


def _owner() -> dict[str, Any]:
    return {"pid": os.getpid(), "host": socket.gethostname(), "started": _started(os.getpid())}


def _started(pid: int) -> str | None:
    """When a process started, in the kernel's ticks, so that a reused process id is told apart (Linux)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _read(path: Path) -> dict[str, Any] | None:
    try:
        holder = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return holder if isinstance(holder, dict) else None


def _is_stale(holder: dict[str, Any] | None) -> bool:
    """Whether a lock's process is known to be gone; one on another computer never is."""
    if holder is None or holder.get("host") != socket.gethostname():
        return False
    pid = holder.get("pid")
    if not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return holder.get("started") != _started(pid)
