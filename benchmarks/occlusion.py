"""What knowing about occlusion is worth: designs and their twins `no-visibility` over numbers of rays, on the arm.

A twin is the same design fitted to the density without its occlusion term, exactly as `evaluate --baseline
no-visibility` makes it. Three kinds of design: distributed, whose rays start across the ceiling; density, whose rays
start from a few points, the means of its components' origins; and mounted, whose four sensors take the best of 25 even
mounting points. The factor says how many times more rays the twin needs for the same Frechet distance, interpolated
between its numbers of rays on logarithmic scales; where it starts below or never gets there, the factor is a bound.

    python benchmarks/occlusion.py                                 # the default set-up
    python benchmarks/occlusion.py --robot iiwa14 --horizon        # the real arm, elevations up to the horizon
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from common import learned, parser, report, robot_option, robot_settings, run_options, without_traceback

CLAIMED_FACTOR = 2.0
HORIZON = {"elevation_max_deg": 0}
SENSORS = {"distributed": 8, "density": 4, "mounted": 4}
MOUNTS_M = [[x, y, 1.0] for x in (-0.8, -0.4, 0.0, 0.4, 0.8) for y in (-0.8, -0.4, 0.0, 0.4, 0.8)]
AWARE = "aware"


@dataclass(frozen=True)
class Curve:
    """Frechet distance [m] and tracked share over numbers of rays."""

    rays: tuple[int, ...]
    distance_m: tuple[float, ...]
    tracked: tuple[float, ...]
    mbps: tuple[float, ...]


@dataclass(frozen=True)
class Needed:
    """The rays that reach a distance; `bound` is "<=" or ">" where the curve starts below it or never gets there."""

    rays: float
    bound: str = ""

    def text(self, unit: float = 1.0, digits: str = ".0f") -> str:
        """The number, in multiples of a unit, behind its bound."""
        return f"{self.bound} {self.rays / unit:{digits}}".strip()


def rays_needed(rays: Sequence[int], distance_m: Sequence[float], reached_m: float) -> Needed:
    """The smallest number of rays at which a curve comes down to a distance, linear on logarithmic scales."""
    first = next((index for index, value in enumerate(distance_m) if value <= reached_m), None)
    if first is None:
        return Needed(rays[-1], ">")
    if first == 0:
        return Needed(rays[0], "<=")
    before, after = math.log(distance_m[first - 1]), math.log(distance_m[first])
    share = (before - math.log(reached_m)) / (before - after)
    return Needed(rays[first - 1] * (rays[first] / rays[first - 1]) ** share)


def curves(run_folder: Path, layout: str, sensors: int, rays: Sequence[int], seed: int) -> tuple[Curve, Curve]:
    """Of a design fitted with a seed, and of its twin."""
    from lidardesign import open_run
    from lidardesign.constraints.document import Constraints
    from lidardesign.fitting.request import TWIN_NAME, Layouts, RunTarget, twin_without_visibility
    from lidardesign.mixture.fit import fit
    from lidardesign.samples import load_samples
    from lidardesign.scoring.evaluation.request import EvaluationRequest
    from lidardesign.scoring.evaluation.score import evaluate

    run = open_run(run_folder)
    config, samples = run.config, load_samples(run.folder)
    level = run.task.defaults.level
    most = max(rays)
    mounted = layout == "mounted"
    design = fit(
        samples,
        sensors=sensors,
        layout="density" if mounted else layout,
        rays=most,
        constraints=Constraints.from_mapping({"origin": {"mounts_m": MOUNTS_M}} if mounted else {}),
        level=level,
        seed=seed,
        name=AWARE,
        retarget=RunTarget(run),
    ).design
    design = replace(design, provenance={**design.provenance, "seed": seed})
    layouts = Layouts.of([(design, run)], run)
    request = EvaluationRequest(
        task=run.task,
        config=config.task,
        space=config.space,
        seed=config.seed,
        designs=[design],
        rays=sorted(rays),
        baselines=(TWIN_NAME,),
        samples={AWARE: samples},
        equal_bandwidth=False,
        train=run.scenes("train", config.seed),
        test=run.scenes("test", config.seed),
        lay_out=layouts,
        without_visibility=lambda: twin_without_visibility(design, run, layouts),
    )
    started = time.perf_counter()
    rows = evaluate(request).rows
    seconds = time.perf_counter() - started
    print(f"{layout}, fit with seed {seed}: evaluated in {seconds:.0f} s", file=sys.stderr)
    return _curve(rows, AWARE), _curve(rows, TWIN_NAME)


def _curve(rows: Sequence[Any], name: str) -> Curve:
    mine = sorted((row for row in rows if row.design == name), key=lambda row: row.rays)
    return Curve(
        tuple(row.rays for row in mine),
        tuple(row.value for row in mine),
        tuple(row.details["tracked_share"] for row in mine),
        tuple(row.bandwidth_mbps for row in mine),
    )


def median_curve(found: Sequence[Curve]) -> Curve:
    """Medians over fits of different seeds."""
    columns = ([curve.distance_m for curve in found], [curve.tracked for curve in found], [one.mbps for one in found])
    medians = (tuple(map(statistics.median, zip(*column, strict=True))) for column in columns)
    return Curve(found[0].rays, *medians)


def layout_rows(layout: str, aware: Curve, twin: Curve, shown: int) -> tuple[list[list[object]], list[Needed]]:
    """One row per number of rays up to `shown`, and the factors."""
    rows, factors = [], []
    for index, rays in enumerate(aware.rays):
        if rays > shown:
            continue
        needed = rays_needed(twin.rays, twin.distance_m, aware.distance_m[index])
        factors.append(Needed(needed.rays / rays, needed.bound))
        rows.append(
            [layout, rays, aware.distance_m[index], twin.distance_m[index], aware.tracked[index], twin.tracked[index],
             aware.mbps[index], twin.mbps[index], needed.text(), factors[-1].text(digits=".2f")]
        )  # fmt: skip
    return rows, factors


def layout_line(layout: str, rays: Sequence[int], factors: Sequence[Needed]) -> str:
    """Where the claimed factor is reached, and the median one."""
    # "at most" can only be a lower number, "more than" only a higher one
    reached = [
        count for count, one in zip(rays, factors, strict=False) if one.rays >= CLAIMED_FACTOR and one.bound != "<="
    ]
    middle = statistics.median(one.rays for one in factors)
    where = ", ".join(map(str, reached)) or "no number of rays"
    return (
        f"{layout}: the twin needs a median of {middle:.2f} times the rays (bounds counted as they stand); "
        f"at least {CLAIMED_FACTOR:g} times at {where}"
    )


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    robot_option(made)
    run_options(made)
    made.add_argument("--horizon", action="store_true", help="rays as flat as the horizon, not 60 degrees below")
    made.add_argument("--layout", action="append", choices=list(SENSORS), help="repeatable (default all)")
    made.add_argument("--rays", type=int, nargs="+", default=[100, 200, 300, 400, 600, 800, 1200, 1600])
    made.add_argument("--further-rays", type=int, nargs="*", default=[2400, 3200], help="of the twin's curve alone")
    options = made.parse_args()
    settings = robot_settings(options.robot) | (HORIZON if options.horizon else {})
    tried = sorted({*options.rays, *options.further_rays})
    rows, lines = [], []
    with tempfile.TemporaryDirectory() as folder:
        run = learned("arm", Path(folder), options, settings)
        for layout in options.layout or list(SENSORS):
            found = [curves(run, layout, SENSORS[layout], tried, seed) for seed in range(options.rounds)]
            aware, twin = (median_curve([pair[side] for pair in found]) for side in range(2))
            of_layout, factors = layout_rows(layout, aware, twin, max(options.rays))
            rows += of_layout
            lines.append(layout_line(layout, aware.rays, factors))
    columns = [
        "layout", "rays", "m", "twin m", "tracked", "twin tracked", "Mbit/s", "twin Mbit/s", "twin's rays", "factor",
    ]  # fmt: skip
    report(
        f"Knowing about occlusion: medians, fits per layout: {options.rounds}",
        {"Frechet distance of designs and their twins without visibility": (columns, rows)},
        lines,
        options.json,
    )


if __name__ == "__main__":
    without_traceback(main)
