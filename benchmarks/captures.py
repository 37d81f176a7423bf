"""What gates remove from captured histograms, over many heads; and how long the tour of a steering mirror takes.

python benchmarks/captures.py [--run RUN] [--detector NAME|FILE] [--heads N] [--side PIXELS]

The laboratory is the simulated one of examples/capture.py. A run that is given must be of the task face with
`illuminance_lux=100000` and `light=sun`.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import ROOT, face_settings, fitted, learned, model_option, parser, report, run_options, without_traceback

# the laboratory lies beside the other examples
sys.path.insert(0, str(ROOT / "examples"))

SUNLIGHT = {"illuminance_lux": 100000, "light": "sun"}
ESTIMATORS = ("peak", "matched")
OUTLIER_M = 0.010
KINDS = {"own": "gated afterwards", "whole": "not gated", "detector": "gated detector"}
Figures = dict[tuple[str, str, str], list[tuple[float, float]]]


def add_head(figures: Figures, scene: Any, run: Any, designs: Sequence[Path], options: Any, folder: Path) -> None:
    """Capture a head without a gate, and along every design with one; score all of them."""
    import capture as laboratory

    from lidardesign.formats.designs import load_design
    from lidardesign.formats.galvo import read_galvo, write_galvo

    detector = laboratory.load_detector(options.detector)
    laboratory.write_mesh(scene, folder / "head.ply")
    grid = laboratory.scanned_rays(run.config.space, options.side)
    laboratory.write_capture(scene, grid, detector, folder / "scan.npz", image=options.side)
    loaded = {path.stem: load_design(path) for path in designs}
    rays = {name: design.rays() for name, design in loaded.items()}
    for estimator in ESTIMATORS:
        add_rows(figures, folder / "scan.npz", list(rays.items()), estimator, folder)
    for name, design in loaded.items():
        write_galvo(design, rays[name], folder / "mirrors.csv")
        mirrors = read_galvo(folder / "mirrors.csv")
        laboratory.write_capture(scene, mirrors, detector, folder / "gated.npz")
        for estimator in ESTIMATORS:
            add_rows(figures, folder / "gated.npz", [(name, mirrors)], estimator, folder, gate="detector")


def add_rows(
    figures: Figures, scan: Path, designs: Sequence[Any], estimator: str, folder: Path, gate: str | None = None
) -> None:
    """Outliers [%] and Chamfer [mm] of designs in a capture."""
    from lidardesign.evaluation.captures.capture import load_capture
    from lidardesign.evaluation.captures.scan import Estimation, default_within_rad
    from lidardesign.evaluation.captures.score import CaptureSettings, evaluate_capture

    capture = load_capture(scan)
    settings = CaptureSettings(
        Estimation(estimator), default_within_rad(capture), OUTLIER_M, reference=folder / "head.ply"
    )
    for row in evaluate_capture(capture, designs, settings).rows:
        found = row.as_dict()
        key = (estimator, row.design, gate or row.gate)
        figures.setdefault(key, []).append((found["outliers_percent"] or 0.0, found["chamfer_mm"]))


def figure_rows(figures: Figures) -> list[list[object]]:
    """Means over heads with 95 % intervals, and the difference to uniform rays head by head."""
    import numpy as np

    from lidardesign.estimates import mean_interval, paired_difference

    rows = []
    for (estimator, name, gate), values in sorted(figures.items(), key=_place):
        mine = np.array(values, dtype=np.float64)
        uniform = np.array(figures[estimator, "uniform", "whole"], dtype=np.float64)
        cells: list[object] = [estimator, name, KINDS[gate]]
        for column in (0, 1):
            mean, low, high = mean_interval(mine[:, column])
            apart = paired_difference(mine[:, column], uniform[:, column])
            against = "-" if name == "uniform" else f"{apart.mean:.3g} ({apart.low:.3g} to {apart.high:.3g})"
            cells += [f"{mean:.3g} ({low:.3g} to {high:.3g})", against]
        rows.append(cells)
    return rows


def _place(item: Any) -> tuple[Any, ...]:
    """The order of rows: by estimator, designs before `uniform`, what is heard before what is not."""
    estimator, name, gate = item[0]
    return ESTIMATORS.index(estimator), name == "uniform", len(name), name, sorted(KINDS).index(gate)


def tour_rows(designs: Sequence[Path], rounds: int) -> list[list[object]]:
    """Travel of the mirrors and the median time of finding their order."""
    import statistics

    from lidardesign.formats.designs import load_design
    from lidardesign.formats.galvo import plan, travel

    rows = []
    for path in designs:
        design = load_design(path)
        rays, spent = design.rays(), []
        for _ in range(rounds):
            started = time.thread_time()
            (position,) = plan(design, rays)
            spent.append(time.thread_time() - started)
        row = [path.stem, len(rays), position.own_travel_deg, travel(position.angles_deg), statistics.median(spent)]
        rows.append(row)
    return rows


def main() -> None:
    """Measure and print."""
    options_of = parser(__doc__)
    model_option(options_of)
    run_options(options_of)
    options_of.add_argument("--detector", default="single-photon", help="detector (default %(default)s)")
    options_of.add_argument("--heads", type=int, default=20, help="held-out heads (default %(default)s)")
    options_of.add_argument(
        "--side", type=int, default=128, help="captures of SIDE x SIDE pixels (default %(default)s)"
    )
    options = options_of.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        settings = {} if options.run else {**SUNLIGHT, **face_settings(options.model)}
        measure(learned("face", Path(folder), options, settings), options, Path(folder))


def measure(run_folder: Path, options: Any, folder: Path) -> None:
    """Fit, capture and print."""
    import capture as laboratory

    from lidardesign import open_run

    run = open_run(run_folder)
    designs = [
        fitted(run_folder, f"sensors-{count}", sensors=count, rays=laboratory.RAYS, layout="even").path
        for count in laboratory.SENSORS
    ]
    figures: Figures = {}
    for scene in run.scenes("test", run.config.seed)[: options.heads]:
        add_head(figures, scene, run, designs, options, folder)
    columns = ["estimator", "rays", "", "outliers [%]", "against uniform", "Chamfer [mm]", "against uniform"]
    tours = ["design", "rays", "own order [deg]", "tour [deg]", "seconds"]
    report(
        f"Captures, detector {options.detector}",
        {
            "Means over held-out heads with 95 % intervals, differences head by head": (
                columns,
                figure_rows(figures),
            ),
            "Travel of the mirrors per frame, and the processor time of finding it": (
                tours,
                tour_rows(designs, options.rounds),
            ),
        },
        [],
        options.json,
    )


if __name__ == "__main__":
    without_traceback(main)
