"""Workers as processes of this machine: started together, replaced when one dies, ended with the program."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import types
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.evaluate.scene_scores import SceneScores
from lidardesign.evaluate.workers.worker import SceneFailure, SceneJob, SceneSource, make_scenes, score_job

# A scene whose worker dies so many times is the cause of it.
MOST_TRIES = 3
# Jobs beyond what runs, so that no worker waits for this process.
AHEAD = 1
# Exit code where the process that asks has gone.
EXIT_ALONE = 1


class Processes:
    """Worker processes of this machine, of one thread each.

    Arguments:
        count: How many, at least 1.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._source: SceneSource | None = None
        self._executor: ProcessPoolExecutor | None = None
        self._running: list[multiprocessing.process.BaseProcess] = []
        self._deaths: Counter[int] = Counter()

    def prepare(self, source: SceneSource) -> None:
        """Start all processes, which load libraries and make the scenes while this one goes on.

        Raises:
            ConfigError: The system does not allow so many.
        """
        self.close()
        self._source = source
        spawn = multiprocessing.get_context("spawn")
        self._executor = ProcessPoolExecutor(self._count, spawn, initializer=_begin, initargs=(source,))
        others = multiprocessing.active_children()
        try:
            for _ in range(self._count):
                # a process is started where none is idle, and none is before it has its scenes
                with _undisturbed():
                    self._executor.submit(os.getpid)
        except OSError as error:
            self._running = [one for one in multiprocessing.active_children() if one not in others]
            started = len(self._running)
            self.close()
            raise ConfigError(
                f"only {started} of {self._count} processes could be started: {error.strerror}", where="--workers"
            ) from error
        self._running = [one for one in multiprocessing.active_children() if one not in others]

    def at_once(self) -> int:
        """How many jobs it takes at a time."""
        return self._count + AHEAD

    def submit(self, job: SceneJob) -> Future[SceneScores | SceneFailure]:
        """Hand a job over."""
        if self._executor is None or self._source != job.source:
            self.prepare(job.source)
        try:
            return self._executor.submit(score_job, job)
        except BrokenProcessPool:
            # one was lost while nothing was asked
            self.prepare(job.source)
            return self._executor.submit(score_job, job)

    def check(self) -> None:
        """Lost processes are told by their jobs."""

    def lost(self, error: Exception, numbers: Sequence[int]) -> None:
        """Replace all processes after one died while these scenes were asked about; they can be asked about again.

        Raises:
            NumericalError: It was one scene alone, and not for the first time.
        """
        if not isinstance(error, BrokenProcessPool):
            raise error
        running, source = self._running, self._source
        self._executor.shutdown(wait=True)
        # the others were ended by SIGTERM then
        codes = [process.exitcode for process in running if process.exitcode != -signal.SIGTERM] or [-signal.SIGTERM]
        self._deaths.update(numbers)
        if len(numbers) == 1 and self._deaths[numbers[0]] >= MOST_TRIES:
            code = codes[0]
            how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            raise NumericalError(
                f"the worker of held-out scene {numbers[0]} {how}, {MOST_TRIES} times",
                where="--workers",
                hint="fewer workers need less memory; --workers 1 needs no second process",
            ) from error
        self.prepare(source)

    def close(self) -> None:
        """End all of them, whatever they are doing."""
        for process in self._running:
            process.kill()
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
        self._running, self._executor = [], None


def _begin(source: SceneSource) -> None:
    """Begin a worker: its output is for people, it ends with the process that asks, and its scenes are there."""
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # what goes wrong here does so again, and is told, where a scene is asked about
    with contextlib.suppress(Exception):
        make_scenes(source)


def _end_with_parent() -> None:
    """End at once where the process that asks has gone, in the middle of a scene too."""
    multiprocessing.parent_process().join()
    os._exit(EXIT_ALONE)


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """What is started in here never sees a terminal's Ctrl-C, and does not run the user's script again."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        sys.modules["__main__"] = script
