"""Where the time went, and how far results may be off, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lidardesign.cli.tables.grids import print_table
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.clock import INSIDE, OTHER, keep_timings

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console as RichConsole

    from lidardesign.cli.output import Console

# Phases of a smaller share are left to --json; `other` shows what they took.
LEAST_SHARE = 0.005
INDENT = "  "
MEBIBYTE = 1024**2
# People are shown phases and those directly inside of them.
DEEPEST = 2
# Commands that only read a run wait for its writer no longer than this.
SHORT_WAIT_S = 0.5


def show_times(timings: Mapping[str, float], memory_bytes: int | None, rich: RichConsole) -> None:
    """Print the phases of a clock's timings with their seconds and shares, phases inside of phases indented."""
    timings = {key: seconds for key, seconds in timings.items() if key.count(INSIDE) < DEEPEST}
    total = sum(seconds for key, seconds in timings.items() if INSIDE not in key)
    if total <= 0:
        return
    kept = {key: seconds for key, seconds in timings.items() if key != OTHER and seconds >= LEAST_SHARE * total}
    kept[OTHER] = total - sum(seconds for key, seconds in kept.items() if INSIDE not in key)
    lines = [_line(key, seconds, total) for key, seconds in kept.items()]
    memory = "" if memory_bytes is None else f"; the most memory that it took: {memory_bytes / MEBIBYTE:.0f} MiB"
    print_table(f"where the time went{memory}", ("phase", "seconds", "share"), lines, rich, text=("phase",))


def _line(key: str, seconds: float, total: float) -> tuple[str, str, str]:
    *outside, name = key.split(INSIDE)
    return f"{INDENT * len(outside)}{name}", f"{seconds:.2f}", f"{100 * seconds / total:.0f} %"


def times_so_far(run: Path, name: str, console: Console) -> dict[str, dict[str, float]]:
    """Seconds by phase of each command on a run, in the order in which they first ran; of this one until now."""
    from lidardesign.run.manifest import read_manifest

    kept = read_manifest(run).get("timings", {})
    phases = {command: dict(entry["phases"]) for command, entry in kept.items() if _has_phases(entry)}
    return {**phases, name: console.clock.timings()}


def _has_phases(entry: object) -> bool:
    """Whether an entry of a manifest holds seconds by phase; those of older versions do not."""
    phases = entry.get("phases") if isinstance(entry, dict) else None
    return isinstance(phases, dict) and all(isinstance(seconds, int | float) for seconds in phases.values())


def keep_times(run: Path, name: str, console: Console, *, wait_s: float = SHORT_WAIT_S) -> None:
    """Enter the times of a command in the manifest of its run; where that cannot be, a note says so.

    The work is done by then: that its times are not kept is no reason to fail.
    """
    try:
        keep_timings(run, name, console.clock, wait_s=wait_s)
    except (ConfigError, DataError, OSError) as error:
        message = error.message if isinstance(error, ConfigError | DataError) else error.strerror or error
        console.note(f"note: the times of {name} are not kept in {run}: {message}")
