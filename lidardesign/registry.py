"""Task plugins found through the entry-point group `lidardesign.tasks`; a broken one affects only itself.

Plugins of other packages are imported in a process of their own first: one that hangs in compiled code, where no signal
reaches Python, or crashes, ends that process and not this one.
"""

from __future__ import annotations

import contextlib
import difflib
import faulthandler
import functools
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, distributions, entry_points
from typing import Any

from lidardesign.errors import ConfigError, DataError, LidardesignError, PluginError
from lidardesign.run.clock import phase
from lidardesign.task import API_VERSION, Defaults, Metric, Task, TaskConfig

# In the environment of a probing process, so that a plugin that asks for tasks does not start further ones.
PROBING = "LIDARDESIGN_PROBING"
CHILD = (
    "import json, sys; request = json.loads(sys.stdin.readline()); sys.path[:] = request['path']; "
    "from lidardesign.registry import answer_probe; answer_probe(request)"
)
BEGUN = b"begun\n"
# Python and this package are loaded within this time [s], or the probe says nothing.
START_SECONDS = 60.0
# An import that can be interrupted was interrupted by then, and said so [s].
GRACE_SECONDS = 2.0
# The exit code of a probing process that could not say what it found.
UNANSWERED = 117


@dataclass(frozen=True)
class Probe:
    """What was found.

    Arguments:
        summary: The task's one-line summary, where it keeps the contract.
        error: Why it cannot be used, or None.
        contained: Whether importing it here would hang or crash this process.
    """

    summary: str = ""
    error: str | None = None
    contained: bool = False


class PluginProcess:
    """A process of its own that runs a plugin's code and answers by lines; to be ended in any case.

    Arguments:
        code: Python that reads the request, one line of JSON, from standard input.
        request: What it is asked.
    """

    def __init__(self, code: str, request: dict[str, Any]) -> None:
        self._lines: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, PROBING: "1"},
            # what the plugin starts is ended with it, and a terminal's Ctrl-C is for this process
            start_new_session=True,
        )
        threading.Thread(target=self._read, daemon=True).start()
        with contextlib.suppress(OSError), self._process.stdin as pipe:  # type: ignore[union-attr]
            pipe.write(json.dumps(request).encode() + b"\n")

    def end(self) -> None:
        """End the process and what it started."""
        if self._process.returncode is None and hasattr(os, "killpg"):
            with contextlib.suppress(OSError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.wait()

    def next_line(self, deadline: float) -> tuple[float, bytes | None]:
        """The next line and when it came: empty at the end, None where none came in time."""
        try:
            return self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
        except queue.Empty:
            return deadline, None

    def _read(self) -> None:
        with self._process.stdout as pipe:  # type: ignore[union-attr]
            while line := pipe.readline():
                self._lines.put((time.monotonic(), line))
        self._lines.put((time.monotonic(), b""))

    def died_of(self, deadline: float, when: str) -> str | None:
        """How it ended; None where it only closed its pipe and hangs until the deadline and a little longer.

        Arguments:
            deadline: On the monotonic clock [s].
            when: What the plugin did meanwhile, as "while it is imported".
        """
        try:
            code = self._process.wait(max(deadline - time.monotonic(), 0.0) + GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            return None
        if code == UNANSWERED:
            return f"closes files that it did not open {when}"
        if code < 0:
            return f"crashes {when} ({signal.strsignal(-code)})"
        return f"ends the program {when} (exit code {code})"


class ImportProcess(PluginProcess):
    """A plugin that is being imported elsewhere.

    Arguments:
        offer: Its entry point.
        seconds: How long the import may take.
    """

    def __init__(self, offer: EntryPoint, seconds: float) -> None:
        self._seconds = seconds
        super().__init__(CHILD, {"name": offer.name, "value": offer.value, "path": sys.path, "seconds": seconds})

    def result(self) -> Probe | None:
        """What came of it, waited for; None where nothing could be found out."""
        begun, line = self.next_line(time.monotonic() + START_SECONDS)
        if line != BEGUN:
            return None
        deadline = begun + self._seconds + GRACE_SECONDS
        _, line = self.next_line(deadline)
        if line:
            return _read(line)
        died_of = None if line is None else self.died_of(deadline, "while it is imported")
        return Probe(error=died_of or f"was not imported within {self._seconds:g} s", contained=True)


def _read(line: bytes) -> Probe:
    """The answer of a line; a plugin may have written it, which knows neither its form nor that it is read."""
    try:
        found = json.loads(line)
        return Probe(summary=str(found.get("summary", "")), error=found.get("error"))
    except (ValueError, AttributeError):
        return Probe(error="writes to a stream that is not its own while it is imported", contained=True)


def probed(offers: list[EntryPoint], seconds: float) -> list[Probe | None]:
    """What each of some plugins does, found out side by side; None where no process could tell.

    Arguments:
        offers: Their entry points.
        seconds: How long each import may take.
    """
    running: list[ImportProcess] = []
    try:
        for offer in offers:
            running.append(ImportProcess(offer, seconds))
        return [process.result() for process in running]
    except OSError:  # no further process may be started
        return [None] * len(offers)
    finally:
        for process in running:
            process.end()


def write_line(result: Any, document: dict[str, Any]) -> None:
    """Write a line of a probe's answer; a process that cannot is ended."""
    try:
        result.write(json.dumps(document).encode() + b"\n")
        result.flush()
    except OSError:
        os._exit(UNANSWERED)


def answer(result: Any, document: dict[str, Any]) -> None:
    """Write a probe's answer and end the probing process: threads and exit handlers of the plugin end with it."""
    write_line(result, document)
    os._exit(0)


GROUP = "lidardesign.tasks"
IMPORT_SECONDS = 30.0
AUTHOR_HINT = "report it to its author"
# Plugins that are imported elsewhere at the same time.
SIDE_BY_SIDE = 8


@dataclass(frozen=True)
class TaskListing:
    """One line of `tasks list`.

    Arguments:
        name: The entry point's name, as `learn` takes it.
        summary: The task's own one-line summary, empty where it is broken.
        distribution: The installed package that offers it.
        error: Why it cannot be used, or None.
    """

    name: str
    summary: str
    distribution: str
    error: str | None = None


@phase("tasks")
def list_tasks() -> list[TaskListing]:
    """Every installed task by name, broken ones with their reason."""
    found = sorted(_offers().items())
    foreign = [offers[0] for _, offers in found if len(offers) == 1 and _is_foreign(offers[0])]
    probes: dict[str, Probe | None] = {}
    for start in range(0, len(foreign), SIDE_BY_SIDE):
        some = foreign[start : start + SIDE_BY_SIDE]
        probes.update(zip((offer.name for offer in some), probed(some, IMPORT_SECONDS), strict=True))
    listings = []
    for name, offers in found:
        distribution, probe = ", ".join(_distribution(offer) for offer in offers), probes.get(name)
        if probe is None:
            try:
                probe = Probe(_load(name, offers).summary)
            except PluginError as error:
                probe = Probe(error=error.message)
        listings.append(TaskListing(name, probe.summary, distribution, probe.error))
    return listings


@phase("tasks")
def load_task(name: str) -> Task:
    """The task of a name, ready to use.

    Raises:
        ConfigError: No installed package offers it; the message lists what there is.
        PluginError: The plugin cannot be loaded, or does not keep the contract.
    """
    return _load(name, _known(name))


class UnknownTaskError(ConfigError):
    """A task that no installed package offers."""


def _known(name: str) -> list[EntryPoint]:
    offers = _offers()
    if name not in offers:
        close = difflib.get_close_matches(name, offers, n=1)
        raise UnknownTaskError(
            f"unknown task {name!r}",
            where="TASK",
            allowed=", ".join(sorted(offers)),
            hint=f"did you mean {close[0]!r}?" if close else "lidardesign tasks list",
        )
    return offers[name]


@contextlib.contextmanager
def plugin_guard(name: str) -> Iterator[None]:
    """Run a plugin's code; whatever it raises becomes a PluginError, but for errors of this program and of files.

    Whatever it prints goes to stderr, so that it cannot spoil a command's output.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except (LidardesignError, KeyboardInterrupt, GeneratorExit, MemoryError):
        raise
    except SystemExit as error:
        raise PluginError(f"tried to end the program (exit {error.code})", where=f"task {name}") from error
    except BaseException as error:
        if isinstance(error, OSError) and error.filename is not None:
            reason, hint = error.strerror or type(error).__name__, f"the task {name} reads it: check the path"
            raise DataError(f"cannot be read: {reason}", where=str(error.filename), hint=hint) from error
        raise PluginError(
            f"{type(error).__name__}: {text_of(error)}",
            where=f"task {name}",
            hint=f"LIDARDESIGN_DEBUG=1 shows where; {AUTHOR_HINT}",
        ) from error


def text_of(error: BaseException) -> str:
    """What an error says, on one line, whatever its class makes of that."""
    try:
        return " ".join(str(error).split()) or "no message"
    except Exception:
        return "no message"


def _offers() -> dict[str, list[EntryPoint]]:
    """Entry points by name; one that is found twice on the path (an editable install) counts once."""
    try:
        offers = list(entry_points(group=GROUP))
    except Exception:  # importlib reads those of all packages, and one broken file ends it
        offers = []
        for distribution in distributions():
            with contextlib.suppress(Exception):
                offers += distribution.entry_points.select(group=GROUP)
    found: dict[str, list[EntryPoint]] = {}
    for offer in offers:
        same_name = found.setdefault(offer.name, [])
        if all(offer.value != other.value for other in same_name):
            same_name.append(offer)
    return {name: sorted(same_name, key=_distribution) for name, same_name in found.items()}


def _distribution(offer: EntryPoint) -> str:
    return f"{offer.dist.name} {offer.dist.version}" if offer.dist else "unknown"


def _load(name: str, offers: list[EntryPoint]) -> Task:
    offer = _only(name, offers)
    if _is_foreign(offer):
        _check_containable(name, offer.value, tuple(sys.path))
    return import_task(offer, IMPORT_SECONDS)


def _only(name: str, offers: list[EntryPoint]) -> EntryPoint:
    if len(offers) > 1:
        packages = " and ".join(f"{_distribution(offer)} ({offer.value})" for offer in offers)
        raise PluginError(f"is offered by {packages}", where=f"task {name}", hint="uninstall only one of them")
    return offers[0]


def import_task(offer: EntryPoint, seconds: float) -> Task:
    """The task of an entry point, imported here and now.

    Raises:
        PluginError: It cannot be loaded in time, or does not keep the contract.
    """
    with plugin_guard(offer.name), _time_limit(offer.name, seconds):
        plugin = offer.load()
        task = plugin() if callable(plugin) else plugin
        check_interface(offer.name, task)
    return task


def _is_foreign(offer: EntryPoint) -> bool:
    """Whether a plugin is none of this package's own, and this is not the process that finds out about it."""
    return PROBING not in os.environ and (offer.dist is None or offer.dist.name != "lidardesign")


@functools.cache
def _check_containable(name: str, value: str, path: tuple[str, ...]) -> None:
    """Import a plugin elsewhere first; what it raises there, it raises here as well, and can be shown where.

    Raises:
        PluginError: It hangs, or ends the process.
    """
    (probe,) = probed([EntryPoint(name, value, GROUP)], IMPORT_SECONDS)
    if probe is not None and probe.contained:
        raise PluginError(str(probe.error), where=f"task {name}", hint=AUTHOR_HINT)


def distribution_of(name: str) -> str:
    """The installed package that a task comes with, and its version; empty where that is not known."""
    offers = _offers().get(name, [])
    return _distribution(offers[0]) if len(offers) == 1 and offers[0].dist else ""


def task_names() -> list[str]:
    """The names of all installed tasks, with nothing imported."""
    return sorted(_offers())


def offer_of(name: str) -> EntryPoint:
    """The one entry point of a name, with nothing imported.

    Raises:
        ConfigError: No installed package offers it; the message lists what there is.
        PluginError: Several do.
    """
    return _only(name, _known(name))


def answer_probe(request: dict[str, Any]) -> None:
    """In the process of a probe: import the plugin that is asked about, answer on stdout, and end."""
    result = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    nowhere = open(os.devnull, "w")  # noqa: SIM115 - lives as long as the process
    os.dup2(nowhere.fileno(), sys.stdout.fileno())
    name, seconds = request["name"], request["seconds"]
    result.write(BEGUN)
    result.flush()
    # ends this process even where nobody is left to do it, and long after whoever asked has stopped waiting
    faulthandler.dump_traceback_later(seconds + START_SECONDS, exit=True, file=nowhere)
    try:
        answer(result, {"summary": import_task(EntryPoint(name, request["value"], GROUP), seconds).summary})
    except PluginError as error:
        answer(result, {"error": error.message})
    except BaseException as error:
        answer(result, {"error": f"{type(error).__name__}: {text_of(error)}"})


@contextlib.contextmanager
def _time_limit(name: str, seconds: float) -> Iterator[None]:
    """Interrupt an import that hangs; only where the system can (POSIX signals, main thread)."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: Any) -> None:
        raise PluginError(f"was not imported within {seconds:g} s", where=f"task {name}", hint=AUTHOR_HINT)

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


def check_interface(name: str, task: Any) -> None:
    """Check that an object keeps the task contract.

    Raises:
        PluginError: Naming the first member that is missing or of the wrong type.
    """
    version = getattr(task, "api_version", None)
    if version != API_VERSION:
        raise PluginError(
            f"was written for version {version!r} of the task interface",
            where=f"task {name}",
            allowed=str(API_VERSION),
            hint="install matching versions of lidardesign and the plugin",
        )
    for member, kind in (("name", str), ("summary", str), ("metric", Metric), ("defaults", Defaults)):
        if not isinstance(getattr(task, member, None), kind):
            raise PluginError(f"its {member} is no {kind.__name__}", where=f"task {name}", hint=AUTHOR_HINT)
    if not (isinstance(getattr(task, "Config", None), type) and issubclass(task.Config, TaskConfig)):
        raise PluginError("its Config is not a subclass of TaskConfig", where=f"task {name}", hint=AUTHOR_HINT)
    for member in ("space", "scenes", "score"):
        if not callable(getattr(task, member, None)):
            raise PluginError(f"it has no method {member}()", where=f"task {name}", hint=AUTHOR_HINT)
    if task.name != name:
        raise PluginError(f"its name is {task.name!r}", where=f"task {name}", hint=AUTHOR_HINT)
