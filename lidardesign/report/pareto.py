"""Error against seconds of every sweep: a panel each, on logarithmic axes, and tables.

A line joins the settings that no other one beats in both, the Pareto front; the others are pale. The tolerance is a
dashed line, the run's own setting has a ring, the one to choose has another colour. A reference, whose error is 0,
is on the lower edge as a triangle, as are settings whose errors are too small to show.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lidardesign.evaluation.sweep import Measurement, Sweep
from lidardesign.report.figures import LAYOUT
from lidardesign.run.markup import rendered

# Axes span at least so many times their smallest value, and end so far beyond what they show.
LEAST_SPAN = 4.0
BEYOND = 1.5
# Ticks lie at 1, 2 and 5 where an axis spans less than this or has one power of ten at most, else at powers of ten.
FINE_TICKS_SPAN = 60.0
# Errors below this share of the largest, or of the tolerance, stand on the lower edge: nobody looks there.
SHOWN_SHARE = 1e-4
LINE, CHOSEN, TOLERANCE = "#0072B2", "#D55E00", "#555555"
PALE = 0.45
# Text on marks whose places along the axis differ by more than this share of it does not meet.
TEXT_SHARE = 0.45
# Of a panel; pixels of it above for its title, below for its axis, and per line of text.
PANEL_PX = 300
ABOVE_PX, BELOW_PX, LINE_PX = 34, 46, 11
BYTES_PER_MB = 1e6


@dataclass(frozen=True)
class Mark:
    """A measurement in a panel.

    Arguments:
        measurement: The measurement.
        x: Its seconds.
        y: Its error, or the panel's lower edge.
        low, high: Ends of its error bar, one standard error each way, within the panel.
        on_edge: Whether its error is too small to show.
        chosen: Whether it is the one to choose.
        beaten: Whether another measurement is both faster and more accurate.
    """

    measurement: Measurement
    x: float
    y: float
    low: float
    high: float
    on_edge: bool
    chosen: bool
    beaten: bool


@dataclass(frozen=True)
class Panel:
    """The panel of a sweep.

    Arguments:
        sweep: The sweep.
        marks: Its measurements, the roughest first.
        seconds, errors: Ends of both axes.
    """

    sweep: Sweep
    marks: tuple[Mark, ...]
    seconds: tuple[float, float]
    errors: tuple[float, float]

    @property
    def front(self) -> list[Mark]:
        """The marks of the Pareto front, the fastest first."""
        return sorted((mark for mark in self.marks if not mark.beaten), key=lambda mark: (mark.x, -mark.y))


def panels(sweeps: Sequence[Sweep]) -> list[Panel]:
    """One panel per sweep that has two measurements or more."""
    return [_panel(sweep) for sweep in sweeps if len(sweep.measurements) > 1]


def _panel(sweep: Sweep) -> Panel:
    seconds = [measurement.seconds for measurement in sweep.measurements if measurement.seconds > 0] or [1.0]
    places = [*(measurement.error for measurement in sweep.measurements), sweep.tolerance]
    known = [place for place in places if place > 0 and math.isfinite(place)]
    largest = max(known, default=1.0)
    low, high = _spanned(min((place for place in known if place >= SHOWN_SHARE * largest), default=1.0), largest)
    # room for what stands on the edge
    errors = (low / BEYOND, high)
    marks = tuple(_mark(measurement, min(seconds), errors, sweep) for measurement in sweep.measurements)
    return Panel(sweep, marks, _spanned(min(seconds), max(seconds)), errors)


def _spanned(low: float, high: float) -> tuple[float, float]:
    """Ends of a logarithmic axis around two values, at least `LEAST_SPAN` long."""
    factor = BEYOND * math.sqrt(max(LEAST_SPAN / (high / low), 1.0))
    return low / factor, high * factor


def _mark(measurement: Measurement, least_seconds: float, errors: tuple[float, float], sweep: Sweep) -> Mark:
    low, high = errors
    on_edge = measurement.error <= low
    # what has no finite error stands on the upper edge
    y = low if on_edge else measurement.error if math.isfinite(measurement.error) else high
    uncertainty = measurement.uncertainty if math.isfinite(measurement.uncertainty) else 0.0
    beaten = any(
        other.seconds <= measurement.seconds
        and other.error <= measurement.error
        and (other.seconds, other.error) != (measurement.seconds, measurement.error)
        for other in sweep.measurements
    )
    return Mark(
        measurement,
        x=max(measurement.seconds, least_seconds),
        y=y,
        low=min(max(y - uncertainty, low), y),
        high=max(min(y + uncertainty, high), y),
        on_edge=on_edge,
        chosen=measurement is sweep.chosen,
        beaten=beaten,
    )


def label_places(panel: Panel) -> list[tuple[float, float, str]]:
    """Places of the marks' labels: pixels to the right and upwards of the mark, and the aligned side of the text.

    To the right of the mark, to the left in the right third of the panel; moved up where texts would overlap.
    """
    height = PANEL_PX - ABOVE_PX - BELOW_PX
    across = [_share(mark.x, panel.seconds) for mark in panel.marks]
    wanted = [height * _share(mark.y, panel.errors) for mark in panel.marks]
    placed: dict[int, float] = {}
    # from the lower edge upwards, so that nothing is pushed below it
    for index in sorted(range(len(wanted)), key=lambda index: (wanted[index], across[index])):
        near = [up for other, up in placed.items() if abs(across[other] - across[index]) < TEXT_SHARE]
        up = max(wanted[index], LINE_PX * 0.6)
        placed[index] = max([up, *(other + LINE_PX for other in near if other + LINE_PX > up)])
    sides = [(-LINE_PX, "right") if share > 0.66 else (LINE_PX, "left") for share in across]
    return [(aside, placed[index] - wanted[index], side) for index, (aside, side) in enumerate(sides)]


def _share(value: float, ends: tuple[float, float]) -> float:
    low, high = ends
    return math.log(value / low) / math.log(high / low)


def pareto_figures(sweeps: Sequence[Sweep]) -> list[dict[str, Any]]:
    """One figure per sweep with two measurements or more; hovering shows a measurement's values."""
    return [_pareto_figure(panel) for panel in panels(sweeps)]


def _pareto_figure(panel: Panel) -> dict[str, Any]:
    line = {
        "type": "scatter",
        "x": [mark.x for mark in panel.front],
        "y": [mark.y for mark in panel.front],
        "mode": "lines",
        "line": {"color": LINE, "width": 1.5},
        "opacity": PALE,
        "hoverinfo": "skip",
    }
    layout = {
        **LAYOUT,
        "margin": {"l": 62, "r": 12, "t": ABOVE_PX, "b": BELOW_PX},
        "hovermode": "closest",
        "annotations": [_title(panel), *_settings(panel)],
        "xaxis": _pareto_axis(panel.seconds, "seconds"),
        "yaxis": _pareto_axis(panel.errors, html.escape(f"error [{panel.sweep.unit or 'share'}]")),
    }
    low, high = panel.errors
    tolerance = [_tolerance(panel)] if low <= panel.sweep.tolerance <= high else []
    return {"data": [*tolerance, line, _marks(panel)], "layout": layout}


def _marks(panel: Panel) -> dict[str, Any]:
    marks = panel.marks
    return {
        "type": "scatter",
        "x": [mark.x for mark in marks],
        "y": [mark.y for mark in marks],
        "mode": "markers",
        "cliponaxis": False,
        "marker": {
            "symbol": ["triangle-down" if mark.on_edge else "circle" for mark in marks],
            "size": [13 if mark.measurement.default else 9 for mark in marks],
            "color": [CHOSEN if mark.chosen else LINE for mark in marks],
            "opacity": [
                PALE if mark.beaten and not (mark.chosen or mark.measurement.default) else 1.0 for mark in marks
            ],
            "line": {"color": "#222222", "width": [2.5 if mark.measurement.default else 0 for mark in marks]},
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
        "customdata": [_hover_text(mark, panel.sweep) for mark in marks],
        "hovertemplate": "%{customdata}<extra></extra>",
    }


def _settings(panel: Panel) -> list[dict[str, Any]]:
    return [
        {
            "text": html.escape(mark.measurement.setting),
            "xref": "x",
            "yref": "y",
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
        for mark, (across, up, side) in zip(panel.marks, label_places(panel), strict=True)
    ]


def _hover_text(mark: Mark, sweep: Sweep) -> str:
    measurement = mark.measurement
    error = f"error {measurement.error:.3g} &#177; {measurement.uncertainty:.1g} {html.escape(sweep.unit)}"
    lines = [f"<b>{html.escape(measurement.setting)}</b>", "the reference" if measurement.reference else error]
    lines.append(f"{measurement.seconds:.3g} s")
    if measurement.memory_bytes is not None:
        lines.append(f"{measurement.memory_bytes / BYTES_PER_MB:.3g} MB")
    lines += ["the one to choose"] if mark.chosen else []
    lines += ["the run's own"] if measurement.default else []
    return "<br>".join(line.strip() for line in lines)


def _pareto_axis(ends: tuple[float, float], title: str) -> dict[str, Any]:
    low, high = ends
    powers = math.floor(math.log10(high)) - math.ceil(math.log10(low)) + 1
    return {
        "type": "log",
        "gridcolor": "#e4e7eb",
        "linecolor": "#9aa5b1",
        "ticks": "outside",
        "zeroline": False,
        "dtick": "D2" if high < FINE_TICKS_SPAN * low or powers < 2 else 1,
        "range": [math.log10(end) for end in ends],
        "tickformat": "~g",
        "tickfont": {"size": 10},
        "automargin": True,
        "title": {"text": title, "standoff": 4, "font": {"size": 11}},
    }


def _title(panel: Panel) -> dict[str, Any]:
    return {
        "text": f"<b>{html.escape(panel.sweep.knob)}</b>",
        "xref": "x domain",
        "yref": "y domain",
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
    return {
        "type": "scatter",
        "x": list(panel.seconds),
        "y": [panel.sweep.tolerance] * 2,
        "mode": "lines",
        "line": {"color": TOLERANCE, "width": 1.2, "dash": "dash"},
        "hoverinfo": "skip",
    }


def accuracy_section(sweeps: Sequence[Sweep]) -> str:
    """The pictures, and a table of each sweep with all its measurements, an explanation and its verdict."""
    return rendered("report/templates/accuracy.html", sweeps=sweeps, figures=pareto_figures(sweeps))
