"""Workers of a cluster, through dask.distributed: it hands jobs out and repeats those of workers that it loses."""

from __future__ import annotations

import importlib.metadata
import logging
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, wait
from typing import Any

from lidardesign import __version__
from lidardesign.errors import ConfigError, NumericalError, page
from lidardesign.evaluate.scene_scores import SceneScores
from lidardesign.evaluate.workers.worker import SceneFailure, SceneJob, SceneSource, score_job

HINT = f"{page('cluster.md')} has the commands that start a scheduler and its workers"
# A scheduler that listens answers at once; workers of a batch system may still be waiting for their machines.
SCHEDULER_SECONDS = 10.0
# What is given a connection, in times of that: it is tried again and again until its own time is over.
PATIENCE = 1.5
WORKER_SECONDS = 60.0
# Jobs beyond what runs, so that no worker waits for this process.
AHEAD = 2


class Cluster:
    """The workers of a scheduler that is running already.

    While it is open, what dask.distributed would log about lost connections is left to the errors of this class.

    Arguments:
        address: As tcp://HOST:PORT.

    Raises:
        ConfigError: dask.distributed is not installed, no scheduler answers there, it has no workers, or they lack
            this version of this program.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._logger = logging.getLogger("distributed")
        self._level = self._logger.level
        try:
            with warnings.catch_warnings():
                # packages announce their own removals
                warnings.simplefilter("ignore")
                from distributed import Client
        except ImportError:
            raise ConfigError(
                "workers of a cluster need dask.distributed, which is not installed",
                where="--workers",
                hint="pip install 'lidardesign[cluster]'",
            ) from None
        self._logger.setLevel(logging.CRITICAL)
        try:
            try:
                client = _answered(lambda: Client(address, timeout=SCHEDULER_SECONDS, set_as_default=False))
            except (OSError, ValueError) as error:
                why = " ".join(str(error).split())
                raise ConfigError(f"no scheduler answers at {address}: {why}", where="--workers", hint=HINT) from None
            try:
                client.wait_for_workers(1, timeout=WORKER_SECONDS)
                _check_versions(client)
            except TimeoutError:
                client.close()
                raise ConfigError(
                    f"the scheduler at {address} had no worker within {WORKER_SECONDS:g} s",
                    where="--workers",
                    hint=HINT,
                ) from None
            except ConfigError:
                client.close()
                raise
            self._client = client
        except ConfigError:
            self._logger.setLevel(self._level)
            raise
        self._executor = self._client.get_executor(pure=False)
        self._last_worker = time.monotonic()

    def prepare(self, source: SceneSource) -> None:
        """Workers come and go: each makes the scenes when it is first asked about one."""

    def at_once(self) -> int:
        """How many jobs its workers take at a time, as of now."""
        return AHEAD + self._threads()

    def submit(self, job: SceneJob) -> Future[SceneScores | SceneFailure]:
        """Hand a job over; it is part of its task, so that whoever loses it can have it again."""
        with warnings.catch_warnings():
            # many rays make a long message, which the work on them outweighs
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            return self._executor.submit(score_job, job)

    def check(self) -> None:
        """Give up where there has been no worker for a while.

        Raises:
            ConfigError: There has not, or the scheduler was lost.
        """
        now = time.monotonic()
        if self._threads():
            self._last_worker = now
        elif now - self._last_worker > WORKER_SECONDS:
            raise ConfigError(
                f"the scheduler at {self._address} has had no worker for {WORKER_SECONDS:g} s",
                where="--workers",
                hint="the logs of the workers say why they ended",
            )

    def lost(self, error: Exception, numbers: Sequence[int]) -> None:
        """Say why the first of some scenes came to nothing.

        Raises:
            NumericalError: Its workers died, one after the other.
            ConfigError: The scheduler was lost, or the cluster could not load or run this program.
        """
        from distributed import KilledWorker

        if isinstance(error, KilledWorker):
            raise NumericalError(
                f"the workers of held-out scene {numbers[0]} died, one after the other",
                where="--workers",
                hint="their logs say why; memory is the usual cause",
            ) from error
        if isinstance(error, CancelledError | OSError):
            raise self._lost_scheduler() from error
        raise _unusable(f"{type(error).__name__}: {error}") from error

    def close(self) -> None:
        """Leave the scheduler, which forgets what nobody waits for; a scene that a worker is at is finished there."""
        self._client.close()
        self._logger.setLevel(self._level)

    def _threads(self) -> int:
        """Jobs that workers can do at a time, as of now."""
        try:
            return sum(self._client.nthreads().values())
        except (OSError, RuntimeError) as error:
            raise self._lost_scheduler() from error

    def _lost_scheduler(self) -> ConfigError:
        return ConfigError(f"the scheduler at {self._address} was lost", where="--workers", hint=HINT)


def _unusable(found: str) -> ConfigError:
    return ConfigError(
        f"the cluster cannot run this program: {' '.join(found.split())}",
        where="--workers",
        hint="install the same versions of lidardesign and of the task for the scheduler and all workers",
    )


def _answered(connect: Callable[[], Any]) -> Any:
    """What a thread connects to: the client's own time ends with the connection, whatever answers it or does not.

    Raises:
        TimeoutError: Nothing came of it.
    """
    answer: Future[Any] = Future()

    def work() -> None:
        try:
            answer.set_result(connect())
        except Exception as error:
            # raised where it was asked for
            answer.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    if not wait([answer], timeout=PATIENCE * SCHEDULER_SECONDS).done:
        raise TimeoutError("something listens there, but it is not a dask scheduler")
    return answer.result()


def _check_versions(client: Any) -> None:
    """Refuse a scheduler or workers without this version of this program; they would only die of it."""
    asked = (importlib.metadata.version, "lidardesign")
    try:
        versions = {"the scheduler": client.run_on_scheduler(*asked), **client.run(*asked)}
    except importlib.metadata.PackageNotFoundError as error:
        raise _unusable("the scheduler or a worker does not have it") from error
    for place, version in versions.items():
        if version != __version__:
            raise _unusable(f"{place} has version {version} of it, not {__version__}")
