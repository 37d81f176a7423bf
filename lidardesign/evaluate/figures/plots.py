"""Everything that the report shows, as pictures for papers: each as PNG and as SVG, in one folder.

Nothing is imported before a picture is asked for, nothing needs a display, and the same figures give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lidardesign.evaluate.figures.canvas import picture_style, write_pictures
from lidardesign.evaluate.figures.density import field_picture, marginals_picture
from lidardesign.evaluate.figures.scene import scene_picture
from lidardesign.evaluate.figures.scene_figure import FigureData
from lidardesign.evaluate.figures.scores import (
    constraints_picture,
    curve_picture,
    differences_picture,
    effects_picture,
    times_picture,
)
from lidardesign.evaluate.results import Evaluation

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_plots(evaluation: Evaluation, directory: Path, pictured: FigureData | None = None) -> list[Path]:
    """Write all pictures that there is something to draw for; returns the files, in the order of the report.

    The folder is made where it is missing.
    """
    written: list[Path] = []
    with picture_style():
        for stem, draw in pictures(evaluation, pictured or FigureData()).items():
            figure = draw()
            if figure is not None:
                written += write_pictures(figure, Path(directory), stem)
    return written


def pictures(evaluation: Evaluation, pictured: FigureData) -> dict[str, Callable[[], Figure | None]]:
    """What draws each picture, by the stem of its files; None comes back where there is nothing to draw."""
    from lidardesign.evaluate.figures.pareto import pareto_picture

    shown, density = pictured.shown, pictured.density
    sweeps = evaluation.accuracy.sweeps if evaluation.accuracy is not None else ()
    return {
        "scene": lambda: scene_picture(shown) if shown is not None and shown.designs else None,
        "density_marginals": lambda: marginals_picture(density) if density is not None and density.marginals else None,
        "density_field": lambda: field_picture(density) if density is not None and density.planes else None,
        "score_against_rays": lambda: curve_picture(evaluation, "rays"),
        "score_against_bandwidth": lambda: curve_picture(evaluation, "bandwidth"),
        "paired_differences": lambda: differences_picture(evaluation) if evaluation.paired else None,
        "constraints": lambda: constraints_picture(pictured.slacks),
        "effects": lambda: effects_picture(evaluation.effects),
        "accuracy": lambda: pareto_picture(sweeps),
        "times": lambda: times_picture(pictured.times),
    }
