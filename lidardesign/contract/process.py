"""The contract tried in a child process, which contains plugins that hang or crash.

The child writes lines of JSON for each call of the task's code and each finding; the parent waits for each line no
longer than a call may take. The child works in an empty folder and has temporary files of its own.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from lidardesign.config import resolve
from lidardesign.contract.law import (
    CALL_SECONDS,
    LOADS,
    Finding,
    Subject,
    Tried,
    error_words,
    place_of,
    restore_random_states,
)
from lidardesign.errors import ConfigError, DataError, LidardesignError, PluginError
from lidardesign.formats import FORMATS
from lidardesign.plugins import PROBING, PluginKind
from lidardesign.problem.method import METHODS
from lidardesign.run.processes import START_SECONDS, Child, ChildError, write_line
from lidardesign.task import TASKS

if TYPE_CHECKING:
    from lidardesign.contract.contract import Contract

# A call beyond its limit may run this many times as long, so that its time can be reported.
OVERTIME = 3
# The key of a line with the present call; empty once the call has ended.
CALLED = "called"
FINDING_KEYS = {"law", "group", "statement", "outcome", "detail", "seconds", "figures"}
REFUSALS = {"config": ConfigError, "data": DataError}
KINDS: dict[str, PluginKind[Any]] = {kind.noun: kind for kind in (TASKS, FORMATS, METHODS)}
Statements = list[tuple[str, str, str]]


@dataclass(frozen=True)
class CheckRequest:
    """A plugin to check in a child process.

    Arguments:
        name: The plugin's name.
        config_file: A YAML file of a task's configuration.
        overrides: `KEY=VALUE` as `--set` takes it.
        seed: Root of all random numbers.
        limit_s: Time limit of one call of the plugin's code [s].
        noun: What it is: a task, a format or a method.
    """

    name: str
    config_file: Path | None = None
    overrides: Sequence[str] = ()
    seed: int | None = None
    limit_s: float = CALL_SECONDS
    noun: str = "task"


def check_in_process(request: CheckRequest) -> Iterator[Finding]:
    """The finding of each law, as soon as there is one; the first is that the plugin loads.

    Raises:
        ConfigError, DataError: There is no such plugin, or a task's configuration is refused.
    """
    statements = statements_of(request.noun)
    try:
        offer = KINDS[request.noun].offer_of(request.name)
    except PluginError as error:
        yield from _all_lost(statements, error_words(error))
        return
    with tempfile.TemporaryDirectory(prefix="lidardesign-check-") as folder:
        child = Child(
            f"{__name__}:answer_check",
            {
                "folder": folder,
                "noun": request.noun,
                "name": offer.name,
                "value": offer.value,
                "config_file": str(request.config_file) if request.config_file else None,
                "overrides": list(request.overrides),
                "seed": request.seed,
                "seconds": request.limit_s,
            },
            {PROBING: "1"},
        )
        try:
            yield from _read_findings(child, request.limit_s, statements)
        finally:
            child.end()


def _read_findings(child: Child, seconds: float, statements: Statements) -> Iterator[Finding]:
    """Findings as they arrive; where the child is lost, the law under trial does not hold.

    Raises:
        ConfigError, DataError: A task's configuration is refused.
    """
    for number in range(len(statements)):
        found = _next_finding(child, seconds, loading=number == 0)
        if isinstance(found, str):
            yield from _all_lost(statements[number:], found)
            return
        if "refused" in found:
            refused = found["refused"]
            raise REFUSALS.get(refused["kind"], ConfigError)(
                refused["message"], **{key: refused.get(key) for key in ("where", "allowed", "hint")}
            )
        finding = Finding(**found)
        yield finding
        if number == 0 and finding.outcome == "fail":
            yield from _not_reached(statements[1:])
            return


def _next_finding(child: Child, seconds: float, *, loading: bool) -> dict[str, Any] | str:
    """The next finding, or the reason why the child was lost; the time limit holds for each call of the task's code.

    Arguments:
        child: The child process.
        seconds: Time limit of a call [s].
        loading: Whether the call loads the plugin.
    """
    # between calls libraries are loaded, fields built and other processes waited for
    allowed = seconds if loading else START_SECONDS + OVERTIME * seconds
    called = ""
    while True:
        try:
            found = child.answer(allowed, "while this is tried")
        except ChildError as lost:
            return f"{called} did not end within {allowed:g} s".lstrip() if lost.reason == "late" else str(lost)
        if "refused" in found or set(found) == FINDING_KEYS:
            return found
        if set(found) != {CALLED}:
            return "writes to a stream that is not its own while this is tried"
        called = str(found[CALLED])
        allowed = OVERTIME * seconds if called else START_SECONDS + OVERTIME * seconds


def _all_lost(statements: Statements, reason: str) -> Iterator[Finding]:
    """A failure of the first law, and findings that later laws were not reached."""
    yield Finding(*statements[0], "fail", reason)
    yield from _not_reached(statements[1:])


def _not_reached(statements: Statements) -> list[Finding]:
    return [Finding(*one, "skip", "not reached") for one in statements]


def statements_of(noun: str) -> Statements:
    """Name, group and statement of what comes before all laws of a kind of plugins, then of each law."""
    from lidardesign.contract.contract import LAWS_OF

    return [LOADS, *((law.name, law.group, law.statement) for law in LAWS_OF[noun])]


def answer_check(request: dict[str, Any], result: BinaryIO) -> dict[str, Any]:
    """In the child: try all laws and write their findings."""
    # temporary files and bytecode of the plugin stay out of its folder
    tempfile.tempdir = os.environ["TMPDIR"] = tempfile.mkdtemp(dir=request["folder"])
    os.environ["PYTHONDONTWRITEBYTECODE"], sys.dont_write_bytecode = "1", True
    contract = _begin(request, result)
    if contract is None:
        return {}
    os.chdir(tempfile.mkdtemp(dir=request["folder"]))
    for finding in contract.findings():
        write_line(result, finding.as_dict())
    return {}


def _begin(request: dict[str, Any], result: BinaryIO) -> Contract | None:
    """Import the plugin and resolve its configuration; write the finding, and return None after a failure."""
    started = time.perf_counter()
    try:
        plugin, subject = _loaded(request, lambda what: write_line(result, {CALLED: what}))
    except PluginError as error:
        write_line(result, Finding(*LOADS, "fail", f"{error_words(error)}{place_of(error)}").as_dict())
        return None
    except LidardesignError as error:
        if str(error.where).startswith("defaults of task"):
            write_line(result, Finding(*LOADS, "fail", f"{error.where}: {error_words(error)}").as_dict())
        else:
            write_line(result, {"refused": error.as_dict()})
        return None
    # imported late: a plugin that fails to load is reported without the libraries that the laws need
    from lidardesign.contract.contract import Contract

    passed = f"version {plugin.api_version} of the {request['noun']} interface, {type(plugin).__module__}"
    write_line(result, Finding(*LOADS, "pass", passed, time.perf_counter() - started).as_dict())
    return Contract(subject)


def _loaded(request: dict[str, Any], on_call: Callable[[str], None]) -> tuple[Any, Tried]:
    """The plugin, and it with all that it is tried with."""
    drawn: list[str] = []
    kind, conduct = KINDS[request["noun"]], (request["seconds"], drawn, on_call)
    with restore_random_states(drawn, "import"):
        plugin, _ = kind.imported(EntryPoint(request["name"], request["value"], kind.group))
    if kind is not TASKS:
        from lidardesign.contract.contract import SUBJECTS

        return plugin, SUBJECTS[kind.noun](plugin, *conduct)
    config_file = Path(request["config_file"]) if request["config_file"] else None
    with restore_random_states(drawn, "space"):
        config = resolve(
            plugin, preset="draft", config_file=config_file, overrides=request["overrides"], seed=request["seed"]
        )
    return plugin, Subject(plugin, config, *conduct)
