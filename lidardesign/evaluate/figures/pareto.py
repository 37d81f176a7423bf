"""Error against seconds, one panel per sweep, on logarithmic axes: what the pictures have in common, and the picture.

A line joins the settings that no other one beats in both; those that are beaten are pale. The tolerance is a dashed
line, the run's own setting has a ring, the one to choose has another colour. A reference, whose error is nothing,
stands on the lower edge as a triangle, as do settings whose errors are too small to show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidardesign.evaluate.accuracy.settings import Measurement, Sweep
from lidardesign.evaluate.figures.canvas import (
    LETTERS_POINTS,
    PAGE_INCHES,
    SMALL_POINTS,
    add_legend,
    label_ticks,
    new_figure,
    plain_label,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 3
PANEL_INCHES = (PAGE_INCHES / COLUMNS, 2.2)
# Axes span at least so many times their smallest value, and end so far beyond what they show.
LEAST_SPAN = 4.0
BEYOND = 1.5
# Ticks lie at 1, 2 and 5 where an axis spans less than this or has one power of ten at most, else at powers of ten.
FINE_TICKS_SPAN = 60.0
# Errors below this share of the largest, or of the tolerance, stand on the lower edge: nobody looks there.
SHOWN_SHARE = 1e-4
LINE, CHOSEN, TOLERANCE = "#0072B2", "#D55E00", "#555555"
PALE = 0.45
# Points per inch, and a line of the settings' text [points].
POINTS, LINE_POINTS = 72.0, 8.0
# Text on marks whose places along the axis differ by more than this share of it does not meet.
TEXT_SHARE = 0.45
LEGEND = (
    ("the one to choose", {"color": CHOSEN, "markersize": 4.5, "linestyle": "none", "marker": "o"}),
    (
        "the run's own",
        {"color": "none", "markeredgecolor": "#222222", "markersize": 8.5, "linestyle": "none", "marker": "o"},
    ),
    ("reference, or next to no error", {"color": LINE, "linestyle": "none", "marker": "v", "markersize": 4.5}),
    ("tolerance", {"color": TOLERANCE, "linestyle": "dashed", "linewidth": 1.0}),
)
# Of a panel's height, what its title and axis take.
MARGIN_INCHES = 0.75


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
    """A sweep as it is drawn.

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
    def shows_tolerance(self) -> bool:
        """Whether the tolerance has a place on the axis."""
        return self.errors[0] <= self.sweep.tolerance <= self.errors[1]

    @property
    def front(self) -> list[Mark]:
        """The marks that no other one beats, the fastest first."""
        return sorted((mark for mark in self.marks if not mark.beaten), key=lambda mark: (mark.x, -mark.y))

    @property
    def error_title(self) -> str:
        """The vertical axis: what the error is, with its unit."""
        return f"error [{self.sweep.unit}]" if self.sweep.unit else "error [share]"


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
    """Ends of a logarithmic axis that holds both values and is not too short."""
    factor = BEYOND * math.sqrt(max(LEAST_SPAN / (high / low), 1.0))
    return low / factor, high * factor


def has_fine_ticks(ends: tuple[float, float]) -> bool:
    """Whether an axis between these ends needs ticks between the powers of ten."""
    low, high = ends
    powers = math.floor(math.log10(high)) - math.ceil(math.log10(low)) + 1
    return high < FINE_TICKS_SPAN * low or powers < 2


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


def pareto_picture(sweeps: Sequence[Sweep]) -> Figure | None:
    """All panels, a page wide; None where there is nothing to draw."""
    shown = panels(sweeps)
    if not shown:
        return None
    columns = min(COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure = new_figure(columns * PANEL_INCHES[0], rows * PANEL_INCHES[1] + 0.5)
    for number, panel in enumerate(shown):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.set(xscale="log", yscale="log", xlim=panel.seconds, ylim=panel.errors)
        # on axes of one or two powers of ten there would be names at all ticks, which do not fit
        label_ticks(axes.xaxis, fine=has_fine_ticks(panel.seconds))
        label_ticks(axes.yaxis, fine=has_fine_ticks(panel.errors))
        axes.set_title(plain_label(panel.sweep.knob, 48), fontsize=LETTERS_POINTS, loc="left", color="#222222")
        axes.set(xlabel="seconds", ylabel=plain_label(panel.error_title, 40))
        axes.tick_params(labelsize=SMALL_POINTS)
        axes.set_axisbelow(True)
        axes.grid(True, which="major", color="#e2e2e2", linewidth=0.7, zorder=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        if panel.shows_tolerance:
            axes.axhline(panel.sweep.tolerance, color=TOLERANCE, linestyle="dashed", linewidth=1.1, zorder=1.5)
        fastest_first = ([mark.x for mark in panel.front], [mark.y for mark in panel.front])
        axes.plot(*fastest_first, color=LINE, alpha=PALE, linewidth=1.3, zorder=2)
        for mark in panel.marks:
            colour, alpha = (CHOSEN, 1.0) if mark.chosen else (LINE, PALE if mark.beaten else 1.0)
            if mark.high > mark.y or mark.low < mark.y:
                axes.plot([mark.x, mark.x], [mark.low, mark.high], color=colour, linewidth=1.0, alpha=alpha, zorder=3)
            look = {"linestyle": "none", "clip_on": False, "zorder": 4}
            filled = {"marker": "v" if mark.on_edge else "o", "markersize": 4.5, "markeredgewidth": 0, **look}
            axes.plot(mark.x, mark.y, color=colour, alpha=alpha, **filled)
            if mark.measurement.default:
                axes.plot(mark.x, mark.y, marker="o", markersize=8.5, color="none", markeredgecolor="#222222", **look)
        places = label_places(panel, POINTS * (PANEL_INCHES[1] - MARGIN_INCHES), LINE_POINTS)
        for mark, (across, up, side) in zip(panel.marks, places, strict=True):
            axes.annotate(
                plain_label(mark.measurement.setting, 22),
                (mark.x, mark.y),
                xytext=(across, up),
                textcoords="offset points",
                ha=side,
                va="center",
                fontsize=SMALL_POINTS,
                color=CHOSEN if mark.chosen else "#333333",
                # lines behind the text would strike it through
                bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.6},
                zorder=3.5,
            )
    add_legend(figure, LEGEND, 4 if columns > 1 else 2)
    return figure


def label_places(panel: Panel, height: float, line: float) -> list[tuple[float, float, str]]:
    """Where each mark's setting is written: offsets to the right and upwards, and the side of the text that is aligned.

    To the right of its mark, to the left in the right third of the panel; moved up where texts would meet.

    Arguments:
        panel: The panel.
        height, line: Of the panel and of a line of text, in one unit, which the offsets have too.
    """
    across = [_share(mark.x, panel.seconds) for mark in panel.marks]
    wanted = [height * _share(mark.y, panel.errors) for mark in panel.marks]
    placed: dict[int, float] = {}
    # from the lower edge upwards, so that nothing is pushed below it
    for index in sorted(range(len(wanted)), key=lambda index: (wanted[index], across[index])):
        near = [up for other, up in placed.items() if abs(across[other] - across[index]) < TEXT_SHARE]
        up = max(wanted[index], line * 0.6)
        placed[index] = max([up, *(other + line for other in near if other + line > up)])
    sides = [(-line, "right") if share > 0.66 else (line, "left") for share in across]
    return [(aside, placed[index] - wanted[index], side) for index, (aside, side) in enumerate(sides)]


def _share(value: float, ends: tuple[float, float]) -> float:
    low, high = ends
    return math.log(value / low) / math.log(high / low)
