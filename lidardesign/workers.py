"""Processing of scenes by worker processes of this machine, or by the workers of a dask scheduler.

A scene is sent with its rays, and the same function runs on it as in this process: the results are the same for any
number of workers. Workers report their own times, which add up to more than the elapsed time.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import multiprocessing
import os
import re
import signal
import sys
import threading
import types
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

from lidardesign import __version__
from lidardesign.errors import ConfigError, LidardesignError, NumericalError, page
from lidardesign.task import TASKS, Task, load_task

ADDRESS = re.compile(r"tcp://(\[[0-9a-fA-F:]+\]|[^\s:/\[\]]+):([0-9]{1,5})")
MOST_PROCESSES = 1024
OPTION = "--workers"
# A running scheduler answers at once; workers of a batch system may still be waiting for their machines.
SCHEDULER_SECONDS, WORKER_SECONDS = 10.0, 60.0
SAME_HINT = "install the same versions of lidardesign and of the task for the scheduler and all workers"
# Scenes submitted beyond the running ones, so that no worker waits for this process.
AHEAD = 2
_one_at_a_time = threading.Lock()
Result = TypeVar("Result")


class Starmap(Protocol):
    """Calls a function with each tuple of arguments; results in their order, as `itertools.starmap`."""

    def __call__(self, function: Callable[..., Result], asked: Iterable[tuple[Any, ...]]) -> Iterable[Result]:
        """The results, in order."""
        ...


def check_workers(text: str) -> int | str:
    """The value of `--workers`: a number of processes, or the address of a scheduler.

    Raises:
        ConfigError: It is neither.
    """
    text = text.strip()
    address = ADDRESS.fullmatch(text)
    if address and 0 < int(address.group(2)) <= 65_535:
        return text
    if re.fullmatch("[0-9]{1,9}", text) and 1 <= int(text) <= MOST_PROCESSES:
        return int(text)
    allowed = f"a whole number from 1 to {MOST_PROCESSES}, or tcp://HOST:PORT of a dask scheduler"
    raise ConfigError(f"{text!r}", where=OPTION, allowed=allowed)


@contextlib.contextmanager
def opened_workers(workers: int | str, task: Task, scenes: int) -> Iterator[Starmap]:
    """Open workers, as a number of processes or a scheduler's address; processes end with the context.

    Arguments:
        workers: As from `check_workers`.
        task: The task of the scenes.
        scenes: Number of scenes, an upper limit of the processes.

    Raises:
        ConfigError: No scheduler answers, it has no workers, or the task is not the installed one of its name.
        NumericalError: A worker died.
    """
    if isinstance(workers, int) and min(workers, scenes) == 1:
        yield itertools.starmap
        return
    if type(load_task(task.name)) is not type(task):
        raise ConfigError(
            f"task {task.name} is not the installed task of this name",
            where=OPTION,
            hint="workers import a task by its entry point; without workers any task will do",
        )
    opened = _cluster(workers, task) if isinstance(workers, str) else _processes(min(workers, scenes))
    with opened as (submit, threads):
        yield partial(_map_there, submit, threads, task)


def _map_there(
    submit: Callable[..., Future[Any]],
    threads: Callable[[], int],
    task: Task,
    function: Callable[..., Result],
    asked: Iterable[tuple[Any, ...]],
) -> Iterator[Result]:
    """Results in the order of the calls, so that the first of several errors is raised."""
    asked, waiting, versions = iter(asked), deque[Future[Result]](), _versions(task)
    while True:
        for arguments in islice(asked, max(threads() + AHEAD - len(waiting), 0)):
            waiting.append(submit(_call, versions, task, function, *arguments))
        if not waiting:
            return
        first = waiting.popleft()
        while not wait([first], WORKER_SECONDS).done:
            threads()
        yield first.result()


def _call(versions: str, task: Task, function: Callable[..., Result], *arguments: Any) -> Result:
    """Call a function in a worker, one thread at a time: tasks need not be thread-safe."""
    _check_versions(versions, task)
    with _one_at_a_time:
        return function(*arguments)


def _versions(task: Task) -> str:
    """Versions of this program and of a task's package, as text."""
    return f"lidardesign {__version__} with {TASKS.distribution_of(task.name) or 'no such task'}"


def _check_versions(wanted: str, task: Task) -> None:
    if _versions(task) != wanted:
        raise ConfigError(f"the cluster has {_versions(task)}", where=OPTION, allowed=wanted, hint=SAME_HINT)


@contextlib.contextmanager
def _processes(count: int) -> Iterator[tuple[Callable[..., Future[Any]], Callable[[], int]]]:
    """Worker processes of this machine, all started at once and killed at the end, even while busy.

    Each has a thread here and a pipe of its own, which ends when its process dies, also in the middle of a message.
    The pools of Python and of loky share one pipe: a process that dies while it writes there is waited for for ever.
    """
    context, processes, idle = multiprocessing.get_context("spawn"), [], SimpleQueue[Connection]()

    def ask(function: Callable[..., Result], *arguments: Any) -> Result:
        pipe = idle.get()
        try:
            pipe.send((function, arguments))
            result, error = pipe.recv()
        except (EOFError, OSError) as lost:
            for process in processes:  # calls before this one would be waited for
                process.kill()
            raise NumericalError(
                "a worker process died",
                where=OPTION,
                hint="memory is the usual cause, and fewer workers need less; --workers 1 needs no second process",
            ) from lost
        finally:
            idle.put(pipe)
        if error:
            raise error
        return result

    threads = ThreadPoolExecutor(count)
    try:
        with _undisturbed():
            for _ in range(count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs,))
                process.start()
                processes.append(process)
                theirs.close()
                idle.put(ours)
        yield partial(threads.submit, ask), lambda: count
    except BlockingIOError as error:
        raise ConfigError(f"{count} processes could not be started: {error.strerror}", where=OPTION) from error
    finally:
        for process in processes:
            process.kill()
        threads.shutdown(cancel_futures=True)
        for process in processes:
            process.join()


def _work(pipe: Connection) -> None:
    """Answer the calls that come through a pipe, with the result or with what was raised."""
    _end_with_parent()
    # the other end is closed when nobody waits any more
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            function, arguments = pipe.recv()
            try:
                pipe.send((function(*arguments), None))
            except Exception as error:
                pipe.send((None, ExceptionWithTraceback(error, error.__traceback__)))


def _end_with_parent() -> None:
    """End a worker as soon as its parent process has gone, even during a scene."""

    def watch(end: Callable[[int], object] = os._exit) -> None:  # as it is before a plugin runs
        multiprocessing.parent_process().join()
        end(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Start processes that never receive a terminal's Ctrl-C and do not run the user's script again."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        sys.modules["__main__"] = script


@contextlib.contextmanager
def _cluster(address: str, task: Task) -> Iterator[tuple[Callable[..., Future[Any]], Callable[[], int]]]:
    """Workers of a running scheduler, which gives the scenes of lost workers to others.

    Logs of dask.distributed about lost connections are silenced in favour of the errors raised here.
    """
    try:
        with warnings.catch_warnings():
            # deprecation warnings of packages
            warnings.simplefilter("ignore")
            from distributed import Client, KilledWorker
    except ImportError:
        raise ConfigError(
            "workers of a cluster need dask.distributed, which is not installed",
            where=OPTION,
            hint="pip install 'lidardesign[cluster]'",
        ) from None
    hint = f"{page('cluster.md')} has the commands that start a scheduler and its workers"
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as opened:
        opened.callback(logger.setLevel, level)
        opened.enter_context(warnings.catch_warnings())
        # many rays make a long message, which is short compared with their simulation
        warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
        try:
            # nothing may ever come from what listens there; a notebook's own loop runs in this thread
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, asyncio.wait_for(_greet(address), 1.5 * SCHEDULER_SECONDS)).result()
            client = Client(address, timeout=SCHEDULER_SECONDS, set_as_default=False)
        except Exception as error:
            # what is no OSError comes of bytes that are not a scheduler's
            said = str(error) if isinstance(error, OSError) else ""
            why = " ".join(said.split()) or "something listens there, but it is not a dask scheduler"
            raise ConfigError(f"no scheduler answers at {address}: {why}", where=OPTION, hint=hint) from None
        opened.callback(client.close)

        def threads() -> int:
            client.wait_for_workers(1, timeout=WORKER_SECONDS)
            return sum(client.nthreads().values())

        try:
            threads()
            _check_cluster(client, task)
            yield client.get_executor(pure=False).submit, threads
        except KilledWorker as error:
            why = "the workers of a scene died, one after the other"
            raise NumericalError(why, where=OPTION, hint="their logs say why; memory is the usual cause") from error
        except TimeoutError as error:
            why = f"the scheduler at {address} had no worker within {WORKER_SECONDS:g} s"
            raise ConfigError(why, where=OPTION, hint=hint) from error
        except (CancelledError, OSError) as error:
            raise ConfigError(f"the scheduler at {address} was lost", where=OPTION, hint=hint) from error


def _check_cluster(client: Any, task: Task) -> None:
    """Refuse a scheduler or workers with other versions, which would fail on the tasks sent to them."""
    try:
        for ask in (client.run_on_scheduler, client.run):
            ask(_check_versions, _versions(task), task)
    except LidardesignError:
        raise
    except Exception as error:
        # an ImportError, as wrapped by dask
        raise ConfigError(f"the cluster cannot run this program: {error}", where=OPTION, hint=SAME_HINT) from error


async def _greet(address: str) -> None:
    """Ask a scheduler who it is: a client that meets something else there waits for it again when it ends."""
    from distributed.comm import connect

    comm = await connect(address, timeout=SCHEDULER_SECONDS)
    await comm.write({"op": "identity", "reply": True})
    await comm.read()
    comm.abort()
