"""Designs and scores as plotly figures, for notebooks."""

from __future__ import annotations

import numpy as np
from plotly.graph_objects import Figure, Scatter3d

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import check_choice
from lidardesign.evaluate.figures.drawing import frustum_lines
from lidardesign.evaluate.report.figures import curve_figure
from lidardesign.evaluate.results import Evaluation
from lidardesign.geometry.rays import Rays

# More lines are no picture.
MOST_DRAWN_RAYS = 2000


def design_figure(design: DesignSpec, rays: Rays | None = None) -> Figure:
    """The sensors of a design with their fields of view and gates; rays are drawn inside their gates."""
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
    check_choice(against, "against", ("rays", "bandwidth"))
    return Figure(curve_figure(evaluation, against)).update_layout(showlegend=True)


def _add_lines(figure: Figure, points_m: np.ndarray, name: str) -> None:
    x, y, z = points_m.T
    figure.add_trace(Scatter3d(x=x, y=y, z=z, mode="lines", name=name))
