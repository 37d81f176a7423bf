"""The report's section on what accuracy costs: error against seconds as an interactive figure, and a table."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any

from lidardesign.evaluate.figures import FONT
from lidardesign.evaluate.pareto import (
    CHOSEN,
    LINE,
    PALE,
    TOLERANCE,
    Mark,
    Panel,
    has_fine_ticks,
    label_places,
    panels,
)
from lidardesign.evaluate.rungs import Ladder, Rung
from lidardesign.evaluate.verdicts import plain, table

COLUMNS = 2
ROW_PX = 300
# The share of the figure's width between panels; pixels above panels for titles, below for axes, and per line of text.
BETWEEN, ABOVE_PX, BELOW_PX, LINE_PX = 0.13, 34, 46, 11
RING = "#222222"
BYTES_PER_MB = 1e6


def pareto_height_px(ladders: Sequence[Ladder]) -> int:
    """The height that the figure needs [px]."""
    return ROW_PX * math.ceil(len(panels(ladders)) / COLUMNS)


def pareto_figure(ladders: Sequence[Ladder]) -> dict[str, Any]:
    """All panels, two beside each other; hovering tells what a rung is."""
    shown = panels(ladders)
    rows = math.ceil(len(shown) / COLUMNS)
    layout: dict[str, Any] = {
        "font": {**FONT, "size": 12},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 62, "r": 12, "t": 4, "b": 4},
        "showlegend": False,
        "hovermode": "closest",
        "annotations": [],
    }
    traces: list[dict[str, Any]] = []
    for index, panel in enumerate(shown):
        name = "" if index == 0 else str(index + 1)
        traces += _traces(panel, name)
        layout |= _axes(panel, name, index, rows)
        layout["annotations"] += [_title(panel, name), *_settings(panel, name)]
    return {"data": traces, "layout": layout}


def _traces(panel: Panel, name: str) -> list[dict[str, Any]]:
    where = {"xaxis": f"x{name}", "yaxis": f"y{name}", "type": "scatter"}
    front = panel.front
    line = {
        **where,
        "x": [mark.x for mark in front],
        "y": [mark.y for mark in front],
        "mode": "lines",
        "line": {"color": LINE, "width": 1.5},
        "opacity": PALE,
        "hoverinfo": "skip",
    }
    tolerance = [{**where, **_tolerance(panel)}] if panel.shows_tolerance else []
    return [*tolerance, line, {**where, **_marks(panel)}]


def _marks(panel: Panel) -> dict[str, Any]:
    marks = panel.marks
    colours = [CHOSEN if mark.chosen else LINE for mark in marks]
    return {
        "x": [mark.x for mark in marks],
        "y": [mark.y for mark in marks],
        "mode": "markers",
        "cliponaxis": False,
        "marker": {
            "symbol": ["triangle-down" if mark.on_edge else "circle" for mark in marks],
            "size": [13 if mark.rung.default else 9 for mark in marks],
            "color": colours,
            "opacity": [PALE if mark.beaten and not (mark.chosen or mark.rung.default) else 1.0 for mark in marks],
            "line": {"color": RING, "width": [2.5 if mark.rung.default else 0 for mark in marks]},
        },
        "error_y": {
            "type": "data",
            "symmetric": False,
            "array": [mark.high - mark.y for mark in marks],
            "arrayminus": [mark.y - mark.low for mark in marks],
            "thickness": 1,
            "width": 0,
            "color": LINE,
        },
        "customdata": [_told(mark, panel.ladder) for mark in marks],
        "hovertemplate": "%{customdata}<extra></extra>",
    }


def _settings(panel: Panel, name: str) -> list[dict[str, Any]]:
    """The setting beside each mark."""
    places = label_places(panel, ROW_PX - ABOVE_PX - BELOW_PX, LINE_PX)
    return [
        {
            "text": html.escape(mark.rung.setting),
            "xref": f"x{name}",
            "yref": f"y{name}",
            "x": math.log10(mark.x),
            "y": math.log10(mark.y),
            "xshift": across,
            "yshift": up,
            "xanchor": side,
            "yanchor": "middle",
            "showarrow": False,
            "bgcolor": "rgba(255,255,255,0.75)",
            "borderpad": 0,
            "font": {"size": 10, "color": CHOSEN if mark.chosen else "#333333"},
        }
        for mark, (across, up, side) in zip(panel.marks, places, strict=True)
    ]


def _told(mark: Mark, ladder: Ladder) -> str:
    rung, unit = mark.rung, html.escape(ladder.unit)
    error = "the reference" if rung.reference else f"error {rung.error:.3g} &#177; {rung.uncertainty:.1g} {unit}"
    lines = [f"<b>{html.escape(rung.setting)}</b>", error, f"{rung.seconds:.3g} s"]
    if rung.memory_bytes is not None:
        lines.append(f"{rung.memory_bytes / BYTES_PER_MB:.3g} MB")
    lines += ["the one to choose"] if mark.chosen else []
    lines += ["the run's own"] if rung.default else []
    return "<br>".join(line.strip() for line in lines)


def _axes(panel: Panel, name: str, index: int, rows: int) -> dict[str, Any]:
    """Both axes of a panel in its place: across, then down."""
    row, column = divmod(index, COLUMNS)
    width = (1 - BETWEEN) / COLUMNS
    left = column * (width + BETWEEN)
    top = 1 - (row + ABOVE_PX / ROW_PX) / rows
    bottom = 1 - (row + 1 - BELOW_PX / ROW_PX) / rows
    look = {
        "type": "log",
        "gridcolor": "#e4e7eb",
        "linecolor": "#9aa5b1",
        "ticks": "outside",
        "zeroline": False,
    }
    seconds = {**look, **_ticks(panel.seconds), "domain": [left, left + width], "anchor": f"y{name}"}
    errors = {**look, **_ticks(panel.errors), "domain": [bottom, top], "anchor": f"x{name}"}
    seconds |= {"title": {"text": "seconds", "standoff": 4, "font": {"size": 11}}}
    errors |= {"title": {"text": html.escape(panel.error_title), "standoff": 4, "font": {"size": 11}}}
    return {f"xaxis{name}": seconds, f"yaxis{name}": errors}


def _ticks(ends: tuple[float, float]) -> dict[str, Any]:
    low, high = ends
    spacing = {"dtick": "D2"} if has_fine_ticks(ends) else {"dtick": 1}
    return {**spacing, "range": [math.log10(low), math.log10(high)], "tickformat": "~g", "tickfont": {"size": 10}}


def _title(panel: Panel, name: str) -> dict[str, Any]:
    return {
        "text": f"<b>{html.escape(panel.ladder.knob)}</b>",
        "xref": f"x{name} domain",
        "yref": f"y{name} domain",
        "x": 0,
        "y": 1.0,
        "yshift": 2,
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 13},
    }


def _tolerance(panel: Panel) -> dict[str, Any]:
    """A dashed line across the panel; a trace, because shapes vanish behind grid lines in the same place."""
    limit = panel.ladder.tolerance
    return {
        "x": list(panel.seconds),
        "y": [limit, limit],
        "mode": "lines",
        "line": {"color": TOLERANCE, "width": 1.2, "dash": "dash"},
        "hoverinfo": "skip",
    }


def accuracy_tables(ladders: Sequence[Ladder]) -> str:
    """Every ladder with all its rungs, what its figures mean and its verdict."""
    return "".join(_table(ladder) for ladder in ladders)


def _table(ladder: Ladder) -> str:
    unit = f" [{ladder.unit}]" if ladder.unit else ""
    limit = f"{ladder.tolerance:.3g} {ladder.unit}".rstrip()
    about = (
        f"Error: {ladder.error_of}, against {ladder.against}. Tolerance: {limit}, {ladder.because}. Seconds: "
        f"{ladder.work}." + (f" Note: {ladder.note}." if ladder.note else "")
    )
    headings = ("setting", f"error{unit}", "standard error", "seconds", "MB", "verdict")
    chosen = ladder.chosen
    lines = [(_cells(rung), "better" if rung is chosen else "open", False) for rung in ladder.rungs]
    words = {"better": "to choose", "open": ""}
    return f"<h3>{html.escape(ladder.knob)}: {html.escape(ladder.verdict)}</h3><p>{html.escape(about)}</p>" + table(
        headings, lines, text_columns=1, words=words, caption=f"Settings of {ladder.knob}."
    )


def _cells(rung: Rung) -> list[str]:
    """The setting, its error and uncertainty, seconds and memory; the last cell is for the verdict."""
    memory = "" if rung.memory_bytes is None else plain(rung.memory_bytes / BYTES_PER_MB, 3, tiny=1.0)
    error = ("reference", "") if rung.reference else (f"{rung.error:.3g}", f"{rung.uncertainty:.2g}")
    return [rung.setting + (" (run)" if rung.default else ""), *error, f"{rung.seconds:.3g}", memory, ""]
