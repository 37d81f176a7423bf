"""Where the time went, and how accurate results are at which cost, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lidardesign.cli.tables.grids import print_table
from lidardesign.run.clock import INSIDE, OTHER

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.evaluate.accuracy.settings import Accuracy, Measurement, Sweep

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
    """Print every sweep, the roughest measurement first, and the verdict on each."""
    from rich.markup import escape

    for sweep in accuracy.sweeps:

        unit = f" [{sweep.unit}]" if sweep.unit else ""
        title = f"{sweep.knob}: {sweep.error_of}{unit}, against {sweep.against}; seconds of {sweep.work}"
        further = list(dict.fromkeys(name for measurement in sweep.measurements for name in measurement.values))
        lines = [
            (*_cells(measurement, sweep), *(_figure(measurement.values.get(name)) for name in further))
            for measurement in sweep.measurements
        ]
        # a sentence, which wraps like those below the table
        rich.print(f"[italic]{escape(title)}[/italic]")
        print_table(None, ("setting", "error", "+-", "seconds", "memory", *further), lines, rich, text=("setting",))
        rich.print(f"{escape(sweep.verdict)}; tolerance {sweep.tolerance:.3g}{escape(unit)}: {escape(sweep.because)}")
        if sweep.note:
            rich.print(f"note: {escape(sweep.note)}")
        rich.print()
    taken = sum(accuracy.seconds.values())
    rich.print(f"accuracy measured in {taken:.0f} s; [bold]*[/bold] is what to choose, (run) what this run does")
    off = [sweep for sweep in accuracy.sweeps if sweep.default is not None and sweep.chosen is not sweep.default]
    for sweep in off:
        rich.print(f"note: {escape(sweep.knob)}: {escape(sweep.verdict)}")


def _cells(measurement: Measurement, sweep: Sweep) -> tuple[str, ...]:
    marks = (" *" if measurement is sweep.chosen else "") + (" (run)" if measurement.default else "")
    error = "reference" if measurement.reference else _figure(measurement.error)
    spread = "" if measurement.reference else _figure(measurement.uncertainty)
    memory = "" if measurement.memory_bytes is None else f"{measurement.memory_bytes / MEBIBYTE:.0f} MiB"
    return measurement.setting + marks, error, spread, _figure(measurement.seconds), memory


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
