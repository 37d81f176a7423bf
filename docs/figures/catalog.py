"""Draws docs/catalog.png: real parts in the design space, and what fitted designs ask for beside them.

    python docs/figures/catalog.py
    python docs/figures/catalog.py --design "a face=RUN/designs/NAME.yaml" --design ...

Everything shown is computed from the part files of the catalogue and from design files. Designs stand above the parts:
each sensor has a bar of its own for its gate, and a design's field of view is that of its sensors.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from drawing import INK, QUIET, save
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lidardesign.formats.designs import load_design
from lidardesign.parts.catalogue import load_library
from lidardesign.parts.part import Part
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import angles

COLOURS = {
    "single zone": "#8c564b", "multi-zone": "#D55E00", "flash": "#CC79A7", "line scanner": "#E69F00",
    "spinning": "#0072B2", "scanner": "#009E73", "rosette": "#56B4E9",
}  # fmt: skip
FITTED = "#1f2933"
PATTERNS = ("vl53l8cx", "tmf8821:3x6", "mid-40", "vlp-32c", "pandarqt")
MOST_RAYS = 15_000
WINDOW_DEG = 15
SIZE_INCHES = (10.5, 12.0)
DOTS_PER_INCH = 105
SMALLEST_M = 0.01


def draw_pattern(axes: Axes, part: Part) -> None:
    """One frame of a part, as azimuth and elevation of its rays; of dense ones the middle."""
    azimuth, elevation = angles(part.directions)
    across, up = np.degrees(np.remainder(azimuth + math.pi, 2 * math.pi) - math.pi), np.degrees(elevation)
    title = f"{part.name}\n{part.rays} rays"
    if part.rays > MOST_RAYS:
        inside = (np.abs(across) < WINDOW_DEG) & (np.abs(up) < WINDOW_DEG)
        across, up = across[inside], up[inside]
        title += ", the middle"
    axes.scatter(across, up, s=9 if part.rays < 100 else 1.2, color=COLOURS[part.kind], linewidths=0)
    axes.set_title(title, fontsize=8, color=INK)
    axes.tick_params(labelsize=6, colors=QUIET)
    axes.set_aspect("equal", adjustable="datalim")


def draw_rows(axes: list[Axes], parts: list[Part], designs: list[tuple[str, DesignSpec]]) -> None:
    """A row per design and part: field of view, range gate, rays per frame."""
    fields, gates, rays = axes
    labels = []
    for row, (name, design) in enumerate(designs):
        labels.append(name)
        for index, sensor in enumerate(design.sensors):
            at = row + 0.36 - 0.72 * (index + 0.5) / len(design.sensors)
            thick = 0.6 / len(design.sensors)
            horizontal, vertical = np.degrees(sensor.field_of_view_rad)
            fields.barh(at, horizontal, thick, color=FITTED, alpha=0.35)
            fields.barh(at, vertical, thick, color=FITTED)
            start, end = sensor.gate_m
            gates.barh(at, end - start, thick, left=start, color=FITTED)
        if design.count is not None:
            rays.plot(design.count, row, "o", color=FITTED, markersize=4)
    for row, part in enumerate(parts, start=len(designs)):
        labels.append(part.name)
        colour = COLOURS[part.kind]
        horizontal, vertical = np.degrees(part.field_of_view_rad)
        fields.barh(row, horizontal, 0.6, color=colour, alpha=0.35)
        fields.barh(row, max(vertical, 0.7), 0.6, color=colour)
        near, far = part.range_m
        near = max(near, SMALLEST_M)
        gates.barh(row, far - near, 0.6, left=near, color=colour, alpha=0.9)
        for farther in part.figures["far_m"][1:]:
            gates.plot(farther.value, row, "|", color=INK, markersize=5, markeredgewidth=0.8)
        rays.plot(part.rays, row, "o", color=colour, markersize=4)
    dress(axes, labels)


def dress(axes: list[Axes], labels: list[str]) -> None:
    """Titles, ticks and limits of the three columns."""
    fields, gates, rays = axes
    titles = (
        "field of view [deg]\n(pale: horizontal, full: vertical)",
        "range, the gate [m]\n(ticks: under other conditions, by other sources)",
        "rays per frame",
    )
    for one, title in zip(axes, titles, strict=True):
        one.set_title(title, fontsize=8, color=INK)
        one.set_ylim(len(labels) - 0.4, -0.6)
        one.set_yticks(range(len(labels)), labels if one is fields else [""] * len(labels), fontsize=7)
        one.tick_params(axis="x", labelsize=7)
        one.grid(axis="x", color="#d9dee3", linewidth=0.5)
        one.set_axisbelow(True)
        one.spines[["top", "right"]].set_visible(False)
    fields.set_xlim(0, 362)
    fields.set_xticks(range(0, 361, 60))
    gates.set_xscale("log")
    gates.set_xlim(SMALLEST_M, 600)
    rays.set_xscale("log")


def main() -> None:
    """Draw the picture."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--design", action="append", default=[], metavar="LABEL=FILE", help="a design to show")
    arguments.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "catalog.png")
    given = arguments.parse_args()
    designs = [(label, load_design(Path(file))) for label, _, file in (one.partition("=") for one in given.design)]
    library = load_library()
    order = list(COLOURS)
    parts = sorted((library.part(name) for name in library.names), key=lambda one: (order.index(one.kind), one.name))
    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subfigures(2, 1, height_ratios=[1, 4.4])
    for axes, name in zip(top.subplots(1, len(PATTERNS)), PATTERNS, strict=True):
        draw_pattern(axes, library.part(name))
    top.supxlabel("azimuth [deg]", fontsize=8)
    top.supylabel("elevation [deg]", fontsize=8)
    draw_rows(list(bottom.subplots(1, 3, width_ratios=[3, 4, 2])), parts, designs)
    handles = [bottom.axes[0].barh(0, 0, color=colour, label=kind) for kind, colour in COLOURS.items()]
    bottom.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7, frameon=False)
    save(figure, given.out)
    print(f"wrote {given.out} ({given.out.stat().st_size} bytes)")


if __name__ == "__main__":
    main()
