"""One writer per run folder: a lock of the operating system, which frees it however its process ends.

The lock file names who holds it; it is there for as long as it is held.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from lidardesign.errors import ConfigError, DataError
from lidardesign.run.files import is_gone, remove_stray_temporaries

FILE_NAME = ".lock"


@contextlib.contextmanager
def run_lock(run: Path, *, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a run folder's lock; what is left of a lock whose process was killed is no obstacle.

    Temporary files that a killed writer left in the folder are removed once the lock is held.

    Arguments:
        run: The run folder.
        wait_s: How long to wait for another writer: commands that write one file hold the lock for an instant.

    Raises:
        ConfigError: Another process writes this run.
        DataError: The folder cannot be written.
    """
    from filelock import FileLock, Timeout

    path = Path(run) / FILE_NAME
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
        # while it is held: whoever has opened the file meanwhile finds that it is no longer there
        with contextlib.suppress(OSError):
            path.unlink()
        lock.release()


def writer(run: Path) -> str | None:
    """Who is writing a run at this moment; None where nobody is, or only a dead process's lock file is left."""
    try:
        holder = json.loads((Path(run) / FILE_NAME).read_bytes())
        pid, host = int(holder["pid"]), str(holder["host"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError):
        return "another process"
    return None if host == socket.gethostname() and is_gone(pid) else f"process {pid} on {host}"
