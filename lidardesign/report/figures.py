"""Scores as curves or bars, with the style of each, and the learned density, as plain plotly documents.

plotly reads a little HTML in names, so every name is escaped here. Legends are in the page itself, where they can be
switched from the keyboard too.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lidardesign.errors import check_choice
from lidardesign.evaluation.results import Evaluation, Row
from lidardesign.report.density_views import Marginal, PlaneDensity
from lidardesign.report.scene_figure import frustum_lines
from lidardesign.scenes.rays import Outcome, Rays
from lidardesign.sensors.design import DesignSpec

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Against = Literal["rays", "bandwidth"]

OUTCOME_WORDS = {
    Outcome.RETURN: "return",
    Outcome.OCCLUDED: "occluded",
    Outcome.AFTER_GATE: "behind the gate",
    Outcome.MISS: "nothing hit",
    Outcome.NOT_DETECTED: "not detected",
}

# Okabe and Ito 2008, without yellow (too faint on white) and with black kept for text.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
GREYS = ("#555555", "#808080", "#222222", "#999999", "#6b6b6b")
# By plotly's names, as dashes are.
MARKERS = ("circle", "square", "triangle-up", "diamond", "triangle-down", "cross")
BASELINE_MARKERS = ("x-thin-open", "cross-thin-open", "asterisk-open", "y-down-open", "diamond-tall-open")
DASHES = ("solid", "dash", "dashdot", "dot")
# Labels of a logarithmic axis: at these times every power of ten, the few where the values span more than the factor.
FEW_MANTISSAS, MANY_MANTISSAS, WIDE_FACTOR = (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0), 30.0
TICK_MARGIN = 1.2
LOGARITHMIC_FACTOR = 4.0  # a range of values wider than this factor is easier to read on a logarithmic axis
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 14, "color": "#1f2933"}
FAR_SHARE = 0.5  # of the worst design's score: baselines that are always worse by more are hidden at first
# One hue from light to dark: it reads the same without colour vision and on paper.
SCALE = [[0.0, "#ffffff"], [0.2, "#d6e6f4"], [0.45, "#6baed6"], [0.7, "#2171b5"], [1.0, "#08306b"]]
FILL, INK, QUIET = "#b8c1cb", "#1f2933", "#7b8794"
MOST_DESIGNS = 6  # drawn beside a marginal
AXIS = {"gridcolor": "#e4e7eb", "zeroline": False, "linecolor": "#9aa5b1", "ticks": "outside", "tickformat": "~g"}
LAYOUT = {
    "font": {**FONT, "size": 12},
    "paper_bgcolor": "#ffffff",
    "plot_bgcolor": "#ffffff",
    "margin": {"l": 58, "r": 12, "t": 10, "b": 46},
    "showlegend": False,
}
MOST_DRAWN_RAYS = 2000  # of a design: more lines are no picture


@dataclass(frozen=True)
class Series:
    """One curve.

    Arguments:
        name: Of the design or baseline.
        rows: By growing number of rays.
        colour, marker, dash: Distinct in more than colour; baselines are grey, with open markers and dashes.
        baseline: Whether it is a baseline.
    """

    name: str
    rows: tuple[Row, ...]
    colour: str
    marker: str
    dash: str
    baseline: bool


def series(evaluation: Evaluation) -> list[Series]:
    """One series per name, in the order of the rows."""
    curves: list[Series] = []
    for name in dict.fromkeys(row.design for row in evaluation.rows):
        rows = tuple(sorted((row for row in evaluation.rows if row.design == name), key=lambda row: row.rays))
        baseline = rows[0].baseline
        index = sum(other.baseline == baseline for other in curves)
        colours, markers = (GREYS, BASELINE_MARKERS) if baseline else (COLOURS, MARKERS)
        turn = 1 + index % (len(DASHES) - 1) if baseline else index // len(COLOURS) % len(DASHES)
        colour, marker = colours[index % len(colours)], markers[index % len(markers)]
        curves.append(Series(name, rows, colour, marker, DASHES[turn], baseline))
    return curves


def position(row: Row, against: Against) -> float:
    """The place of a row on the horizontal axis: rays per frame or position, or Mbit/s."""
    return float(row.rays) if against == "rays" else row.bandwidth_mbps


def logarithmic(values: Sequence[float]) -> bool:
    """True for positive values that span more than `LOGARITHMIC_FACTOR`."""
    positive = [value for value in values if value > 0]
    return len(positive) == len(values) > 1 and max(positive) > LOGARITHMIC_FACTOR * min(positive)


def log_ticks(values: Sequence[float]) -> list[float]:
    """Round values to label on a logarithmic axis of some values: more per decade where it has few decades."""
    low, high = min(values), max(values)
    mantissas = FEW_MANTISSAS if high > WIDE_FACTOR * low else MANY_MANTISSAS
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [mantissa * 10.0**decade for decade in decades for mantissa in mantissas]
    return [tick for tick in ticks if low / TICK_MARGIN <= tick <= high * TICK_MARGIN]


def far_baselines(evaluation: Evaluation) -> set[str]:
    """Names of baselines far worse than all designs at every number of rays, to hide at first in a plot."""
    sign, baseline = evaluation.metric.sign, evaluation.strongest_baseline
    worst: dict[int, float] = {}
    for row in evaluation.rows:
        if not row.baseline:
            worst[row.rays] = max(sign * row.value, worst.get(row.rays, -math.inf))
    baselines = [row for row in evaluation.rows if row.baseline and row.rays in worst]
    near = {row.design for row in baselines if sign * row.value - worst[row.rays] <= FAR_SHARE * abs(worst[row.rays])}
    strongest = {baseline.name} if baseline is not None else set()
    return {row.design for row in baselines} - near - strongest - set(evaluation.named)


def curve_figure(evaluation: Evaluation, against: Against, hidden: Collection[str] = ()) -> dict[str, Any]:
    """Score against rays or bandwidth: a line and an interval band per name, some of them hidden at first.

    At one number of rays there are bars instead.
    """
    curves, metric = series(evaluation), evaluation.metric
    across = "rays" if against == "rays" else "bandwidth [Mbit/s]"
    up = f"{metric.name} [{metric.unit}], {metric.better} is better"
    rows = [row for curve in curves for row in curve.rows]
    places = [position(row, against) for row in rows]
    ends = [end for curve in curves if curve.name not in hidden for row in curve.rows for end in row.drawn_interval]
    has_bars = against == "rays" and len(set(places)) == 1
    numbered = {"tickvals": sorted(set(places)), "tickformat": "~g"} if against == "rays" else {"tickformat": "~g"}
    ticks = {"type": "category", "automargin": True} if has_bars else {**_scale(places), **numbered}
    # shares are compared by what is between them, and bars by their lengths
    is_linear = has_bars or metric.unit == "%"
    values = {"type": "linear"} if is_linear else _scale([row.value for row in rows], ends)
    axis = {"gridcolor": "#e4e7eb", "zeroline": False, "linecolor": "#9aa5b1", "ticks": "outside"}
    layout = {
        "font": FONT,
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 74, "r": 16, "t": 12, "b": 56},
        "xaxis": {**axis, **ticks, "title": {"text": f"at {places[0]:g} rays" if has_bars else across}},
        "yaxis": {
            **axis,
            **values,
            "tickformat": "~g",
            "automargin": True,
            "title": {"text": html.escape(up).replace(", ", "<br>"), "font": {"size": 13}},
        },
        "showlegend": False,
        "hovermode": "closest",
    }
    traces = [
        {**trace, "visible": curve.name not in hidden}
        for curve in curves
        for trace in (_bar_traces(curve) if has_bars else _curve_traces(curve, against))
    ]
    return {"data": traces, "layout": layout}


def _scale(values: Sequence[float], shown: Sequence[float] = ()) -> dict[str, Any]:
    """The scale of an axis for some values, with ticks that also suit those shown at first."""
    if not logarithmic(values):
        return {"type": "linear"}
    positive = [value for value in shown if value > 0]
    return {"type": "log", "tickvals": sorted({*log_ticks(values), *(log_ticks(positive) if positive else ())})}


def _curve_traces(curve: Series, against: Against) -> list[dict[str, Any]]:
    across = [position(row, against) for row in curve.rows]
    name = html.escape(curve.name)
    red, green, blue = (int(curve.colour[i : i + 2], 16) for i in (1, 3, 5))
    values = [row.value for row in curve.rows]
    low, high = zip(*(row.drawn_interval for row in curve.rows), strict=True)
    band = {
        "type": "scatter",
        "x": [*across, *across[::-1]],
        "y": [*high, *low[::-1]],
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
        "y": values,
        # a single point has no band
        "error_y": {
            "type": "data",
            "symmetric": False,
            "array": [end - value for end, value in zip(high, values, strict=True)],
            "arrayminus": [value - end for end, value in zip(low, values, strict=True)],
            "visible": len(values) == 1,
        },
        "name": name,
        "legendgroup": name,
        "mode": "lines+markers",
        "line": {
            "color": curve.colour,
            "width": 1.5 if curve.baseline else 2.5,
            "dash": curve.dash,
        },
        "marker": {
            "symbol": curve.marker,
            "size": 8,
            "color": curve.colour,
            "line": {"color": curve.colour, "width": 1.5},
        },
        "text": [f"{row.rays} rays, {row.bandwidth_mbps:.3g} Mbit/s, {row.failures} failures" for row in curve.rows],
        "hovertemplate": "%{y:.4g}<br>%{text}<extra>%{fullData.name}</extra>",
    }
    return [band, line]


def _bar_traces(curve: Series) -> list[dict[str, Any]]:
    """A bar with its interval; the empty first trace is that of a curve's band."""
    point = _curve_traces(curve, "rays")[1]
    shared = {key: point[key] for key in ("y", "error_y", "name", "legendgroup", "text", "hovertemplate")}
    bar = {**shared, "type": "bar", "x": [point["name"]], "textposition": "none", "marker": {"color": curve.colour}}
    return [{"type": "bar", "x": [], "y": [], "showlegend": False, "legendgroup": point["name"]}, bar]


def marginal_figure(marginal: Marginal, looks: Mapping[str, Series]) -> dict[str, Any]:
    """One marginal as a filled outline, those of designs as lines."""
    density = {
        **_steps(marginal.edges, marginal.heights),
        "fill": "tozeroy",
        "fillcolor": FILL,
        "line": {"color": QUIET, "width": 1},
        "hoverinfo": "skip",
    }
    lines = [
        {
            **_steps(marginal.edges, heights),
            "line": {"color": looks[name].colour, "width": 2, "dash": looks[name].dash},
            "name": html.escape(name),
            "hovertemplate": "%{y:.3g}<extra>%{fullData.name}</extra>",
        }
        for name, heights in list(marginal.designs.items())[:MOST_DESIGNS]
        if name in looks
    ]
    layout = {
        **LAYOUT,
        "xaxis": {**AXIS, "title": {"text": marginal.label}, "range": [marginal.edges[0], marginal.edges[-1]]},
        "yaxis": {**AXIS, "title": {"text": marginal.unit}, "range": [0, marginal.top]},
        "hovermode": "closest",
    }
    return {"data": [density, *lines], "layout": layout}


def plane_figure(plane: PlaneDensity) -> dict[str, Any]:
    """A heat map of a plane's density, with outlines of targets and other bodies."""
    across, up = ((edges[:-1] + edges[1:]) / 2 for edges in plane.edges)
    heat = {
        "type": "heatmap",
        "x": across.tolist(),
        "y": up.tolist(),
        "z": _array(plane.heights),
        "colorscale": SCALE,
        "zmin": 0,
        "colorbar": {"title": {"text": plane.unit}, "thickness": 12, "tickformat": "~g", "len": 0.9},
        "hovertemplate": f"%{{x:.3f}}, %{{y:.3f}} m: %{{z:.3g}} {html.escape(plane.unit)}<extra></extra>",
    }
    outlines = [
        {
            "type": "contour",
            "x": across.tolist(),
            "y": up.tolist(),
            "z": _array(covered),
            "contours": {"start": 0.5, "end": 0.5, "size": 1, "coloring": "none"},
            "line": {"color": INK, "width": 1.2, "dash": dash},
            "showscale": False,
            "hoverinfo": "skip",
        }
        for covered, dash in ((plane.targets, "solid"), (plane.others, "dot"))
        if covered.any() and not covered.all()
    ]
    layout = {
        **LAYOUT,
        "xaxis": {**AXIS, "title": {"text": plane.labels[0]}, "constrain": "domain", "showgrid": False},
        "yaxis": {
            **AXIS, "title": {"text": plane.labels[1]}, "constrain": "domain", "showgrid": False, "scaleanchor": "x"
        },
    }  # fmt: skip
    return {"data": [heat, *outlines], "layout": layout}


def encoded(values: np.ndarray, kind: str) -> str:
    """An array as base64 of its little-endian bytes, row by row."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def _array(values: np.ndarray) -> dict[str, str]:
    """A matrix as plotly's own short form."""
    rows, columns = values.shape
    return {"dtype": "f4", "bdata": encoded(values, "<f4"), "shape": f"{rows}, {columns}"}


def _steps(edges: np.ndarray, heights: np.ndarray) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "x": np.repeat(edges, 2).tolist(),
        "y": [0.0, *np.repeat(heights, 2).tolist(), 0.0],
    }


def design_figure(design: DesignSpec, rays: Rays | None = None) -> Figure:
    """The sensors of a design with their fields of view and gates; rays are drawn inside their gates."""
    from plotly.graph_objects import Figure

    figure = Figure()
    for sensor in design.sensors:
        _add_lines(figure, frustum_lines(sensor), sensor.name)
    if rays is not None:
        chosen = np.unique(np.linspace(0, len(rays) - 1, min(len(rays), MOST_DRAWN_RAYS)).astype(int))
        ends = rays.origin_m[chosen, None] + rays.gate_m[chosen, :, None] * rays.direction[chosen, None]
        gaps = np.full((len(chosen), 1, 3), np.nan)
        _add_lines(figure, np.concatenate([ends, gaps], axis=1).reshape(-1, 3), "gates of rays")
    axes = {f"{name}axis": {"title": {"text": f"{name} [m]"}} for name in "xyz"}
    return figure.update_layout(title={"text": design.name}, scene={"aspectmode": "data", **axes})


def scores_figure(evaluation: Evaluation, against: str = "rays") -> Figure:
    """Scores with their intervals against numbers of rays, or against bandwidth."""
    from plotly.graph_objects import Figure

    check_choice(against, "against", ("rays", "bandwidth"))
    return Figure(curve_figure(evaluation, against)).update_layout(showlegend=True)


def _add_lines(figure: Figure, points_m: np.ndarray, name: str) -> None:
    x, y, z = points_m.T
    figure.add_scatter3d(x=x, y=y, z=z, mode="lines", name=name)
