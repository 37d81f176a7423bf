"""What the network is for: the same fit and choice from points that training scenes return, without a flow.

Design points are drawn where rays of the space end on training surfaces, and weighted to the target: the points that
learning balances by. They take the place of the flow's samples, and everything after that is the same: mixture,
choice of rays, and scenes. Both designs have the bandwidth that the flow's takes by itself, the same number of
sensors and of rays, and are scored in the same held-out scenes. What is in the folder is not made again.

    python benchmarks/returns.py --folder returns [--seeds 3]
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from common import ARM_MODEL, FACE_MODEL, parser, report, verdict

HELD_OUT_SEED = 2026
FLOW, RETURNS = "flow", "returns"


def cases() -> dict[str, tuple[str, str, Mapping[str, Any]]]:
    """Task, preset and settings of everything that is learned here."""
    found: dict[str, tuple[str, str, Mapping[str, Any]]] = {
        "faces": ("face", "draft", {}),
        "ten training heads": ("face", "draft", {"train": 10}),
        "arm": ("arm", "draft", {}),
        "aisle": ("warehouse", "draft", {}),
    }
    if FACE_MODEL.exists():
        found["head model"] = ("face", "standard", {"model": FACE_MODEL})
    if ARM_MODEL.exists():
        settings = {"model": ARM_MODEL, "targets": ["link7"], "origin_box_m": 0.3, "metric": "seen"}
        found["7-axis arm"] = ("mujoco", "draft", settings)
    if (settings := humanoid_settings()) is not None:
        found["humanoid"] = ("mujoco", "draft", settings)
    return found


def humanoid_settings() -> Mapping[str, Any] | None:
    """Keys of the task for a humanoid's hands, with origins free in a box; None where the model is not installed."""
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        return None
    model = Path(package.submodule_search_locations[0]) / "suite" / "humanoid.xml"
    return {"model": model, "targets": ["*hand"], "origin_box_m": 0.3, "metric": "seen"}


def with_returns(run: Any, folder: Path) -> tuple[Any, dict[str, float]]:
    """A copy of a run whose samples are points of the training scenes, and what they are worth and took [s]."""
    from lidardesign import open_run
    from lidardesign.density.objective.prepare import prepare_target, training_scenes
    from lidardesign.density.objective.proposals import independent_points
    from lidardesign.run.manifest import read_manifest
    from lidardesign.samples import Samples, load_samples, save_samples
    from lidardesign.task import random_generator

    started, flow = time.perf_counter(), load_samples(run.folder)
    shutil.copytree(run.folder, folder, dirs_exist_ok=True)
    scenes, decided = training_scenes(run.task, run.config), read_manifest(run.folder).get("visibility")
    target = prepare_target(scenes, run.config, visibility=decided, compiled=False)[0]
    count, generator = run.config.learning.samples, random_generator(run.config.seed, "returns")
    points, log_density = independent_points(target, count, generator)
    samples = Samples(points, log_density, target.log_density(points), run.config.space)
    save_samples(samples, folder)
    worth = {
        "flow ESS": flow.effective_sample_size,
        "flow worth": flow.independent,
        "returns ESS": samples.effective_sample_size,
        "returns worth": samples.independent,
        "seconds": time.perf_counter() - started,
    }
    return open_run(folder), worth


def measured(title: str, seed: int, sensors: int, folder: Path) -> dict[str, Any]:
    """Scores of both designs by scene, their difference, and what samples are worth; kept once it is there."""
    import lidardesign as ld

    kept = folder / f"{title.replace(' ', '-')}-{seed}.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    task, preset, settings = cases()[title]
    place = folder / f"{title.replace(' ', '-')}-{seed}"
    started = time.perf_counter()
    run = ld.learn(task, preset=preset, out=place / FLOW, seed=seed, settings=settings, overwrite=True)
    learning_s = time.perf_counter() - started
    other, worth = with_returns(run, place / RETURNS)
    rays = sorted(run.task.defaults.rays)[len(run.task.defaults.rays) // 2]
    free = run.fit(sensors=sensors, rays=rays, name="free")
    mbps = bandwidth_mbps(run, free, rays)
    constraints = {"budget": {"bandwidth_mbps": mbps}}
    designs = []
    for name, own in ((FLOW, run), (RETURNS, other)):
        design = own.fit(sensors=sensors, rays=rays, constraints=constraints, name=name)
        designs.append(design.save())
    scores = run.evaluate(designs, rays=[rays], baselines=["none"], scenes_seed=HELD_OUT_SEED)
    found = {
        "metric": run.metric.unit,
        "better": run.metric.better,
        "rays": rays,
        "mbps": mbps,
        "learning_s": learning_s,
        **worth,
        "misplaced": run.quality.misplaced,
        "rows": {row.design: row.value for row in scores.rows},
        "difference": next(pair.difference for pair in scores.paired),
        "interval": next((pair.ci_low, pair.ci_high) for pair in scores.paired),
    }
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def bandwidth_mbps(run: Any, design: Any, rays: int) -> float:
    """Bandwidth of a design's rays, where rays have conditions the largest one [Mbit/s]."""
    from lidardesign.sensors.bandwidth import Bandwidth

    conditions = run.conditions()
    return max(Bandwidth().mbps(design.rays(rays, at=at or None)) for at in conditions)


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--seeds", type=int, default=3, help="(default %(default)s)")
    made.add_argument("--sensors", type=int, default=4, help="of each design (default %(default)s)")
    made.add_argument("--only", action="append", choices=list(cases()), help="only this case; repeatable")
    options = made.parse_args()
    options.folder = options.folder.resolve()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows, ties = [], {}
    for title in options.only or cases():
        each = []
        for seed in range(options.seeds):
            print(f"{title}, seed {seed}", file=sys.stderr, flush=True)
            each.append(measured(title, seed, options.sensors, options.folder))
        # how much worse, by logarithms, whichever direction is better
        sign = 1.0 if each[0]["better"] == "lower" else -1.0
        ratios = sign * np.log([one["rows"][RETURNS] / one["rows"][FLOW] for one in each])
        worse = [100 * float(np.expm1(value)) for value in (ratios.mean(), ratios.min(), ratios.max())]
        beyond = [one["interval"] for one in each]
        ties[title] = not all(low > 0 for low, _ in beyond) and not all(high < 0 for _, high in beyond)
        means = {name: float(np.mean([one["rows"][name] for one in each])) for name in (FLOW, RETURNS)}
        worth = {name: float(np.mean([one[f"{name} ESS"] for one in each])) for name in (FLOW, RETURNS)}
        rows.append(
            [
                f"{title} [{each[0]['metric']}]",
                each[0]["rays"],
                float(np.mean([one["mbps"] for one in each])),
                means[FLOW],
                means[RETURNS],
                f"{worse[0]:+.1f} ({worse[1]:+.1f} to {worse[2]:+.1f})",
                worth[FLOW],
                worth[RETURNS],
                float(np.mean([one["learning_s"] for one in each])),
                float(np.mean([one["seconds"] for one in each])),
            ]
        )
    columns = [
        "case", "rays", "Mbit/s", "flow", "returns", "returns worse by % (seeds)", "ESS of flow", "ESS of returns",
        "learning s", "returns s",
    ]  # fmt: skip
    caption = f"Means over {options.seeds} seeds, {options.sensors} sensors"
    line = verdict("neither is better in every seed by the interval over scenes", ties)
    report("What the network is for", {caption: (columns, rows)}, [line], options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
