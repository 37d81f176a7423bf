"""Task plugins of the entry-point group `lidardesign.tasks`; a broken one affects only itself.

Plugins of other packages are first imported in a child process: one that crashes, or hangs in compiled code where no
signal reaches Python, affects only that process.
"""

from __future__ import annotations

import contextlib
import difflib
import faulthandler
import functools
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, distributions, entry_points
from typing import Any, NoReturn

from lidardesign.errors import ConfigError, DataError, LidardesignError, PluginError, lacks_memory, text_of
from lidardesign.run.clock import phase
from lidardesign.run.processes import START_SECONDS, Child, ChildError
from lidardesign.task import API_VERSION, Defaults, Metric, Task, TaskConfig

# Environment variable of a probing process, so that a plugin that loads tasks starts no further ones.
PROBING = "LIDARDESIGN_PROBING"


@dataclass(frozen=True)
class Probe:
    """Result of importing a plugin in a child process.

    Arguments:
        summary: The task's one-line summary, if it fulfils the contract.
        error: Reason why it cannot be used, or None.
        contained: Whether importing it here would hang or crash this process.
    """

    summary: str = ""
    error: str | None = None
    contained: bool = False


def probe_plugins(offers: list[EntryPoint], seconds: float) -> list[Probe | None]:
    """Import plugins in child processes side by side; None for one whose process could not be started.

    Arguments:
        offers: Entry points of the plugins.
        seconds: Time limit of each import [s].
    """
    running: list[Child] = []
    try:
        for offer in offers:
            request = {"name": offer.name, "value": offer.value, "seconds": seconds}
            running.append(Child(f"{__name__}:answer_probe", request, {PROBING: "1"}))
        return [_probe_of(child, seconds) for child in running]
    except OSError:  # no further process may be started
        return [None] * len(offers)
    finally:
        for child in running:
            child.end()


def _probe_of(child: Child, seconds: float) -> Probe | None:
    try:
        found = child.answer(seconds, "while it is imported")
    except ChildError as lost:
        error = f"was not imported within {seconds:g} s" if lost.reason == "late" else str(lost)
        return None if lost.reason == "unstarted" else Probe(error=error, contained=True)
    return Probe(summary=str(found.get("summary", "")), error=found.get("error"))


GROUP = "lidardesign.tasks"
IMPORT_SECONDS = 30.0
AUTHOR_HINT = "report it to its author"
END_PROCESS, HERE = os._exit, getattr(os, "O_PATH", os.O_RDONLY)
# Child processes at the same time.
SIDE_BY_SIDE = 8


@dataclass(frozen=True)
class TaskListing:
    """A line of `tasks list`.

    Arguments:
        name: Name of the entry point, for `learn`.
        summary: The task's own one-line summary, empty where it is broken.
        distribution: The installed package that offers it.
        error: Reason why it cannot be used, or None.
    """

    name: str
    summary: str
    distribution: str
    error: str | None = None


@phase("tasks")
def list_tasks() -> list[TaskListing]:
    """All installed tasks by name, broken ones with the reason."""
    found = sorted(_entry_points_by_name().items())
    foreign = [offers[0] for _, offers in found if len(offers) == 1 and _is_foreign(offers[0])]
    probes: dict[str, Probe | None] = {}
    for start in range(0, len(foreign), SIDE_BY_SIDE):
        some = foreign[start : start + SIDE_BY_SIDE]
        probes.update(zip((offer.name for offer in some), probe_plugins(some, IMPORT_SECONDS), strict=True))
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
    """Load the task of a name.

    Raises:
        ConfigError: No installed package offers it; the message lists all tasks.
        PluginError: The plugin cannot be loaded, or breaks the contract.
    """
    return _load(name, _known(name))


class UnknownTaskError(ConfigError):
    """A task that no installed package offers."""


def _known(name: str) -> list[EntryPoint]:
    offers = _entry_points_by_name()
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
    """Run a plugin's code; its exceptions become PluginErrors, except errors of this program and of files.

    Its output goes to stderr, so that it cannot corrupt a command's output.
    """
    try:
        with _unchanged_process(), contextlib.redirect_stdout(sys.stderr):
            yield
    except (LidardesignError, KeyboardInterrupt, MemoryError):
        raise
    except SystemExit as error:
        raise PluginError(f"tried to end the program (exit {error.code})", where=f"task {name}") from error
    except BaseException as error:
        if lacks_memory(error):
            raise MemoryError from error
        if isinstance(error, OSError) and error.filename is not None:
            reason, hint = error.strerror or type(error).__name__, f"the task {name} reads it: check the path"
            raise DataError(f"cannot be read: {reason}", where=str(error.filename), hint=hint) from error
        raise PluginError(
            f"{type(error).__name__}: {text_of(error)}",
            where=f"task {name}",
            hint=f"LIDARDESIGN_DEBUG=1 shows where; {AUTHOR_HINT}",
        ) from error


@contextlib.contextmanager
def _unchanged_process() -> Iterator[None]:
    """Put folder and umask back; `os._exit` raises SystemExit, and a process that was forked meanwhile ends."""
    # by its number a folder is found again even where it has gone
    process, mask, folder = os.getpid(), os.umask(0o077), os.open(".", HERE)
    os.umask(mask)

    def leave(status: int) -> NoReturn:
        raise SystemExit(status if os.getpid() == process else END_PROCESS(status))

    os._exit = leave
    try:
        yield
    finally:
        if os.getpid() != process:
            END_PROCESS(0)
        # never what another thread has put there meanwhile
        os._exit = END_PROCESS
        os.umask(mask)
        os.fchdir(folder)
        os.close(folder)


@contextlib.contextmanager
def plugin_method(name: str, method: str, where: str) -> Iterator[None]:
    """Run a plugin's method as `plugin_guard` does; its errors say which method failed, and where."""
    try:
        with plugin_guard(name):
            yield
    except PluginError as error:
        raise PluginError(f"{method} failed: {error.message}", where=where, hint=error.hint) from error


def _entry_points_by_name() -> dict[str, list[EntryPoint]]:
    """Entry points by name; duplicates on the path (an editable install) count once."""
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
    offer = _unique_entry_point(name, offers)
    if _is_foreign(offer):
        _check_containable(name, offer.value, tuple(sys.path))
    return import_task(offer)


def _unique_entry_point(name: str, offers: list[EntryPoint]) -> EntryPoint:
    if len(offers) > 1:
        packages = " and ".join(f"{_distribution(offer)} ({offer.value})" for offer in offers)
        raise PluginError(f"is offered by {packages}", where=f"task {name}", hint="uninstall only one of them")
    return offers[0]


def import_task(offer: EntryPoint) -> Task:
    """Import the task of an entry point in this process.

    Raises:
        PluginError: It cannot be loaded, or breaks the contract.
    """
    with plugin_guard(offer.name):
        plugin = offer.load()
        task = plugin() if callable(plugin) else plugin
        check_interface(offer.name, task)
    return task


def _is_foreign(offer: EntryPoint) -> bool:
    """True if a plugin is of another package and this is not a probing process."""
    return PROBING not in os.environ and (offer.dist is None or offer.dist.name != "lidardesign")


@functools.cache
def _check_containable(name: str, value: str, path: tuple[str, ...]) -> None:
    """Import a plugin in a child process, and refuse one that hangs or crashes; other errors recur in this process.

    Raises:
        PluginError: It hangs, or ends the process.
    """
    (probe,) = probe_plugins([EntryPoint(name, value, GROUP)], IMPORT_SECONDS)
    if probe is not None and probe.contained:
        raise PluginError(str(probe.error), where=f"task {name}", hint=AUTHOR_HINT)


def distribution_of(name: str) -> str:
    """Name and version of the installed package of a task; empty if unknown."""
    offers = _entry_points_by_name().get(name, [])
    return _distribution(offers[0]) if len(offers) == 1 and offers[0].dist else ""


def task_names() -> list[str]:
    """Names of all installed tasks, without importing any."""
    return sorted(_entry_points_by_name())


def offer_of(name: str) -> EntryPoint:
    """The unique entry point of a name, without importing it.

    Raises:
        ConfigError: No installed package offers it; the message lists all tasks.
        PluginError: Several do.
    """
    return _unique_entry_point(name, _known(name))


def answer_probe(request: dict[str, Any], _: object) -> dict[str, Any]:
    """Import the requested plugin in a probing process, and return its summary or error."""
    # ends this process even if the parent has gone, well after the parent's time limit
    faulthandler.dump_traceback_later(request["seconds"] + START_SECONDS, exit=True)
    offer = EntryPoint(request["name"], request["value"], GROUP)
    try:
        return {"summary": import_task(offer).summary}
    except BaseException as error:
        return {"error": getattr(error, "message", None) or f"{type(error).__name__}: {text_of(error)}"}


def check_interface(name: str, task: Any) -> None:
    """Check that an object fulfils the task contract.

    Raises:
        PluginError: The first member that is missing or of the wrong type.
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
            raise PluginError(f"its {member} is not of type {kind.__name__}", where=f"task {name}", hint=AUTHOR_HINT)
    if not (isinstance(getattr(task, "Config", None), type) and issubclass(task.Config, TaskConfig)):
        raise PluginError("its Config is not a subclass of TaskConfig", where=f"task {name}", hint=AUTHOR_HINT)
    for member in ("space", "scenes", "score"):
        if not callable(getattr(task, member, None)):
            raise PluginError(f"it has no method {member}()", where=f"task {name}", hint=AUTHOR_HINT)
    if task.name != name:
        raise PluginError(f"its name is {task.name!r}", where=f"task {name}", hint=AUTHOR_HINT)
