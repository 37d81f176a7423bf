"""Figures as text, tables of text, and tables of figures that stay in one piece on narrow terminals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

RichConsole: TypeAlias = "Console"

# Wider than any terminal: what a table takes where nothing limits it.
UNBOUNDED = 10_000


def number(value: Any, digits: int = 4) -> str:
    """A figure, a text, or a list or mapping of them, for people; a dash where there is none."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {number(item, digits)}" for name, item in value.items())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(number(item, digits) for item in value) + "]"
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def value_cells(row: Mapping[str, Any]) -> list[str]:
    """The value of a row and its interval, as fine as the interval says; a dash where there is none."""
    from lidardesign.estimates import figure_and_interval

    value, low, high = figure_and_interval(row["value"], row["ci_low"], row["ci_high"])
    return [value, low if row["ci_low"] is None else f"{low} - {high}"]


def difference_cell(pair: Mapping[str, Any], sign: str = "") -> str:
    """The difference of a pair and its interval, as fine as the interval says."""
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
    """As many columns beside each other as fit; the texts in front stand in each part."""
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
