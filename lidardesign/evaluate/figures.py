"""The report's interactive figures, as plain plotly documents: curves, and scene, sensors and rays in 3D.

plotly stores float32 and int32 arrays as base64, which keeps the page small. It also reads a little HTML in
names, so every name is escaped here.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidardesign.design.sensor import Design, Sensor
from lidardesign.evaluate.curves import Against, Series, axis_titles, logarithmic, position, series
from lidardesign.evaluate.drawing import (
    body_triangles,
    drawn_share,
    frustum_lines,
    gate_shell,
    origin_lines,
    ray_segments,
    scene_bounds,
)
from lidardesign.evaluate.results import Evaluation
from lidardesign.numerics import EPSILON_FLOAT32
from lidardesign.scene import Scene
from lidardesign.simulate.returns import Outcome, Rays

MOST_RAYS = 2000  # drawn per design
MANY_RAYS, FAINT = 300, 0.22  # more rays that hit nothing would hide everything else
MOST_SENSORS = 40  # drawn as frusta; a scan has hundreds, and its rays say it all
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
OUTCOME_COLOURS = {
    Outcome.RETURN: "#009E73",
    Outcome.OCCLUDED: "#D55E00",
    Outcome.AFTER_GATE: "#0072B2",
    Outcome.MISS: "#9aa5b1",
    Outcome.NOT_DETECTED: "#CC79A7",
}
SENSOR_COLOUR = "#3b3f8f"
LIGHT_DISTANCE = 1e4  # far away, so that light is parallel


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
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0},
        "hovermode": "closest",
    }
    return {"data": [trace for curve in curves for trace in _curve_traces(curve, against)], "layout": layout}


def scene_figure(
    scene: Scene, designs: Sequence[Design], rays_by_design: Mapping[str, Rays], frame: int = 0
) -> tuple[dict[str, Any], dict[str, list[bool]]]:
    """Scene, sensors with their gates, rays by outcome; and by name which traces show each design."""
    shown = [design for design in designs if design.name in rays_by_design]
    rays = {design.name: _thinned(rays_by_design[design.name]) for design in shown}
    drawn = list(rays.values())
    eye = _camera(_directions(drawn))["eye"]
    traces = _body_traces(scene, frame, scene_bounds(scene, frame, drawn), eye)
    owners: list[str | None] = [None] * len(traces)
    for design in shown:
        own = [*_sensor_traces(design), *_ray_traces(scene, rays[design.name], frame)]
        traces += own
        owners += [design.name] * len(own)
    masks = {design.name: [owner in (None, design.name) for owner in owners] for design in shown}
    if shown:
        for trace, visible in zip(traces, masks[shown[0].name], strict=True):
            trace["visible"] = visible
    return {"data": traces, "layout": _scene_layout(drawn)}, masks


def _scale(values: Sequence[float]) -> dict[str, Any]:
    return {"type": "log", "dtick": "D2"} if logarithmic(values) else {"type": "linear"}


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


def _mesh_trace(vertices: np.ndarray, faces: np.ndarray, **looks: Any) -> dict[str, Any]:
    x, y, z = (np.ascontiguousarray(column) for column in vertices.T)
    i, j, k = (np.ascontiguousarray(column) for column in faces.T)
    return {"type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, **looks}


def _line_trace(points: np.ndarray, **looks: Any) -> dict[str, Any]:
    x, y, z = (np.ascontiguousarray(column) for column in points.T)
    return {"type": "scatter3d", "mode": "lines", "x": x, "y": y, "z": z, "hoverinfo": "skip", **looks}


def _body_traces(
    scene: Scene, frame: int, bounds_m: np.ndarray, eye: Mapping[str, float]
) -> list[dict[str, Any]]:
    """All targets in one trace and all mere occluders in another, lit from where the camera starts."""
    share = drawn_share(scene)
    light = {axis: LIGHT_DISTANCE * value for axis, value in eye.items()}
    looks = {
        True: {"name": "scene", "color": "#c9b8a8"},
        False: {"name": "occluders", "color": "#6b7280"},
    }
    traces = []
    for target, look in looks.items():
        bodies = [body for body in scene.bodies if body.is_target == target]
        pieces = [body_triangles(body, frame, bounds_m, share) for body in bodies]
        if pieces:
            offsets = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
            vertices = np.concatenate([vertices for vertices, _ in pieces])
            faces = np.concatenate(
                [faces + start for (_, faces), start in zip(pieces, offsets, strict=False)]
            )
            lighting = {"ambient": 0.55, "diffuse": 0.7, "specular": 0.05, "roughness": 0.9}
            traces.append(
                _mesh_trace(
                    vertices,
                    faces.astype(np.int32),
                    **look,
                    lighting=lighting,
                    lightposition=light,
                    showlegend=True,
                    hoverinfo="name",
                )
            )
    return traces


def _sensor_traces(design: Design) -> list[dict[str, Any]]:
    sensors: Sequence[Sensor] = design.sensors if len(design.sensors) <= MOST_SENSORS else ()
    if not sensors:
        return []
    pieces = [piece for sensor in sensors for piece in (frustum_lines(sensor), origin_lines(sensor, design.level))]
    lines = np.concatenate(pieces)
    traces = [
        _line_trace(
            lines, name="fields of view", line={"color": SENSOR_COLOUR, "width": 3}, legendgroup="sensors"
        )
    ]
    for sensor in sensors:
        vertices, faces = gate_shell(sensor)
        start, end = sensor.gate_m
        name = f"{html.escape(sensor.name)}: gate {start:.3f} to {end:.3f} m"
        traces.append(
            _mesh_trace(
                vertices,
                faces,
                name=name,
                color=SENSOR_COLOUR,
                opacity=0.18,
                hoverinfo="name",
                legendgroup="sensors",
                hoverlabel={"namelength": -1},
            )
        )
    return traces


def _ray_traces(scene: Scene, rays: Rays, frame: int) -> list[dict[str, Any]]:
    traces = []
    for outcome, lines in ray_segments(scene, rays, frame).items():
        if not len(lines):
            continue
        colour, label = OUTCOME_COLOURS[outcome], outcome.name.lower().replace("_", " ")
        name = f"{label} ({len(lines) // 3})"
        look = {"color": colour, "width": 1.5}
        opacity = FAINT if outcome == Outcome.MISS and len(lines) // 3 > MANY_RAYS else 0.55
        traces.append(_line_trace(lines, name=name, line=look, opacity=opacity, legendgroup=label))
        if outcome == Outcome.RETURN:
            ends = _line_trace(lines[1::3], name="returns", legendgroup=label, showlegend=False)
            traces.append({**ends, "mode": "markers", "marker": {"color": colour, "size": 3}})
    return traces


def _thinned(rays: Rays) -> Rays:
    """Every n-th ray where there are more than can be drawn."""
    return (
        rays if len(rays) <= MOST_RAYS else rays.subset(np.linspace(0, len(rays) - 1, MOST_RAYS).astype(int))
    )


def _scene_layout(rays: Sequence[Rays]) -> dict[str, Any]:
    axis = {"backgroundcolor": "#f7f8fa", "gridcolor": "#dfe3e8", "showbackground": True, "zeroline": False}
    axes = {f"{name}axis": {**axis, "title": {"text": f"{name} [m]"}} for name in "xyz"}
    camera = _camera(_directions(rays))
    if camera["up"]["z"] == 0:
        axes["zaxis"]["visible"] = False
    return {
        "font": {**FONT, "size": 12},
        "paper_bgcolor": "#ffffff",
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "scene": {"aspectmode": "data", "camera": camera, **axes},
        "legend": {"orientation": "h", "yanchor": "top", "y": 0.0, "x": 0, "itemsizing": "constant"},
    }


def _directions(rays: Sequence[Rays]) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3)), *(ray.direction for ray in rays)])


def _camera(directions: np.ndarray) -> dict[str, Any]:
    """From behind and above the sensors; a world in the plane z = 0 is looked at from above, as on paper."""
    if len(directions) and np.abs(directions[:, 2]).max() < EPSILON_FLOAT32:
        up, kind = {"x": 0, "y": 1, "z": 0}, {"type": "orthographic"}
        return {"eye": {"x": 0, "y": 0, "z": 1.9}, "up": up, "projection": kind}
    return {"eye": _side_view(directions), "up": {"x": 0, "y": 0, "z": 1}}


def _side_view(directions: np.ndarray) -> dict[str, float]:
    """A camera beside the mean direction of the rays, a little behind the sensors and above them."""
    mean = directions.mean(axis=0) if len(directions) else np.array([1.0, 0.0, 0.0])
    forward = np.array([mean[0], mean[1], 0.0])
    length = np.linalg.norm(forward)
    forward = forward / length if length > EPSILON_FLOAT32 else np.array([1.0, 0.0, 0.0])
    eye = 1.25 * np.array([-forward[1], forward[0], 0.0]) - 1.0 * forward + np.array([0.0, 0.0, 0.7])
    return {name: float(value) for name, value in zip("xyz", eye, strict=True)}
