"""Which processes are still there: who left a lock or a temporary file behind is told from who is at work."""

from __future__ import annotations

import functools
import hashlib
import os
import socket
from pathlib import Path

HOST_DIGITS = 8


def started(pid: int) -> str | None:
    """When a process started, in the kernel's ticks, so that a reused process id is told apart (Linux)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def is_gone(pid: int) -> bool:
    """Whether no process of this computer has an id; one that cannot be asked counts as there."""
    if os.name != "posix":  # elsewhere the question ends the process
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        return False
    return False


@functools.cache
def host_mark() -> str:
    """A short name of this computer that fits into any file name."""
    return hashlib.sha256(socket.gethostname().encode(errors="surrogateescape")).hexdigest()[:HOST_DIGITS]
