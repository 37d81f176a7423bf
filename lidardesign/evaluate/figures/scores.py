"""Pictures of scores: against rays and bandwidth with their intervals, and the differences between designs.

A picture of where the time went: one panel per command, one bar per phase.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from lidardesign.evaluate.figures.canvas import (
    BAND_OPACITY,
    COLUMN_INCHES,
    INK,
    PAGE_INCHES,
    SMALL_POINTS,
    SOFT,
    label_ticks,
    new_figure,
    plain_axes,
    plain_label,
)
from lidardesign.evaluate.figures.curves import Against, Series, axis_titles, log_ticks, logarithmic, position, series
from lidardesign.evaluate.results import Evaluation, Paired, Row
from lidardesign.evaluate.verdicts import verdict
from lidardesign.run.clock import INSIDE, OTHER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


CURVE_HEIGHT, LEGEND_LINE = 2.5, 0.15  # inches
LEGEND_COLUMNS = 2
# Ticks at every number of rays, as long as so many fit.
MOST_RAY_TICKS = 7
# Pairs are drawn at all numbers of rays up to so many rows, then at the largest, then against baselines alone.
MOST_ROWS = 48
ROW_INCHES, MARGIN_INCHES = 0.165, 0.75
# By verdict: colour, marker and whether it is filled.
VERDICT_LOOKS = {
    "better": ("#0072B2", "o", True),
    "worse": ("#D55E00", "s", True),
    "open": ("#6b7280", "D", False),
}
VERDICT_WORDS = {"better": "a is better", "worse": "a is worse", "open": "not clear"}


def curve_picture(evaluation: Evaluation, against: Against) -> Figure:
    """Score against rays or bandwidth, a column wide: a line and an interval band per design and baseline."""
    curves = series(evaluation)
    lines = -(-len(curves) // LEGEND_COLUMNS)
    figure = new_figure(COLUMN_INCHES, CURVE_HEIGHT + lines * LEGEND_LINE)
    axes = figure.add_subplot()
    for curve in curves:
        _draw_curve(axes, curve, against)
    _dress_curves(axes, evaluation, curves, against)
    figure.legend(loc="outside lower center", ncols=LEGEND_COLUMNS, frameon=False, handlelength=2.6, borderaxespad=0.2)
    return figure


def _draw_curve(axes: Axes, curve: Series, against: Against) -> None:
    across = [position(row, against) for row in curve.rows]
    low, high = [row.ci_low for row in curve.rows], [row.ci_high for row in curve.rows]
    axes.fill_between(across, low, high, color=curve.colour, alpha=BAND_OPACITY, linewidth=0)
    axes.plot(
        across,
        [row.value for row in curve.rows],
        color=curve.colour,
        marker=curve.marker,
        linestyle=curve.dash,
        linewidth=1.0 if curve.baseline else 1.5,
        label=plain_label(curve.name),
    )
    if len(curve.rows) == 1:  # there is no band of a single point
        axes.errorbar(across, [curve.rows[0].value], _lengths(curve.rows[0]), color=curve.colour, capsize=2.0)


def _lengths(row: Row) -> list[list[float]]:
    """Both lengths of an error bar; an interval of a bootstrap may leave its mean out."""
    low, high = row.value - row.ci_low, row.ci_high - row.value
    return [[max(low, 0.0)], [max(high, 0.0)]]


def _dress_curves(axes: Axes, evaluation: Evaluation, curves: list[Series], against: Against) -> None:
    across, _ = axis_titles(evaluation, against)
    up = f"{evaluation.metric.name} [{evaluation.metric.unit}]"
    rows = [row for curve in curves for row in curve.rows]
    scenes = f"{evaluation.scenes} held-out scene{'s' if evaluation.scenes != 1 else ''}"
    axes.set_xlabel(across)
    axes.set_ylabel(plain_label(up, longest=40))
    told = f"{evaluation.metric.better} is better; {scenes}, 95 % intervals"
    axes.set_title(told, fontsize=SMALL_POINTS, loc="left", color=SOFT)
    places = [position(row, against) for row in rows]
    if logarithmic(places):
        axes.set_xscale("log")
        counts = sorted({row.rays for row in rows})
        at_counts = against == "rays" and len(counts) <= MOST_RAY_TICKS
        label_ticks(axes.xaxis, counts if at_counts else log_ticks(places))
    if logarithmic([row.value for row in rows]):
        axes.set_yscale("log")
        label_ticks(axes.yaxis, log_ticks([row.value for row in rows]))
    plain_axes(axes)


def differences_picture(evaluation: Evaluation) -> Figure:
    """Every paired difference with its interval, a page wide: what the scenes can tell apart, and what they cannot."""
    pairs, told = shown_pairs(evaluation)
    figure = new_figure(PAGE_INCHES, MARGIN_INCHES + max(len(pairs), 2) * ROW_INCHES)
    axes = figure.add_subplot()
    for place, pair in enumerate(pairs):
        colour, marker, filled = VERDICT_LOOKS[verdict(evaluation, pair)]
        face = colour if filled else "white"
        axes.plot([pair.ci_low, pair.ci_high], [place, place], color=colour, linewidth=1.2, solid_capstyle="butt")
        axes.plot(pair.difference, place, marker=marker, color=colour, markerfacecolor=face, linestyle="none", zorder=3)
        if place and pair.a != pairs[place - 1].a:
            axes.axhline(place - 0.5, color=SOFT, linewidth=0.5)
    axes.axvline(0.0, color=INK, linewidth=0.8, zorder=1)
    axes.set_yticks(range(len(pairs)), [_pair_label(pair) for pair in pairs])
    axes.set_ylim(max(len(pairs), 1) - 0.4, -0.6)
    metric = evaluation.metric
    axes.set_xlabel(plain_label(f"a - b: {metric.name} [{metric.unit}], {metric.better} is better", longest=90))
    plain_axes(axes, grid="x")
    axes.set_title(told, fontsize=SMALL_POINTS, loc="left", color=SOFT)
    _verdict_legend(figure)
    return figure


def shown_pairs(evaluation: Evaluation) -> tuple[list[Paired], str]:
    """The pairs that a picture holds, by design, and a line that says which they are."""
    order = {name: place for place, name in enumerate(dict.fromkeys(row.design for row in evaluation.rows))}
    pairs = sorted(evaluation.paired, key=lambda pair: (order.get(pair.a, -1), order.get(pair.b, -1), pair.rays))
    told = f"paired over {evaluation.scenes} held-out scenes, 95 % bootstrap intervals"
    if len(pairs) <= MOST_ROWS:
        return pairs, told
    most = {name: max(pair.rays for pair in pairs if pair.a == name) for name in {pair.a for pair in pairs}}
    pairs = [pair for pair in pairs if pair.rays == most[pair.a]]
    told += "; at the most rays"
    if len(pairs) <= MOST_ROWS:
        return pairs, told
    baselines = {row.design for row in evaluation.rows if row.baseline}
    pairs = [pair for pair in pairs if pair.b in baselines]
    return pairs[:MOST_ROWS], f"{told}, against baselines" + (f"; the first {MOST_ROWS}" * (len(pairs) > MOST_ROWS))


def _pair_label(pair: Paired) -> str:
    return f"{plain_label(pair.a)} - {plain_label(pair.b)}, {pair.rays} rays"


def _verdict_legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=colour, marker=marker, markerfacecolor=colour if filled else "white", linewidth=1.2)
        for colour, marker, filled in VERDICT_LOOKS.values()
    ]
    figure.legend(handles, list(VERDICT_WORDS.values()), loc="outside lower center", ncols=3, frameon=False)


PHASE_ROW_INCHES, PANEL_MARGIN_INCHES = 0.17, 0.62
PERCENT = 100.0
# Phases of a smaller share of their command are in `other`.
LEAST_SHARE = 0.005
MOST_PHASES = 24
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
    figure = new_figure(PAGE_INCHES, sum(counts) * PHASE_ROW_INCHES + len(shown) * PANEL_MARGIN_INCHES)
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
    if len(rows) > MOST_PHASES:
        rows = [row for row in rows if not row[2]][:MOST_PHASES]
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
