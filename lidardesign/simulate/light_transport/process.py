"""The process that the light-transport simulator runs in: found, started, asked, and reported on when it dies.

With the wrong LLVM the simulator aborts its whole process, so it gets one of its own, kept for the next request:
importing and compiling take most of the time of a small one. Arrays travel through files of a temporary folder,
without pickle.
"""

from __future__ import annotations

import atexit
import importlib.metadata
import importlib.util
import os
import re
import tempfile
import threading
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.run.child import Child, ChildError

WORKER = "lidardesign.simulate.light_transport.worker:serve"
# The simulator's packages and the oldest versions that answer as its tests expect.
PACKAGES = {"mitsuba": (3, 9), "mitransient": (1, 3), "drjit": (1, 0)}
# Older ones cannot select instructions for the kernels and abort (14 to 16), or are refused.
OLDEST_LLVM = 19
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib",
)
LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
TIME_LIMIT_S = 600.0
HINT = (
    "pip install 'lidardesign[transport]' and an LLVM library of version 19 or newer (Debian, Ubuntu: apt install "
    f"libllvm19), or name one in {LLVM_VARIABLE}"
)
# What names an error, or else the end of what was printed, is enough to tell what went wrong.
SHOWN_LINES = 4


def missing() -> str | None:
    """What keeps the simulator from running here, in one line; None if nothing does. Imports nothing of it."""
    absent = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if absent:
        return f"not installed: {', '.join(absent)}"
    for name, oldest in PACKAGES.items():
        found = importlib.metadata.version(name)
        if tuple(int(part) for part in re.findall(r"\d+", found)[:2]) < oldest:
            return f"{name} {found} is too old: {'.'.join(map(str, oldest))} or newer is needed"
    if llvm_library() is None:
        named = os.environ.get(LLVM_VARIABLE)
        if named:
            return f"{LLVM_VARIABLE} names {named}, which is not an LLVM library of version {OLDEST_LLVM} or newer"
        return f"no LLVM library of version {OLDEST_LLVM} or newer was found"
    return None


def llvm_library() -> str | None:
    """The path of the newest usable LLVM library; the one that the environment names comes first."""
    named = os.environ.get(LLVM_VARIABLE)
    if named:
        version = llvm_version(Path(named).name)
        return named if Path(named).is_file() and (version is None or version >= OLDEST_LLVM) else None
    return _newest_installed()


@lru_cache(maxsize=1)
def _newest_installed() -> str | None:
    found = {}
    for folder in LLVM_FOLDERS:
        for path in Path("/").glob(f"{folder[1:]}/libLLVM*.so*"):
            version = llvm_version(path.name)
            if version is not None and version >= OLDEST_LLVM and path.exists():
                found.setdefault(version, str(path))
    return found[max(found)] if found else None


def llvm_version(file_name: str) -> int | None:
    """The major version in a library's file name: libLLVM-19.so, libLLVM.so.19.1, libLLVM-14.0.6.so.1."""
    match = re.match(r"libLLVM-(\d+)|libLLVM\.so\.(\d+)", file_name)
    return int(match.group(1) or match.group(2)) if match else None


def ask(
    request: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, limit_s: float = TIME_LIMIT_S
) -> dict[str, np.ndarray]:
    """Have the simulator answer one request.

    Arguments:
        request: Numbers and shapes, as JSON.
        arrays: Arrays by name.
        limit_s: How long the answer may take [s].

    Raises:
        ConfigError: The simulator is not usable here.
        NumericalError: It failed, died, or took too long; the message says which and why.
    """
    with tempfile.TemporaryDirectory(prefix="lidardesign-light-") as name:
        folder = Path(name)
        np.savez(folder / "request.npz", **arrays)
        with _one_at_a_time:
            reason = missing()
            if reason is not None:
                raise ConfigError(f"the light-transport simulator cannot run: {reason}", hint=HINT)
            if not _running or not _running[0].alive:
                end_worker()
                _running[:] = [Child(WORKER, None, {LLVM_VARIABLE: str(llvm_library())})]
            worker = _running[0]
            worker.send({"folder": name, **request})
            try:
                found = worker.answer(limit_s, "while it renders")
            except ChildError as lost:
                end_worker()
                lines = [line for line in worker.printed if line.strip()]
                said = "\n".join(([line for line in lines if "error" in line.lower()] or lines)[-SHOWN_LINES:])
                raise NumericalError(
                    f"the light-transport simulator {lost}" + (f"; it said:\n{said}" if said else ""),
                    hint="fewer rays, samples or bounces" if lost.reason == "late" else HINT,
                ) from None
        if "error" in found:
            raise NumericalError(
                f"the light-transport simulator failed: {found['error']}", hint="report it with the scene"
            )
        with np.load(folder / "result.npz", allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}


_running: list[Child] = []
_one_at_a_time = threading.Lock()


def end_worker() -> None:
    """End the simulator's process, if this process runs one."""
    for worker in _running:
        if worker.owner == os.getpid():
            worker.end()
    _running.clear()


atexit.register(end_worker)
