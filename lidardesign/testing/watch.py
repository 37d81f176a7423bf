"""What a task's code does to the process that runs it: random state, environment, files.

Files are watched by an audit hook of Python: it sees what Python opens, makes, moves and removes, and refuses what lies
outside temporary files and caches, so that a careless plugin does no harm while it is tried. It is no prison: compiled
code and other processes write unseen.
"""

from __future__ import annotations

import contextlib
import locale
import os
import random
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Events of the audit hook that change files, with the positions of the paths among their arguments.
CHANGING = {
    "os.rename": (0, 1),
    "os.remove": (0,),
    "os.rmdir": (0,),
    "os.mkdir": (0,),
    "os.chmod": (0,),
    "os.chown": (0,),
    "os.link": (1,),
    "os.symlink": (1,),
    "os.truncate": (0,),
    "os.utime": (0,),
    "shutil.rmtree": (0,),
    "sqlite3.connect": (0,),
}
DEVICES = ("/dev/", "/proc/")
# Python and numba keep what they compile beside the source.
COMPILED = "__pycache__"
MOST_NOTES = 20
# Libraries set variables of these names for themselves when they are imported, as scikit-learn does.
LIBRARIES_OWN = ("KMP_", "JAX_", "TF_", "TF2_", "TPU_", "XLA_", "PYGAME_", "OPENCV_", "QT_")
# Ctrl-C and what ends a process belong to the program.
PROGRAMS_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Watch:
    """Notes what happens while a task's code runs.

    Arguments:
        allowed: Folders that it may write into, beside temporary files and caches.
        all_threads: Whether whatever the process does counts, and not only the thread that is watched.
    """

    def __init__(self, allowed: tuple[Path, ...] = (), *, all_threads: bool = False) -> None:
        self.all_threads = all_threads
        self.allowed = tuple(_real(folder) for folder in (*allowed, *_usual_folders()))
        self.empty_folder: Path | None = None
        self.written: list[str] = []
        self.drawn: list[str] = []
        self.changed: list[str] = []

    @contextlib.contextmanager
    def during(self, what: str) -> Iterator[None]:
        """Watch the code inside; global random states and the environment are put back afterwards."""
        # Audit hooks stay for good: one is enough, and it looks only while some task is watched
        if not _HOOKED:
            _HOOKED.append(True)
            sys.addaudithook(_audit)
        before, surroundings = _random_states(), _Surroundings()
        _ACTIVE.append((self, threading.get_ident()))
        try:
            yield
        finally:
            _ACTIVE.pop()
            _note(self.drawn, [f"{name} in {what}" for name in _restored(before)])
            _note(self.changed, [f"{name} in {what}" for name in surroundings.restored()])

    def written_files(self) -> list[str]:
        """What was written or tried to be: also by compiled code, in a folder that was empty."""
        left = sorted(self.empty_folder.rglob("*")) if self.empty_folder else []
        return [*self.written, *(f"{path.name} in the working folder" for path in left[:MOST_NOTES])]

    def refuse(self, event: str, path: Any) -> None:
        """Note a change to a file that may not be changed, and refuse it.

        Raises:
            PermissionError: The path is neither temporary, nor a cache, nor allowed.
        """
        if not isinstance(path, str | bytes | os.PathLike) or os.fsdecode(path) in ("", ":memory:"):
            return
        found = _real(Path(os.fsdecode(path)))
        if COMPILED in found.parts or str(found).startswith(DEVICES):
            return
        if any(found.is_relative_to(folder) for folder in self.allowed):
            return
        _note(self.written, [str(found)])
        raise PermissionError(1, f"a task may not write here while it is checked ({event})", str(found))


_ACTIVE: list[tuple[Watch, int]] = []
_HOOKED: list[bool] = []


def _note(notes: list[str], found: list[str]) -> None:
    for text in found:
        if text not in notes and len(notes) < MOST_NOTES:
            notes.append(text)


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if not _ACTIVE:
        return
    watch, thread = _ACTIVE[-1]
    if not watch.all_threads and thread != threading.get_ident():
        return
    if event == "open":
        path, mode, flags = arguments
        if any(sign in mode for sign in "wax+") if isinstance(mode, str) else bool((flags or 0) & WRITING):
            watch.refuse(event, path)
    elif event in CHANGING:
        for position in CHANGING[event]:
            watch.refuse(event, arguments[position])


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _usual_folders() -> tuple[Path, ...]:
    folders = [Path(tempfile.gettempdir()), Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")]
    folders += [Path(os.environ[name]) for name in ("LIDARDESIGN_CACHE", "NUMBA_CACHE_DIR") if os.environ.get(name)]
    return tuple(folders)


def _random_states() -> dict[str, Any]:
    """The global random states by the words for them; torch's only where torch is loaded."""
    found: dict[str, Any] = {
        "Python's random": random.getstate(),
        "numpy's random": np.random.get_state(),  # noqa: NPY002 - it is this state that must not change
    }
    torch = sys.modules.get("torch")
    if torch is not None and hasattr(torch, "get_rng_state"):
        found["torch's random"] = torch.get_rng_state()
    return found


def _restored(before: dict[str, Any]) -> list[str]:
    """Put global random states back; the names of those that had changed."""
    now = _random_states()
    changed = [name for name, state in before.items() if not _same_state(state, now[name])]
    if "Python's random" in changed:
        random.setstate(before["Python's random"])
    if "numpy's random" in changed:
        np.random.set_state(before["numpy's random"])  # noqa: NPY002
    if "torch's random" in changed:
        sys.modules["torch"].set_rng_state(before["torch's random"])
    return changed


def _same_state(first: Any, second: Any) -> bool:
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(_same_state, first, second))
    return bool(np.array_equal(first, second))


class _Surroundings:
    """The working folder, the environment, the locale, who hears signals, and numpy's answer to bad numbers."""

    def __init__(self) -> None:
        self._folder, self._environment, self._errors = os.getcwd(), dict(os.environ), np.geterr()
        self._locale = locale.setlocale(locale.LC_ALL)
        self._heard = {number: signal.getsignal(number) for number in PROGRAMS_SIGNALS}

    def restored(self) -> list[str]:
        """Put all back; the names of what had changed."""
        changed = []
        if os.getcwd() != self._folder:
            changed.append("the working folder")
            os.chdir(self._folder)
        if dict(os.environ) != self._environment:
            now, before = dict(os.environ), self._environment
            names = [name for name in sorted({*now, *before}) if now.get(name) != before.get(name)]
            named = [name for name in names if name in before or not name.startswith(LIBRARIES_OWN)]
            os.environ.clear()
            os.environ.update(before)
            changed += [f"the environment ({', '.join(named)})"] if named else []
        if locale.setlocale(locale.LC_ALL) != self._locale:
            changed.append("the locale")
            locale.setlocale(locale.LC_ALL, self._locale)
        if np.geterr() != self._errors:
            changed.append("numpy's error settings")
            np.seterr(**self._errors)
        return changed + self._restored_signals()

    def _restored_signals(self) -> list[str]:
        changed = [number for number, heard in self._heard.items() if signal.getsignal(number) != heard]
        for number in changed:
            with contextlib.suppress(ValueError, TypeError):  # not in this thread, or not from Python
                signal.signal(number, self._heard[number])
        return [f"who handles {number.name}" for number in changed]
