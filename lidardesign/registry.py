"""Task plugins found through the entry-point group `lidardesign.tasks`; a broken one affects only itself."""

from __future__ import annotations

import contextlib
import difflib
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from lidardesign.errors import ConfigError, LidardesignError, PluginError
from lidardesign.run.clock import phase
from lidardesign.task import API_VERSION, Defaults, Metric, Task, TaskConfig

GROUP = "lidardesign.tasks"
IMPORT_SECONDS = 30.0
LIST_HINT = "lidardesign tasks list"


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
    listings = []
    for name, offers in sorted(_offers().items()):
        distribution = ", ".join(_distribution(offer) for offer in offers)
        try:
            task = _load(name, offers)
        except PluginError as error:
            listings.append(TaskListing(name, "", distribution, error.message))
        else:
            listings.append(TaskListing(name, task.summary, distribution))
    return listings


@phase("tasks")
def load_task(name: str) -> Task:
    """The task of a name, ready to use.

    Raises:
        ConfigError: No installed package offers it; the message lists what there is.
        PluginError: The plugin cannot be loaded, or does not keep the contract.
    """
    offers = _offers()
    if name not in offers:
        close = difflib.get_close_matches(name, offers, n=1)
        hint = f"did you mean {close[0]!r}?" if close else LIST_HINT
        raise ConfigError(f"unknown task {name!r}", where="TASK", allowed=", ".join(sorted(offers)), hint=hint)
    return _load(name, offers[name])


@contextlib.contextmanager
def plugin_guard(name: str) -> Iterator[None]:
    """Run a plugin's code; what it raises, other than this program's own errors, becomes a PluginError.

    Whatever it prints goes to stderr, so that it cannot spoil a command's output.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except (LidardesignError, KeyboardInterrupt, MemoryError):
        raise
    except SystemExit as error:
        raise PluginError(f"tried to end the program (exit {error.code})", where=f"task {name}") from error
    except Exception as error:
        text = " ".join(str(error).split()) or "no message"
        raise PluginError(
            f"{type(error).__name__}: {text}",
            where=f"task {name}",
            hint="--debug shows where; tell its author",
        ) from error


def _offers() -> dict[str, list[EntryPoint]]:
    """Entry points by name; one that is found twice on the path (an editable install) counts once."""
    found: dict[str, list[EntryPoint]] = {}
    for offer in entry_points(group=GROUP):
        same_name = found.setdefault(offer.name, [])
        if all(offer.value != other.value for other in same_name):
            same_name.append(offer)
    return found


def _distribution(offer: EntryPoint) -> str:
    return f"{offer.dist.name} {offer.dist.version}" if offer.dist else "unknown"


def _load(name: str, offers: list[EntryPoint]) -> Task:
    if len(offers) > 1:
        packages = " and ".join(f"{_distribution(offer)} ({offer.value})" for offer in offers)
        raise PluginError(f"is offered by {packages}", where=f"task {name}", hint="uninstall one of them")
    with plugin_guard(name), _time_limit(name):
        plugin = offers[0].load()
        task = plugin() if callable(plugin) else plugin
    _check(name, task)
    return task


@contextlib.contextmanager
def _time_limit(name: str) -> Iterator[None]:
    """Interrupt an import that hangs; only where the system can (POSIX signals, main thread)."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: Any) -> None:
        raise PluginError(f"was not imported within {IMPORT_SECONDS:g} s", where=f"task {name}", hint="tell its author")

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, IMPORT_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


def _check(name: str, task: Any) -> None:
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
            raise PluginError(f"its {member} is no {kind.__name__}", where=f"task {name}", hint="tell its author")
    if not (isinstance(getattr(task, "Config", None), type) and issubclass(task.Config, TaskConfig)):
        raise PluginError("its Config is no subclass of TaskConfig", where=f"task {name}", hint="tell its author")
    for member in ("space", "scenes", "score"):
        if not callable(getattr(task, member, None)):
            raise PluginError(f"it has no method {member}()", where=f"task {name}", hint="tell its author")
    if task.name != name:
        raise PluginError(f"it calls itself {task.name!r}", where=f"task {name}", hint="tell its author")
