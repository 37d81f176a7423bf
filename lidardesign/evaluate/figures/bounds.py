"""Pictures of limits: how much room designs leave under their constraints, and how much each effect could change."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lidardesign.design.constraints.slack import SPACE_MARK, ConstraintSlack
from lidardesign.evaluate.figures.canvas import (
    INK,
    PAGE_INCHES,
    SMALL_POINTS,
    SOFT,
    label_powers,
    new_figure,
    plain_axes,
    plain_label,
)
from lidardesign.evaluate.figures.curves import COLOURS, MARKERS
from lidardesign.evaluate.results import MILLIMETRES, EffectSummary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW_INCHES, MARGIN_INCHES = 0.19, 0.95
DESIGN_INCHES = 0.085  # of a row, for each design in it
MOST_ROWS = 48
MOST_DESIGNS = 6
PERCENT = 100.0
# Room is shown on an axis between these; what is further is drawn on the edge.
LEAST_ROOM, MOST_ROOM = -25.0, 105.0
BROKEN = "#D55E00"
ON, OFF = "#0072B2", "#6b7280"
# Shares of the tolerance below this one stand on the left edge.
LEAST_SHARE = 1e-4


def constraints_picture(tightness: Mapping[str, Sequence[ConstraintSlack]]) -> Figure | None:
    """The room that designs leave under each bound, a page wide; None where nothing was asked for.

    Arguments:
        tightness: How tight each bound is, by the design's name.
    """
    # what holds for every design of the space is no constraint of anybody's
    designs = {name: rows for name, rows in tightness.items() if any(not _of_space(row) for row in rows)}
    if not designs:
        return None
    shown = dict(list(designs.items())[:MOST_DESIGNS])
    labels = list(dict.fromkeys(bound_label(row) for rows in shown.values() for row in rows))
    told = "of the closest sensor; at 0 the design leans on the bound"
    if len(labels) > MOST_ROWS:
        told += f"; the first {MOST_ROWS} of {len(labels)} bounds"
        labels = labels[:MOST_ROWS]
    if len(designs) > len(shown):
        told += f"; the first {len(shown)} of {len(designs)} designs"
    row_inches = max(ROW_INCHES, len(shown) * DESIGN_INCHES)
    figure = new_figure(PAGE_INCHES, MARGIN_INCHES + max(len(labels), 2) * row_inches)
    axes = figure.add_subplot()
    for number, (name, rows) in enumerate(shown.items()):
        _draw_room(axes, rows, labels, number, len(shown), name)
    axes.axvline(0.0, color=INK, linewidth=0.8, zorder=1)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(max(len(labels), 1) - 0.4, -0.6)
    axes.set_xlim(LEAST_ROOM, MOST_ROOM)
    axes.set_xlabel("room left [% of the bound]; negative: broken")
    plain_axes(axes, grid="both")
    axes.set_title(told, fontsize=SMALL_POINTS, loc="left", color=SOFT)
    figure.legend(*_room_legend(list(shown)), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _of_space(row: ConstraintSlack) -> bool:
    return row.name.startswith(SPACE_MARK)


def bound_label(row: ConstraintSlack) -> str:
    """A bound as its key and what was asked for."""
    return plain_label(f"{row.name}: {short_value(row.bound)}", longest=40)


def short_value(value: Any) -> str:
    """A bound or value in few letters: numbers with four digits, lists in brackets."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, int | float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(short_value(one) for one in value)}]"
    return str(value)


def _draw_room(
    axes: Axes, rows: Sequence[ConstraintSlack], labels: Sequence[str], number: int, count: int, name: str
) -> None:
    offset = (number - (count - 1) / 2) * 0.7 / count
    colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
    for row in rows:
        label = bound_label(row)
        if label not in labels:
            continue
        place = labels.index(label) + offset
        across = _place_of(row)
        broken = row.broken > 0
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


def _room_legend(names: Sequence[str]) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=COLOURS[i % len(COLOURS)], marker=MARKERS[i % len(MARKERS)], linewidth=0.8)
        for i in range(len(names))
    ]
    handles += [
        Line2D([], [], color=SOFT, marker="o", markerfacecolor="white", linestyle="none"),
        Line2D([], [], color=BROKEN, marker="X", markersize=5.5, linestyle="none"),
    ]
    return handles, [*(plain_label(name) for name in names), "kept, without a distance", "broken"]


def effects_picture(effects: Sequence[EffectSummary]) -> Figure | None:
    """The most that each effect could change, over what is tolerated, a page wide; None where none is called for."""
    if not any(effect.on or effect.range_m > 0 or effect.lost > 0 for effect in effects):
        return None
    figure = new_figure(PAGE_INCHES, MARGIN_INCHES + len(effects) * ROW_INCHES)
    axes = figure.add_subplot()
    tolerance = effects[0].tolerance
    shares = [share for effect in effects for share in _shares(effect)]
    most = 10.0 ** math.ceil(math.log10(max([*shares, 10.0])))
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
    axes.set_xscale("log")
    axes.set_xlim(LEAST_SHARE, most)
    label_powers(axes.xaxis)
    axes.set_yticks(range(len(effects)), [effect.name.replace("_", " ") for effect in effects])
    axes.set_ylim(len(effects) - 0.4, -0.6)
    axes.set_xlabel("most that it could change / tolerated together")
    plain_axes(axes, grid="both")
    told = f"tolerated together (dashed): {MILLIMETRES * tolerance.range_m:.3g} mm, {tolerance.lost:.2g} of the returns"
    axes.set_title(told, fontsize=SMALL_POINTS, loc="left", color=SOFT)
    figure.legend(*_effect_legend(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _shares(effect: EffectSummary) -> tuple[float, float]:
    """Bounds on ranges and returns as shares of what is tolerated; 0 where nothing is bounded by nothing."""
    tolerance = effect.tolerance
    return _over(effect.range_m, tolerance.range_m), _over(effect.lost, tolerance.lost)


def _over(bound: float, tolerated: float) -> float:
    if not bound > 0:
        return 0.0
    share = bound / tolerated if tolerated > 0 else math.inf
    return min(share, 1 / LEAST_SHARE**2)


def _draw_effect(axes: Axes, effect: EffectSummary, place: int) -> None:
    colour = ON if effect.on else OFF
    for share, marker, shift in zip(_shares(effect), ("o", "s"), (-0.14, 0.14), strict=True):
        if share <= 0:
            continue
        axes.plot(
            max(share, LEAST_SHARE),
            place + shift,
            marker=marker,
            color=colour,
            markerfacecolor=colour if effect.on else "white",
            linestyle="none",
            clip_on=False,
            zorder=3,
        )


def _effect_words(effect: EffectSummary) -> str:
    if effect.on:
        return "simulated" if effect.scenes_on == 1 else f"in {PERCENT * effect.scenes_on:.0f} % of scenes"
    if effect.missing is not None:
        return "not possible here"
    return "skipped" if any(_shares(effect)) else "not there"


def _effect_legend() -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    def mark(marker: str, *, filled: bool) -> Line2D:
        colour = ON if filled else OFF
        return Line2D([], [], color=colour, marker=marker, markerfacecolor=colour if filled else "white", linestyle="")

    names = ["range", "returns", "skipped (hollow)"]
    return [mark("o", filled=True), mark("s", filled=True), mark("o", filled=False)], names
