"""Tables of figures that stay in one piece on narrow terminals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console as RichConsole
    from rich.table import Table

# Wider than any terminal: what a table takes where nothing limits it.
UNBOUNDED = 10_000


def print_table(
    title: str | None,
    headings: Sequence[str],
    lines: Sequence[Sequence[str]],
    rich: RichConsole,
    text: Sequence[str] = ("design",),
    wraps: bool = False,
) -> None:
    """Print a table; where it is too wide it loses its lines, then brackets go below, then columns follow in parts.

    Arguments:
        title: Rich markup, above the table, if there is one.
        headings: One per column.
        lines: The cells of each line, plain text.
        rich: Where it is printed.
        text: Headings of the columns that are no figures, the first ones.
        wraps: Whether a last column holds sentences, which may wrap.
    """
    # a table's own title would wrap at the table's width
    if title is not None:
        rich.print(f"[italic]{title}[/italic]", soft_wrap=True)
    table = _table(headings, lines, text)
    if not _fits(table, rich):
        _lighten(table)
        if not _fits(table, rich):
            folded = [_folded(line, headings, text) for line in (headings, *lines)]
            table = _table(folded[0], folded[1:], text)
            _lighten(table)
            if not wraps and not _fits(table, rich):
                _print_parts(folded, text, rich)
                return
    rich.print(table)


def _print_parts(lines: Sequence[Sequence[str]], text: Sequence[str], rich: RichConsole) -> None:
    """As many columns beside each other as fit; the texts in front stand in each part."""
    names = [column for column, heading in enumerate(lines[0]) if heading in text]
    rest = [column for column in range(len(lines[0])) if column not in names]
    while rest:
        for count in range(len(rest), 0, -1):
            shown = [[line[column] for column in names + rest[:count]] for line in lines]
            table = _table(shown[0], shown[1:], text)
            _lighten(table)
            if _fits(table, rich):
                break
        rich.print(table)
        rest = rest[count:]


def _folded(line: Sequence[str], headings: Sequence[str], text: Sequence[str]) -> list[str]:
    pairs = zip(line, headings, strict=True)
    return [cell if heading in text else cell.replace(" (", "\n(") for cell, heading in pairs]


def _table(headings: Sequence[str], lines: Sequence[Sequence[str]], text: Sequence[str]) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for heading in headings:
        table.add_column(escape(heading), justify="left" if heading in text else "right")
    for line in lines:
        table.add_row(*map(escape, line))
    return table


def _lighten(table: Table) -> None:
    """Leave out all lines but the one under the headings."""
    from rich import box

    table.box, table.show_edge, table.pad_edge, table.padding = box.SIMPLE, False, False, (0, 1, 0, 0)


def _fits(table: Table, rich: RichConsole) -> bool:
    from rich.measure import Measurement

    return Measurement.get(rich, rich.options.update(max_width=UNBOUNDED), table).maximum <= rich.width
