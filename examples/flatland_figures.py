"""Draws the paper's figures 2 and 3 for flatland, where a design point is only (x, azimuth, range).

    python examples/flatland_figures.py                   # learns a draft run first, some seconds
    python examples/flatland_figures.py --run runs/flatland --out pictures

Three pictures: the rays that observe one scene point, as a curve in design space weighted by visibility; the target
and the learned density over design space, with the scenes; and existing LiDARs as volumes in the same space.
(Behari et al. 2026, arXiv 2505.22344; figures drawn anew.)
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import numpy as np
from lidardesign_tasks.flatland import FlatlandConfig, build_scene
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Wedge
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

import lidardesign
from lidardesign.config import RunConfig
from lidardesign.density.objective.target import Target, build_target
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Capsule, Scene
from lidardesign.space import AZIMUTH, RANGE, DesignSpace, X, aim

INK, QUIET, SURFACE, OCCLUDER = "#1f2933", "#9aa5b1", "#3e4c59", "#b0b8c1"
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
DOTS_PER_INCH = 130
LARGEST_SCATTER = 7000


def new_figure(width: float, height: float) -> Figure:
    """An empty picture with a canvas of its own."""
    figure = Figure(figsize=(width, height), dpi=DOTS_PER_INCH, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def draw_scene(axes: Axes, scene: Scene, colour: str = SURFACE, opacity: float = 1.0) -> None:
    """A scene's bodies, cut by the plane."""
    for body in scene.bodies:
        pose = body.pose()
        shade = colour if body.is_target else OCCLUDER
        if isinstance(body.shape, Capsule):
            half = body.shape.half_length_m * pose[:2, 2]
            ends = np.stack([pose[:2, 3] - half, pose[:2, 3] + half])
            axes.plot(*ends.T, color=shade, alpha=opacity, linewidth=3.0, solid_capstyle="round")
        else:
            axes.add_patch(Circle(pose[:2, 3], body.shape.radius_m, color=shade, alpha=opacity, linewidth=0))


def flat_axes(axes: Axes, title: str) -> None:
    """Axes of a picture of the plane; the sensor line is y = 0."""
    axes.set(xlim=(-0.05, 1.05), ylim=(-0.06, 1.05), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.axhline(0.0, color=QUIET, linewidth=1.2, zorder=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(length=3, colors=INK)
    axes.set_title(title, fontsize=12, color=INK, loc="left")


def space_axes(axes: Axes, space: DesignSpace, title: str) -> None:
    """Axes of design space."""
    axes.set_xlim(space.low[X], space.high[X])
    axes.set_ylim(np.degrees([space.low[AZIMUTH], space.high[AZIMUTH]]))
    axes.set_zlim(space.low[RANGE], space.high[RANGE])
    axes.set_xlabel("x [m]", labelpad=4)
    axes.set_ylabel("azimuth [°]", labelpad=6)
    axes.set_zlabel("range [m]", labelpad=3)
    axes.set_yticks([45, 90, 135])
    axes.set_box_aspect((1.15, 1.15, 0.95), zoom=1.0)
    axes.view_init(elev=22, azim=-58)
    axes.set_title(title, fontsize=12, color=INK, loc="left", y=0.985)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_facecolor("#f7f9fb")
        axis._axinfo["grid"].update(color="#dde3e9", linewidth=0.7)


def place(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, azimuth in degrees, and range of design points, as they are drawn."""
    return points[:, X], np.degrees(points[:, AZIMUTH]), points[:, RANGE]


def observers(space: DesignSpace, point: np.ndarray, count: int) -> np.ndarray:
    """The admissible design points that observe a scene point, one per origin, (N, 6)."""
    origins = np.linspace(space.low[:3], space.high[:3], count)
    points = space.wrap(aim(origins, np.array([*point, 0.0])))
    return points[space.contains(points)]


def visible(scene: Scene, points: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Which design points see the scene point they are aimed at."""
    directions = (np.array([*toward, 0.0]) - points[:, :3]) / points[:, RANGE, None]
    return SceneCaster(scene).first_hit(points[:, :3], directions).range_m >= points[:, RANGE] - 1e-3


def single_point_figure(config: RunConfig) -> Figure:
    """The paper's figure 2: all rays that observe a scene point form a curve, and occlusion weights it."""
    flat = FlatlandConfig(scene="occluded")
    scene = build_scene(flat, config.space, "figure", np.random.default_rng(3))
    curve = scene.truth["curve_m"]
    chosen = [curve[np.abs(curve[:, 0] - x).argmin()] for x in (0.30, 0.56, 0.74)]
    figure = new_figure(11.5, 5.0)
    left = figure.add_axes((0.055, 0.115, 0.40, 0.78))
    right = figure.add_axes((0.49, 0.0, 0.47, 0.95), projection="3d")
    draw_scene(left, scene)
    for point, colour in zip(chosen, (BLUE, ORANGE, GREEN), strict=True):
        few, many = observers(config.space, point, 13), observers(config.space, point, 400)
        for design, seen in zip(few, visible(scene, few, point), strict=True):
            start = design[:2]
            look = {"color": colour, "linewidth": 1.3} if seen else {"color": QUIET, "linewidth": 0.9, "alpha": 0.6}
            left.plot(*np.stack([start, point]).T, linestyle="-" if seen else (0, (2, 2)), zorder=1, **look)
            left.plot(*start, marker="o", markersize=5, color=INK, clip_on=False)
        left.plot(
            *point, marker="o", markersize=9, color=colour, markeredgecolor="white", markeredgewidth=1.4, zorder=5
        )
        seen = visible(scene, many, point)
        right.add_collection(segments(many, ~(seen[1:] & seen[:-1]), QUIET, 1.2))
        right.add_collection(segments(many, seen[1:] & seen[:-1], colour, 3.2))
    flat_axes(left, "rays that observe three points of a scene")
    space_axes(right, config.space, "the same rays in design space; grey: hidden")
    return figure


def segments(points: np.ndarray, keep: np.ndarray, colour: str, width: float) -> Line3DCollection:
    """Pieces of a curve in design space."""
    line = np.stack(place(points), axis=1)
    return Line3DCollection(
        np.stack([line[:-1], line[1:]], axis=1)[keep], colors=colour, linewidths=width, capstyle="round"
    )


def density_figure(config: RunConfig, samples: Samples, scenes: list[Scene], target: Target) -> Figure:
    """The paper's figure 3: scenes, target and learned density over (x, azimuth, range)."""
    generator = np.random.default_rng(0)
    count = min(LARGEST_SCATTER, len(samples))
    learned = samples.points[generator.choice(len(samples), count, replace=False)]
    probed = config.space.sample(30 * count, generator)
    log_target = target.log_density(probed)
    wanted = probed[generator.random(len(probed)) < np.exp(log_target - log_target.max())][:count]
    figure = new_figure(14.0, 4.9)
    left = figure.add_axes((0.045, 0.13, 0.27, 0.76))
    for scene in scenes:
        draw_scene(left, scene, BLUE, 0.30)
    flat_axes(left, f"{len(scenes)} training scenes")
    parts = {"target density": (0.325, wanted), "learned density": (0.64, learned)}
    norm = Normalize(target.log_density(learned).max() - 4, target.log_density(learned).max())
    for title, (start, points) in parts.items():
        axes = figure.add_axes((start, 0.0, 0.32, 0.95), projection="3d")
        values = target.log_density(points)
        order = np.argsort(values)
        axes.scatter(*place(points[order]), c=values[order], cmap="viridis", norm=norm, s=3.2, linewidths=0, alpha=0.55)
        space_axes(axes, config.space, title)
    figure.text(0.985, 0.02, "samples; bright: observed in many scenes", ha="right", fontsize=9.5, color="#52606d")
    return figure


LIDARS = {
    "spinning LiDAR": (BLUE, (0.16, 0.20), [(a, a + 3) for a in range(48, 134, 12)], (0.05, 1.15)),
    "flash LiDAR with a gate": (ORANGE, (0.48, 0.52), [(65, 115)], (0.60, 0.80)),
    "single-zone sensor": (GREEN, (0.80, 0.82), [(78, 102)], (0.02, 0.55)),
}


def lidar_figure(config: RunConfig) -> Figure:
    """Existing LiDARs: where they are and how they look in the plane, and the volumes they sample."""
    figure = new_figure(11.5, 5.0)
    left = figure.add_axes((0.055, 0.115, 0.40, 0.78))
    right = figure.add_axes((0.49, 0.0, 0.47, 0.95), projection="3d")
    for name, (colour, across, angles, gate) in LIDARS.items():
        origin = (sum(across) / 2, 0.0)
        for low, high in angles:
            left.add_patch(
                Wedge(origin, gate[1], low, high, width=gate[1] - gate[0], facecolor=colour, alpha=0.35, linewidth=0)
            )
            for angle in (math.radians(low), math.radians(high)):
                end = (origin[0] + gate[0] * math.cos(angle), gate[0] * math.sin(angle))
                left.plot(*np.stack([origin, end]).T, color=colour, linewidth=0.6, alpha=0.6)
            right.add_collection3d(box(across, (low, high), gate, colour))
        left.plot(*origin, marker="s", markersize=8, color=colour, label=name, linestyle="none", clip_on=False)
    flat_axes(left, "in the plane")
    left.set_ylim(-0.06, 1.20)
    figure.legend(*left.get_legend_handles_labels(), frameon=False, loc="upper right", fontsize=11, labelcolor=INK)
    space_axes(right, config.space, "in design space")
    return figure


def box(across: tuple, angles: tuple, gate: tuple, colour: str) -> Poly3DCollection:
    """The six faces of a box in design space."""
    sides = (across, angles, gate)
    faces = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for end in sides[axis]:
            corners = np.empty((4, 3))
            corners[:, axis] = end
            corners[:, others[0]] = np.array(sides[others[0]])[[0, 1, 1, 0]]
            corners[:, others[1]] = np.array(sides[others[1]])[[0, 0, 1, 1]]
            faces.append(corners)
    return Poly3DCollection(faces, facecolors=colour, edgecolors=colour, linewidths=0.7, alpha=0.40)


def main() -> None:
    """Draw all three into a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a flatland run (default: learn a draft)")
    parser.add_argument("--out", type=Path, default=Path("flatland_figures"), help="folder (default %(default)s)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.run is None:
            run = lidardesign.learn("flatland", preset="draft", out=Path(folder) / "run", settings=options.set)
        else:
            run = lidardesign.open_run(options.run)
        if run.task.name != "flatland":
            sys.exit(f"{run.folder} is a run of {run.task.name}; these figures are of flatland")
        config, samples = run.config, load_samples(run.folder)
        scenes = run.scenes("train", config.seed)
    target = build_target(scenes, config.space, config.density, "raycast")
    figures = {
        "scene_point": single_point_figure(config),
        "density": density_figure(config, samples, scenes, target),
        "existing_lidars": lidar_figure(config),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(options.out / f"{name}.png", metadata={"Software": None})
        print(options.out / f"{name}.png")


if __name__ == "__main__":
    main()
