"""Draws the pictures of docs/concepts.md: docs/overview.png (from a scene to a score) and docs/idea-*.png.

    python docs/figures/idea.py                 # learns a run on the embedded head model first
    python docs/figures/idea.py --run RUN       # from a face run that is there

Everything shown is computed: heads are held-out ones but for the outlines, which are those that are learned from;
the density is the weighted samples of the run, sensors and rays come from `lidardesign fit`, scores from `evaluate`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from drawing import INK, PAPER, QUIET, SideOn, command, save
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator, NullLocator
from scipy.ndimage import gaussian_filter

from lidardesign.config import RunConfig, load_run_config
from lidardesign.formats.designs import load_design
from lidardesign.report.density_views import DensityView, density_view
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import field_on_sphere
from lidardesign.sensors.sensor import Sensor, tangent_directions
from lidardesign.simulate.returns import simulate
from lidardesign.space import AZIMUTH, ELEVATION, angles, direction

SIZE_INCHES, DOTS_PER_INCH = (14.0, 11.2), 100
RAYS = 576
COLOURS = 256  # of the overview: it has more areas than fit with all colours
HALF_HIGH_M = 0.26  # of what the side view shows
OUTLINES = 12  # heads that are learned from, drawn as outlines
PIXELS = 1000  # of the head's picture, along each side
BINS = 210  # of the density, along each side
SERIES = {
    "10 sensors, chosen": ("#0072B2", "o", "-"),
    "10 sensors, even": ("#56B4E9", "s", "-"),
    "bounding": ("#D55E00", "^", (0, (5, 2))),
    "uniform": ("#555555", "x", (0, (4, 2, 1, 2))),
    "random": ("#999999", "+", (0, (1, 1.5))),
}
SENSOR = "#3b3f8f"
OUTCOME_LOOKS = {
    Outcome.MISS: ("#9aa5b1", "dotted"),
    Outcome.NOT_DETECTED: ("#CC79A7", "dashdot"),
    Outcome.AFTER_GATE: ("#0072B2", "dashed"),
    Outcome.OCCLUDED: ("#D55E00", (0, (4, 1.2, 1, 1.2))),
    Outcome.RETURN: ("#007A59", "solid"),
}
# From pale to dark, so that grey print keeps the order; the least of it is left clear.
FIELD = LinearSegmentedColormap.from_list("field", ["#fde9b8", "#f6b04a", "#d95f30", "#93265f", "#2b0f54"])
HEAT = LinearSegmentedColormap.from_list("heat", ["#1b2a6b", "#7b2a8b", "#d5483c", "#f6a02c", "#fdf3b4"])
GATES = LinearSegmentedColormap.from_list("gates", ["#f0a202", "#d5483c", "#8a2f8f", "#2c4bb0"])


def computed(run: Path, learn: bool) -> tuple[DesignSpec, dict[str, Any]]:
    """Ten sensors with chosen rays, and their evaluation beside even rays and the baselines."""
    if learn:
        command("learn", "face", "--out", run)
    names = {"overview-chosen": "chosen", "overview-even": "even"}
    for name, layout in names.items():
        command("fit", run, "--sensors", "10", "--layout", layout, "--name", name)
    paths = [run / "designs" / f"{name}.yaml" for name in names]
    return load_design(paths[0]), command("evaluate", *paths)


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


def draw_sensors(axes: Axes, gates: Axes, view: HeadView, design: DesignSpec) -> None:
    """Fields of view over the head, coloured by where their gates are, and the gates beside them."""
    view.draw(axes, 1.0)
    order = sorted(design.sensors, key=lambda sensor: sum(sensor.gate_m))
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
    names = {"overview-chosen": "10 sensors, chosen", "overview-even": "10 sensors, even"}
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
    axes.set_ylim(1.3, 150.0)
    lines = axes.get_lines()
    look = {"frameon": False, "fontsize": 12, "labelcolor": INK, "handlelength": 2.6}
    axes.add_artist(axes.legend(handles=lines[:2], loc="lower left", **look))
    axes.legend(handles=lines[2:], loc="upper right", **look)


class SideView:
    """Heads seen from the side, with where rays may start and look."""

    def __init__(self, config: RunConfig, heads: list[Scene], head: Scene) -> None:
        space = config.space
        self.origin = np.array(space.low[:3]) / 2 + np.array(space.high[:3]) / 2
        middle = (space.low[AZIMUTH] + space.high[AZIMUTH]) / 2
        self.rims = direction(np.full(2, middle), np.array([space.low[ELEVATION], space.high[ELEVATION]]))
        ahead = direction(middle, 0.0)
        corners = self.origin + np.array([0.68 * ahead, -0.04 * ahead, (0, 0, HALF_HIGH_M), (0, 0, -HALF_HIGH_M)])
        self.view = SideOn(-ahead, corners)
        self.head = self.view.shaded(head, 900)
        self.others = [self.view.shaded(one, 450) for one in heads]

    def draw(self, axes: Axes) -> None:
        """The shaded head."""
        axes.imshow(self.head, extent=self.view.window, origin="lower", interpolation="antialiased")
        axes.set(xlim=self.view.window[:2], ylim=self.view.window[2:])
        axes.set_aspect("equal")
        axes.set_axis_off()

    def draw_space(self, axes: Axes) -> None:
        """Outlines of the heads that are learned from, and the wedge of directions and ranges that rays may have."""
        for other in self.others:
            axes.contour(other[..., 3], (0.5,), extent=self.view.window, colors=[QUIET], linewidths=0.8, alpha=0.6)
        start = self.view.project(self.origin)
        ends = self.view.project(self.origin + HALF_HIGH_M / abs(self.rims[0, 2]) * self.rims)
        for end in ends:
            axes.plot(*np.stack([start, end]).T, color=SENSOR, linewidth=1.6, linestyle=(0, (4, 3)))
        axes.plot(*start, marker="D", color=SENSOR, markersize=10)

    def draw_rays(self, axes: Axes, rays: Rays, returns: Returns) -> None:
        """Rays by what became of them, up to their first hit or their gate's end, and the points that are measured."""
        length = np.where(returns.returned, np.nan_to_num(returns.range_m), rays.gate_m[:, 1])
        starts, ends = self.view.project(rays.origin_m), rays.origin_m + length[:, None] * rays.direction
        lines = np.stack([starts, self.view.project(ends)], axis=1)
        for kind, (colour, dash) in OUTCOME_LOOKS.items():
            some = returns.outcome == kind
            axes.add_collection(LineCollection(lines[some], colors=colour, linestyles=dash, linewidths=0.6, alpha=0.2))
        measured = self.view.project(returns.points_m)
        axes.plot(*measured.T, "o", color=OUTCOME_LOOKS[Outcome.RETURN][0], markersize=3.4)
        axes.plot(*starts[0], marker="D", color=SENSOR, markersize=10)
        shown = [kind for kind in reversed(OUTCOME_LOOKS) if (returns.outcome == kind).any()]
        handles = [
            Line2D([], [], color=OUTCOME_LOOKS[kind][0], linestyle=OUTCOME_LOOKS[kind][1], linewidth=2)
            for kind in shown
        ]
        counts = [int((returns.outcome == kind).sum()) for kind in shown]
        names = [f"{kind.name.lower().replace('_', ' ')} ({count})" for kind, count in zip(shown, counts, strict=True)]
        axes.legend(handles, names, loc="lower right", frameon=False, fontsize=12, labelcolor=INK)


def draw_rays(axes: Axes, view: HeadView, rays: Rays, design: DesignSpec) -> None:
    """Where each ray looks, coloured by its sensor as the fields of view are."""
    view.draw(axes, 1.0)
    order = sorted(range(len(design.sensors)), key=lambda index: sum(design.sensors[index].gate_m))
    colours = GATES(np.linspace(0, 1, len(order)))
    for place, index in enumerate(order):
        looking = view.degrees(rays.direction[rays.sensor == index])
        axes.plot(*looking.T, "o", color=colours[place], markersize=4.2, markeredgecolor="white", markeredgewidth=0.4)


def caption(figure: Figure, left: float, top: float, number: int, word: str, explanation: str) -> None:
    """A heading over one of the parts."""
    figure.text(left, top, f"{number}  {word}", fontsize=22, fontweight="bold", color=INK, va="center")
    figure.text(left, top - 0.031, explanation, fontsize=13.5, color="#52606d", va="center")


def overview(
    side: SideView,
    view: HeadView,
    samples: Samples,
    design: DesignSpec,
    rays: Rays,
    found: Returns,
    scores: dict[str, Any],
) -> Figure:
    """The whole way, in six parts."""
    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor=PAPER)
    FigureCanvasAgg(figure)
    columns, rows = (0.02, 0.35, 0.69), (0.525, 0.02)
    first = figure.add_axes((columns[0], rows[0], 0.30, 0.40))
    side.draw(first)
    side.draw_space(first)
    draw_density(figure.add_axes((columns[1], rows[0], 0.29, 0.41)), view, samples)
    heads = figure.add_axes((columns[2] - 0.02, rows[0], 0.26, 0.41))
    draw_sensors(heads, figure.add_axes((0.952, rows[0] + 0.05, 0.042, 0.31)), view, design)
    draw_rays(figure.add_axes((columns[0] - 0.01, rows[1], 0.29, 0.41)), view, rays, design)
    fifth = figure.add_axes((columns[1], rows[1], 0.29, 0.40))
    side.draw(fifth)
    side.draw_rays(fifth, rays, found)
    draw_scores(figure.add_axes((0.735, rows[1] + 0.045, 0.255, 0.345)), scores)
    words = [
        ("scene", "simulated heads, and rays from the mark"),
        ("density", "learn: where rays are worth firing"),
        ("sensors", "fit: 10 fields of view, a time gate for each"),
        ("rays", f"{len(rays)} of them, chosen together"),
        ("returns", "what a held-out head sends back"),
        ("score", f"evaluate: {scores['scenes']} held-out heads; lower is better"),
    ]
    for number, (word, explanation) in enumerate(words):
        caption(figure, columns[number % 3] + 0.002, (0.978, 0.474)[number // 3], number + 1, word, explanation)
    return figure


def marginals_picture(view: DensityView) -> Figure:
    """The density along each dimension as an area, the design beside it as steps."""
    figure = Figure(figsize=(16, 4.6), dpi=DOTS_PER_INCH, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, one in zip(figure.subplots(1, len(view.marginals)), view.marginals, strict=True):
        axes.stairs(one.heights, one.edges, fill=True, color="#cfd6de", label="learned density")
        for name, heights in one.designs.items():
            axes.stairs(heights, one.edges, color=SENSOR, linewidth=2.2, baseline=None, label=name)
        axes.set(xlim=(one.edges[0], one.edges[-1]), ylim=(0.0, one.top))
        axes.set_xlabel(one.label, fontsize=15)
        axes.set_ylabel(one.unit, fontsize=15)
        axes.tick_params(labelsize=13)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=15)
    return figure


def field_picture(view: DensityView) -> Figure:
    """Where in space the density looks, over what the scene covers."""
    figure = Figure(figsize=(16, 7.2), dpi=DOTS_PER_INCH, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, plane in zip(figure.subplots(1, len(view.planes)), view.planes, strict=True):
        across, up = plane.edges
        image = {"extent": (across[0], across[-1], up[0], up[-1]), "origin": "lower", "interpolation": "nearest"}
        axes.imshow(np.where(plane.targets, 0.85, 1.0), cmap="gray", vmin=0.0, vmax=1.0, **image)
        most = float(np.quantile(plane.heights[plane.heights > 0], 0.998))
        shown = np.ma.masked_less(plane.heights, 0.02 * most)
        drawn = axes.imshow(shown, cmap=FIELD, vmin=0.0, vmax=most, **image)
        axes.contour(plane.targets, (0.5,), extent=image["extent"], colors=[INK], linewidths=1.0, alpha=0.7)
        axes.set_xlabel(plane.labels[0], fontsize=15)
        axes.set_ylabel(plane.labels[1], fontsize=15)
        axes.tick_params(labelsize=13)
        axes.spines[["top", "right"]].set_visible(False)
        bar = figure.colorbar(drawn, ax=axes, shrink=0.75)
        bar.set_label(plane.unit.replace("2", "²"), fontsize=15)
        bar.outline.set_visible(False)
    return figure


def main() -> None:
    """Compute what is not there, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a run of the face task (default: learn one)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1], help="the folder of the pictures")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or Path(folder) / "run"
        design, scores = computed(run, learn=options.run is None)
        task, config = load_run_config(run)
        head = task.scenes(config.task.model_copy(update={"test": 1}), "test", config.seed)[0]
        learned = task.scenes(config.task, "train", config.seed)[:OUTLINES]
        samples = load_samples(run)
    rays = design.rays(RAYS)
    side, front = SideView(config, list(learned), head), HeadView(config, head)
    figure = overview(side, front, samples, design, rays, simulate(head, rays)[0], scores)
    save(figure, options.out / "overview.png", colours=COLOURS)
    view = density_view(samples, head, [replace(design, name="10 sensors")])
    save(marginals_picture(view), options.out / "idea-marginals.png")
    save(field_picture(view), options.out / "idea-field.png")
    for name in ("overview", "idea-marginals", "idea-field"):
        path = options.out / f"{name}.png"
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
