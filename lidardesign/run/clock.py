"""The time of a command: seconds by phase, phases inside of phases.

A clock runs for as long as a command, or a library call that reports its own times. Code below marks its work with
`phase`, as a context or a decorator, which does nothing where no clock runs. Nested clocks all count the same phases,
each from its own start.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path

# Called with what is done, how much of it, and of how much; None where that is not counted.
Progress = Callable[[str, int | None, int | None], None]
# Between the name of a phase and that of one inside of it.
INSIDE = "/"
# What passed outside of all phases.
OTHER = "other"
# Commands that write one entry hold the lock for an instant.
WAIT_S = 10.0
PROCESS_STATUS = Path("/proc/self/status")
KIBIBYTE = 1024
_RUNNING: ContextVar[tuple[Clock, ...]] = ContextVar("clocks that run", default=())


class Clock:
    """Wall time by phase, from its creation on."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._within: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Wall time since the clock was made [s]."""
        return time.perf_counter() - self._started

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count the time inside towards a phase; directly inside a phase of the same name it is that one."""
        before = self._within
        if before[-1:] == (name,):
            yield
            return
        self._within = (*before, name)
        key = INSIDE.join(self._within)
        # entered in the order of beginning, so that phases come in the order of the work
        self._seconds.setdefault(key, 0.0)
        started = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[key] += time.perf_counter() - started
            self._within = before

    def timings(self) -> dict[str, float]:
        """Finished phases and their seconds, in milliseconds' steps, as {"learning": 12.3, "learning/target": 8.1}.

        Names without a stroke add up, with `other`, to the time since the clock was made.
        """
        found = {key: round(seconds, 3) for key, seconds in self._seconds.items()}
        counted = sum(seconds for key, seconds in self._seconds.items() if INSIDE not in key)
        return {**found, OTHER: round(max(self.seconds - counted, 0.0), 3)}


@contextlib.contextmanager
def running(clock: Clock | None = None) -> Iterator[Clock]:
    """A context in which a clock counts phases, beside clocks that run already."""
    clock = Clock() if clock is None else clock
    token = _RUNNING.set((*_RUNNING.get(), clock))
    try:
        yield clock
    finally:
        _RUNNING.reset(token)


def outermost_clock() -> Clock | None:
    """The outermost running clock, that of the command; None where none runs."""
    clocks = _RUNNING.get()
    return clocks[0] if clocks else None


@contextlib.contextmanager
def phase(name: str) -> Iterator[None]:
    """Count the time inside towards a phase of every clock that runs; also a decorator."""
    with contextlib.ExitStack() as stack:
        for clock in _RUNNING.get():
            stack.enter_context(clock.phase(name))
        yield


def peak_memory_bytes() -> int | None:
    """The peak memory of this process [bytes]; None where the system does not report it."""
    # on Linux getrusage includes the memory of the parent at the time of the fork
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(PROCESS_STATUS.read_text().split("VmHWM:")[1].split()[0]) * KIBIBYTE
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * KIBIBYTE
