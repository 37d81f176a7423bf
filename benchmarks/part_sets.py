"""Sets of parts under a detector: what `fit --parts` chooses against the best of many other sets.

The others are random, greedy from random starts, of one kind, and the best by the proxy with a member exchanged. The
best of them is picked on half of the held-out scenes and compared on the other half. Effects are those of the
choice: all that matter but multipath.

    python benchmarks/part_sets.py --run RUN [--parts NAME,NAME] [--count N] [--klux 0 100] [--others 30] [--scenes 100]
"""

from __future__ import annotations

import itertools
import resource
import time
from functools import partial
from typing import Any

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import parser, report, without_traceback

WAYS = ("random", "greedy", "one kind", "swap")


def seconds() -> float:
    """Processor time of this process and of those that it started [s]."""
    every = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in every)


def designs_of(request: Any, training: Any, others: int) -> dict[str, Any]:
    """Designs of other sets of the same candidates, by how they came to be."""
    from lidardesign.constraints.feasibility import BandwidthBudget
    from lidardesign.fitting import part_design, part_sets
    from lidardesign.fitting.part_shapes import PartBundle, part_table, parts_inform
    from lidardesign.parts.catalogue import named_parts
    from lidardesign.rays.information import checked_information
    from lidardesign.rays.training_scenes import CHOICE
    from lidardesign.samples import load_samples

    rules, run, count = request.constraints, request.run, request.sensors
    placed = part_design.proposed(named_parts(rules.parts.names), rules, load_samples(run.folder), request.seed)
    placed = part_design._covered(placed, request.planner.detector, print)
    most = part_design.MOST_FILE_RAYS // count
    limits = part_design._limits(placed, rules, count, most, BandwidthBudget.of(rules, None))
    scenes = training.first(CHOICE)
    bundle = PartBundle(placed, most, scenes[0].frames, request.planner.detector)
    informs = partial(checked_information, run.task)
    coverage = part_table(parts_inform(bundle, scenes, informs, count, request.seed), len(placed))
    kind, generator = limits.kinds[0][0], np.random.default_rng(1)
    own, found = part_sets.choose_set(coverage, limits).members, {}
    for number in range(others):
        way = WAYS[number % len(WAYS)]
        start = int(generator.integers(len(placed)))
        members: tuple[int, ...] = (start,)
        if way == "random":
            while len(members) < count and (may := limits.may_join(members, len(placed))).any():
                members = (*members, int(generator.choice(np.flatnonzero(may))))
        elif way == "greedy":
            members = part_sets._filled(coverage, limits, members)
        elif way == "one kind":
            rows = np.flatnonzero(kind == kind[start])
            part = coverage.grouped(rows[:, None])
            first = int(generator.integers(len(rows)))
            members = tuple(int(rows[one]) for one in part_sets._filled(part, limits.of(rows), (first,)))
        else:
            members = part_sets._filled(coverage, limits, (*np.delete(own, generator.integers(len(own))), start))
        found[f"{way} {number}"] = part_design._design(way, rules, [placed[one] for one in members], None)
    return found


def scored(run: Any, planner: Any, designs: dict[str, Any], count: int) -> tuple[np.ndarray, list[str]]:
    """Scores of designs (D, S) on so many held-out scenes, and the effects."""
    from lidardesign.fitting.trials import Trial, effects_line, score_trials
    from lidardesign.scoring.fired import fired
    from lidardesign.scoring.scene_scores import TrainingScorer

    stream = itertools.chain.from_iterable(run.scenes("test", seed) for seed in itertools.count(run.config.seed))
    trials = [Trial(0, fired(one, planner=planner)) for one in designs.values()]
    scorer = TrainingScorer(run.task, run.metric, run.config.seed, stream, planner, plans_once=True)
    score_trials(trials, scorer, count)
    return np.array([one.scores for one in trials]), effects_line(scorer)


def compared(options: Any, klux: float) -> dict[str, Any]:
    """The choice against the best other set at an illuminance."""
    from lidardesign.api.run import open_run
    from lidardesign.config import with_task_settings
    from lidardesign.fitting.request import FitRequest
    from lidardesign.rays.training_scenes import TrainingScenes

    run, settings = open_run(options.run), [f"illuminance_lux={1000 * klux:g}", "light=sun"]
    asked: dict[str, Any] = {"parts": options.parts.split(","), "sensors": options.count, "detector": options.detector}
    began, clock = seconds(), time.perf_counter()
    said: list[str] = []
    chosen = run.fit(**asked, settings=settings, name="choice", notes=said.append).specification
    took, clock = seconds() - began, time.perf_counter() - clock
    request = FitRequest.resolve(run, {**asked, "settings": settings})
    seen = type(run)(run.folder, run.task, with_task_settings(run.task, run.config, settings))
    designs = {"choice": chosen, **designs_of(request, TrainingScenes(seen, 0), options.others)}
    values, effects = scored(seen, request.planner, designs, options.scenes)
    sign, half = (1 if run.metric.better == "lower" else -1), options.scenes // 2
    best = 1 + int((sign * values[1:, :half]).mean(axis=1).argmin())
    differences = sign * (values[0, half:] - values[best, half:]) / values[best, half:].mean()
    error = 1.96 * differences.std(ddof=1) / np.sqrt(len(differences))
    return {
        "klux": klux,
        "cpu_s": took,
        "wall_s": clock,
        "choice": float(values[0].mean()),
        "parts": [sensor.part for sensor in chosen.sensors],
        "rank": 1 + int((sign * values[1:].mean(axis=1) < sign * values[0].mean()).sum()),
        "other": list(designs)[best],
        "other_parts": [sensor.part for sensor in list(designs.values())[best].sensors],
        "worse_percent": [100 * float(differences.mean() + shift) for shift in (0, -error, error)],
        "effects": effects,
        "notes": said,
    }


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--run", required=True, metavar="RUN", help="a learned run")
    made.add_argument("--parts", default="vl53l8cx,vl53l5cx,tmf8828", help="kinds (default %(default)s)")
    made.add_argument("--count", type=int, default=3, help="parts of a design (default %(default)s)")
    made.add_argument("--detector", default="consumer-8x8", help="default %(default)s")
    made.add_argument("--klux", type=float, nargs="+", default=[0.0, 100.0], help="default 0 100")
    made.add_argument("--others", type=int, default=30, help="other sets (default %(default)s)")
    made.add_argument("--scenes", type=int, default=100, help="held-out scenes (default %(default)s)")
    options = made.parse_args()
    rows = [compared(options, klux) for klux in options.klux]
    columns = ["klux", "choice", "rank", "best other", "choice worse by", "CPU s", "wall s", "parts", "other parts"]
    cells = [
        [
            row["klux"],
            row["choice"],
            row["rank"],
            row["other"],
            "{:.1f} ({:.1f} to {:.1f}) %".format(*row["worse_percent"]),
            row["cpu_s"],
            row["wall_s"],
            ", ".join(row["parts"]),
            ", ".join(row["other_parts"]),
        ]
        for row in rows
    ]
    lines = [f"{row['klux']:g} klux: {line}" for row in rows for line in (*row["notes"], *row["effects"])]
    report(
        f"Sets of parts under {options.detector}", {f"{options.others} others": (columns, cells)}, lines, options.json
    )


if __name__ == "__main__":
    without_traceback(main)
