"""Workers of a cluster, through dask.distributed: it hands messages out and repeats those of workers that it loses."""

from __future__ import annotations

import asyncio
import importlib.metadata
import itertools
import logging
import queue
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from lidardesign import __version__
from lidardesign.errors import ConfigError, LidardesignError, NumericalError
from lidardesign.evaluate.workers.worker import answer

HINT = "docs/cluster.md has the commands that start a scheduler and its workers"
SAME_EVERYWHERE = "install the same versions of lidardesign and of the task for the scheduler and all workers"
# A scheduler that listens answers at once; workers of a batch system may still be waiting for their machines.
SCHEDULER_SECONDS = 10.0
# What is given a connection, in times of that: it is tried again and again until its own time is over.
PATIENCE = 1.5
WORKER_SECONDS = 60.0
# How often somebody looks whether there is still a worker, while none answers.
LOOK_SECONDS = 2.0
# Messages beyond what runs, so that no worker waits for this process.
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
        client_class = _client_class()
        self._logger.setLevel(logging.CRITICAL)
        try:
            self._client = _connected(client_class, address)
        except ConfigError:
            self._logger.setLevel(self._level)
            raise

    def prepare(self, message: bytes) -> None:
        """Workers come and go: each makes the scenes when it is first asked about one."""

    def answers(self, questions: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
        """The number and the answer of each message, as they come.

        Raises:
            ConfigError: The scheduler or all workers were lost, or cannot load this program.
            NumericalError: The workers of one message died, one after the other.
        """
        rest = enumerate(questions)
        numbers: dict[Any, int] = {}
        done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        while True:
            for number, message in itertools.islice(rest, max(AHEAD + self._threads() - len(numbers), 0)):
                future = self._asked(message)
                numbers[future] = number
                future.add_done_callback(done.put)
            if not numbers:
                return
            future = self._next(done)
            number = numbers.pop(future)
            yield number, self._result(future, number)

    def _asked(self, message: bytes) -> Any:
        """A future of the answer; the message is part of its task, so that whoever loses it can have it again."""
        with warnings.catch_warnings():
            # many rays make a long message, which the work on them outweighs
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            return self._client.submit(answer, message, key=f"lidardesign-{uuid.uuid4()}", pure=False)

    def close(self) -> None:
        """Leave the scheduler, which forgets what nobody waits for; a scene that a worker is at is finished there."""
        self._client.close()
        self._logger.setLevel(self._level)

    def _next(self, done: queue.SimpleQueue[Any]) -> Any:
        """The next future that is done; gives up where there has been no worker for a while."""
        last_seen = time.monotonic()
        while True:
            try:
                return done.get(timeout=LOOK_SECONDS)
            except queue.Empty:
                last_seen = self._last_worker_seen(last_seen)

    def _last_worker_seen(self, before: float) -> float:
        """When there was a worker last, now or before; gives up where that is too long ago."""
        now = time.monotonic()
        last_seen = now if self._threads() else before
        if now - last_seen > WORKER_SECONDS:
            raise ConfigError(
                f"the scheduler at {self._address} has had no worker for {WORKER_SECONDS:g} s",
                where="--workers",
                hint="the logs of the workers say why they ended",
            )
        return last_seen

    def _threads(self) -> int:
        """Messages that workers can take at a time, as of now."""
        try:
            return sum(self._client.nthreads().values())
        except (OSError, RuntimeError) as error:
            raise self._lost() from error

    def _result(self, future: Any, number: int) -> bytes:
        from distributed import CancelledError, KilledWorker

        try:
            return self._fetched(future)
        except KilledWorker as error:
            raise NumericalError(
                f"the workers of held-out scene {number} died, one after the other",
                where="--workers",
                hint="their logs say why; memory is the usual cause",
            ) from error
        except (CancelledError, OSError) as error:
            raise self._lost() from error
        except LidardesignError:
            raise
        except Exception as error:
            # `answer` itself never raises: the cluster could not load or run it
            raise _unusable(f"{type(error).__name__}: {error}") from error

    def _fetched(self, future: Any) -> bytes:
        """The answer of a future that was done; where its worker died since, another one has to make it again."""
        from distributed import TimeoutError as NotYet

        last_seen = time.monotonic()
        while True:
            try:
                return future.result(timeout=max(LOOK_SECONDS, 1.0))
            except NotYet:
                last_seen = self._last_worker_seen(last_seen)

    def _lost(self) -> ConfigError:
        return ConfigError(f"the scheduler at {self._address} was lost", where="--workers", hint=HINT)


def _unusable(found: str) -> ConfigError:
    return ConfigError(
        f"the cluster cannot run this program: {' '.join(found.split())}", where="--workers", hint=SAME_EVERYWHERE
    )


def _client_class() -> Any:
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
    return Client


def _connected(client_class: Any, address: str) -> Any:
    try:
        client = _answered(lambda: client_class(address, timeout=SCHEDULER_SECONDS, set_as_default=False))
    except (OSError, ValueError) as error:
        found = " ".join(str(error).split())
        raise ConfigError(f"no scheduler answers at {address}: {found}", where="--workers", hint=HINT) from None
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
        _check_versions(client)
    except asyncio.TimeoutError:
        client.close()
        raise ConfigError(
            f"the scheduler at {address} had no worker within {WORKER_SECONDS:g} s", where="--workers", hint=HINT
        ) from None
    except ConfigError:
        client.close()
        raise
    return client


def _answered(connect: Callable[[], Any]) -> Any:
    """What a thread connects to: the client's own time ends with the connection, whatever answers it or does not.

    Raises:
        TimeoutError: Nothing came of it.
    """
    done: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()

    def work() -> None:
        try:
            done.put((connect(), None))
        except Exception as error:
            # raised where it was asked for
            done.put((None, error))

    threading.Thread(target=work, daemon=True).start()
    try:
        client, error = done.get(timeout=PATIENCE * SCHEDULER_SECONDS)
    except queue.Empty:
        raise TimeoutError("something listens there, but does not speak as a scheduler of dask does") from None
    if error is not None:
        raise error
    return client


def _check_versions(client: Any) -> None:
    """Refuse a scheduler or workers without this version of this program; they would only die of it."""
    asked = (importlib.metadata.version, "lidardesign")
    try:
        found = {"the scheduler": client.run_on_scheduler(*asked), **client.run(*asked)}
    except importlib.metadata.PackageNotFoundError as error:
        raise _unusable("the scheduler or a worker does not have it") from error
    for place, version in found.items():
        if version != __version__:
            raise _unusable(f"{place} has version {version} of it, not {__version__}")
