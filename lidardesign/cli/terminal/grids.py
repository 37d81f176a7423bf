"""Figures and tables as text that stays in one piece on narrow terminals, and progress.

Progress is a bar that changes on a terminal, and a line now and then elsewhere.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self, TypeAlias

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

RichConsole: TypeAlias = "Console"

# Wider than any terminal: what a table takes where nothing limits it.
UNBOUNDED = 10_000
# Between two lines of progress: such a share of all the time that the work takes, but so long at least and at most.
SHARE, LEAST_S, MOST_S = 0.2, 10.0, 600.0


def number(value: Any, digits: int = 4) -> str:
    """A value, or a list or mapping of values, as text; a dash for None and non-finite numbers."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {number(item, digits)}" for name, item in value.items())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(number(item, digits) for item in value) + "]"
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def value_cells(row: Mapping[str, Any]) -> list[str]:
    """The value of a row and its interval, rounded by the interval's width; a dash without one."""
    from lidardesign.estimates import figure_and_interval

    value, low, high = figure_and_interval(row["value"], row["ci_low"], row["ci_high"])
    return [value, low if row["ci_low"] is None else f"{low} - {high}"]


def difference_cell(pair: Mapping[str, Any], sign: str = "") -> str:
    """The difference of a pair and its interval, rounded by the interval's width."""
    from lidardesign.estimates import figure_and_interval

    difference, low, high = figure_and_interval(pair["difference"], pair["ci_low"], pair["ci_high"], sign=sign)
    return f"{difference} ({low})" if pair["ci_low"] is None else f"{difference} ({low} to {high})"


def duration(seconds: float) -> str:
    """A time for people, as `0.4 s`, `33 s`, `3 min 20 s` or `2 h 5 min`."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def text_table(
    headings: Sequence[str],
    rows: Iterable[Sequence[Any]] = (),
    title: str | None = None,
    figures: Sequence[str] = (),
    **column: Any,
) -> Table:
    """A table of text whose cells wrap.

    Arguments:
        headings: One per column.
        rows: The cells of each row.
        title: Above it on the left, if there is one.
        figures: Headings of columns that keep to the right.
        column: What every column has, as rich's `add_column` takes it.
    """
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for heading in headings:
        table.add_column(heading, justify="right" if heading in figures else "left", **column)
    for row in rows:
        table.add_row(*row)
    return table


def print_table(
    title: str | None,
    headings: Sequence[str],
    lines: Sequence[Sequence[str]],
    rich: RichConsole,
    text: Sequence[str] = ("design",),
    wraps: bool = False,
) -> None:
    """Print a table; where it is too wide brackets go below, then columns follow in parts.

    Arguments:
        title: Above the table, if there is one; an empty line then ends it.
        headings: One per column.
        lines: The cells of each line, plain text.
        rich: Where it is printed.
        text: Headings of the columns that are no figures, the first ones.
        wraps: Whether a last column holds sentences, which may wrap.
    """
    # a table's own title would wrap at the table's width
    if title is not None:
        rich.print(title, style="italic", soft_wrap=True)
    table = _grid([headings, *lines], text)
    if not _fits(table, rich):
        folded = [
            [cell if name in text else cell.replace(" (", "\n(") for cell, name in zip(line, headings, strict=True)]
            for line in (headings, *lines)
        ]
        table = _grid(folded, text)
        if not wraps and not _fits(table, rich):
            _print_parts(folded, text, rich)
            return
    rich.print(table)
    if title is not None:
        rich.print()


def _print_parts(lines: Sequence[Sequence[str]], text: Sequence[str], rich: RichConsole) -> None:
    """Print a table in parts of as many columns as fit, with the text columns in each."""
    names = [column for column, heading in enumerate(lines[0]) if heading in text]
    rest = [column for column in range(len(lines[0])) if column not in names]
    while rest:
        for count in range(len(rest), 0, -1):
            table = _grid([[line[column] for column in names + rest[:count]] for line in lines], text)
            if _fits(table, rich):
                break
        rich.print(table)
        rich.print()
        rest = rest[count:]


def _grid(lines: Sequence[Sequence[str]], text: Sequence[str]) -> Table:
    return text_table(lines[0], lines[1:], figures=[heading for heading in lines[0] if heading not in text])


def _fits(table: Table, rich: RichConsole) -> bool:
    from rich.measure import Measurement

    return Measurement.get(rich, rich.options.update(max_width=UNBOUNDED), table).maximum <= rich.width


class ProgressDisplay:
    """A context that displays progress.

    Arguments:
        label: The label where `show` gives none.
        say: Prints a line away from a terminal.
        console: The terminal's, or None.
    """

    def __init__(self, label: str, say: Callable[[str], None], console: Console | None) -> None:
        self.label, self.say, self.console = label, say, console
        self.began_s = self.said_s = time.monotonic()
        self.bar: Progress | None = None
        self.lines: dict[str, Any] = {}
        # when counted work began, and with how much done
        self.firsts: dict[str, tuple[float, float]] = {}

    def __enter__(self) -> Self:
        if self.console is not None:
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[detail]}"))
            self.bar = Progress(*columns, console=self.console, transient=True)
            self.bar.start()
            self.show()
        return self

    def __exit__(self, *error: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def show(
        self,
        done: float = 0,
        total: float = 0,
        *,
        label: str | None = None,
        detail: str = "",
        left_s: float | None = None,
        line: str = "",
    ) -> None:
        """Show the progress of the work.

        Arguments:
            done: Units of work done.
            total: All units; 0 where their number is not known.
            label: The current step.
            detail: Further text.
            left_s: The time that remains; by default what follows from the time until now [s].
            line: The name of the line, where there are several.
        """
        now_s, label = time.monotonic(), self.label if label is None else label
        began_s, first = self.firsts.setdefault(line, (now_s, done)) if total else (now_s, done)
        if left_s is None and first < done <= total:
            left_s = (now_s - began_s) * (total - done) / (done - first)
        share = f"{100 * done / total:.0f} %" if done and total else ""
        left = f"{duration(left_s)} left" if left_s is not None else ""
        text = ", ".join(filter(None, [share, detail, left]))
        if self.bar is not None:
            if line not in self.lines:
                self.lines[line] = self.bar.add_task(label, total=None, detail="")
            self.bar.update(self.lines[line], description=label, completed=done, total=total or None, detail=text)
        elif now_s - self.said_s >= min(max(LEAST_S, SHARE * (now_s - self.began_s + (left_s or 0.0))), MOST_S):
            self.said_s = now_s
            self.say(f"{label}: {text}" if text else f"{label} ...")
