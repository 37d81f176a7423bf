"""`--dry-run`: what a command would do, read and write, and how long it took before; nothing is done."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.errors import DataError
from lidardesign.run.streams import STDIO

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.console import Console

DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Check everything that can be checked at once, say what would be done, read and written, and do nothing.",
    ),
]
BYTES_PER_MEGABYTE = 1e6
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Before:
    """How long something like it took.

    Arguments:
        seconds: Wall time [s].
        where: Whose time that was.
    """

    seconds: float
    where: str


@dataclass(frozen=True)
class Plan:
    """What a command would do.

    Arguments:
        command: The command.
        steps: What it would do, one line each, in order.
        reads: Files and folders that it would read.
        writes: Files and folders that it would write; a folder's name ends in a stroke.
        settings: What it would do it with, for `--json`.
        before: How long that took before, where that is known.
    """

    command: str
    steps: Sequence[str]
    reads: Sequence[Path | str] = ()
    writes: Sequence[Path | str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    before: Before | None = None

    def as_dict(self) -> dict[str, Any]:
        """The document of `--json`."""
        before = None if self.before is None else {"seconds": self.before.seconds, "of": self.before.where}
        return {
            "dry_run": True,
            "command": self.command,
            "steps": list(self.steps),
            "reads": [{"path": str(path), "bytes": _bytes_of(path)} for path in self.reads],
            "writes": [{"path": str(path), "replaces": _is_replaced(path)} for path in self.writes],
            "settings": dict(self.settings),
            "before": before,
        }


def tell_plan(plan: Plan, console: Console) -> None:
    """Give a plan as the result of its command.

    Raises:
        DataError: What would be written could not be.
    """
    for path in plan.writes:
        check_can_be_written(path)
    document = plan.as_dict()
    console.result(document, lambda rich: _show(document, rich), show_costs=False)


def _show(document: Mapping[str, Any], rich: RichConsole) -> None:
    def line(text: str) -> None:
        rich.print(text, soft_wrap=True, markup=False)

    line(f"{document['command']} would")
    for step in document["steps"]:
        line(f"  {step}")
    for entry in document["reads"]:
        size = "" if entry["bytes"] is None else f" ({_size(entry['bytes'])})"
        line(f"read   {_named(entry['path'], 'standard input')}{size}")
    for entry in document["writes"]:
        replaces = " (replaced)" if entry["replaces"] else ""
        line(f"write  {_named(entry['path'], 'standard output')}{replaces}")
    if not document["writes"]:
        line("write  nothing")
    if document["before"]:
        line(f"time   {document['before']['of']} took {document['before']['seconds']:.1f} s")
    line("nothing was done: leave out --dry-run to do it")


def _named(path: str, standard: str) -> str:
    return standard if path == STDIO else path


def _size(size: int) -> str:
    return f"{size / BYTES_PER_MEGABYTE:.1f} MB" if size >= BYTES_PER_MEGABYTE else f"{size:,} bytes"


def _bytes_of(path: Path | str) -> int | None:
    return os.path.getsize(path) if str(path) != STDIO and os.path.isfile(path) else None


def _is_replaced(path: Path | str) -> bool:
    return str(path) != STDIO and os.path.isfile(path)


def check_can_be_written(path: Path | str) -> None:
    """Refuse a place where nothing can be written.

    Raises:
        DataError: A file stands where a folder would be, a folder where the file would, or writing is forbidden.
    """
    if str(path) == STDIO:
        return
    is_folder = str(path).endswith("/")
    target = Path(path)
    if target.is_dir() and not is_folder:
        raise DataError("is a folder", where=str(path), hint="give the name of a file")
    if target.is_file() and is_folder:
        raise DataError("is a file", where=str(target), hint="give a new folder, or one that is there")
    there = next(parent for parent in (target, *target.absolute().parents) if parent.exists())
    if there != target and not there.is_dir():
        raise DataError(f"cannot be made: {there} is a file", where=str(path), hint="give another place")
    if not os.access(there, os.W_OK):
        raise DataError(f"cannot be written: {there} is read-only", where=str(path), hint="give another place")


def last_time(run: Path | None, command: str) -> Before | None:
    """How long a command took the last time on a run, as its manifest has it; None where it does not."""
    if run is None:
        return None
    entry = _manifest(run).get("timings", {}).get(command)
    seconds = entry.get("seconds") if isinstance(entry, dict) else None
    return Before(seconds, f"the last {command} of {run}") if isinstance(seconds, int | float) else None


def _manifest(run: Path) -> dict[str, Any]:
    """A run's manifest; an empty one where it cannot be read: whoever needs it says so."""
    from lidardesign.run.manifest import read_manifest

    try:
        return read_manifest(run)
    except DataError:
        return {}


def like_time(run: Path, alike: Mapping[str, Any]) -> Before | None:
    """How long learning took in a run beside another one, whose configuration has the same sections.

    Arguments:
        run: The run to be; those in its folder are looked at.
        alike: The sections of the configuration that must be the same.
    """
    from lidardesign.errors import LidardesignError
    from lidardesign.run.yaml import load_yaml

    for manifest in sorted(run.absolute().parent.glob(f"*/{MANIFEST}")):
        other = manifest.parent
        try:
            found = load_yaml(other / "config.yaml").mapping
        except LidardesignError:
            continue
        before = last_time(other, "learn")
        if before is not None and all(found.get(name) == value for name, value in alike.items()):
            return Before(before.seconds, f"learning {other.name}, which has the same settings,")
    return None
