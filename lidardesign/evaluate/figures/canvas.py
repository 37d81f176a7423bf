"""Pictures for papers: one size of paper, one look, curves, and files that come out the same every time.

Figures are drawn at the size at which they are printed, a column or a page wide, so that letters are as large on paper
as stated here. Each is written as PNG and as SVG. In the SVG, letters are text (any script that the reader's fonts
have, to be searched and edited); what would take very many lines is an embedded image.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lidardesign.evaluate.results import Evaluation, Row
from lidardesign.geometry.rays import Outcome
from lidardesign.run.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLUMN_INCHES, PAGE_INCHES = 3.5, 7.1
DOTS_PER_INCH = 300
LETTERS_POINTS, SMALL_POINTS = 8.0, 7.0
INK, SOFT, GRID = "#1f2933", "#52606d", "#dde1e6"
BAND_OPACITY = 0.15
KINDS = ("png", "svg")
# What is drawn does not hang on the user's own settings of matplotlib, nor on the day.
LOOK: dict[str, Any] = {
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "Helvetica"],
    "font.size": LETTERS_POINTS,
    "axes.labelsize": LETTERS_POINTS,
    "axes.titlesize": LETTERS_POINTS,
    "xtick.labelsize": SMALL_POINTS,
    "ytick.labelsize": SMALL_POINTS,
    "legend.fontsize": SMALL_POINTS,
    "axes.linewidth": 0.7,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.minor.width": 0.5,
    "ytick.minor.width": 0.5,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.parse_math": False,
    "axes.unicode_minus": True,
    "svg.fonttype": "none",
    "svg.hashsalt": "lidardesign",
    "savefig.dpi": DOTS_PER_INCH,
}


@contextmanager
def picture_style() -> Iterator[None]:
    """Draw in the look of all pictures; the settings before are there again afterwards."""
    from matplotlib import style

    with style.context(["default", LOOK]), warnings.catch_warnings():
        # a name in a script that the font lacks is drawn as boxes in the PNG, which is no reason to fail
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        warnings.filterwarnings("ignore", message="Matplotlib currently does not support .* natively")
        yield


def new_figure(width_inches: float, height_inches: float) -> Figure:
    """An empty figure on a canvas of its own: no display, no global state. Call inside `looks`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), dpi=DOTS_PER_INCH, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def picture(figure: Figure, kind: str) -> bytes:
    """A figure as the bytes of a PNG or SVG file, always the same. Call inside `looks`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata={"Software": None} if kind == "png" else {"Date": None})
    return buffer.getvalue()


def write_pictures(figure: Figure, directory: Path, stem: str) -> list[Path]:
    """Write a figure in all kinds into a folder, which is made where it is missing. Call inside `looks`."""
    paths = [Path(directory) / f"{stem}.{kind}" for kind in KINDS]
    for path, kind in zip(paths, KINDS, strict=True):
        write_atomic(path, picture(figure, kind))
        # laid out once: both kinds are the same picture
        figure.set_layout_engine("none")
    return paths


def plain_axes(axes: Axes, *, grid: str | None = "both") -> None:
    """No box, and a pale grid behind what is drawn."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)
    if grid is not None:
        axes.grid(True, axis=grid, which="major", color=GRID, linewidth=0.6)


def add_legend(figure: Figure, looks: Sequence[tuple[str, Mapping[str, Any]]], columns: int, **further: Any) -> None:
    """A legend below all panels: names with the looks of their lines or marks."""
    from matplotlib.lines import Line2D

    names, handles = [name for name, _ in looks], [Line2D([], [], **look) for _, look in looks]
    figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False, **further)


def label_ticks(axis: Any, at: Sequence[float] | None = None, *, fine: bool = False) -> None:
    """Plain numbers at powers of ten; at the given places where there are any, at 1, 2 and 5 where `fine`."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

    if at is not None:
        axis.set_major_locator(FixedLocator(at))
        axis.set_minor_locator(NullLocator())
    elif fine:
        axis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def plain_label(text: str, longest: int = 28) -> str:
    """Text that can be drawn as it is: one line, no control characters, no hidden legend entries, not too long."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text)
    shown = shown if len(shown) <= longest else f"{shown[: longest - 1]}…"
    return f" {shown}" if shown.startswith("_") else shown


Against = Literal["rays", "bandwidth"]

# The words of the report and of the pictures beside it.
VERDICT_WORDS = {"better": "better", "worse": "worse", "open": "no difference found"}
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
MARKERS = ("o", "s", "^", "D", "v", "P")
BASELINE_MARKERS = ("x", "+", "*", "1", "d")
DASHES = ("solid", "dashed", "dashdot", "dotted")
# Labels of a logarithmic axis: at these times every power of ten, the few where the values span more than the factor.
FEW_MANTISSAS, MANY_MANTISSAS, WIDE_FACTOR = (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0), 30.0
TICK_MARGIN = 1.2
MANY_DECADES = 4.0  # a range of values wider than this factor is easier to read on a logarithmic axis


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
    """Where a row stands on the horizontal axis: rays per frame or position, or Mbit/s."""
    return float(row.rays) if against == "rays" else row.bandwidth_mbps


def logarithmic(values: Sequence[float]) -> bool:
    """Whether values span so much that a logarithmic axis shows them better."""
    positive = [value for value in values if value > 0]
    return len(positive) == len(values) > 1 and max(positive) > MANY_DECADES * min(positive)


def log_ticks(values: Sequence[float]) -> list[float]:
    """Round places to label on a logarithmic axis that holds some values: more to a decade where it has few of them."""
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
