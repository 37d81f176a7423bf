"""The contract tried in a child process, which contains plugins that hang or crash.

The child writes lines of JSON for each call of the task's code and each finding; the parent waits for each line no
longer than a call may take. The child works in an empty folder and has temporary files of its own.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from lidardesign import registry
from lidardesign.config import resolve
from lidardesign.contract.law import CALL_SECONDS, LOADS, Finding, error_words, place_of, restore_random_states
from lidardesign.errors import ConfigError, DataError, LidardesignError
from lidardesign.run.processes import START_SECONDS, Child, ChildError, write_line

if TYPE_CHECKING:
    from lidardesign.config import RunConfig
    from lidardesign.contract.contract import Contract
    from lidardesign.task import Task

# A call beyond its limit may run this many times as long, so that its time can be reported.
OVERTIME = 3
# The key of a line with the present call; empty once the call has ended.
CALLED = "called"
FINDING_KEYS = {"law", "group", "statement", "outcome", "detail", "seconds", "figures"}
REFUSALS = {"config": ConfigError, "data": DataError}


@dataclass(frozen=True)
class CheckRequest:
    """A task to check in a child process.

    Arguments:
        name: The task, as `learn` takes it.
        config_file: A YAML file of its configuration.
        overrides: `KEY=VALUE` as `--set` takes it.
        seed: Root of all random numbers.
        limit_s: Time limit of one call of the task's code [s].
    """

    name: str
    config_file: Path | None = None
    overrides: Sequence[str] = ()
    seed: int | None = None
    limit_s: float = CALL_SECONDS


def check_in_process(request: CheckRequest) -> Iterator[Finding]:
    """The finding of each law, as soon as there is one; the first is that the plugin loads.

    Raises:
        ConfigError, DataError: There is no such task, or its configuration is refused.
    """
    try:
        offer = registry.offer_of(request.name)
    except registry.PluginError as error:
        yield from _all_lost(0, error_words(error))
        return
    with tempfile.TemporaryDirectory(prefix="lidardesign-check-") as folder:
        document = {
            "folder": folder,
            "name": offer.name,
            "value": offer.value,
            "config_file": str(request.config_file) if request.config_file else None,
            "overrides": list(request.overrides),
            "seed": request.seed,
            "seconds": request.limit_s,
        }
        child = Child(f"{__name__}:answer_check", document, {registry.PROBING: "1"})
        try:
            yield from _read_findings(child, request.limit_s)
        finally:
            child.end()


def _read_findings(child: Child, seconds: float) -> Iterator[Finding]:
    """Findings as they arrive; where the child is lost, the law under trial does not hold."""
    for number in range(len(_statements())):
        found = _next_finding(child, seconds, loading=number == 0)
        if isinstance(found, str):
            yield from _all_lost(number, found)
            return
        finding = _finding(found)
        yield finding
        if number == 0 and finding.outcome == "fail":
            yield from _not_reached(1)
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


def _finding(found: dict[str, Any]) -> Finding:
    """The finding of a line; raises the error of a refused configuration."""
    if "refused" not in found:
        return Finding(**found)
    told = found["refused"]
    raise REFUSALS.get(told["kind"], ConfigError)(
        told["message"], **{key: told.get(key) for key in ("where", "allowed", "hint")}
    )


def _all_lost(number: int, reason: str) -> Iterator[Finding]:
    """A failure of law `number` (0: the plugin loads), and findings that later laws were not reached."""
    yield Finding(*_statements()[number], "fail", reason)
    yield from _not_reached(number + 1)


def _not_reached(number: int) -> Iterator[Finding]:
    for one in _statements()[number:]:
        yield Finding(*one, "skip", "not reached")


def _statements() -> list[tuple[str, str, str]]:
    """Name, group and statement of what comes before all laws, then of each law."""
    from lidardesign.contract.contract import LAWS

    return [LOADS, *((law.name, law.group, law.statement) for law in LAWS)]


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
    drawn: list[str] = []
    started = time.perf_counter()
    try:
        task, config = _loaded(request, drawn)
    except registry.PluginError as error:
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
    from lidardesign.contract.law import Subject

    version = f"version {task.api_version} of the task interface"
    loaded = Finding(*LOADS, "pass", f"{version}, {type(task).__module__}", time.perf_counter() - started)
    write_line(result, loaded.as_dict())
    return Contract(Subject(task, config, request["seconds"], drawn, lambda what: write_line(result, {CALLED: what})))


def _loaded(request: dict[str, Any], drawn: list[str]) -> tuple[Task, RunConfig]:
    offer = EntryPoint(request["name"], request["value"], registry.GROUP)
    with restore_random_states(drawn, "import"):
        task = registry.import_task(offer)
    config_file = Path(request["config_file"]) if request["config_file"] else None
    with restore_random_states(drawn, "space"):
        return task, resolve(
            task, preset="draft", config_file=config_file, overrides=request["overrides"], seed=request["seed"]
        )
