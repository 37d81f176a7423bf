"""Chosen rays in the report: certificates, the price curve of bandwidth, and the proxy compared with the score.

Rays are chosen by a proxy of the score, on training scenes. Its value on scenes held back from the choice is compared
with the score of the same rays on held-out scenes; where both order choices alike, the proxy is a good one.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidardesign.evaluation.results import Evaluation
from lidardesign.report.figures import AXIS, LAYOUT, Series
from lidardesign.run.markup import rendered
from lidardesign.sensors.design import DesignSpec

FEWEST_POINTS = 4  # of a rank correlation that says anything
LEFT_PX = 78  # small losses have long labels
Points = Sequence[tuple[float, float]]


def choice_section(designs: Sequence[DesignSpec], evaluation: Evaluation, looks: Mapping[str, Series]) -> str:
    """The section of certificates of all designs with chosen rays, with both figures; empty where there is none."""
    chosen = {design.name: found for design in designs if (found := design.certificates)}
    certificates = [(name, entry) for name, entries in chosen.items() for entry in entries]
    axis = f"loss [{', '.join(sorted({str(entry.get('unit', '1')) for _, entry in certificates}))}]"
    scores = {(row.design, row.rays): row for row in evaluation.rows}
    curves = {name: _curve(entries) for name, entries in chosen.items()}
    if max(map(len, curves.values()), default=0) < 2:
        curves = {}
    counts = sorted({entry["rays"] for _, entry in certificates if "curve" in entry})
    pairs = {name: _pair_with_scores(name, entries, scores) for name, entries in chosen.items()}
    metric = f"{evaluation.metric.name} [{evaluation.metric.unit}]"
    proxy = [pair for points in pairs.values() for pair in points]
    return rendered(
        "report/templates/choice.html",
        certificates=certificates,
        axis=axis,
        looks=[looks[name] for name in chosen],
        counts=counts,
        curves=_lines(curves, looks, ("Mbit/s", axis)),
        proxy=_lines(pairs, looks, (f"{axis}, on other scenes", metric)),
        choices=len(proxy),
        correlation=rank_correlation(proxy, evaluation),
    )


def rank_correlation(pairs: Points, evaluation: Evaluation) -> float | None:
    """The rank correlation of proxy and score over choices (Spearman); None for too few.

    Arguments:
        pairs: The proxy's loss and the score of each choice.
        evaluation: The evaluation of the scores.
    """
    losses, scores = np.array(pairs).reshape(-1, 2).T
    if len(pairs) < FEWEST_POINTS or np.ptp(losses) == 0 or np.ptp(scores) == 0:
        return None
    from scipy.stats import spearmanr

    return float(spearmanr(losses, evaluation.metric.sign * scores).statistic)


def _curve(entries: Sequence[Mapping[str, Any]]) -> Points:
    """The first undamaged price curve of the entries; empty without one."""
    for entry in entries:
        points = entry.get("curve")
        if isinstance(points, list) and all(isinstance(point, list) and _numbers(point) for point in points):
            return [(point[0], point[1]) for point in points]
    return []


def _numbers(point: Sequence[Any]) -> bool:
    return len(point) == 2 and all(isinstance(value, int | float) and math.isfinite(value) for value in point)


def _pair_with_scores(name: str, entries: Sequence[Mapping[str, Any]], scores: Mapping[tuple[str, int], Any]) -> Points:
    """The proxy on scenes held back from the choice, and the score of the same rays, at each number of rays."""
    pairs = [
        (entry["held_back_value"], scores[name, entry["rays"]].value)
        for entry in entries
        if (name, entry["rays"]) in scores
    ]
    return [pair for pair in pairs if _numbers(pair)]


def _lines(drawn: Mapping[str, Points], looks: Mapping[str, Series], titles: tuple[str, str]) -> dict[str, Any]:
    """A line with marks for each design."""
    across, up = ({**AXIS, "title": {"text": html.escape(title)}} for title in titles)
    traces = [
        {
            "type": "scatter",
            "x": [point[0] for point in points],
            "y": [point[1] for point in points],
            "mode": "lines+markers",
            "name": html.escape(name),
            "line": {"color": looks[name].colour, "dash": looks[name].dash, "width": 2},
            "marker": {"symbol": looks[name].marker, "size": 8, "color": looks[name].colour},
            "hovertemplate": "%{x:.4g}: %{y:.4g}<extra>%{fullData.name}</extra>",
        }
        for name, points in drawn.items()
        if points
    ]
    margin = {**LAYOUT["margin"], "l": LEFT_PX}
    layout = {**LAYOUT, "margin": margin, "xaxis": across, "yaxis": up, "hovermode": "closest"}
    return {"data": traces, "layout": layout}
