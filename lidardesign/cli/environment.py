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
    """SIGTERM, treated like an interruption by whoever cleans up."""


def set_thread_defaults() -> None:
    """One thread per numerical library unless the user chose otherwise."""
    for name, value in THREAD_DEFAULTS.items():
        os.environ.setdefault(name, value)


def make_streams_tolerant() -> None:
    """Escape characters that the terminal lacks; a stream that was closed swallows its output."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - lives as long as the process
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def terminate_cleanly() -> None:
    """Let SIGTERM end the program as Ctrl-C does, so that checkpoints and locks are tidied up."""

    def interrupt(*_: Any) -> None:
        raise TerminatedError

    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGTERM, interrupt)
