"""Pictures of scores, of differences between designs, of times, of room under constraints, and of effects."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lidardesign.design.constraints.slack import SPACE_MARK, ConstraintSlack
from lidardesign.evaluate.effects import MILLIMETRES, EffectSummary
from lidardesign.evaluate.figures.canvas import (
    BAND_OPACITY,
    COLOURS,
    COLUMN_INCHES,
    INK,
    MARKERS,
    PAGE_INCHES,
    SMALL_POINTS,
    SOFT,
    VERDICT_WORDS,
    Against,
    Series,
    add_legend,
    axis_titles,
    label_ticks,
    log_ticks,
    logarithmic,
    new_figure,
    plain_axes,
    plain_label,
    position,
    series,
)
from lidardesign.evaluate.results import Evaluation, Paired, verdict
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
LEGEND_WORDS = ("a is better", "a is worse", VERDICT_WORDS["open"])
VERDICT_LOOKS = {
    "better": ("#0072B2", "o", True),
    "worse": ("#D55E00", "s", True),
    "open": ("#6b7280", "D", False),
}


def curve_picture(evaluation: Evaluation, against: Against) -> Figure:
    """Score against rays or bandwidth, a column wide: a line and an interval band per design and baseline."""
    curves = series(evaluation)
    figure = new_figure(COLUMN_INCHES, CURVE_HEIGHT + math.ceil(len(curves) / LEGEND_COLUMNS) * LEGEND_LINE)
    axes = figure.add_subplot()
    for curve in curves:
        across = [position(row, against) for row in curve.rows]
        low, high = zip(*(row.drawn_interval for row in curve.rows), strict=True)
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
            (row,) = curve.rows
            # an interval of a bootstrap may leave its mean out
            lengths = [[max(row.value - low[0], 0.0)], [max(high[0] - row.value, 0.0)]]
            axes.errorbar(across, [row.value], lengths, color=curve.colour, capsize=2.0)
    _dress_curves(axes, evaluation, curves, against)
    figure.legend(loc="outside lower center", ncols=LEGEND_COLUMNS, frameon=False, handlelength=2.6, borderaxespad=0.2)
    return figure


def _dress_curves(axes: Axes, evaluation: Evaluation, curves: list[Series], against: Against) -> None:
    metric, rows = evaluation.metric, [row for curve in curves for row in curve.rows]
    up = plain_label(f"{metric.name} [{metric.unit}]", longest=40)
    axes.set(xlabel=axis_titles(evaluation, against)[0], ylabel=up)
    scenes = f"{evaluation.scenes} held-out scene{'s' if evaluation.scenes != 1 else ''}"
    _soft_title(axes, f"{metric.better} is better; {scenes}, 95 % intervals")
    places, values = [position(row, against) for row in rows], [row.value for row in rows]
    if logarithmic(places):
        axes.set_xscale("log")
        counts = sorted({row.rays for row in rows})
        at_counts = against == "rays" and len(counts) <= MOST_RAY_TICKS
        label_ticks(axes.xaxis, counts if at_counts else log_ticks(places))
    if logarithmic(values):
        axes.set_yscale("log")
        label_ticks(axes.yaxis, log_ticks(values))
    plain_axes(axes)


def _soft_title(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=SMALL_POINTS, loc="left", color=SOFT)


def _list_rows(axes: Axes, labels: Sequence[str]) -> None:
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(max(len(labels), 1) - 0.4, -0.6)


def differences_picture(evaluation: Evaluation) -> Figure:
    """Every paired difference with its interval, a page wide: where a difference was found, and where not."""
    pairs, title = drawn_pairs(evaluation)
    figure = new_figure(PAGE_INCHES, MARGIN_INCHES + max(len(pairs), 2) * ROW_INCHES)
    axes = figure.add_subplot()
    for place, pair in enumerate(pairs):
        colour, marker, filled = VERDICT_LOOKS[verdict(evaluation, pair)]
        face = colour if filled else "white"
        axes.plot(pair.drawn_interval, [place, place], color=colour, linewidth=1.2, solid_capstyle="butt")
        axes.plot(pair.difference, place, marker=marker, color=colour, markerfacecolor=face, linestyle="none", zorder=3)
        if place and pair.a != pairs[place - 1].a:
            axes.axhline(place - 0.5, color=SOFT, linewidth=0.5)
    axes.axvline(0.0, color=INK, linewidth=0.8, zorder=1)
    _list_rows(axes, [f"{plain_label(pair.a)} - {plain_label(pair.b)}, {pair.rays} rays" for pair in pairs])
    metric = evaluation.metric
    axes.set_xlabel(plain_label(f"a - b: {metric.name} [{metric.unit}], {metric.better} is better", longest=90))
    plain_axes(axes, grid="x")
    _soft_title(axes, title)
    looks = [
        (words, {"color": colour, "marker": mark, "markerfacecolor": colour if filled else "white", "linewidth": 1.2})
        for words, (colour, mark, filled) in zip(LEGEND_WORDS, VERDICT_LOOKS.values(), strict=True)
    ]
    add_legend(figure, looks, 3)
    return figure


def drawn_pairs(evaluation: Evaluation) -> tuple[list[Paired], str]:
    """The pairs that a picture holds, by design, and a line that says which they are."""
    order = {name: place for place, name in enumerate(dict.fromkeys(row.design for row in evaluation.rows))}
    pairs = sorted(evaluation.paired, key=lambda pair: (order.get(pair.a, -1), order.get(pair.b, -1), pair.rays))
    title = f"paired over {evaluation.scenes} held-out scenes, 95 % intervals"
    if len(pairs) <= MOST_ROWS:
        return pairs, title
    most = {name: max(pair.rays for pair in pairs if pair.a == name) for name in {pair.a for pair in pairs}}
    pairs = [pair for pair in pairs if pair.rays == most[pair.a]]
    title += "; at the most rays"
    if len(pairs) <= MOST_ROWS:
        return pairs, title
    baselines = {row.design for row in evaluation.rows if row.baseline}
    pairs = [pair for pair in pairs if pair.b in baselines]
    return pairs[:MOST_ROWS], f"{title}, against rivals" + (f"; the first {MOST_ROWS}" * (len(pairs) > MOST_ROWS))


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
        total = sum(seconds for _, seconds, inside in rows if not inside)
        for place, (_, seconds, inside) in enumerate(rows):
            axes.barh(place, seconds, height=0.62 if inside else 0.78, color=INNER if inside else WHOLE, linewidth=0)
            text = f" {seconds:.3g} s, {PERCENT * seconds / total:.0f} %"
            axes.text(seconds, place, text, va="center", fontsize=SMALL_POINTS, color=INK)
        _list_rows(axes, [f"{'in it: ' * inside}{plain_label(name)}" for name, _, inside in rows])
        axes.set(xlim=(0.0, 1.22 * max(seconds for _, seconds, _ in rows)), xlabel="seconds")
        axes.set_title(f"{plain_label(command)}: {total:.3g} s", loc="left", color=INK)
        axes.tick_params(axis="y", length=0)
        plain_axes(axes, grid="x")
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


BOUND_ROW_INCHES, BOUND_MARGIN_INCHES = 0.19, 0.95
DESIGN_INCHES = 0.085  # of a row, for each design in it
MOST_DESIGNS = min(len(COLOURS), len(MARKERS))
# Room is shown on an axis between these; what is further is drawn on the edge.
LEAST_ROOM, MOST_ROOM = -25.0, 105.0
BROKEN = "#D55E00"
ON, OFF = "#0072B2", "#6b7280"
# Shares of the tolerance below this one stand on the left edge.
LEAST_TOLERANCE_SHARE = 1e-4


def constraints_picture(slacks: Mapping[str, Sequence[ConstraintSlack]]) -> Figure | None:
    """The room that designs leave under each bound, a page wide; None where nothing was asked for.

    Arguments:
        slacks: How tight each bound is, by the design's name.
    """
    # what holds for every design of the space is no constraint of anybody's
    designs = {name: rows for name, rows in slacks.items() if not all(row.name.startswith(SPACE_MARK) for row in rows)}
    if not designs:
        return None
    shown = dict(list(designs.items())[:MOST_DESIGNS])
    labels = list(dict.fromkeys(bound_label(row) for rows in shown.values() for row in rows))
    title = "of the closest sensor; at 0 the design leans on the bound"
    if len(labels) > MOST_ROWS:
        title += f"; the first {MOST_ROWS} of {len(labels)} bounds"
        labels = labels[:MOST_ROWS]
    if len(designs) > len(shown):
        title += f"; the first {len(shown)} of {len(designs)} designs"
    row_inches = max(BOUND_ROW_INCHES, len(shown) * DESIGN_INCHES)
    figure = new_figure(PAGE_INCHES, BOUND_MARGIN_INCHES + max(len(labels), 2) * row_inches)
    axes = figure.add_subplot()
    for number, (name, rows) in enumerate(shown.items()):
        _draw_room(axes, rows, labels, number, len(shown), name)
    axes.axvline(0.0, color=INK, linewidth=0.8, zorder=1)
    _list_rows(axes, labels)
    axes.set(xlim=(LEAST_ROOM, MOST_ROOM), xlabel="room left [% of the bound]; negative: broken")
    plain_axes(axes)
    _soft_title(axes, title)
    looks = [
        *((plain_label(name), _design_look(number)) for number, name in enumerate(shown)),
        ("kept, without a distance", {"color": SOFT, "marker": "o", "markerfacecolor": "white", "linestyle": "none"}),
        ("broken", {"color": BROKEN, "marker": "X", "markersize": 5.5, "linestyle": "none"}),
    ]
    add_legend(figure, looks, 4)
    return figure


def _design_look(number: int) -> dict[str, Any]:
    return {"color": COLOURS[number], "marker": MARKERS[number], "linewidth": 0.8}


def bound_label(row: ConstraintSlack) -> str:
    """A bound as its key and what was asked for."""
    return plain_label(f"{row.name}: {short_value(row.bound)}", longest=40)


def short_value(value: Any) -> str:
    """A bound or value in few letters: numbers with four digits, lists in brackets."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, list | tuple):
        return f"[{', '.join(short_value(one) for one in value)}]"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _draw_room(
    axes: Axes, rows: Sequence[ConstraintSlack], labels: Sequence[str], number: int, count: int, name: str
) -> None:
    offset = (number - (count - 1) / 2) * 0.7 / count
    colour, marker = COLOURS[number], MARKERS[number]
    for row in rows:
        label = bound_label(row)
        if label not in labels:
            continue
        place, across, broken = labels.index(label) + offset, _place_of(row), row.broken > 0
        if across > 0 and row.share is not None:
            axes.plot([0.0, min(across, MOST_ROOM)], [place, place], color=colour, linewidth=0.8, alpha=0.5, zorder=2)
        axes.plot(
            min(max(across, LEAST_ROOM), MOST_ROOM),
            place,
            marker="X" if broken else marker,
            color=BROKEN if broken else colour,
            markerfacecolor="white" if row.room is None and not broken else BROKEN if broken else colour,
            markersize=5.5 if broken else 4.0,
            linestyle="none",
            clip_on=False,
            zorder=3,
        )


def _place_of(row: ConstraintSlack) -> float:
    """Where a bound stands on the axis: its share of room; what has no distance at the end of its side."""
    if row.share is not None:
        return PERCENT * row.share
    if row.room is not None and row.room <= 0 and not row.broken:
        return 0.0
    return LEAST_ROOM if row.broken else MOST_ROOM


def effects_picture(effects: Sequence[EffectSummary]) -> Figure | None:
    """The most that each effect could change, over what is tolerated, a page wide; None where none is called for."""
    if not any(effect.on or effect.range_m > 0 or effect.lost > 0 for effect in effects):
        return None
    figure = new_figure(PAGE_INCHES, BOUND_MARGIN_INCHES + len(effects) * BOUND_ROW_INCHES)
    axes = figure.add_subplot()
    tolerance = effects[0].tolerance
    most = max([10.0, *(share for effect in effects for share in _shares(effect))])
    for place, effect in enumerate(effects):
        _draw_effect(axes, effect, place)
        axes.annotate(
            _effect_words(effect),
            (1.02, place),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=SMALL_POINTS,
            color=INK if effect.on else SOFT,
        )
    axes.axvline(1.0, color=INK, linewidth=0.9, linestyle="dashed", zorder=1)
    axes.set(xscale="log", xlim=(LEAST_TOLERANCE_SHARE, 10.0 ** math.ceil(math.log10(most))))
    label_ticks(axes.xaxis)
    _list_rows(axes, [effect.name.replace("_", " ") for effect in effects])
    axes.set_xlabel("most that it could change / tolerated together")
    plain_axes(axes)
    together = f"{MILLIMETRES * tolerance.range_m:.3g} mm, {tolerance.lost:.2g} of the returns"
    _soft_title(axes, f"tolerated together (dashed): {together}")
    marks = {"range": ("o", True), "returns": ("s", True), "skipped (hollow)": ("o", False)}
    add_legend(figure, [(name, _effect_look(mark, filled=filled)) for name, (mark, filled) in marks.items()], 3)
    return figure


def _shares(effect: EffectSummary) -> tuple[float, float]:
    """Bounds on ranges and returns as shares of what is tolerated."""
    tolerance, most = effect.tolerance, 1 / LEAST_TOLERANCE_SHARE**2
    return min(effect.range_m / tolerance.range_m, most), min(effect.lost / tolerance.lost, most)


def _effect_look(marker: str, *, filled: bool) -> dict[str, Any]:
    colour = ON if filled else OFF
    return {"color": colour, "marker": marker, "markerfacecolor": colour if filled else "white", "linestyle": "none"}


def _draw_effect(axes: Axes, effect: EffectSummary, place: int) -> None:
    for share, marker, shift in zip(_shares(effect), ("o", "s"), (-0.14, 0.14), strict=True):
        if share > 0:
            look = {**_effect_look(marker, filled=effect.on), "clip_on": False, "zorder": 3}
            axes.plot(max(share, LEAST_TOLERANCE_SHARE), place + shift, **look)


def _effect_words(effect: EffectSummary) -> str:
    if effect.on:
        return "simulated" if effect.scenes_on == 1 else f"in {PERCENT * effect.scenes_on:.0f} % of scenes"
    if effect.missing is not None:
        return "not possible here"
    return "skipped" if any(_shares(effect)) else "not there"
