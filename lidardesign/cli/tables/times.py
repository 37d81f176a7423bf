"""Where the time went, and how accurate results are at which cost, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lidardesign.cli.tables.grids import print_table
from lidardesign.run.clock import INSIDE, OTHER

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.evaluate.accuracy.settings import Ladder, Rung
    from lidardesign.evaluate.accuracy.sweeps import Accuracy

# Phases of a smaller share are left to --json; `other` shows what they took.
LEAST_SHARE = 0.005
MEBIBYTE = 1024**2
# People are shown phases and those directly inside of them.
DEEPEST = 2


def show_times(timings: Mapping[str, float], memory_bytes: int | None, rich: RichConsole) -> None:
    """Print the phases of a clock's timings with their seconds and shares, phases inside of phases indented."""
    timings = {key: seconds for key, seconds in timings.items() if key.count(INSIDE) < DEEPEST}
    total = sum(seconds for key, seconds in timings.items() if INSIDE not in key)
    if total <= 0:
        return
    shown = {key: seconds for key, seconds in timings.items() if key != OTHER and seconds >= LEAST_SHARE * total}
    shown[OTHER] = total - sum(seconds for key, seconds in shown.items() if INSIDE not in key)
    lines = []
    for key, seconds in shown.items():
        *outside, name = key.split(INSIDE)
        lines.append(("  " * len(outside) + name, f"{seconds:.2f}", f"{100 * seconds / total:.0f} %"))
    memory = "" if memory_bytes is None else f"; the most memory that it took: {memory_bytes / MEBIBYTE:.0f} MiB"
    print_table(f"where the time went{memory}", ("phase", "seconds", "share"), lines, rich, text=("phase",))


def show_accuracy(accuracy: Accuracy, rich: RichConsole) -> None:
    """Print every ladder, the roughest rung first, and the verdict on each."""
    from rich.markup import escape

    for ladder in accuracy.ladders:
        _show_ladder(ladder, rich)
    taken = sum(accuracy.seconds.values())
    rich.print(f"accuracy measured in {taken:.0f} s; [bold]*[/bold] is what to choose, (run) what this run does")
    off = [ladder for ladder in accuracy.ladders if ladder.default is not None and ladder.chosen is not ladder.default]
    for ladder in off:
        rich.print(f"note: {escape(ladder.knob)}: {escape(ladder.verdict)}")


def _show_ladder(ladder: Ladder, rich: RichConsole) -> None:
    from rich.markup import escape

    unit = f" [{ladder.unit}]" if ladder.unit else ""
    title = f"{ladder.knob}: {ladder.error_of}{unit}, against {ladder.against}; seconds of {ladder.work}"
    further = list(dict.fromkeys(name for rung in ladder.rungs for name in rung.values))
    lines = [(*_cells(rung, ladder), *(_figure(rung.values.get(name)) for name in further)) for rung in ladder.rungs]
    # a sentence, which wraps like those below the table
    rich.print(f"[italic]{escape(title)}[/italic]")
    print_table(None, ("setting", "error", "+-", "seconds", "memory", *further), lines, rich, text=("setting",))
    rich.print(f"{escape(ladder.verdict)}; tolerance {ladder.tolerance:.3g}{escape(unit)}: {escape(ladder.because)}")
    if ladder.note:
        rich.print(f"note: {escape(ladder.note)}")
    rich.print()


def _cells(rung: Rung, ladder: Ladder) -> tuple[str, ...]:
    marks = (" *" if rung is ladder.chosen else "") + (" (run)" if rung.default else "")
    error = "reference" if rung.reference else _figure(rung.error)
    spread = "" if rung.reference else _figure(rung.uncertainty)
    memory = "" if rung.memory_bytes is None else f"{rung.memory_bytes / MEBIBYTE:.0f} MiB"
    return rung.setting + marks, error, spread, _figure(rung.seconds), memory


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
