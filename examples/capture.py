"""The paper's real-world test with a simulated laboratory: capture a face in sunlight, score designs by the capture.

python examples/capture.py [--out FOLDER] [--run RUN] [--detector NAME|FILE] [--side PIXELS] [--picture FILE.png]

It learns a small draft of the face task, fits 4 and 10 sensors with 576 rays, captures a held-out head without a gate
at the detector's settings, as a lab would, and shows what the gates remove. Then it captures the head once more along
the mirror angles that it exported, with the detector switched on by the gates: photons before them no longer blind it.
(Behari et al. 2026, experiment F.) docs/captures.md says how to do it with a real scanner.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from demo import new_folder, step
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lidardesign import open_run
from lidardesign.evaluation.captures.capture import Capture, load_capture
from lidardesign.formats.galvo import SPEED_OF_LIGHT_M_PER_PS, degree_frame, read_galvo, scan_directions
from lidardesign.run.files import write_atomic
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Mesh, Scene
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import FWHM_PER_SIGMA, Detector, Physics
from lidardesign.simulate.returns import photon_histograms
from lidardesign.space import RANGE, DesignSpace

SUNLIGHT = ("illuminance_lux=100000", "light=sun")
SENSORS = (4, 10)
RAYS = 576
SCANNER_DEG = 20.0
EFFECTS = frozenset({"photon_noise", "jitter", "ambient", "pile_up", "quantisation"})
INK, QUIET, RIGHT, WRONG, GATE = "#1f2933", "#9aa5b1", "#0072B2", "#D55E00", "#009E73"
# Histograms are drawn so many bins together, so that single photons do not hide the peak.
DRAWN_BINS = 4
DOTS_PER_INCH = 110
Returns = Sequence[dict[str, str]]


def main() -> None:
    """Run the chain and say where the results are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/capture-example"), help="where to put everything")
    parser.add_argument("--run", type=Path, help="a run of the task face in sunlight, instead of learning one")
    parser.add_argument("--detector", default="single-photon", help="a detector that counts photons")
    parser.add_argument("--side", type=int, default=128, help="the capture has SIDE x SIDE pixels")
    parser.add_argument("--head", type=int, default=0, help="which held-out head is captured")
    parser.add_argument("--picture", type=Path, help="where to draw the picture; in the folder by default")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="further settings of `learn`")
    options = parser.parse_args()
    folder, started = new_folder(options.out), time.perf_counter()
    folder.mkdir(parents=True)
    learned_run = options.run or learned(folder / "run", options.set)
    designs = [fitted(learned_run, sensors) for sensors in SENSORS]
    mirrors = [folder / f"{design.stem}.galvo.csv" for design in designs]
    for design, file in zip(designs, mirrors, strict=True):
        step("What a scanner needs: mirror angles and gates.", "export", design, "--format", "galvo", "--out", file)

    run = open_run(learned_run)
    scene, detector = run.scenes("test", run.config.seed)[options.head], load_detector(options.detector)
    head, scan = folder / "head.ply", folder / "scan.npz"
    write_mesh(scene, head)
    grid = scanned_rays(run.config.space, options.side)
    write_capture(scene, grid, detector, scan, image=options.side)
    print(f"\n# Captured a held-out head with {options.side} x {options.side} pixels, not gated: {scan}, .mat")
    for estimator in ("peak", "matched"):
        score("What would the designs have measured?", scan, designs, head, estimator)
    for file in mirrors:
        gated = folder / f"{file.name.partition('.')[0]}-gated.npz"
        write_capture(scene, read_galvo(file), detector, gated)
        score("The detector was switched on by the gates.", gated, [file], head, "matched")
    picture = options.picture or folder / "capture.png"
    draw(load_capture(scan), scan, gated, designs[-1].stem, picture)
    print(f"\nDone in {time.perf_counter() - started:.0f} s. The picture: {picture}")


def learned(run: Path, settings: Sequence[str]) -> Path:
    """A draft of the face task in sunlight."""
    words = [word for value in (*SUNLIGHT, *settings) for word in ("--set", value)]
    step("Learn which rays are worth firing at a face.", "learn", "face", "--preset", "draft", *words, "--out", run)
    return run


def fitted(run: Path, sensors: int) -> Path:
    """A design of the paper's kind: even rays in each sensor's field, one gate per sensor."""
    name = f"sensors-{sensors}"
    step(
        f"Fit {sensors} sensors.",
        "fit", run, "--layout", "even", "--sensors", str(sensors), "--rays", str(RAYS), "--name", name,
    )  # fmt: skip
    return run / "designs" / f"{name}.yaml"


def score(why: str, scan: Path, designs: Sequence[Path], head: Path, estimator: str) -> None:
    """Score designs by a capture, and keep every ray's point beside it."""
    points = points_of(scan)
    step(why, "capture", scan, *designs, "--reference", head, "--estimator", estimator, "--csv", points)


def points_of(scan: Path) -> Path:
    """Where the points of a capture are kept."""
    return scan.with_suffix(".points.csv")


def scanned_rays(space: DesignSpace, side: int) -> Rays:
    """SIDE x SIDE rays over all that the mirrors reach, which hear the whole range."""
    axis = np.linspace(-SCANNER_DEG, SCANNER_DEG, side)
    x_deg, y_deg = np.meshgrid(axis, axis)
    looking = scan_directions(degree_frame(180.0, 0.0), np.stack([x_deg.ravel(), y_deg.ravel()], axis=1))
    count = side * side
    origin, gate = np.tile(space.low[:3], (count, 1)), np.tile([space.low[RANGE], space.high[RANGE]], (count, 1))
    return Rays(origin, looking, gate, np.zeros(count), np.zeros(count))


def write_capture(scene: Scene, rays: Rays, detector: Detector, path: Path, image: int | None = None) -> None:
    """A capture as .npz and .mat: every pixel is looked at as long as a ray of a frame of 576."""
    caster = SceneCaster(scene, 0)
    if detector.photons is None:
        raise SystemExit(f"the detector {detector.name} counts no photons")
    slower = replace(detector.photons, pulses_per_frame=detector.photons.pulses_per_frame * len(rays) / RAYS)
    measured = photon_histograms(scene, 0, rays, caster, Physics(replace(detector, photons=slower), EFFECTS))
    hits = caster.first_hit(rays.origin_m, rays.direction)
    pixels = (len(rays),) if image is None else (image, image)
    arrays: dict[str, Any] = {
        "counts": measured.counts.astype(np.uint16).reshape(*pixels, -1),
        "bin_width_ps": 2 * measured.width_m / SPEED_OF_LIGHT_M_PER_PS,
        "start_ps": (2 * measured.start_m / SPEED_OF_LIGHT_M_PER_PS).reshape(pixels),
        "origin_m": rays.origin_m[0],
        "direction": rays.direction.reshape(*pixels, 3),
        "true_range_m": np.where(hits.body >= 0, hits.range_m, np.nan).reshape(pixels),
        "pulse_fwhm_ps": FWHM_PER_SIGMA * detector.timing_sigma_s * 1e12,
    }
    np.savez_compressed(path, **arrays)
    from scipy.io import savemat

    savemat(path.with_suffix(".mat"), arrays, do_compression=True)


def write_mesh(scene: Scene, path: Path) -> None:
    """The head where it stands, in metres."""
    import trimesh

    (body,) = scene.bodies
    shape, pose = body.shape, body.pose()
    if not isinstance(shape, Mesh):
        raise SystemExit("the scene's body is no mesh")
    moved = shape.vertices @ pose[:3, :3].T + pose[:3, 3]
    write_atomic(path, trimesh.Trimesh(moved, shape.faces, process=False).export(file_type="ply"))


def draw(capture: Capture, scan: Path, gated: Path, design: str, path: Path) -> None:
    """Returns from the side: uniform rays, a design without gates, with them, and gated; a pixel below."""
    rows, own = returns_in(points_of(scan)), returns_in(points_of(gated))
    mine = [row for row in rows if row["design"] == design]
    panels: Mapping[str, Returns] = {
        "uniform, not gated": [row for row in rows if row["design"] == "uniform"],
        f"{design}, not gated": [row for row in mine if row["gate"] == "whole"],
        f"{design}, gated afterwards": [row for row in mine if row["gate"] == "own"],
        f"{design}, gated detector": [row for row in own if row["gate"] == "own"],
    }
    figure = Figure(figsize=(9.6, 6.0), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 4, height_ratios=(2.2, 1))
    for column, (title, returns) in enumerate(panels.items()):
        _draw_returns(figure.add_subplot(grid[0, column]), title, returns, capture)
    wrong = [row for row in panels[f"{design}, not gated"] if row["outlier"] == "1" and row["reference_m"]]
    gates = {row["ray"]: row for row in mine if row["gate"] == "own" and row["outlier"] == "0"}
    mended = [row for row in wrong if row["ray"] in gates]
    if mended:
        shown = max(mended, key=lambda row: _inside(gates[row["ray"]]))
        _draw_histogram(figure.add_subplot(grid[1, :]), capture, shown, gates[shown["ray"]])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def returns_in(points: Path) -> Returns:
    """The lines of rays that returned something."""
    with points.open(encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["range_m"]]


def _inside(row: Mapping[str, str]) -> float:
    """How far a range lies from the nearer end of its gate [m]."""
    start, end, found = (float(row[name]) for name in ("gate_start_m", "gate_end_m", "range_m"))
    return min(found - start, end - found)


def _draw_returns(axes: Axes, title: str, returns: Returns, capture: Capture) -> None:
    """Returns from the side, ahead of the scanner to the right: outliers stand apart from the head's profile."""
    wrong = np.array([row["outlier"] == "1" for row in returns], dtype=bool)
    points = np.array([[float(row[f"point_{axis}_m"]) for axis in "xyz"] for row in returns]).reshape(-1, 3)
    ahead, up = capture.origin_m[0] - points[:, 0], points[:, 2]
    for chosen, colour, size in ((~wrong, RIGHT, 4), (wrong, WRONG, 8)):
        axes.scatter(ahead[chosen], up[chosen], s=size, c=colour, linewidths=0)
    share = 100 * wrong.mean() if len(wrong) else 0.0
    axes.set_title(f"{title}\n{len(wrong)} returns, {share:.1f} % outliers", color=INK, fontsize=9)
    axes.set_xlim(0.0, 0.65)
    axes.set_ylim(-0.18, 0.18)
    axes.set_xlabel("ahead of the scanner [m]", color=INK, fontsize=8)
    axes.tick_params(labelsize=7, color=QUIET)


def _draw_histogram(axes: Axes, capture: Capture, wrong: Mapping[str, str], own: Mapping[str, str]) -> None:
    """The histogram of a ray that is wrong without its gate and right with it."""
    pixel, width = int(wrong["pixel"]), DRAWN_BINS * capture.bin_m
    bins = capture.bins // DRAWN_BINS * DRAWN_BINS
    counts = capture.counts[pixel][:bins].reshape(-1, DRAWN_BINS).sum(axis=1)
    axes.step(capture.start_m[pixel] + (np.arange(len(counts)) + 0.5) * width, counts, where="mid", color=INK, lw=0.7)
    axes.axvspan(float(own["gate_start_m"]), float(own["gate_end_m"]), color=GATE, alpha=0.2, lw=0, label="its gate")
    axes.axvline(float(wrong["range_m"]), color=WRONG, lw=1.2, label="taken for the surface without the gate")
    axes.axvline(float(own["range_m"]), color=RIGHT, lw=1.2, label="found inside the gate")
    axes.set_xlabel(f"range along one ray of {own['design']} [m]", color=INK, fontsize=8)
    axes.set_ylabel(f"photons\nper {DRAWN_BINS * capture.bin_ps:g} ps", color=INK, fontsize=8)
    axes.legend(fontsize=8, frameon=False)
    axes.tick_params(labelsize=7, color=QUIET)


if __name__ == "__main__":
    main()
