"""Draws docs/emitter.png: four emitters for one detector, what they light of a held-out head, and how they score.

    python docs/figures/emitter.py                 # learns a standard run first, about three minutes
    python docs/figures/emitter.py --run RUN       # from an emitter run that is there

Everything shown is computed: the head is a held-out one, the emitters come from `lidardesign constrain` with the
constraints of examples/emitter.py, and the scores from `lidardesign evaluate`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from drawing import INK, QUIET, Camera, command, save
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from lidardesign import open_run
from lidardesign.formats.designs import load_design
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.detector.physics import IDEAL, Physics
from lidardesign.simulate.returns import simulate

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from emitter import EMITTERS

RAYS = 576
TITLES = {"laser": "laser at the detector", "flood": "one flood", "floods": "three floods", "bistatic": "bistatic"}
FORBIDDEN_M = np.array([[0.40, -0.025, -0.02], [0.40, 0.025, 0.02]])  # where the detector's plane cuts it
AIM_M = np.array([0.155, 0.0, -0.022])
EYE_M = AIM_M + 2.4 * np.array([0.66, -0.68, 0.32])
PIXELS = (520, 410)
HALF_WIDTH = 0.128  # tangent of half the horizontal angle of view
LIGHT = np.array([0.55, -0.62, 0.56])
HALF_DETECTOR_M = np.array([0.0, 0.009, 0.009])
COLOURS = ["#0072B2", "#D55E00", "#009E73"]
DETECTOR, BARRED = INK, "#c62828"


def draw_head(axes: Axes, camera: Camera, scene: Scene) -> None:
    """The head, shaded."""
    looking = camera.directions()
    hits = SceneCaster(scene).first_hit(np.broadcast_to(camera.eye_m, looking.shape), looking)
    light = np.clip(hits.normal @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, 1.0)
    shade = np.where(np.isfinite(hits.range_m), 0.55 + 0.4 * light, 1.0)
    axes.imshow(shade.reshape(camera.pixels[::-1]), cmap="gray", vmin=0, vmax=1, interpolation="bilinear")
    axes.set(xlim=(0, camera.pixels[0]), ylim=(camera.pixels[1], 0))
    axes.set_axis_off()


def rectangle(low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Corners of a rectangle across x, shape (4, 3)."""
    x, (y, z), (right, top) = low_m[0], low_m[1:], high_m[1:]
    return np.array([[x, y, z], [x, right, z], [x, right, top], [x, y, top]])


def draw_detector(axes: Axes, camera: Camera, scene: Scene, half_m: np.ndarray) -> None:
    """The plane that emitters may be in, the forbidden region, and the detector."""
    place = np.array(scene.receiver.origin_m)
    low, high = place - half_m, place + half_m
    low[0] = high[0] = place[0]
    plane = camera.project(rectangle(low, high))
    axes.add_patch(Polygon(plane, closed=True, facecolor="#e8eef5", edgecolor=QUIET, linewidth=1.0, alpha=0.55))
    barred = camera.project(rectangle(*FORBIDDEN_M))
    axes.add_patch(Polygon(barred, closed=True, facecolor="none", edgecolor=BARRED, linewidth=1.0, hatch="/////"))
    eye = camera.project(rectangle(place - HALF_DETECTOR_M, place + HALF_DETECTOR_M))
    axes.add_patch(Polygon(eye, closed=True, facecolor=DETECTOR, edgecolor="white", linewidth=0.8, zorder=6))


def draw_light(axes: Axes, camera: Camera, scene: Scene, design: DesignSpec) -> int:
    """Rays that are heard, and where they end; the number of them."""
    rays = design.rays(RAYS)
    (returns,) = simulate(scene, rays, physics=Physics(IDEAL, frozenset({"shadowing"})))
    ends, sensor = camera.project(returns.points_m), rays.sensor[returns.returned]
    starts = camera.project(rays.origin_m[returns.returned])
    to_eye = camera.eye_m - returns.points_m
    distance = np.linalg.norm(to_eye, axis=1)
    hits = SceneCaster(scene).first_hit(np.broadcast_to(camera.eye_m, to_eye.shape), -to_eye)
    in_sight = hits.range_m > distance - 1e-3
    for index, one in enumerate(design.sensors):
        own, colour = sensor == index, COLOURS[index]
        lines = np.stack([starts[own], ends[own]], axis=1)
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=0.45, alpha=0.16))
        axes.plot(*ends[own & in_sight].T, "o", color=colour, markersize=3.0, markeredgewidth=0)
        axes.plot(*camera.project(one.origin_m), "o", color=colour, markersize=7.5, markeredgecolor="white", zorder=7)
    return int(returns.returned.sum())


def label(figure: Figure, left: float, name: str, rows: dict[str, Any], heard: int) -> None:
    """The name of an emitter over its picture, its score below."""
    row, unit = rows[name], "mm"
    figure.text(left, 0.94, TITLES[name], fontsize=17, fontweight="bold", color=INK, va="center")
    score = f"{row['value']:.2f} {unit}"
    if name != "laser":
        score += f"  ({100 * (row['value'] / rows['laser']['value'] - 1):+.0f} %)"
    figure.text(left, 0.125, score, fontsize=17, color=INK, va="center")
    interval = f"95 %: {row['ci_low']:.2f} to {row['ci_high']:.2f} {unit}; {heard} rays heard here"
    figure.text(left, 0.052, interval, fontsize=11, color="#52606d", va="center")


def picture(scene: Scene, half_m: np.ndarray, designs: dict[str, DesignSpec], evaluation: dict[str, Any]) -> Figure:
    """The whole picture."""
    figure = Figure(figsize=(16.0, 5.0), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    rows = {row["design"]: row for row in evaluation["rows"]}
    camera = Camera(EYE_M, AIM_M, PIXELS, HALF_WIDTH)
    for column, (name, design) in enumerate(designs.items()):
        axes = figure.add_axes((0.25 * column, 0.155, 0.25, 0.74))
        draw_head(axes, camera, scene)
        draw_detector(axes, camera, scene, half_m)
        label(figure, 0.25 * column + 0.012, name, rows, draw_light(axes, camera, scene, design))
    note = {"fontsize": 12, "va": "center"}
    figure.text(0.262, 0.285, "black: detector", color=DETECTOR, **note)
    figure.text(0.262, 0.235, "red: no emitters here", color=BARRED, **note)
    return figure


def main() -> None:
    """Compute what is not there, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a run of the emitter task (default: learn one)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "emitter.png")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or Path(folder) / "run"
        if options.run is None:
            command("learn", "emitter", "--out", run)
        for name, (_, text) in EMITTERS.items():
            constraints = Path(folder) / f"{name}.yaml"
            constraints.write_text(text, encoding="utf-8")
            command("constrain", run, "--constraints", constraints, "--name", f"picture-{name}")
        files = {name: run / "designs" / f"picture-{name}.yaml" for name in EMITTERS}
        evaluation = command("evaluate", *files.values(), "--rays", str(RAYS))
        for row in evaluation["rows"]:
            row["design"] = row["design"].removeprefix("picture-")
        opened = open_run(run)
        half_m = np.broadcast_to(opened.config.task.emitter_box_m, 3)
        scene = opened.scenes("test", opened.config.seed)[0]
        designs = {name: load_design(path) for name, path in files.items()}
        save(picture(scene, half_m, designs, evaluation), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
