"""Choosing real parts with their poses: time, memory and how far from the best, by the number of kinds of parts.

The parts are those of the catalogue that measure where heads are, the first so many by name, each at 500 poses. Every
row is a process of its own: poses, shared rays, what parts tell, the choice and its certificate, all in processor time.
Small random problems are solved by HiGHS (`scipy.optimize.milp`), too.

    python benchmarks/parts.py --run RUN [--kinds N ...] [--count N]
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import ROOT, parser, report, run_process, verdict

SECONDS, GAP = 120.0, 0.1
SCENES, PROBLEMS = 50, 20
STAGES = ("poses", "shared rays", "returns", "choice")


def chosen(options: Any, kinds: int) -> dict[str, Any]:
    """One choice, with the processor time of its stages [s]."""
    from lidardesign.constraints.document import Constraints
    from lidardesign.fitting.part_design import proposed
    from lidardesign.fitting.part_sets import SetLimits, choose_set
    from lidardesign.fitting.part_shapes import PartBundle, part_table, parts_inform
    from lidardesign.parts.catalogue import named_parts
    from lidardesign.rays.information import checked_information
    from lidardesign.rays.training_scenes import CHOICE, TrainingScenes
    from lidardesign.run_folder import RunFolder
    from lidardesign.samples import load_samples

    run, samples = RunFolder.open(options.run), load_samples(options.run)
    training = TrainingScenes(run, 0)
    marks = [time.process_time()]
    placed = proposed(named_parts("catalog")[:kinds], Constraints(), options.count, samples, 0)
    marks.append(time.process_time())
    bundle = PartBundle(placed, 60_000 // options.count, next(training.scenes(CHOICE)).frames)
    marks.append(time.process_time())
    scenes = itertools.islice(training.scenes(CHOICE), SCENES)
    informed = parts_inform(bundle, scenes, partial(checked_information, run.task), options.count, 0)
    coverage = part_table(informed, len(placed))
    marks.append(time.process_time())
    found = choose_set(coverage, SetLimits(options.count))
    marks.append(time.process_time())
    gap = (found.bound - found.value) / (coverage.complete - found.value)
    stages = dict(zip(STAGES, np.diff(marks).tolist(), strict=True))
    return {**stages, "candidates": len(placed), "cast": len(bundle.rays), "pairs": len(coverage.item), "gap": gap}


def small_problems() -> list[list[object]]:
    """Sets of 3 of so many candidates: how often HiGHS finds a better one."""
    sys.path.insert(0, str(ROOT / "tests"))
    from support.coverages import relaxed_by_highs, small

    from lidardesign.fitting.part_sets import SetLimits, choose_set

    rows: list[list[object]] = []
    for candidates in (20, 40):
        lacks = []
        for seed in range(PROBLEMS):
            coverage = small(seed, rays=candidates, items=30, scenes=4).through(np.zeros(candidates, dtype=np.intp))
            value = choose_set(coverage, SetLimits(3)).value
            lacks.append(relaxed_by_highs(coverage, 3, 0.0, True) / value - 1)
        rows.append([candidates, PROBLEMS, float(np.max(lacks))])
    return rows


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--run", type=Path, required=True, help="a run folder that `learn` made")
    made.add_argument("--kinds", type=int, nargs="+", default=[10, 20, 41])
    made.add_argument("--count", type=int, default=3, help="parts that are chosen (default %(default)s)")
    made.add_argument("--one", type=int, metavar="KINDS", help="one row, as JSON")
    options = made.parse_args()
    if options.one is not None:
        print(json.dumps(chosen(options, options.one)))
        return
    rows: list[list[object]] = []
    for kinds in options.kinds:
        words = [sys.executable, Path(__file__), "--one", str(kinds), "--count", str(options.count)]
        result = run_process([*words, "--run", options.run])
        found = result.document()
        stages = [found[stage] for stage in STAGES]
        sizes = [kinds, found["candidates"], found["cast"], found["pairs"] / 1e6]
        rows.append([*sizes, *stages, sum(stages), result.wall, result.peak_mib, f"{100 * found['gap']:.1f} %"])
    seconds = [f"{stage} s" for stage in STAGES]
    columns = ["kinds", "candidates", "rays cast", "million pairs", *seconds, "all s", "process, wall s", "MiB", "gap"]
    tables: dict[str, tuple[list[str], list[list[object]]]] = {
        f"{options.count} parts, {SCENES} scenes": (columns, rows),
        "3 of some candidates, beside HiGHS": (["candidates", "problems", "HiGHS better by at most"], small_problems()),
    }
    lines = [
        verdict(f"choosing within {SECONDS:g} s", {str(row[0]): float(str(row[8])) <= SECONDS for row in rows}),
        verdict("a gap of at most 10 %", {str(row[0]): float(str(row[11])[:-2]) <= 100 * GAP for row in rows}),
    ]
    report("Choosing parts", tables, lines, options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
