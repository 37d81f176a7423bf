"""Workers of a cluster, through dask.distributed: it hands messages out and repeats those of workers that it loses."""

from __future__ import annotations

import asyncio
import itertools
import logging
import uuid
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.evaluate.worker import answer

HINT = "docs/cluster.md has the commands that start a scheduler and its workers"
# A scheduler that listens answers at once; workers of a batch system may still be waiting for their machines.
SCHEDULER_SECONDS = 10.0
WORKER_SECONDS = 60.0
# Messages beyond what runs, so that no worker waits for this process.
AHEAD = 2


class Cluster:
    """The workers of a scheduler that is running already.

    Arguments:
        address: As tcp://HOST:PORT.

    Raises:
        ConfigError: dask.distributed is not installed, no scheduler answers there, or it has no workers.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._client = _connected(address)

    def prepare(self, message: bytes) -> None:
        """Workers come and go: each makes the scenes when it is first asked about one."""

    def answers(self, questions: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
        """The number and the answer of each message, as they come.

        Raises:
            ConfigError: The workers lack this package, or the scheduler was lost.
            NumericalError: The workers of one message died, one after the other.
        """
        from distributed import as_completed

        rest = enumerate(questions)
        numbers: dict[Any, int] = {}
        running = as_completed(loop=self._client.loop)
        for number, message in itertools.islice(rest, self._capacity()):
            running.add(self._asked(numbers, number, message))
        for future in running:
            number = numbers.pop(future)
            reply = self._result(future, number)
            for following, message in itertools.islice(rest, max(self._capacity() - len(numbers), 0)):
                running.add(self._asked(numbers, following, message))
            yield number, reply

    def close(self) -> None:
        """Leave the scheduler, which forgets what nobody waits for; a scene that a worker is at is finished there."""
        self._client.close()

    def _asked(self, numbers: dict[Any, int], number: int, message: bytes) -> Any:
        # the message is part of the task, so that whoever loses it can have it again
        future = self._client.submit(answer, message, key=f"lidardesign-{uuid.uuid4()}", pure=False)
        numbers[future] = number
        return future

    def _capacity(self) -> int:
        """Messages that may be out: those that run at a time, as of now, and some that wait."""
        return AHEAD + sum(self._client.nthreads().values())

    def _result(self, future: Any, number: int) -> bytes:
        from distributed import CancelledError, KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            raise NumericalError(
                f"the workers of held-out scene {number} died, one after the other",
                where="--workers",
                hint="their logs say why; memory is the usual cause",
            ) from error
        except (CancelledError, OSError) as error:
            raise ConfigError(f"the scheduler at {self._address} was lost", where="--workers", hint=HINT) from error
        except ImportError as error:
            raise ConfigError(
                f"a worker cannot load this program: {error}",
                where="--workers",
                hint="install the same version of lidardesign and of the task everywhere",
            ) from error


def _connected(address: str) -> Any:
    try:
        with warnings.catch_warnings():
            # packages that differ are told by the answers, where it matters
            warnings.simplefilter("ignore")
            from distributed import Client
    except ImportError:
        raise ConfigError(
            "workers of a cluster need dask.distributed, which is not installed",
            where="--workers",
            hint="pip install 'lidardesign[cluster]'",
        ) from None
    # what it logs about connections that fail is told by the errors below
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=SCHEDULER_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        found = " ".join(str(error).split())
        raise ConfigError(f"no scheduler answers at {address}: {found}", where="--workers", hint=HINT) from None
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except asyncio.TimeoutError:
        client.close()
        raise ConfigError(
            f"the scheduler at {address} had no worker within {WORKER_SECONDS:g} s", where="--workers", hint=HINT
        ) from None
    return client
