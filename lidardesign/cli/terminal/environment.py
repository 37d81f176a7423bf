"""What the process needs before anything heavy is imported: threads, streams and signals."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
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
