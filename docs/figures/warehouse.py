"""Draws docs/warehouse.png: what a design of 12 rays sees of a held-out shelf, and how it follows the aisle.

    python docs/figures/warehouse.py                 # learns a standard run first, about three minutes
    python docs/figures/warehouse.py --run RUN       # from a warehouse run that is there

Everything shown is computed: the shelf is a held-out one, the density is the run's weighted samples, and the design
comes from `lidardesign fit`.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from drawing import INK, QUIET, command, save
from lidardesign_tasks.warehouse_truth import cut_scene, seen_boxes
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.ndimage import gaussian_filter

from lidardesign import open_run
from lidardesign.formats.designs import load_design
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.rays import Outcome
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.returns import simulate
from lidardesign.space import AZIMUTH, ELEVATION, X

RAYS = 12
POSITION_M = 0.37
BINS = (90, 120)  # of the density, along the aisle and in elevation
CHOSEN = ("#f0a202", "#d5483c", "#8a2f8f")  # of three rays, whose gates are drawn
SEEN, UNSEEN, BEAM, GATE = "#5fa777", "#d9c7a3", "#7b8794", "#d5483c"
HEAT = LinearSegmentedColormap.from_list("paper", ["#ffffff", "#cfe0f2", "#6fa3d6", "#1f5fa8"])


def draw_shelf(axes: Axes, scene: Scene, design: DesignSpec, azimuth_rad: float) -> None:
    """The plane that the sensor looks into: what stands there, the rays, and where each of them listens."""
    rays = design.rays(at={"x_m": POSITION_M})
    (returns,) = simulate(scene, rays)
    cut = cut_scene(scene, rays.origin_m[0], azimuth_rad)
    seen = set(seen_boxes(cut, returns.points_m, rays.origin_m[0], azimuth_rad).tolist())
    for body, low, high, is_box in zip(cut.body, cut.low, cut.high, cut.is_box, strict=True):
        colour = (SEEN if body in seen else UNSEEN) if is_box else "#52606d"
        axes.add_patch(Rectangle(low, *(high - low), facecolor=colour, edgecolor="white", linewidth=0.8))
    along = np.column_stack([np.hypot(*rays.direction[:, :2].T), rays.direction[:, 2]])
    reach = np.where(returns.outcome == Outcome.RETURN, np.nan_to_num(returns.range_m), rays.gate_m[:, 1])
    beams = [[(0, 0), tuple(length * unit)] for length, unit in zip(reach, along, strict=True)]
    gates = [[tuple(start * unit), tuple(end * unit)] for (start, end), unit in zip(rays.gate_m, along, strict=True)]
    axes.add_collection(LineCollection(beams, colors=BEAM, linewidths=0.9))
    axes.add_collection(LineCollection(gates, colors=GATE, linewidths=2.6, alpha=0.75))
    hit = returns.points_m
    axes.plot(-hit[:, 1], hit[:, 2], "o", color=INK, markersize=4.5, zorder=5)
    axes.plot(0, 0, "s", color=INK, markersize=11, zorder=5, clip_on=False)
    axes.set(xlim=(-0.08, 1.75), ylim=(-0.06, 2.25), aspect="equal")
    axes.set_xlabel("distance from the robot [m]", color=INK, fontsize=12)
    axes.set_ylabel("height above the sensor [m]", color=INK, fontsize=12)


def draw_density(axes: Axes, samples: Samples) -> None:
    """The learned density of elevation at each position."""
    bounds = [(samples.space.low[axis], samples.space.high[axis]) for axis in (X, ELEVATION)]
    edges = [np.linspace(*bound, count + 1) for bound, count in zip(bounds, BINS, strict=True)]
    density, _, _ = np.histogram2d(
        samples.points[:, X], samples.points[:, ELEVATION], bins=edges, weights=samples.weights
    )
    density = gaussian_filter(density, 1.2)
    density /= density.sum(axis=1, keepdims=True)
    extent = (*bounds[0], *np.degrees(bounds[1]))
    top = np.quantile(density, 0.99)
    axes.imshow(density.T, extent=extent, origin="lower", aspect="auto", cmap=HEAT, vmax=top, interpolation="bicubic")


def draw_pattern(axes: Axes, gates: Axes, design: DesignSpec) -> None:
    """Every ray's elevation and gate along the aisle."""
    (pattern,) = design.patterns
    knots = pattern.knots
    chosen = dict(zip(np.linspace(0, len(pattern) - 1, len(CHOSEN)).astype(int), CHOSEN, strict=True))
    for ray, elevation in enumerate(np.degrees(pattern.elevation_rad).T):
        axes.plot(knots, elevation, color=chosen.get(ray, INK), linewidth=2.6 if ray in chosen else 1.1)
    for place in (axes, gates):
        place.axvline(POSITION_M, color=INK, linewidth=1.1, linestyle=(0, (4, 3)))
        place.set_xlim(knots[0], knots[-1])
    axes.text(POSITION_M + 0.05, 86, f"x = {POSITION_M} m", color=INK, fontsize=11, va="top")
    axes.set_ylim(0, 90)
    axes.set_yticks([0, 30, 60, 90])
    axes.set_ylabel("elevation [deg]", color=INK, fontsize=12)
    for ray, colour in chosen.items():
        start, end = pattern.gate_m[:, ray].T
        gates.fill_between(knots, start, end, color=colour, alpha=0.55, linewidth=0)
    gates.set_ylabel("gate [m]", color=INK, fontsize=12)
    gates.set_xlabel("position along the aisle [m]", color=INK, fontsize=12)


def picture(scene: Scene, samples: Samples, design: DesignSpec) -> Figure:
    """The whole picture."""
    figure = Figure(figsize=(13.0, 6.4), dpi=90, facecolor="white")
    FigureCanvasAgg(figure)
    shelf = figure.add_axes((0.055, 0.10, 0.37, 0.78))
    along, gates = figure.add_axes((0.50, 0.42, 0.455, 0.46)), figure.add_axes((0.50, 0.10, 0.455, 0.25))
    draw_shelf(shelf, scene, design, samples.space.low[AZIMUTH])
    draw_density(along, samples)
    draw_pattern(along, gates, design)
    along.set_xticklabels([])
    for axes in (shelf, along, gates):
        axes.tick_params(colors=INK, labelsize=11, length=3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(QUIET)
    heading = {"fontsize": 13, "fontweight": "bold", "color": INK, "va": "center"}
    figure.text(0.055, 0.945, f"held-out shelf at x = {POSITION_M} m: rays and gates", **heading)
    figure.text(0.50, 0.945, "12 rays for every position, over the learned density", **heading)
    return figure


def main() -> None:
    """Compute what is not there, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a run of the warehouse task (default: learn one)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "warehouse.png")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or Path(folder) / "run"
        if options.run is None:
            command("learn", "warehouse", "--out", run)
        command("fit", run, "--rays", str(RAYS), "--name", "picture")
        opened = open_run(run)
        scene = opened.scenes("test", opened.config.seed)[0]
        save(picture(scene, load_samples(run), load_design(run / "designs" / "picture.yaml")), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
