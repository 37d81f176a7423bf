"""Draws docs/arm.png: the paths that a ball takes, the arm that carries it, and four sensors' rays from the ceiling.

    python docs/figures/arm.py                 # learns a standard run first, about three minutes
    python docs/figures/arm.py --run RUN       # from an arm run that is there

Everything shown is computed: arm and paths are held-out ones, and the sensors come from `lidardesign constrain`.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from drawing import INK, Camera, command, save
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from lidardesign import open_run
from lidardesign.formats.designs import load_design
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Body, Plane, Scene
from lidardesign.simulate.returns import simulate

RAYS, SENSORS = 400, 4
SPREAD_M = 0.5  # of the regions in which rays start
FRAME = 26
EYE_M, AIM_M = np.array([1.55, -2.55, 1.42]), np.array([0.36, 0.0, 0.50])
PIXELS = (960, 700)  # of the picture, across and down
HALF_WIDTH = 0.375  # tangent of half the horizontal angle of view
LIGHT = np.array([0.35, -0.55, 0.76])
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#AA4499"]
BALL, PATH, EDGE = "#f0a202", "#b45309", "#b8c2cc"
SHADOW = 0.9
GRID_M, LINE_PIXELS, LINE_DARKNESS = 0.25, 0.8, 0.07  # lines on the floor
FLOOR_M = 1.15  # as far as they are drawn to each side


def draw_arm(axes: Axes, camera: Camera, scene: Scene) -> None:
    """The arm, the ball and the floor at one frame, shaded, with a shadow on the floor."""
    with_floor = Scene((*scene.bodies, Body(Plane(), "floor")), frame_rate_hz=scene.frame_rate_hz)
    caster = SceneCaster(with_floor, FRAME)
    looking = camera.directions()
    hits = caster.first_hit(np.broadcast_to(EYE_M, looking.shape), looking)
    seen = np.isfinite(hits.range_m)
    points = EYE_M + np.where(seen, hits.range_m, 0.0)[:, None] * looking
    towards = LIGHT / np.linalg.norm(LIGHT)
    lit = np.clip(hits.normal @ towards, 0.0, 1.0)
    off_surface = points + 1e-4 * hits.normal
    shadow = np.isfinite(caster.first_hit(off_surface, np.broadcast_to(towards, points.shape)).range_m)
    colour = np.ones((len(looking), 3))
    names = np.array([body.name for body in with_floor.bodies])
    floor = seen & (names[hits.body] == "floor")
    ball = seen & (names[hits.body] == "ball")
    shade = 0.45 + 0.5 * lit * np.where(shadow, 0.35, 1.0)
    colour[seen] = (shade[:, None] * np.array([0.93, 0.94, 0.96]))[seen]
    colour[ball] = (np.clip(1.1 * shade, 0, 1)[:, None] * np.array([0.98, 0.55, 0.05]))[ball]
    off_line = np.abs((points[:, :2] + GRID_M / 2) % GRID_M - GRID_M / 2).min(axis=1)
    line = np.clip(1.5 - off_line / (LINE_PIXELS * 2 * HALF_WIDTH / PIXELS[0] * hits.range_m), 0.0, 1.0)
    line *= np.abs(points[:, :2] - (AIM_M[0], 0.0)).max(axis=1) < FLOOR_M
    colour[floor] = (np.where(shadow, SHADOW, 1.0) - LINE_DARKNESS * line)[floor, None]
    axes.imshow(colour.reshape(PIXELS[1], PIXELS[0], 3), interpolation="bilinear")
    axes.set(xlim=(0, PIXELS[0]), ylim=(PIXELS[1], 0))
    axes.set_axis_off()


def ends(returns: Returns, range_m: np.ndarray) -> np.ndarray:
    """Points along every ray at a range (N,) or (), shape (N, 3)."""
    return returns.rays.origin_m + np.broadcast_to(range_m, len(returns.rays))[:, None] * returns.rays.direction


def draw_rays(axes: Axes, camera: Camera, rays: Rays, returns: Returns) -> None:
    """Where rays start, coloured by sensor; all of them faintly to their gates' ends, the ball's returns boldly."""
    started = camera.project(rays.origin_m)
    edge = camera.project(np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1]], dtype=float))
    axes.plot(*edge.T, color=EDGE, linewidth=1.2, linestyle=(0, (4, 3)))
    for sensor in range(SENSORS):
        colour, own = COLOURS[sensor], rays.sensor == sensor
        heard = np.stack([started, camera.project(ends(returns, rays.gate_m[:, 1]))], axis=1)
        axes.add_collection(LineCollection(heard[own], colors=colour, linewidths=0.5, alpha=0.13))
        met = own & returns.returned
        full = np.stack([started, camera.project(ends(returns, np.nan_to_num(returns.range_m)))], axis=1)
        axes.add_collection(LineCollection(full[met], colors=colour, linewidths=1.6))
        axes.plot(*started[own].T, "o", color=colour, markersize=3.0, alpha=0.85, label=f"sensor {sensor}")


def picture(scenes: list[Scene], rays: Rays) -> Figure:
    """The whole picture."""
    figure = Figure(figsize=(PIXELS[0] / 100, PIXELS[1] / 100), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes, camera = figure.add_axes((0, 0, 1, 1)), Camera(EYE_M, AIM_M, PIXELS, HALF_WIDTH)
    draw_arm(axes, camera, scenes[0])
    for scene in scenes[1:]:
        axes.plot(*camera.project(scene.truth["ball_m"]).T, color=BALL, linewidth=0.8, alpha=0.6)
    axes.plot(*camera.project(scenes[0].truth["ball_m"]).T, color=PATH, linewidth=2.2)
    draw_rays(axes, camera, rays, simulate(scenes[0], rays)[FRAME])
    axes.legend(loc="lower right", frameon=False, fontsize=11, labelcolor=INK, markerscale=2.5, handletextpad=0.1)
    return figure


def main() -> None:
    """Compute what is not there, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a run of the arm task (default: learn one)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "arm.png")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or Path(folder) / "run"
        if options.run is None:
            command("learn", "arm", "--out", run)
        words = ("--set", f"origin.spread_m.max={SPREAD_M}", "--sensors", str(SENSORS), "--rays", str(RAYS))
        command("constrain", run, *words, "--name", "picture")
        opened = open_run(run)
        rays = load_design(run / "designs" / "picture.yaml").rays(RAYS)
        save(picture(opened.scenes("test", opened.config.seed), rays), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
