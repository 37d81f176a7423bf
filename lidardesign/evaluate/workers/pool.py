"""Held-out scenes scored by workers: processes of this machine, or of a cluster.

The numbers are those of one process, for any number of workers and in whatever order they answer: a scene's scores
depend on nothing but its rays and the seed. Rows' seconds are the workers' own, so they add up to more than the time
that passed.
"""

from __future__ import annotations

import contextlib
import re
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait

from lidardesign.errors import ConfigError
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.scene_scores import Progress, ScenePass, SceneScores
from lidardesign.evaluate.workers.cluster import Cluster
from lidardesign.evaluate.workers.processes import Processes
from lidardesign.evaluate.workers.worker import SceneFailure, SceneJob, SceneSource
from lidardesign.registry import load_task

ADDRESS = re.compile(r"tcp://(\[[0-9a-fA-F:]+\]|[^\s:/\[\]]+):(\d{1,5})")
MOST_PROCESSES = 1024
ALLOWED = f"a whole number from 1 to {MOST_PROCESSES}, or tcp://HOST:PORT of a dask scheduler"
# How often somebody looks whether there is still a worker, while none answers.
LOOK_SECONDS = 2.0


class WorkerScorer:
    """Scores scenes with workers; a context that ends them.

    Arguments:
        engine: What hands jobs to them: an executor that says what became of lost workers.
    """

    def __init__(self, engine: Processes | Cluster) -> None:
        self._engine = engine

    def __enter__(self) -> WorkerScorer:
        return self

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
                f"task {task.name} is not the installed one of this name",
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
    if re.fullmatch(r"\d{1,9}", text.strip()) and 1 <= int(text) <= MOST_PROCESSES:
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
    engine = Cluster(wanted) if isinstance(wanted, str) else Processes(min(wanted, most))
    with WorkerScorer(engine) as scorer:
        yield scorer
