"""A picture of where the time went: one panel per command, one bar per phase."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lidardesign.evaluate.plots_canvas import INK, PAGE_INCHES, SMALL_POINTS, new_figure, plain_axes, plain_label
from lidardesign.run.clock import INSIDE, OTHER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW_INCHES, MARGIN_INCHES = 0.17, 0.62
PERCENT = 100.0
# Phases of a smaller share of their command are in `other`.
LEAST_SHARE = 0.005
MOST_ROWS = 24
WHOLE, INNER = "#0072B2", "#9ecae9"


def times_picture(times: Mapping[str, Mapping[str, float]]) -> Figure | None:
    """Seconds by phase of each command, a page wide; phases inside of phases are pale and indented.

    Arguments:
        times: A clock's timings by command; None comes back where there are none.
    """
    shown = {command: rows for command, rows in ((name, phase_rows(one)) for name, one in times.items()) if rows}
    if not shown:
        return None
    counts = [len(rows) for rows in shown.values()]
    figure = new_figure(PAGE_INCHES, sum(counts) * ROW_INCHES + len(shown) * MARGIN_INCHES)
    panels = figure.subplots(len(shown), 1, squeeze=False, gridspec_kw={"height_ratios": [n + 1 for n in counts]})
    for axes, (command, rows) in zip(panels[:, 0], shown.items(), strict=True):
        _draw(axes, command, rows)
    return figure


def phase_rows(timings: Mapping[str, float]) -> list[tuple[str, float, bool]]:
    """Name, seconds, and whether it is inside of another, of the phases that took time; `other` last.

    Phases two deep are shown; what is left out counts as `other`.
    """
    outer = {key: seconds for key, seconds in timings.items() if INSIDE not in key and seconds > 0}
    total = sum(outer.values())
    kept = {key: seconds for key, seconds in outer.items() if key != OTHER and seconds >= LEAST_SHARE * total}
    rows: list[tuple[str, float, bool]] = []
    for key, seconds in kept.items():
        rows.append((key, seconds, False))
        rows += [
            (inner.removeprefix(key + INSIDE), taken, True)
            for inner, taken in timings.items()
            if inner.startswith(key + INSIDE) and inner.count(INSIDE) == 1 and taken >= LEAST_SHARE * total
        ]
    if len(rows) > MOST_ROWS:
        rows = [row for row in rows if not row[2]][:MOST_ROWS]
    rest = total - sum(seconds for _, seconds, inside in rows if not inside)
    return [*rows, (OTHER, rest, False)] if rows and rest >= LEAST_SHARE * total else rows


def _draw(axes: Axes, command: str, rows: list[tuple[str, float, bool]]) -> None:
    total = sum(seconds for _, seconds, inside in rows if not inside)
    most = max(seconds for _, seconds, _ in rows)
    for place, (_, seconds, inside) in enumerate(rows):
        axes.barh(place, seconds, height=0.62 if inside else 0.78, color=INNER if inside else WHOLE, linewidth=0)
        text = f" {seconds:.3g} s, {PERCENT * seconds / total:.0f} %"
        axes.text(seconds, place, text, va="center", fontsize=SMALL_POINTS, color=INK)
    axes.set_yticks(range(len(rows)), [f"{'in it: ' * inside}{plain_label(name)}" for name, _, inside in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(0.0, 1.22 * most)
    axes.set_xlabel("seconds")
    axes.set_title(f"{plain_label(command)}: {total:.3g} s", loc="left", color=INK)
    axes.tick_params(axis="y", length=0)
    plain_axes(axes, grid="x")
