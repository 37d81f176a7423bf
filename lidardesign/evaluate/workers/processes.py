"""Workers as processes of this machine: started, asked in turn, replaced when they die, ended with the program."""

from __future__ import annotations

import contextlib
import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.evaluate.workers.worker import receive, send

WORKER = "lidardesign.evaluate.workers.worker"
# A scene whose worker dies so many times is the cause of it.
MOST_TRIES = 3
# A process that dies closes its pipe just before it is gone.
LAST_BREATH_S = 1.0


@dataclass(eq=False)
class _Job:
    """A message to be answered; without a number nobody waits for the answer."""

    number: int | None
    message: bytes
    tries: int = 0


@dataclass(eq=False)
class _Process:
    """A running worker and what it was asked and did not answer yet."""

    events: queue.SimpleQueue[tuple[_Process, bytes | None]]
    jobs: deque[_Job] = field(default_factory=deque)

    def __post_init__(self) -> None:
        # modules are found where this process finds them, and a folder's own files are not mistaken for libraries
        code = f"import sys; sys.path[:] = {sys.path!r}; from {WORKER} import main; main()"
        self._popen = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # a terminal's Ctrl-C is for this process, which ends its workers
            start_new_session=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def ask(self, job: _Job) -> None:
        """Hand a message over; that it died is told by an event."""
        self.jobs.append(job)
        with contextlib.suppress(OSError):
            send(self._popen.stdin, job.message)

    def end(self) -> None:
        """End it, at the latest a moment later."""
        self._popen.kill()
        self._popen.wait()
        with contextlib.suppress(OSError):
            self._popen.stdin.close()

    def died_of(self) -> str:
        """How it ended, as it closed its pipe."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(LAST_BREATH_S)
        self.end()
        code = self._popen.returncode
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def _read(self) -> None:
        with self._popen.stdout as pipe:
            while (reply := receive(pipe)) is not None:
                self.events.put((self, reply))
        self.events.put((self, None))


class Processes:
    """Worker processes of this machine; they start at once and load libraries while this process goes on.

    Arguments:
        count: How many, at least 1.

    Raises:
        ConfigError: The system does not allow so many.
    """

    def __init__(self, count: int) -> None:
        self._events: queue.SimpleQueue[tuple[_Process, bytes | None]] = queue.SimpleQueue()
        self._running: list[_Process] = []
        try:
            for _ in range(count):
                self._running.append(_Process(self._events))
        except OSError as error:
            started = len(self._running)
            self.close()
            raise ConfigError(
                f"only {started} of {count} processes could be started: {error.strerror}", where="--workers"
            ) from error

    def prepare(self, message: bytes) -> None:
        """Tell every worker something whose answer nobody waits for."""
        for process in self._running:
            process.ask(_Job(None, message))

    def answers(self, questions: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
        """The number and the answer of each message, as they come.

        Raises:
            NumericalError: The workers of one message died, one after the other.
        """
        waiting = _Waiting(questions)
        while True:
            for process in self._running:
                if not any(job.number is not None for job in process.jobs) and (job := waiting.take()):
                    process.ask(job)
            if not any(process.jobs for process in self._running):
                return
            waiting.prefetch()
            process, reply = self._events.get()
            if process not in self._running:
                continue
            if reply is None:
                self._replace(process, waiting)
                continue
            job = process.jobs.popleft()
            if job.number is not None:
                yield job.number, reply

    def close(self) -> None:
        """End all of them, whatever they are doing."""
        while self._running:
            self._running.pop().end()

    def _replace(self, process: _Process, waiting: _Waiting) -> None:
        """A new worker for one that died; what it was asked waits for the next that is free."""
        self._running.remove(process)
        how = process.died_of()
        for job in process.jobs:
            if job.number is None:
                continue
            job.tries += 1
            if job.tries == MOST_TRIES:
                raise NumericalError(
                    f"the worker of held-out scene {job.number} {how}, {MOST_TRIES} times",
                    where="--workers",
                    hint="fewer workers need less memory; --workers 1 needs no second process",
                )
            waiting.again(job)
        self._running.append(_Process(self._events))


class _Waiting:
    """Questions that no worker has: those that a lost one leaves, then the next ones, made when they are needed."""

    def __init__(self, questions: Iterable[bytes]) -> None:
        self._rest = enumerate(questions)
        self._ready: deque[_Job] = deque()

    def take(self) -> _Job | None:
        """The next one, or None where there is none left."""
        self.prefetch()
        return self._ready.popleft() if self._ready else None

    def prefetch(self) -> None:
        """Have the next one ready before somebody is free to take it."""
        if not self._ready and (following := next(self._rest, None)):
            self._ready.append(_Job(*following))

    def again(self, job: _Job) -> None:
        """Take one back."""
        self._ready.appendleft(job)
