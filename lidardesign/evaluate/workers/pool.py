"""Held-out scenes scored by workers: processes of this machine, or of a cluster.

The numbers are those of one process, for any number of workers and in whatever order they answer: a scene's scores
depend on nothing but its rays and the seed. Rows' seconds are the workers' own, so they add up to more than the time
that passed.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

from lidardesign.errors import ConfigError
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.scene_scores import Progress, ScenePass, SceneScores
from lidardesign.evaluate.workers import worker as messages
from lidardesign.evaluate.workers.worker import preparation, question
from lidardesign.registry import load_task

ADDRESS = re.compile(r"tcp://(\[[0-9a-fA-F:]+\]|[^\s:/\[\]]+):(\d{1,5})")
MOST_PROCESSES = 1024
ALLOWED = f"a whole number from 1 to {MOST_PROCESSES}, or tcp://HOST:PORT of a dask scheduler"
MOST_PORT = 65_535


class Engine(Protocol):
    """What hands messages to workers."""

    def prepare(self, message: bytes) -> None:
        """Tell workers something ahead."""
        ...

    def answers(self, questions: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
        """The number and the answer of each message, as they come."""
        ...

    def close(self) -> None:
        """End what was started."""
        ...


class WorkerScorer:
    """Scores scenes with workers; a context that ends them.

    Arguments:
        engine: What hands messages to them.
    """

    def __init__(self, engine: Engine) -> None:
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
        self._engine.prepare(preparation(request))

    def __call__(
        self, request: EvaluationRequest, scene_pass: ScenePass, progress: Progress | None
    ) -> Sequence[SceneScores]:
        """As `score_here`; of several errors, that of the first scene is raised."""
        total = len(request.test)
        found: dict[int, SceneScores] = {}
        failed: dict[int, dict[str, Any]] = {}
        if progress:
            progress(0, total, request.test[0].name)
        asked = _Asked(request, scene_pass)
        with contextlib.closing(self._engine.answers(asked)) as answers:
            for number, reply in answers:
                document, _ = messages.unpack(reply)
                if "error" in document:
                    failed[number] = document["error"]
                    # scenes are asked about in order, so those before it are done or under way
                    asked.stop()
                else:
                    found[number] = messages.scores_from_document(document)
                if progress:
                    progress(len(found), total, request.test[number].name)
        if failed:
            messages.raise_from_document(failed[min(failed)])
        return [found[number] for number in range(total)]


class _Asked:
    """The messages of a pass, made one by one until it is stopped."""

    def __init__(self, request: EvaluationRequest, scene_pass: ScenePass) -> None:
        self._request, self._pass, self._stopped = request, scene_pass, False

    def stop(self) -> None:
        """Make no more."""
        self._stopped = True

    def __iter__(self) -> Iterator[bytes]:
        for number in range(len(self._request.test)):
            if self._stopped:
                return
            yield question(self._request, self._pass, number)


def check_workers(text: str) -> int | str:
    """The value of `--workers`: a number of processes, or the address of a scheduler.

    Raises:
        ConfigError: It is neither.
    """
    address = ADDRESS.fullmatch(text.strip())
    if address and 0 < int(address.group(2)) <= MOST_PORT:
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
    with WorkerScorer(_engine(wanted, most)) as scorer:
        yield scorer


def _engine(wanted: int | str, most: int) -> Engine:
    if isinstance(wanted, str):
        from lidardesign.evaluate.workers.cluster import Cluster

        return Cluster(wanted)
    from lidardesign.evaluate.workers.processes import Processes

    return Processes(min(wanted, most))
