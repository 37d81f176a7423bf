"""Draws docs/overview.png: the learned density over a head, sensors fitted to it, and what they are worth.

    python docs/figures/overview.py                 # learns a draft run on the embedded head model first
    python docs/figures/overview.py --run RUN       # from a face run that is there

Everything shown is computed: the head is a held-out one, the density is the run's weighted samples, the sensors come
from `lidardesign fit`, and the curves from `lidardesign evaluate`.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from drawing import INK, PAPER, QUIET, command, save
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator, NullLocator
from scipy.ndimage import gaussian_filter

from lidardesign.design.files import load_design
from lidardesign.design.grid import field_on_sphere
from lidardesign.design.samples import Samples, load_samples
from lidardesign.design.sensor import Design, Sensor, tangent_directions
from lidardesign.run.config import RunConfig, load_run_config
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.space import AZIMUTH, ELEVATION, angles, direction

SIZE_INCHES, DOTS_PER_INCH = (16.0, 7.0), 100
PIXELS = 1000  # of the head's picture, along each side
BINS = 210  # of the density, along each side
SERIES = {
    "10 sensors, density": ("#0072B2", "o", "-"),
    "10 sensors, grid": ("#56B4E9", "s", "-"),
    "bounding": ("#D55E00", "^", (0, (5, 2))),
    "uniform": ("#555555", "x", (0, (4, 2, 1, 2))),
    "random": ("#999999", "+", (0, (1, 1.5))),
}
HEAT = LinearSegmentedColormap.from_list("heat", ["#1b2a6b", "#7b2a8b", "#d5483c", "#f6a02c", "#fdf3b4"])
GATES = LinearSegmentedColormap.from_list("gates", ["#f0a202", "#d5483c", "#8a2f8f", "#2c4bb0"])


def computed(run: Path, learn: bool) -> tuple[Design, dict[str, Any]]:
    """The drawn design, and the evaluation of two layouts of 10 sensors against the baselines."""
    if learn:
        command("learn", "face", "--preset", "draft", "--out", run)
    names = {"overview-grid": "grid", "overview-density": "density"}
    for name, layout in names.items():
        command("fit", run, "--sensors", "10", "--layout", layout, "--name", name)
    designs = [run / "designs" / f"{name}.yaml" for name in names]
    return load_design(designs[0]), command("evaluate", *designs)


class HeadView:
    """One head as the sensor sees it, in degrees to the right of and above the straight view."""

    def __init__(self, config: RunConfig, head: Any) -> None:
        space = config.space
        self.half_deg = np.degrees(space.high[ELEVATION])
        self.middle = (space.low[AZIMUTH] + space.high[AZIMUTH]) / 2
        self.origin = np.array(space.low[:3]) / 2 + np.array(space.high[:3]) / 2
        side = np.linspace(-self.half_deg, self.half_deg, PIXELS)
        right, up = np.meshgrid(side, side)
        directions = direction(self.middle - np.radians(right.ravel()), np.radians(up.ravel()))
        hits = SceneCaster(head).first_hit(np.broadcast_to(self.origin, directions.shape), directions)
        facing = np.abs(np.einsum("nk,nk->n", hits.normal, directions))
        light = np.clip(hits.normal @ (np.array([0.72, 0.45, 0.53])), 0.0, 1.0)
        shade = np.where(np.isfinite(hits.range_m), 0.35 + 0.3 * facing + 0.35 * light, np.nan)
        self.shade = shade.reshape(PIXELS, PIXELS)

    def degrees(self, directions: np.ndarray) -> np.ndarray:
        """Degrees to the right and up of directions, (N, 3) to (N, 2)."""
        azimuth, elevation = angles(directions)
        return np.degrees(np.stack([self.middle - azimuth, elevation], axis=1))

    def draw(self, axes: Axes, brightness: float) -> None:
        """The shaded head, with the frame of both pictures."""
        grey = np.where(np.isfinite(self.shade), brightness * self.shade, 1.0)
        extent = (-self.half_deg, self.half_deg) * 2
        axes.imshow(grey, extent=extent, origin="lower", cmap="gray", vmin=0, vmax=1, interpolation="bilinear")
        axes.set(xlim=(-15.9, 15.9), ylim=(-18.3, 20.1))
        axes.set_axis_off()


def draw_density(axes: Axes, view: HeadView, samples: Samples) -> None:
    """The density of ray directions as a veil over the head, denser where rays are worth more."""
    view.draw(axes, 0.92)
    right = np.degrees(view.middle - samples.points[:, AZIMUTH])
    up = np.degrees(samples.points[:, ELEVATION])
    edges = np.linspace(-view.half_deg, view.half_deg, BINS + 1)
    density, _, _ = np.histogram2d(up, right, bins=(edges, edges), weights=samples.weights)
    density = gaussian_filter(density, 2.2)
    share = np.clip(density / np.quantile(density[density > 0.02 * density.max()], 0.98), 0.0, 1.0)
    picture = HEAT(share)
    picture[..., 3] = np.clip(2.2 * share, 0.0, 0.68)
    axes.imshow(picture, extent=(-view.half_deg, view.half_deg) * 2, origin="lower", interpolation="bicubic")


def outline(sensor: Sensor) -> np.ndarray:
    """Directions round the edge of a sensor's field of view, shape (N, 3)."""
    horizontal, vertical = field_on_sphere(sensor)
    side = np.linspace(-0.5, 0.5, 24)
    half = np.full(24, 0.5)
    across = np.concatenate([side, half, -side, -half])
    along = np.concatenate([-half, side, half, -side])
    return tangent_directions(sensor.frame, np.stack([across * horizontal, along * vertical], axis=1))


def draw_sensors(axes: Axes, gates: Axes, view: HeadView, design: Design) -> None:
    """Fields of view over the head, coloured by where their gates are, and the gates beside them."""
    view.draw(axes, 1.0)
    order = sorted(design.sensors, key=lambda sensor: sensor.range_m)
    colours = dict(zip([s.name for s in order], GATES(np.linspace(0, 1, len(order))), strict=True))
    for sensor in sorted(order, key=lambda s: -np.prod(s.field_of_view_rad)):
        edge = view.degrees(outline(sensor))
        colour = colours[sensor.name]
        axes.add_patch(Polygon(edge, closed=True, facecolor=(*colour[:3], 0.13), edgecolor=colour, linewidth=2.2))
    for place, sensor in enumerate(order):
        start, end = (100 * value for value in sensor.gate_m)
        gates.bar(place, end - start, bottom=start, width=0.66, color=colours[sensor.name])
    low, high = min(s.gate_m[0] for s in order), max(s.gate_m[1] for s in order)
    gates.set(xlim=(-0.7, len(order) - 0.3), ylim=(100 * low - 1, 100 * high + 1))
    gates.set_ylabel("gate [cm]", color=INK, fontsize=12)
    gates.set_xticks([])
    gates.yaxis.set_major_locator(MultipleLocator(5))
    gates.tick_params(axis="y", colors=INK, labelsize=11, length=3)
    gates.spines[["top", "right", "bottom"]].set_visible(False)
    gates.spines["left"].set_color(QUIET)


def draw_scores(axes: Axes, evaluation: dict[str, Any]) -> None:
    """Score against bandwidth, with intervals, one labelled line per design and baseline."""
    names = {"overview-density": "10 sensors, density", "overview-grid": "10 sensors, grid"}
    for name, (colour, marker, dash) in SERIES.items():
        rows = [row for row in evaluation["rows"] if names.get(row["design"], row["design"]) == name]
        rows.sort(key=lambda row: row["rays"])
        across = [row["bandwidth_mbps"] for row in rows]
        ours = name not in ("uniform", "random", "bounding")
        axes.fill_between(
            across,
            [row["ci_low"] for row in rows],
            [row["ci_high"] for row in rows],
            color=colour,
            alpha=0.16,
            linewidth=0,
        )
        axes.plot(
            across,
            [row["value"] for row in rows],
            color=colour,
            marker=marker,
            linestyle=dash,
            linewidth=2.8 if ours else 1.9,
            markersize=8,
            label=name,
            zorder=4 if ours else 3,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis, places in ((axes.xaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10)), (axes.yaxis, (5, 10, 20, 50, 100))):
        axis.set_major_locator(FixedLocator(places))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    metric = evaluation["metric"]
    axes.set_xlabel("bandwidth [Mbit/s]", color=INK, fontsize=13)
    axes.set_ylabel(f"{metric['name']} [{metric['unit']}]", color=INK, fontsize=13)
    axes.tick_params(colors=INK, labelsize=12, length=3)
    axes.grid(True, color="#e4e7eb", linewidth=0.9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.set_ylim(2.6, 150.0)
    lines = axes.get_lines()
    look = {"frameon": False, "fontsize": 12, "labelcolor": INK, "handlelength": 2.6}
    axes.add_artist(axes.legend(handles=lines[:2], loc="lower left", **look))
    axes.legend(handles=lines[2:], loc="upper right", **look)


def caption(figure: Figure, left: float, word: str, explanation: str) -> None:
    """A heading over one of the three parts."""
    figure.text(left, 0.945, word, fontsize=22, fontweight="bold", color=INK, va="center")
    figure.text(left, 0.885, explanation, fontsize=13.5, color="#52606d", va="center")


def overview(config: RunConfig, head: Any, samples: Samples, design: Design, evaluation: dict[str, Any]) -> Figure:
    """The whole picture."""
    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor=PAPER)
    FigureCanvasAgg(figure)
    view = HeadView(config, head)
    draw_density(figure.add_axes((0.015, 0.02, 0.30, 0.83)), view, samples)
    draw_sensors(figure.add_axes((0.318, 0.02, 0.30, 0.83)), figure.add_axes((0.636, 0.10, 0.046, 0.66)), view, design)
    draw_scores(figure.add_axes((0.746, 0.115, 0.242, 0.70)), evaluation)
    caption(figure, 0.022, "learn", "where rays are worth firing, from simulated heads")
    caption(figure, 0.345, "fit", "10 sensors: fields of view, and a time gate for each")
    caption(figure, 0.712, "evaluate", f"on {evaluation['scenes']} held-out heads; lower is better")
    return figure


def main() -> None:
    """Compute what is not there, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a run of the face task (default: learn a draft)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "overview.png")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or Path(folder) / "run"
        design, evaluation = computed(run, learn=options.run is None)
        task, config = load_run_config(run)
        head = task.scenes(config.task.model_copy(update={"test": 1}), "test", config.seed)[0]
        save(overview(config, head, load_samples(run), design, evaluation), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
