"""What `evaluate --accuracy` prints: one table of rungs per numerical choice, and what to choose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidardesign.cli.tables.grids import print_table

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.evaluate.accuracy.settings import Ladder, Rung
    from lidardesign.evaluate.accuracy.sweeps import Accuracy

HEADINGS = ("setting", "error", "+-", "seconds", "memory")
BYTES_PER_MIB = 2**20


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
    print_table(None, (*HEADINGS, *further), lines, rich, text=("setting",))
    rich.print(f"{escape(ladder.verdict)}; tolerance {ladder.tolerance:.3g}{escape(unit)}: {escape(ladder.because)}")
    if ladder.note:
        rich.print(f"note: {escape(ladder.note)}")
    rich.print()


def _cells(rung: Rung, ladder: Ladder) -> tuple[str, ...]:
    marks = (" *" if rung is ladder.chosen else "") + (" (run)" if rung.default else "")
    error = "reference" if rung.reference else _figure(rung.error)
    spread = "" if rung.reference else _figure(rung.uncertainty)
    memory = "" if rung.memory_bytes is None else f"{rung.memory_bytes / BYTES_PER_MIB:.0f} MiB"
    return rung.setting + marks, error, spread, _figure(rung.seconds), memory


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
