"""What knowing about occlusion is worth: designs and their twins `no-visibility` over numbers of rays, on the arm.

A twin is the same design fitted to the density without its occlusion term, exactly as `evaluate --baseline
no-visibility` makes it. Three kinds of design: regions, whose rays start all over the ceiling, as in the paper; places,
whose sensors each stand where the fit puts them; and mounted, whose four sensors take the best of 25 even mounting
points. The factor says how many times more rays the twin needs for the same Frechet distance, interpolated between its
numbers of rays on logarithmic scales; where it starts below or never gets there, the factor is a bound.

    python benchmarks/occlusion.py                                 # the default set-up
    python benchmarks/occlusion.py --robot iiwa14 --horizon        # the real arm, elevations up to the horizon
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from common import (
    REGIONS,
    fitted,
    learned,
    parser,
    report,
    robot_option,
    robot_settings,
    run_options,
    without_traceback,
)

CLAIMED_FACTOR = 2.0
HORIZON = {"elevation_max_deg": 0}
MOUNTS_M = [[x, y, 1.0] for x in (-0.8, -0.4, 0.0, 0.4, 0.8) for y in (-0.8, -0.4, 0.0, 0.4, 0.8)]
# Choices of `fit` by the kind of design.
KINDS: dict[str, dict[str, Any]] = {
    "regions": {"sensors": 8, "constraints": REGIONS},
    "places": {"sensors": 4},
    "mounted": {"sensors": 4, "constraints": {"origin": {"mounts_m": MOUNTS_M}}},
}


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


def curves(run: Any, samples: Callable[[], Any], kind: str, counts: Sequence[int], seed: int) -> tuple[Curve, Curve]:
    """Of designs fitted with a seed, and of their twins, which are fitted to other samples."""
    from lidardesign.evaluation.request import EvaluationRequest
    from lidardesign.evaluation.score import evaluate
    from lidardesign.methods.no_visibility import TWIN_NAME, twin_without_visibility

    started, rows = time.perf_counter(), []
    config, name = run.config, f"benchmark-{kind}"
    train, test = (run.scenes(split, config.seed) for split in ("train", "test"))
    for count in counts:
        design = fitted(run.folder, name, rays=count, seed=seed, **KINDS[kind]).specification
        request = EvaluationRequest(
            task=run.task,
            config=config.task,
            space=config.space,
            seed=config.seed,
            designs=[design],
            rays=[count],
            baselines=(TWIN_NAME,),
            equal_bandwidth=False,
            train=train,
            test=test,
            without_visibility=partial(twin_without_visibility, design, run, samples=samples),
        )
        rows += evaluate(request).rows
    print(f"{kind}, seed {seed}: {time.perf_counter() - started:.0f} s", file=sys.stderr)
    return _curve(rows, name), _curve(rows, TWIN_NAME)


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


def kind_rows(kind: str, aware: Curve, twin: Curve, shown: int) -> tuple[list[list[object]], list[Needed]]:
    """One row per number of rays up to `shown`, and the factors."""
    rows, factors = [], []
    for index, rays in enumerate(aware.rays):
        if rays > shown:
            continue
        needed = rays_needed(twin.rays, twin.distance_m, aware.distance_m[index])
        factors.append(Needed(needed.rays / rays, needed.bound))
        rows.append(
            [kind, rays, aware.distance_m[index], twin.distance_m[index], aware.tracked[index], twin.tracked[index],
             aware.mbps[index], twin.mbps[index], needed.text(), factors[-1].text(digits=".2f")]
        )  # fmt: skip
    return rows, factors


def kind_line(kind: str, rays: Sequence[int], factors: Sequence[Needed]) -> str:
    """Where the claimed factor is reached, and the median one."""
    # "at most" can only be a lower number, "more than" only a higher one
    reached = [
        count for count, one in zip(rays, factors, strict=False) if one.rays >= CLAIMED_FACTOR and one.bound != "<="
    ]
    middle = statistics.median(one.rays for one in factors)
    where = ", ".join(map(str, reached)) or "no number of rays"
    return (
        f"{kind}: the twin needs a median of {middle:.2f} times the rays (bounds counted as they stand); "
        f"at least {CLAIMED_FACTOR:g} times at {where}"
    )


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    robot_option(made)
    run_options(made)
    made.add_argument("--horizon", action="store_true", help="rays as flat as the horizon, not 60 degrees below")
    made.add_argument("--kind", action="append", choices=list(KINDS), help="repeatable (default all)")
    made.add_argument("--rays", type=int, nargs="+", default=[100, 200, 400, 800])
    made.add_argument("--further-rays", type=int, nargs="*", default=[1600], help="of the twin's curve alone")
    options = made.parse_args()
    settings = robot_settings(options.robot) | (HORIZON if options.horizon else {})
    tried = sorted({*options.rays, *options.further_rays})
    rows, lines = [], []
    from lidardesign import open_run
    from lidardesign.methods.no_visibility import twin_samples

    with tempfile.TemporaryDirectory() as folder:
        run = open_run(learned("arm", Path(folder), options, settings))
        samples = cache(partial(twin_samples, run))
        for kind in options.kind or list(KINDS):
            found = [curves(run, samples, kind, tried, seed) for seed in range(options.rounds)]
            aware, twin = (median_curve([pair[side] for pair in found]) for side in range(2))
            of_kind, factors = kind_rows(kind, aware, twin, max(options.rays))
            rows += of_kind
            lines.append(kind_line(kind, aware.rays, factors))
    columns = [
        "design", "rays", "m", "twin m", "tracked", "twin tracked", "Mbit/s", "twin Mbit/s", "twin's rays", "factor",
    ]  # fmt: skip
    report(
        f"Knowing about occlusion: medians, fits per kind: {options.rounds}",
        {"Frechet distance of designs and their twins without visibility": (columns, rows)},
        lines,
        options.json,
    )


if __name__ == "__main__":
    without_traceback(main)
