"""What a request would do, read and write, and how long it took before: what `--dry-run` prints."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidardesign.errors import DataError
from lidardesign.run.files import STDIO
from lidardesign.run.manifest import read_manifest


@dataclass(frozen=True)
class EarlierRun:
    """How long something like a request took before.

    Arguments:
        seconds: Wall time [s].
        name: What took it.
    """

    seconds: float
    name: str


@dataclass(frozen=True)
class RequestPlan:
    """What a request would do.

    Arguments:
        command: The command that does the same.
        steps: What it would do, one line each, in order.
        reads: Files and folders that it would read.
        writes: Files and folders that it would write; a folder's name ends in a stroke.
        settings: What it would do it with, as plain values.
        before: How long that took before, where that is known.
    """

    command: str
    steps: Sequence[str]
    reads: Sequence[Path | str] = ()
    writes: Sequence[Path | str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    before: EarlierRun | None = None

    def as_dict(self) -> dict[str, Any]:
        """The document of `--dry-run --json`."""
        return {
            "dry_run": True,
            "command": self.command,
            "steps": list(self.steps),
            "reads": [
                {"path": str(path), "bytes": (os.path.getsize(path) if _is_file(path) else None)} for path in self.reads
            ],
            "writes": [{"path": str(path), "replaces": _is_file(path)} for path in self.writes],
            "settings": dict(self.settings),
            "before": None if self.before is None else {"seconds": self.before.seconds, "of": self.before.name},
        }

    def check_writable(self) -> None:
        """Refuse places where nothing can be written.

        Raises:
            DataError: A file stands where a folder would be, a folder where a file would, or writing is forbidden.
        """
        for path in self.writes:
            if str(path) != STDIO:
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
                    raise DataError(
                        f"cannot be written: {there} is read-only", where=str(path), hint="give another place"
                    )


def _is_file(path: Path | str) -> bool:
    return str(path) != STDIO and os.path.isfile(path)


def last_time(run: Path | None, command: str) -> EarlierRun | None:
    """How long a command took the last time on a run, as its manifest has it; None where it does not."""
    if run is None:
        return None
    try:
        entry = read_manifest(run).get("timings", {}).get(command)
    except DataError:  # whoever needs the manifest says what is wrong with it
        return None
    seconds = entry.get("seconds") if isinstance(entry, dict) else None
    return EarlierRun(seconds, f"the last {command} of {run}") if isinstance(seconds, int | float) else None
