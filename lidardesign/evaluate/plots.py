"""Curves of score against rays and against bandwidth, as PNG files.

Drawn on matplotlib's own figure and canvas objects: no global state, no display, and nothing is imported
before a plot is asked for.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.evaluate.curves import Against, Series, axis_titles, logarithmic, position, series
from lidardesign.evaluate.results import Evaluation
from lidardesign.run.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_INCHES = (8.0, 4.6)
DOTS_PER_INCH = 160
BAND_OPACITY = 0.15
LONGEST_LABEL = 28
FILES: dict[Against, str] = {"rays": "score_against_rays.png", "bandwidth": "score_against_bandwidth.png"}


def write_plots(evaluation: Evaluation, directory: Path) -> list[Path]:
    """Write both curves, and what accuracy costs where that was measured; returns the files.

    The folder is made where it is missing.
    """
    directory = Path(directory)
    written = [_write(evaluation, against, directory / name) for against, name in FILES.items()]
    if evaluation.accuracy is not None:
        # it draws with this module's looks
        from lidardesign.evaluate.pareto import write_pareto

        written += write_pareto(evaluation.accuracy.ladders, directory)
    return written


def curve_png(evaluation: Evaluation, against: Against) -> bytes:
    """One curve as PNG: a line and an interval band per design and baseline, the legend beside it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    curves = series(evaluation)
    for curve in curves:
        _draw(axes, curve, against)
    _dress(axes, evaluation, curves, against)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # a name in a script that the font lacks is drawn as boxes, which is no reason to fail
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _write(evaluation: Evaluation, against: Against, path: Path) -> Path:
    write_atomic(path, curve_png(evaluation, against))
    return path


def _draw(axes: Axes, curve: Series, against: Against) -> None:
    across = [position(row, against) for row in curve.rows]
    axes.fill_between(
        across,
        [row.ci_low for row in curve.rows],
        [row.ci_high for row in curve.rows],
        color=curve.colour,
        alpha=BAND_OPACITY,
        linewidth=0,
    )
    axes.plot(
        across,
        [row.value for row in curve.rows],
        color=curve.colour,
        marker=curve.marker,
        linestyle=curve.dash,
        linewidth=1.4 if curve.baseline else 2.0,
        markersize=5.5,
        label=plain_label(curve.name),
    )


def _dress(axes: Axes, evaluation: Evaluation, curves: list[Series], against: Against) -> None:
    across, up = axis_titles(evaluation, against)
    rows = [row for curve in curves for row in curve.rows]
    scenes = f"{evaluation.scenes} held-out scene{'s' if evaluation.scenes != 1 else ''}"
    axes.set_xlabel(across)
    axes.set_ylabel(plain_label(up, longest=80))
    axes.set_title(f"{scenes}, bands are 95 % bootstrap intervals", fontsize=9, loc="left", color="#444444")
    if logarithmic([position(row, against) for row in rows]):
        axes.set_xscale("log")
        label_ticks(axes.xaxis, sorted({row.rays for row in rows}) if against == "rays" else None)
    if logarithmic([row.value for row in rows]):
        axes.set_yscale("log")
        label_ticks(axes.yaxis, None)
    axes.grid(True, which="major", color="#dddddd", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.figure.legend(loc="outside right upper", frameon=False)


def label_ticks(axis: Any, at: list[int] | None) -> None:
    """Plain numbers instead of powers of ten; at the given places where there are any."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

    if at is not None:
        axis.set_major_locator(FixedLocator(at))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
        axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def plain_label(text: str, longest: int = LONGEST_LABEL) -> str:
    """Text that matplotlib draws as it is: no formulas, no hidden legend entries, not too long."""
    shortened = text if len(text) <= longest else f"{text[: longest - 1]}…"
    shown = shortened.replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown
