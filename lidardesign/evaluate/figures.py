"""The report's curves of scores, as plain plotly documents.

plotly reads a little HTML in names, so every name is escaped here. Legends are in the page itself, where they can be
switched from the keyboard too.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

from lidardesign.evaluate.curves import Against, Series, axis_titles, log_ticks, logarithmic, position, series
from lidardesign.evaluate.results import Evaluation

FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 14, "color": "#1f2933"}
SYMBOLS = {
    "o": "circle",
    "s": "square",
    "^": "triangle-up",
    "D": "diamond",
    "v": "triangle-down",
    "P": "cross",
    "x": "x-thin-open",
    "+": "cross-thin-open",
    "*": "asterisk-open",
    "1": "y-down-open",
    "d": "diamond-tall-open",
}
DASH_NAMES = {"solid": "solid", "dashed": "dash", "dashdot": "dashdot", "dotted": "dot"}


def curve_figure(evaluation: Evaluation, against: Against) -> dict[str, Any]:
    """Score against rays or bandwidth: a line and an interval band per name."""
    curves = series(evaluation)
    across, up = axis_titles(evaluation, against)
    rows = [row for curve in curves for row in curve.rows]
    places = [position(row, against) for row in rows]
    ticks = (
        {"tickvals": sorted(set(places)), "tickformat": "~g"} if against == "rays" else {"tickformat": "~g"}
    )
    axis = {"gridcolor": "#e4e7eb", "zeroline": False, "linecolor": "#9aa5b1", "ticks": "outside"}
    layout = {
        "font": FONT,
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 74, "r": 16, "t": 12, "b": 56},
        "xaxis": {**axis, **_scale(places), **ticks, "title": {"text": across}},
        "yaxis": {
            **axis,
            **_scale([row.value for row in rows]),
            "tickformat": "~g",
            "title": {"text": html.escape(up).replace(", ", "<br>"), "font": {"size": 13}},
        },
        "showlegend": False,
        "hovermode": "closest",
    }
    return {"data": [trace for curve in curves for trace in _curve_traces(curve, against)], "layout": layout}


def _scale(values: Sequence[float]) -> dict[str, Any]:
    return {"type": "log", "tickvals": log_ticks(values)} if logarithmic(values) else {"type": "linear"}


def _curve_traces(curve: Series, against: Against) -> list[dict[str, Any]]:
    across = [position(row, against) for row in curve.rows]
    name = html.escape(curve.name)
    red, green, blue = (int(curve.colour[i : i + 2], 16) for i in (1, 3, 5))
    band = {
        "type": "scatter",
        "x": [*across, *across[::-1]],
        "y": [*(row.ci_high for row in curve.rows), *(row.ci_low for row in reversed(curve.rows))],
        "fill": "toself",
        "fillcolor": f"rgba({red},{green},{blue},0.13)",
        "line": {"width": 0},
        "mode": "lines",
        "hoverinfo": "skip",
        "showlegend": False,
        "legendgroup": name,
    }
    line = {
        "type": "scatter",
        "x": across,
        "y": [row.value for row in curve.rows],
        "name": name,
        "legendgroup": name,
        "mode": "lines+markers",
        "line": {
            "color": curve.colour,
            "width": 1.5 if curve.baseline else 2.5,
            "dash": DASH_NAMES[curve.dash],
        },
        "marker": {
            "symbol": SYMBOLS[curve.marker],
            "size": 8,
            "color": curve.colour,
            "line": {"color": curve.colour, "width": 1.5},
        },
        "text": [
            f"{row.rays} rays, {row.bandwidth_mbps:.3g} Mbit/s, {row.failures} failures" for row in curve.rows
        ],
        "hovertemplate": "%{y:.4g}<br>%{text}<extra>%{fullData.name}</extra>",
    }
    return [band, line]
