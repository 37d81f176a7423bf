"""Pictures of the learned density: its marginals beside those of designs, and where in space it looks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.evaluate.figures.canvas import (
    COLOURS,
    DASHES,
    INK,
    PAGE_INCHES,
    SMALL_POINTS,
    SOFT,
    new_figure,
    plain_axes,
    plain_label,
)
from lidardesign.evaluate.figures.density_views import DensityView, Marginal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 3
DENSITY_NAME = "learned density"
PANEL_INCHES, LEGEND_INCHES, LINE_INCHES = 1.75, 0.15, 0.15
LEGEND_LETTERS = 64  # of all names, that fit beside each other
DENSITY, EDGE = "#cfd6de", "#8593a3"
# More designs than these are told apart no longer.
MOST_DESIGNS = 6
LEAST_INCHES, MOST_INCHES = 1.3, 4.2
LEFT_INCHES, RIGHT_INCHES, BELOW_INCHES, HEAD_INCHES = 0.6, 0.75, 0.45, 0.25
TARGET, OTHER = "#d9d4cf", "#aab2bd"
# From pale to dark, so that grey print keeps the order; the least of it is left clear.
FIELD_COLOURS = ("#fde9b8", "#f6b04a", "#d95f30", "#93265f", "#2b0f54")
MOST_SHARE = 0.998  # of the cells that hold anything, up to the darkest colour


def marginals_picture(view: DensityView) -> Figure:
    """One panel per dimension, a page wide: the density as an area, designs as steps."""
    shown = view.marginals
    columns = min(COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    names = [DENSITY_NAME, *(plain_label(name) for name in list(shown[0].designs)[:MOST_DESIGNS])]
    beside = len(names) if sum(map(len, names)) < LEGEND_LETTERS else COLUMNS
    lines = math.ceil(len(names) / beside)
    figure = new_figure(PAGE_INCHES, rows * PANEL_INCHES + LEGEND_INCHES + lines * LINE_INCHES)
    for number, marginal in enumerate(shown):
        _draw_marginal(figure.add_subplot(rows, columns, number + 1), marginal)
    handles, _ = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=beside, frameon=False, handlelength=2.4)
    left_out = len(shown[0].designs) - MOST_DESIGNS
    if left_out > 0:
        figure.suptitle(
            f"the first {MOST_DESIGNS} designs; {left_out} more are not drawn", fontsize=SMALL_POINTS, color=SOFT
        )
    return figure


def _draw_marginal(axes: Axes, marginal: Marginal) -> None:
    axes.stairs(marginal.heights, marginal.edges, fill=True, color=DENSITY, label=DENSITY_NAME)
    axes.stairs(marginal.heights, marginal.edges, color=EDGE, linewidth=0.6, baseline=None)
    for number, (name, heights) in enumerate(list(marginal.designs.items())[:MOST_DESIGNS]):
        axes.stairs(
            heights,
            marginal.edges,
            color=COLOURS[number % len(COLOURS)],
            linestyle=DASHES[number % len(DASHES)],
            linewidth=1.1,
            baseline=None,
            label=plain_label(name),
        )
    axes.set(xlim=(marginal.edges[0], marginal.edges[-1]), ylim=(0.0, marginal.top))
    axes.set(xlabel=marginal.label, ylabel=marginal.unit)
    plain_axes(axes, grid=None)


def field_picture(view: DensityView) -> Figure:
    """Where in space the density looks, over what the scene covers, a page wide; one panel per plane."""
    from matplotlib.colors import LinearSegmentedColormap, to_rgb

    # width over height
    places, height = panel_places([float(np.ptp(plane.edges[0]) / np.ptp(plane.edges[1])) for plane in view.planes])
    figure = new_figure(PAGE_INCHES, height)
    # panels keep their shape: where they are is known, and nothing is left to lay out
    figure.set_layout_engine("none")
    for plane, (left, bottom, width, tall) in zip(view.planes, places, strict=True):
        axes = figure.add_axes((left / PAGE_INCHES, bottom / height, width / PAGE_INCHES, tall / height))
        across, up = plane.edges
        extent = (across[0], across[-1], up[0], up[-1])
        # cells coloured by what covers them
        colours = np.ones((*plane.targets.shape, 3))
        colours[plane.others] = to_rgb(OTHER)
        colours[plane.targets] = to_rgb(TARGET)
        image = {"extent": extent, "origin": "lower", "interpolation": "nearest"}
        axes.imshow(colours, **image)
        # the colours end before a few cells that, where a heavy sample lies, would leave all others pale
        held = plane.heights[plane.heights > 0]
        most = float(np.quantile(held, MOST_SHARE)) if len(held) else 1.0
        shown = np.ma.masked_less(plane.heights, 0.02 * most)
        colour_map = LinearSegmentedColormap.from_list("field", FIELD_COLOURS)
        drawn = axes.imshow(shown, **image, cmap=colour_map, vmin=0.0, vmax=most)
        axes.set_aspect("equal")
        axes.set(xlabel=plane.labels[0], ylabel=plane.labels[1])
        for mask, colour in ((plane.others, SOFT), (plane.targets, INK)):
            if mask.any() and not mask.all():
                axes.contour(mask, (0.5,), extent=extent, colors=[colour], linewidths=0.5, alpha=0.7)
        # the colours beside the panel, as high as it is
        thin = 0.1 / width
        place = axes.inset_axes((1.0 + 0.8 * thin, 0.0, thin, 1.0))
        bar = figure.colorbar(drawn, extend="max" if plane.heights.max() > most else "neither", cax=place)
        bar.set_label(plane.unit.replace("2", "²"))
        bar.outline.set_visible(False)
        axes.spines[["top", "right"]].set_visible(False)
    title = f"what the density observes, over {plain_label(view.scene)} (outlined: its bodies)"
    figure.text(0.5, 1 - 0.5 * HEAD_INCHES / height, title, fontsize=SMALL_POINTS, color=SOFT, ha="center", va="center")
    return figure


def panel_places(ratios: list[float]) -> tuple[list[tuple[float, float, float, float]], float]:
    """Where panels of given width over height lie on a page: left, bottom, width and height, and the page's [inches].

    Beside each other where they are high enough then, else below each other.
    """
    beside = (PAGE_INCHES - len(ratios) * (LEFT_INCHES + RIGHT_INCHES)) / sum(ratios)
    if beside >= LEAST_INCHES or len(ratios) == 1:
        tall = min(beside, MOST_INCHES)
        widths = [ratio * tall for ratio in ratios]
        spare = PAGE_INCHES - sum(widths) - len(ratios) * (LEFT_INCHES + RIGHT_INCHES)
        steps = np.cumsum([0.0, *(width + LEFT_INCHES + RIGHT_INCHES for width in widths[:-1])])
        lefts = [float(step) + spare / 2 + LEFT_INCHES for step in steps]
        places = [(left, BELOW_INCHES, width, tall) for left, width in zip(lefts, widths, strict=True)]
        return places, tall + BELOW_INCHES + HEAD_INCHES
    usable = PAGE_INCHES - LEFT_INCHES - RIGHT_INCHES
    sizes = [(min(usable, ratio * MOST_INCHES), min(usable / ratio, MOST_INCHES)) for ratio in ratios]
    height = HEAD_INCHES + sum(tall + BELOW_INCHES for _, tall in sizes)
    top, places = height - HEAD_INCHES, []
    for width, tall in sizes:
        places.append((LEFT_INCHES + (usable - width) / 2, top - tall, width, tall))
        top -= tall + BELOW_INCHES
    return places, height
