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
from lidardesign.report.markup import figure, folded, paragraphs, swatch
from lidardesign.report.tables import four_digits, table
from lidardesign.sensors.design import DesignSpec

FEWEST_POINTS = 4  # of a rank correlation that says anything
FIGURE_PX = 320
LEFT_PX = 78  # small losses have long labels
EXPLAINED = (
    "Loss is what the chosen rays leave unknown about training scenes, by what the task says returns tell: a proxy, "
    "not the score. No other choice of as many of these candidates, with the same gates and no more bandwidth, could "
    "lower the loss by more than the certificate says."
)
Points = Sequence[tuple[float, float]]


def choice_section(designs: Sequence[DesignSpec], evaluation: Evaluation, looks: Mapping[str, Series]) -> str:
    """The section of certificates of all designs with chosen rays, with both figures; empty where there is none."""
    chosen = {design.name: found for design in designs if (found := design.certificates)}
    if not chosen:
        return ""
    unit = ", ".join(sorted({str(entry.get("unit", "1")) for entries in chosen.values() for entry in entries}))
    axis = f"loss [{unit}]"
    scores = {(row.design, row.rays): row for row in evaluation.rows}
    curves = {name: _curve(entries) for name, entries in chosen.items()}
    if max(map(len, curves.values())) < 2:
        curves = {}
    counts = {entry["rays"] for entries in chosen.values() for entry in entries if "curve" in entry}
    rays = " or ".join(map(str, sorted(counts)))
    pairs = {name: _pair_with_scores(name, entries, scores) for name, entries in chosen.items()}
    metric = f"{evaluation.metric.name} [{evaluation.metric.unit}]"
    legend = "".join(
        f'<span class="switch">{swatch(looks[name].colour, looks[name].dash, looks[name].marker)}'
        f"<span>{html.escape(name)}</span></span>"
        for name in chosen
    )
    figures = "".join(
        figure(_lines(drawn, looks, titles), identifier, FIGURE_PX, caption)
        for drawn, identifier, titles, caption in (
            (
                curves,
                "choice-curve",
                ("Mbit/s", axis),
                f"What the choice of {rays} rays would lose in other bandwidths",
            ),
            (pairs, "choice-proxy", (f"{axis}, on other scenes", metric), "The score against the proxy"),
        )
        if any(drawn.values())
    )
    said = correlation_sentence([pair for points in pairs.values() for pair in points], evaluation)
    return (
        paragraphs([EXPLAINED])
        + _table(chosen, axis)
        + f'<div class="curves-shown">{legend}</div><div class="tiles wide">{figures}</div>'
        + paragraphs([said] if said else [])
    )


def correlation_sentence(pairs: Points, evaluation: Evaluation) -> str:
    """A sentence with the rank correlation of proxy and score over choices (Spearman); empty for too few.

    Arguments:
        pairs: The proxy's loss and the score of each choice.
        evaluation: The evaluation of the scores.
    """
    losses, scores = np.array(pairs).reshape(-1, 2).T
    if len(pairs) < FEWEST_POINTS or np.ptp(losses) == 0 or np.ptp(scores) == 0:
        return ""
    from scipy.stats import spearmanr

    correlation = float(spearmanr(losses, evaluation.metric.sign * scores).statistic)
    return (
        f"Proxy and score have a rank correlation (Spearman) of {correlation:.2f} over {len(pairs)} choices; 1 means "
        "that both rank them alike. More rays are better for both."
    )


def _table(chosen: Mapping[str, Sequence[Mapping[str, Any]]], axis: str) -> str:
    headings = ["design", "rays", axis, "on other scenes", "less by at most", "candidates", "gates", "scenes"]
    lines = []
    for name, entries in chosen.items():
        for index, entry in enumerate(entries):
            cells = [name, str(entry["rays"]), four_digits(entry["value"]), four_digits(entry["held_back_value"])]
            cells.append(f"{100 * entry['gap']:.1f} %")
            cells += [str(entry[column]) for column in ("candidates", "gates", "scenes")]
            lines.append((cells, "", bool(index == 0 and lines)))
    caption = "Rays chosen on training scenes, and how far they can be from the best choice."
    return folded("All certificates", table(headings, lines, text_columns=1, caption=caption), len(lines))


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
