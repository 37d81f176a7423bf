"""Held-out scenes scored by workers: processes of this machine, or of a cluster.

The numbers are those of one process, for any number of workers and in whatever order they answer: a scene's scores
depend on nothing but its rays and the seed. Rows' seconds are the workers' own, so they add up to more than the time
that passed.

Workers as processes of this machine: started together, replaced when one dies, ended with the program.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import sys
import threading
import types
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.scene_scores import Progress, ScenePass, SceneScores
from lidardesign.evaluate.workers.cluster import Cluster
from lidardesign.evaluate.workers.worker import SceneFailure, SceneJob, SceneSource, make_scenes, score_job
from lidardesign.registry import load_task

# A scene whose worker dies so many times is the cause of it.
MOST_TRIES = 3
# Jobs beyond what runs, so that no worker waits for this process.
AHEAD = 1


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
        spawn, others = multiprocessing.get_context("spawn"), multiprocessing.active_children()
        self._source = source
        self._executor = ProcessPoolExecutor(self._count, spawn, initializer=_begin, initargs=(source,))
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
        if self._executor is not None and self._source == job.source:
            # one may be lost while nothing is asked
            with contextlib.suppress(BrokenProcessPool):
                return self._executor.submit(score_job, job)
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
    os._exit(1)


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


ADDRESS = re.compile(r"tcp://(\[[0-9a-fA-F:]+\]|[^\s:/\[\]]+):([0-9]{1,5})")
MOST_PROCESSES = 1024
ALLOWED = f"a whole number from 1 to {MOST_PROCESSES}, or tcp://HOST:PORT of a dask scheduler"
# How often somebody looks whether there is still a worker, while none answers.
LOOK_SECONDS = 2.0


class WorkerScorer(contextlib.AbstractContextManager):
    """Scores scenes with workers; a context that ends them.

    Arguments:
        engine: What hands jobs to them: an executor that says what became of lost workers.
    """

    def __init__(self, engine: Processes | Cluster) -> None:
        self._engine = engine

    def __exit__(self, *_: object) -> None:
        self._engine.close()

    def prepare(self, request: EvaluationRequest) -> None:
        """Have workers make the scenes of a request while this process lays rays out.

        Raises:
            ConfigError: The task is not the installed one of its name, which is what workers load.
        """
        task = request.task
        if type(load_task(task.name)) is not type(task):
            raise ConfigError(
                f"task {task.name} is not the installed task of this name",
                where="workers",
                hint="workers load a task by its entry point; without workers any task will do",
            )
        self._engine.prepare(SceneSource.of(request))

    def __call__(self, scenes: ScenePass, progress: Progress | None) -> Sequence[SceneScores]:
        """As `score_here`; of several errors, that of the first scene is raised."""
        total = len(scenes.scenes)
        found: dict[int, SceneScores] = {}
        failed: dict[int, SceneFailure] = {}
        if progress:
            progress(0, total, scenes.scenes[0].name)
        # scenes are asked about in order: those before one that failed are done or under way
        waiting = deque(range(total))
        running: dict[Future[SceneScores | SceneFailure], int] = {}
        # scenes that were asked about when a worker died: each is asked about alone, to know which one it was
        suspects: set[int] = set()
        while waiting or running:
            while waiting and len(running) < (1 if suspects else self._engine.at_once()):
                number = waiting.popleft()
                running[self._engine.submit(SceneJob.of(scenes, number))] = number
            done, _ = wait(running, LOOK_SECONDS, FIRST_COMPLETED)
            if not done:
                self._engine.check()
            for future in sorted(done, key=running.get):
                try:
                    answer = future.result()
                except Exception as error:
                    # an answer is no error: whatever was lost with its worker, and all that was asked with it
                    lost = sorted(running.values())
                    self._engine.lost(error, [running[future], *(one for one in lost if one != running[future])])
                    suspects.update(lost)
                    waiting.extendleft(reversed(lost))
                    running.clear()
                    break
                number = running.pop(future)
                suspects.discard(number)
                if isinstance(answer, SceneFailure):
                    failed[number] = answer
                    waiting.clear()
                else:
                    found[number] = answer
                if progress:
                    progress(len(found), total, scenes.scenes[number].name)
        if failed:
            failed[min(failed)].reraise()
        return [found[number] for number in range(total)]


def check_workers(text: str) -> int | str:
    """The value of `--workers`: a number of processes, or the address of a scheduler.

    Raises:
        ConfigError: It is neither.
    """
    address = ADDRESS.fullmatch(text.strip())
    if address and 0 < int(address.group(2)) <= 65_535:
        return text.strip()
    if re.fullmatch("[0-9]{1,9}", text.strip()) and 1 <= int(text) <= MOST_PROCESSES:
        return int(text)
    raise ConfigError(f"{text!r}", where="--workers", allowed=ALLOWED)


@contextlib.contextmanager
def workers_of(wanted: int | str, most: int) -> Iterator[WorkerScorer | None]:
    """The workers that were asked for; None where one process is enough.

    Arguments:
        wanted: What `check_workers` gives.
        most: Processes beyond this number would have nothing to do.

    Raises:
        ConfigError: No scheduler answers at the address, or it has no workers.
    """
    if isinstance(wanted, int) and min(wanted, most) == 1:
        yield None
        return
    with WorkerScorer(Cluster(wanted) if isinstance(wanted, str) else Processes(min(wanted, most))) as scorer:
        yield scorer
