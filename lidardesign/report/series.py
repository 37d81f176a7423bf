"""Curves of scores: one series per design and baseline with its style, scales of axes, words of outcomes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from lidardesign.scenes.rays import Outcome
from lidardesign.scoring.evaluation.results import Evaluation, Row

Against = Literal["rays", "bandwidth"]

# The words of the report.
VERDICT_WORDS = {"better": "better", "worse": "worse", "open": "no significant difference"}
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


def axis_titles(evaluation: Evaluation, against: Against) -> tuple[str, str]:
    """Titles of the horizontal and the vertical axis, with their units."""
    metric = evaluation.metric
    up = f"{metric.name} [{metric.unit}], {metric.better} is better"
    return ("rays" if against == "rays" else "bandwidth [Mbit/s]"), up
