"""What the process needs before anything heavy is imported: threads, streams and signals."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

# One thread each: two thread pools that spin on shared cores make each other 8 to 40 times slower. These must
# be set before torch and numpy are imported; whoever sets one of them in the environment keeps it.
THREAD_DEFAULTS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
}


class TerminatedError(KeyboardInterrupt):
    """SIGTERM, treated like an interruption where things are tidied up."""


def set_thread_defaults() -> None:
    """One thread per numerical library unless the user chose otherwise."""
    for name, value in THREAD_DEFAULTS.items():
        os.environ.setdefault(name, value)


def set_cache_default() -> None:
    """A folder of this process alone for compiled code, where neither the package nor the home can be written.

    numba refuses to import otherwise. Nobody else can write there: numba's cache is code.
    """
    user_caches = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    places = (Path(__file__).parents[1] / "density" / "fields" / "__pycache__", user_caches / "numba")
    if "NUMBA_CACHE_DIR" in os.environ or any(_can_be_written(place) for place in places):
        return
    folder = tempfile.mkdtemp(prefix="lidardesign-numba-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder


def _can_be_written(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def make_streams_tolerant() -> None:
    """Escape characters that the terminal lacks; a stream that was closed swallows its output."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: else the next file that is opened takes its place, and what is printed there
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - lives as long as the process
        with contextlib.suppress(AttributeError, ValueError):
            getattr(sys, name).reconfigure(errors="backslashreplace")


def terminate_cleanly() -> None:
    """Let SIGTERM end the program as Ctrl-C does, so that checkpoints and locks are tidied up."""

    def interrupt(*_: Any) -> None:
        raise TerminatedError

    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGTERM, interrupt)
