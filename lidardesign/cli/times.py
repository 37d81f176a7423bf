"""Where the time went, and how far results may be off, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lidardesign.cli.grids import print_table
from lidardesign.run.clock import INSIDE, OTHER

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

# Phases of a smaller share are left to --json; `other` shows what they took.
LEAST_SHARE = 0.005
INDENT = "  "


def show_times(timings: Mapping[str, float], rich: RichConsole) -> None:
    """Print the phases of a clock's timings with their seconds and shares, phases inside of phases indented."""
    total = sum(seconds for key, seconds in timings.items() if INSIDE not in key)
    if total <= 0:
        return
    kept = {key: seconds for key, seconds in timings.items() if key != OTHER and seconds >= LEAST_SHARE * total}
    kept[OTHER] = total - sum(seconds for key, seconds in kept.items() if INSIDE not in key)
    lines = [_line(key, seconds, total) for key, seconds in kept.items()]
    print_table("where the time went", ("phase", "seconds", "share"), lines, rich, text=("phase",))


def _line(key: str, seconds: float, total: float) -> tuple[str, str, str]:
    *outside, name = key.split(INSIDE)
    return f"{INDENT * len(outside)}{name}", f"{seconds:.2f}", f"{100 * seconds / total:.0f} %"
