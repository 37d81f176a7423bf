"""Choosing rays: time and memory with scenes and candidates, how far from the best, and how good the proxy is.

Candidates are even over where heads are, each with five gates. Every row of the first two tables is a process of its
own: casting, gates, the table of what rays tell, the choice and its certificate. Small random problems are solved
by HiGHS (`scipy.optimize.milp`) too, as a linear program and with whole rays. The last table sets the proxy beside the
Chamfer distance for choices of one number of rays: at several prices of bandwidth, and at random.

    python benchmarks/selection.py [--scenes N ...] [--candidates N ...]
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import ROOT, face_scenes, face_settings, model_option, parser, report, run_process, verdict

MARGIN_M = 0.01
SECONDS, MEBIBYTES = 30.0, 2048.0  # in which 361 of 1,800 candidates are to be chosen over 800 scenes
PRICES = (0.0, 0.003, 0.01, 0.03, 0.1)  # of 1 Mbit/s in metres of the proxy
FEWEST_OF_RANDOM = 4
STAGES = ("returns", "gates", "table", "choice", "certificate")


def even_candidates(scenes: list[Any], count: int) -> Any:
    """So many rays, even over where some scenes return."""
    from effects import even_rays

    from lidardesign.simulate.returns import simulate

    share = np.mean([simulate(scene, even_rays(2500, (0.05, 1.05)))[0].returned for scene in scenes])
    rays = even_rays(int(np.ceil(1.1 * count / share)), (0.05, 1.05))
    returned = np.flatnonzero(np.any([simulate(scene, rays)[0].returned for scene in scenes], axis=0))
    return rays.subset(returned[np.linspace(0, len(returned) - 1, count).round().astype(int)])


def training_heads(model: str, count: int) -> Iterator[Any]:
    """Training heads, fifty at a time so that they need not all be held at once."""
    from lidardesign_tasks.face import FaceTask

    task = FaceTask()
    for draw, first in enumerate(range(0, count, 50)):
        config = task.Config(train=min(50, count - first), **face_settings(model))
        yield from task.scenes(config, "train", 1000 + draw)


def chosen(options: Any, candidates: int, scenes: int) -> tuple[Any, Any, Any, np.ndarray, dict[str, Any]]:
    """Rays, their table, the choice and its gates, with the processor time that each stage took [s]."""
    from lidardesign_tasks.face import FaceTask

    from lidardesign.rays.certificate import certify
    from lidardesign.rays.choice import RayCounts, choose
    from lidardesign.rays.coverage import gather
    from lidardesign.rays.gates import gate_choices
    from lidardesign.rays.information import CHOSEN_SHARE
    from lidardesign.rays.training_scenes import information_of
    from lidardesign.sensors.bandwidth import Bandwidth

    task, rays = FaceTask(), even_candidates(face_scenes(options.model, 5), candidates)
    bandwidth = Bandwidth()
    marks = [time.process_time()]

    def mark() -> None:
        marks.append(time.process_time())

    informed = [
        information_of(scene, rays, [slice(0, len(rays))], task.informs, CHOSEN_SHARE)
        for scene in training_heads(options.model, scenes)
    ]
    mark()
    gates_m = gate_choices(rays, [slice(0, len(rays))], informed, MARGIN_M)
    mark()
    bits = bandwidth.mbps_of_widths(np.zeros(1)) * bandwidth.bins(gates_m[..., 1] - gates_m[..., 0])
    coverage = gather(informed, gates_m, bits)
    mark()
    counts = RayCounts.of_one(len(rays), options.count)
    choice = choose(coverage, counts)
    mark()
    value, bound = certify(coverage, counts, choice)
    mark()
    found = dict(zip(STAGES, np.diff(marks).tolist(), strict=True))
    found |= {"pairs": len(coverage.item), "gap": (bound - value) / (coverage.complete - value)}
    return rays, coverage, choice, gates_m, found


def growth(options: Any, sizes: list[tuple[int, int]]) -> list[list[object]]:
    """Rows of a process each, for numbers of candidates and scenes."""
    rows: list[list[object]] = []
    for candidates, scenes in sizes:
        words = [sys.executable, Path(__file__), "--one", str(candidates), str(scenes), "--count", str(options.count)]
        result = run_process([*words, "--model", options.model])
        found = result.document()
        stages = [found[stage] for stage in STAGES]
        gap = f"{100 * found['gap']:.2f} %"
        rows.append([candidates, scenes, found["pairs"] / 1e6, *stages, sum(stages), result.wall, result.peak_mib, gap])
    return rows


def small_problems(options: Any) -> list[list[object]]:
    """Choices and their bounds on random tables, as shares of the best choice and of the linear program."""
    sys.path.insert(0, str(ROOT / "tests"))
    from support.coverages import relaxed_by_highs, small

    from lidardesign.rays.certificate import certify
    from lidardesign.rays.choice import RayCounts, choose

    rows: list[list[object]] = []
    for price in (0.0, 0.002):
        found = []
        for seed in range(options.problems):
            coverage, counts = small(seed, rays=40, items=30, scenes=4), RayCounts.of_one(40, 8)
            value, bound = certify(coverage, counts, choose(coverage, counts, price=price, full=False), full=False)
            linear, best = (relaxed_by_highs(coverage, 8, price, integral) for integral in (False, True))
            found.append((value / best, bound / best, bound / linear))
        value, bound, relaxed = np.transpose(found)
        rows.append([price, float(value.mean()), float(value.min()), float(bound.max()), float(relaxed.max())])
    return rows


def proxy_beside_score(options: Any) -> tuple[list[list[object]], float]:
    """Loss on other training heads and Chamfer distance on held-out ones, for choices of one number of rays."""
    from dataclasses import replace

    from lidardesign_tasks.face import FaceTask
    from scipy.stats import spearmanr

    from lidardesign.rays.choice import RayCounts, choose
    from lidardesign.rays.coverage import gather
    from lidardesign.rays.information import CHOSEN_SHARE
    from lidardesign.rays.training_scenes import information_of
    from lidardesign.simulate.returns import simulate

    task, generator = FaceTask(), np.random.default_rng(0)
    rays, coverage, _, gates_m, _ = chosen(options, options.proxy[0], options.proxy[1])
    counts = RayCounts.of_one(len(rays), options.count)
    gates = {f"price {price:g}": choose(coverage, counts, price=price).gate for price in PRICES}
    for number in range(FEWEST_OF_RANDOM):
        gate = np.full(len(rays), -1)
        gate[generator.permutation(len(rays))[: options.count]] = 0
        gates[f"at random, {number}"] = gate
    config = task.Config(test=options.proxy[2], **face_settings(options.model))
    held_out = list(task.scenes(config, "test", 0))
    others = [
        information_of(scene, rays, [slice(0, len(rays))], task.informs, CHOSEN_SHARE)
        for scene in face_scenes(options.model, options.proxy[2], seed=7)
    ]
    judged = gather(others, gates_m, coverage.bits)
    rows: list[list[object]] = []
    for name, gate in gates.items():
        taken = np.flatnonzero(gate >= 0)
        fired = replace(rays.subset(taken), gate_m=gates_m[taken, gate[taken]])
        score = float(np.mean([task.score(scene, simulate(scene, fired)).value for scene in held_out]))
        rows.append([name, coverage.charge(gate)[0], 1e3 * judged.loss_of(gate), score])
    return rows, float(spearmanr([row[2] for row in rows], [row[3] for row in rows]).statistic)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    model_option(made)
    made.add_argument("--count", type=int, default=361, help="rays that are chosen (default %(default)s)")
    made.add_argument("--scenes", type=int, nargs="+", default=[100, 200, 400, 800])
    made.add_argument("--candidates", type=int, nargs="+", default=[900, 1800, 3600])
    made.add_argument("--problems", type=int, default=10, help="small ones (default %(default)s)")
    made.add_argument("--proxy", type=int, nargs=3, default=[1800, 100, 50], metavar=("CANDIDATES", "TRAIN", "TEST"))
    made.add_argument("--one", type=int, nargs=2, metavar=("CANDIDATES", "SCENES"), help="one row, as JSON")
    options = made.parse_args()
    if options.one is not None:
        print(json.dumps(chosen(options, *options.one)[-1]))
        return
    middle = options.candidates[len(options.candidates) // 2]
    columns = [
        "candidates",
        "scenes",
        "million pairs",
        *(f"{stage} s" for stage in STAGES),
        "all s",
        "process, wall s",
        "MiB",
        "gap",
    ]
    by_scenes = growth(options, [(middle, scenes) for scenes in options.scenes])
    by_candidates = growth(options, [(candidates, options.scenes[-2]) for candidates in options.candidates])
    beside, correlation = proxy_beside_score(options)
    tables: dict[str, tuple[list[str], list[list[object]]]] = {
        f"{options.count} rays, by the number of scenes": (columns, by_scenes),
        "By the number of candidates": (columns, by_candidates),
        f"{options.problems} small problems, 8 of 40 rays, beside HiGHS": (
            ["price", "value / best", "least", "bound / best, most", "bound / linear program, most"],
            small_problems(options),
        ),
        f"Proxy and score of {options.count} rays": (["choice", "Mbit/s", "loss, mm", "Chamfer, mm"], beside),
    }
    seconds = {str(row[1]): [float(str(value)) for value in row[3:9]] for row in by_scenes}
    lines = [
        verdict(f"choosing within {SECONDS:g} s", {name: sum(row[1:5]) <= SECONDS for name, row in seconds.items()}),
        verdict(f"with heads and returns within {SECONDS:g} s", {n: row[5] <= SECONDS for n, row in seconds.items()}),
        verdict("memory below 2 GiB", {str(row[1]): float(str(row[10])) < MEBIBYTES for row in by_scenes}),
        f"rank correlation (Spearman) of proxy and score over {len(beside)} choices: {correlation:.2f}",
    ]
    report("Choosing rays", tables, lines, options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
