"""Plugins of entry-point groups, each group with a contract of its own; a broken one affects only itself.

Plugins of other packages are first imported in a child process: one that crashes, or hangs in compiled code where no
signal reaches Python, affects only that process.
"""

from __future__ import annotations

import contextlib
import faulthandler
import functools
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, distributions, entry_points
from typing import Any, Generic, NoReturn, TypeVar

from lidardesign.errors import ConfigError, DataError, LidardesignError, PluginError, lacks_memory, text_of
from lidardesign.run.clock import phase
from lidardesign.run.processes import START_SECONDS, Child, ChildError
from lidardesign.run.validation import suggest

# Environment variable of a probing process, so that a plugin that loads others starts no further ones.
PROBING = "LIDARDESIGN_PROBING"
IMPORT_SECONDS = 30.0
AUTHOR_HINT = "report it to its author"
END_PROCESS, HERE = os._exit, getattr(os, "O_PATH", os.O_RDONLY)
# Child processes at the same time.
SIDE_BY_SIDE = 8
T = TypeVar("T")


@dataclass(frozen=True)
class Listing:
    """A line of a list of plugins.

    Arguments:
        name: Name of the entry point.
        distribution: The installed package that offers it.
        facts: What its contract says of it in lists, such as its summary; empty where it is broken.
        error: Reason why it cannot be used, or None.
        is_fatal: Whether importing it here would hang or crash this process.
    """

    name: str
    distribution: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None
    is_fatal: bool = False


class UnknownPluginError(ConfigError):
    """A plugin that no installed package offers."""


@dataclass(frozen=True)
class PluginKind(Generic[T]):
    """The plugins of one kind; it stands beside its `check` under the plural of its noun in capitals, as TASKS.

    Arguments:
        group: Their entry-point group.
        noun: One of them in messages.
        check: Checks a plugin that was offered by a name, raising PluginError; returns what lists say of it, as JSON.
    """

    group: str
    noun: str
    check: Callable[[str, Any], Mapping[str, Any]]

    def names(self) -> list[str]:
        """Names of all installed ones, without importing any."""
        return sorted(self._offers())

    def allowed(self) -> str:
        """The names in words, for messages."""
        return ", ".join(self.names()) or f"none: install lidardesign again, which lists no {self.noun}s"

    def listings(self) -> list[Listing]:
        """All installed ones by name, broken ones with the reason."""
        with phase("plugins"):
            found = self._offers()
            foreign = [offers[0] for _, offers in sorted(found.items()) if len(offers) == 1 and _is_foreign(offers[0])]
            probed: dict[str, Listing | None] = {}
            for start in range(0, len(foreign), SIDE_BY_SIDE):
                some = foreign[start : start + SIDE_BY_SIDE]
                probed.update(zip((offer.name for offer in some), self.probe(some), strict=True))
            return [probed.get(name) or self._listed(name, offers) for name, offers in sorted(found.items())]

    def load(self, name: str) -> T:
        """Load the one of a name.

        Raises:
            ConfigError: No installed package offers it; the message lists all.
            PluginError: The plugin cannot be loaded, or breaks the contract.
        """
        return self.loaded(name)[0]

    def loaded(self, name: str) -> tuple[T, Mapping[str, Any]]:
        """The one of a name, and what lists say of it; errors as of `load`."""
        with phase("plugins"):
            offer = self.offer_of(name)
            if _is_foreign(offer):
                _check_containable(self, name, offer.value, tuple(sys.path))
            return self.imported(offer)

    def offer_of(self, name: str) -> EntryPoint:
        """The unique entry point of a name, without importing it.

        Raises:
            ConfigError: No installed package offers it; the message lists all.
            PluginError: Several do.
        """
        found = self._offers()
        if name not in found:
            raise UnknownPluginError(
                f"unknown {self.noun} {name!r}",
                where=self.noun.upper(),
                allowed=self.allowed(),
                hint=suggest(name, found) or f"lidardesign {self.noun}s list",
            )
        offer, *others = found[name]
        if others:
            packages = " and ".join(f"{_distribution(one)} ({one.value})" for one in found[name])
            where = f"{self.noun} {name}"
            raise PluginError(f"is offered by {packages}", where=where, hint="uninstall only one of them")
        return offer

    def imported(self, offer: EntryPoint) -> tuple[T, Mapping[str, Any]]:
        """Import the plugin of an entry point in this process; it, and what lists say of it.

        Raises:
            PluginError: It cannot be loaded, or breaks the contract.
        """
        with plugin_guard(offer.name, self.noun):
            loaded = offer.load()
            plugin = loaded() if callable(loaded) else loaded
            return plugin, self.check(offer.name, plugin)

    def distribution_of(self, name: str) -> str:
        """Name and version of the installed package of a plugin; empty if unknown."""
        offers = self._offers().get(name, [])
        return _distribution(offers[0]) if len(offers) == 1 and offers[0].dist else ""

    def is_shipped(self, name: str) -> bool:
        """True if this package alone offers the name."""
        return [offer.dist and offer.dist.name for offer in self._offers().get(name, [])] == ["lidardesign"]

    def _offers(self) -> dict[str, list[EntryPoint]]:
        return _entry_points_by_name(self.group, tuple(sys.path))

    def _listed(self, name: str, offers: list[EntryPoint]) -> Listing:
        distribution = ", ".join(map(_distribution, offers))
        try:
            return Listing(name, distribution, self.loaded(name)[1])
        except PluginError as error:
            return Listing(name, distribution, error=error.message)

    def probe(self, offers: list[EntryPoint]) -> list[Listing | None]:
        """Import plugins in child processes side by side; None for one whose process could not be started."""
        running: list[Child] = []
        try:
            for offer in offers:
                request = {"name": offer.name, "value": offer.value, "seconds": IMPORT_SECONDS}
                work = f"{self.check.__module__}:{self.noun.upper()}S.answer_probe"
                running.append(Child(work, request, {PROBING: "1"}))
            return [_probed(child, offer) for child, offer in zip(running, offers, strict=True)]
        except OSError:  # no further process may be started
            return [None] * len(offers)
        finally:
            for child in running:
                child.end()

    def answer_probe(self, request: dict[str, Any], _: object) -> dict[str, Any]:
        """Import the requested plugin in a probing process, and return what lists say of it, or the error."""
        # ends this process even if the parent has gone, well after the parent's time limit
        faulthandler.dump_traceback_later(request["seconds"] + START_SECONDS, exit=True)
        try:
            return {"facts": dict(self.imported(EntryPoint(request["name"], request["value"], self.group))[1])}
        except BaseException as error:
            return {"error": getattr(error, "message", None) or f"{type(error).__name__}: {text_of(error)}"}


@functools.cache
def _check_containable(kind: PluginKind[Any], name: str, value: str, path: tuple[str, ...]) -> None:
    """Import a plugin in a child process, and refuse one that hangs or crashes; other errors recur in this process.

    Raises:
        PluginError: It hangs, or ends the process.
    """
    (probed,) = kind.probe([EntryPoint(name, value, kind.group)])
    if probed is not None and probed.is_fatal:
        raise PluginError(str(probed.error), where=f"{kind.noun} {name}", hint=AUTHOR_HINT)


def _probed(child: Child, offer: EntryPoint) -> Listing | None:
    try:
        found = child.answer(IMPORT_SECONDS, "while it is imported")
    except ChildError as lost:
        error = f"was not imported within {IMPORT_SECONDS:g} s" if lost.reason == "late" else str(lost)
        unstarted = lost.reason == "unstarted"
        return None if unstarted else Listing(offer.name, _distribution(offer), error=error, is_fatal=True)
    return Listing(offer.name, _distribution(offer), found.get("facts", {}), found.get("error"))


@contextlib.contextmanager
def plugin_guard(name: str, noun: str = "task") -> Iterator[None]:
    """Run a plugin's code; its exceptions become PluginErrors, except errors of this program and of files.

    Its output goes to stderr, so that it cannot corrupt a command's output.
    """
    try:
        with _unchanged_process(), contextlib.redirect_stdout(sys.stderr):
            yield
    except (LidardesignError, KeyboardInterrupt, MemoryError):
        raise
    except SystemExit as error:
        raise PluginError(f"tried to end the program (exit {error.code})", where=f"{noun} {name}") from error
    except BaseException as error:
        if lacks_memory(error):
            raise MemoryError from error
        if isinstance(error, OSError) and error.filename is not None:
            does, done = ("reads", "read") if noun == "task" else ("uses", "used")
            reason, hint = error.strerror or type(error).__name__, f"the {noun} {name} {does} it: check the path"
            raise DataError(f"cannot be {done}: {reason}", where=str(error.filename), hint=hint) from error
        raise PluginError(
            f"{type(error).__name__}: {text_of(error)}",
            where=f"{noun} {name}",
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


def check_members(noun: str, name: str, plugin: Any, api_version: int, /, **kinds: type) -> None:
    """Check the version of a plugin's contract, the types of its members, and its name.

    Arguments:
        noun: One of its kind in messages.
        name: The name that it was offered by.
        plugin: The plugin.
        api_version: The version of this program.
        kinds: Types by the names of members; `object` for a method.

    Raises:
        PluginError: The first member that is missing or of the wrong type.
    """
    where, version = f"{noun} {name}", getattr(plugin, "api_version", None)
    if version != api_version:
        raise PluginError(
            f"was written for version {version!r} of the {noun} interface",
            where=where,
            allowed=str(api_version),
            hint="install matching versions of lidardesign and the plugin",
        )
    for member, kind in kinds.items():
        found = getattr(plugin, member, None)
        if kind is object and not callable(found):
            raise PluginError(f"it has no method {member}()", where=where, hint=AUTHOR_HINT)
        if not isinstance(found, kind):
            raise PluginError(f"its {member} is not of type {kind.__name__}", where=where, hint=AUTHOR_HINT)
    if plugin.name != name:
        raise PluginError(f"its name is {plugin.name!r}", where=where, hint=AUTHOR_HINT)


def _is_foreign(offer: EntryPoint) -> bool:
    """True if a plugin is of another package and this is not a probing process."""
    return PROBING not in os.environ and (offer.dist is None or offer.dist.name != "lidardesign")


def _distribution(offer: EntryPoint) -> str:
    return f"{offer.dist.name} {offer.dist.version}" if offer.dist else "unknown"


@functools.cache
def _entry_points_by_name(group: str, path: tuple[str, ...]) -> dict[str, list[EntryPoint]]:
    """Entry points on a path by name; duplicates (an editable install) count once."""
    try:
        offers = list(entry_points(group=group))
    except Exception:  # importlib reads those of all packages, and one broken file ends it
        offers = []
        for distribution in distributions():
            with contextlib.suppress(Exception):
                offers += distribution.entry_points.select(group=group)
    found: dict[str, list[EntryPoint]] = {}
    for offer in offers:
        same_name = found.setdefault(offer.name, [])
        if all(offer.value != other.value for other in same_name):
            same_name.append(offer)
    return {name: sorted(same_name, key=_distribution) for name, same_name in found.items()}
