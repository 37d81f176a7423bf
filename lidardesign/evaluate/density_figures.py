"""The learned density as plain plotly documents: marginals beside those of designs, and the field it observes."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidardesign.evaluate.curves import Series
from lidardesign.evaluate.density_views import Marginal, PlaneDensity
from lidardesign.evaluate.figures import DASH_NAMES, FONT
from lidardesign.evaluate.scene_view import encoded

# One hue from light to dark: it reads the same without colour vision and on paper.
SCALE = [[0.0, "#ffffff"], [0.2, "#d6e6f4"], [0.45, "#6baed6"], [0.7, "#2171b5"], [1.0, "#08306b"]]
FILL, INK, QUIET = "#b8c1cb", "#1f2933", "#7b8794"
MOST_DESIGNS = 6  # drawn beside a marginal
AXIS = {"gridcolor": "#e4e7eb", "zeroline": False, "linecolor": "#9aa5b1", "ticks": "outside", "tickformat": "~g"}


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
            "line": {"color": looks[name].colour, "width": 2, "dash": DASH_NAMES[looks[name].dash]},
            "name": html.escape(name),
            "hovertemplate": "%{y:.3g}<extra>%{fullData.name}</extra>",
        }
        for name, heights in list(marginal.designs.items())[:MOST_DESIGNS]
        if name in looks
    ]
    layout = {
        **_looks(),
        "xaxis": {**AXIS, "title": {"text": marginal.label}, "range": [marginal.edges[0], marginal.edges[-1]]},
        "yaxis": {**AXIS, "title": {"text": marginal.unit}, "range": [0, marginal.top]},
        "hovermode": "closest",
    }
    return {"data": [density, *lines], "layout": layout}


def plane_figure(plane: PlaneDensity) -> dict[str, Any]:
    """The field of a plane as shades, and the outlines of what stands in it."""
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
        _outline(across, up, covered, dash)
        for covered, dash in ((plane.targets, "solid"), (plane.others, "dot"))
        if covered.any() and not covered.all()
    ]
    layout = {
        **_looks(),
        "xaxis": {**AXIS, "title": {"text": plane.labels[0]}, "constrain": "domain", "showgrid": False},
        "yaxis": {**AXIS, "title": {"text": plane.labels[1]}, "constrain": "domain", "showgrid": False},
    }
    layout["yaxis"]["scaleanchor"] = "x"
    return {"data": [heat, *outlines], "layout": layout}


def _outline(across: np.ndarray, up: np.ndarray, covered: np.ndarray, dash: str) -> dict[str, Any]:
    return {
        "type": "contour",
        "x": across.tolist(),
        "y": up.tolist(),
        "z": _array(covered),
        "contours": {"start": 0.5, "end": 0.5, "size": 1, "coloring": "none"},
        "line": {"color": INK, "width": 1.2, "dash": dash},
        "showscale": False,
        "hoverinfo": "skip",
    }


def _array(values: np.ndarray) -> dict[str, str]:
    """A matrix as plotly's own short form."""
    rows, columns = values.shape
    return {"dtype": "f4", "bdata": encoded(values, "<f4"), "shape": f"{rows}, {columns}"}


def _steps(edges: np.ndarray, heights: np.ndarray) -> dict[str, Any]:
    """A histogram's outline."""
    return {
        "type": "scatter",
        "mode": "lines",
        "x": np.repeat(edges, 2).tolist(),
        "y": [0.0, *np.repeat(heights, 2).tolist(), 0.0],
    }


def _looks() -> dict[str, Any]:
    return {
        "font": {**FONT, "size": 12},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 58, "r": 12, "t": 10, "b": 46},
        "showlegend": False,
    }
