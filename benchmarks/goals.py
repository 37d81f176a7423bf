"""Goals that `fit --goal` keeps on training scenes held back, judged on held-out scenes of two seeds.

Each case is a run, a goal, and what is to be least. It is kept where the 95 % interval of the held-out score reaches
the goal or is better. Runs in the folder are not learned again, and what was measured is not measured again.

    python benchmarks/goals.py --folder goals [--only faces-0]
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common import ARM_MODEL, lidardesign, parser, report, run_process, verdict
from robots import CASES as ROBOTS
from robots import found_file

# Of each run: its number of sensors, where that is not sought, and goals by what is to be least.
GOALS = {
    "faces-0": (2, {"bandwidth": (6.0, 9.0), "rays": (7.0,), "sensors": (8.5,)}),
    "faces-1": (2, {"bandwidth": (6.0, 9.0), "rays": (7.0,), "sensors": (8.5,)}),
    "aisle-0": (1, {"bandwidth": (12.0, 20.0), "rays": (15.0,), "sensors": (12.0,)}),
    "7-axis-arm-0": (2, {"bandwidth": (40.0, 30.0), "rays": (30.0,), "sensors": (35.0,)}),
    "humanoid-0": (2, {"bandwidth": (75.0, 60.0), "rays": (60.0,), "sensors": (70.0,)}),
}
HELD_OUT_SEEDS = (2026, 2031)


def learning_words(name: str) -> list[str]:
    """The task of a run and its settings, as words for `learn`."""
    if name.startswith("faces"):
        return ["face"]
    if name.startswith("aisle"):
        return ["warehouse"]
    if name.startswith("humanoid"):
        model, targets = found_file(ROBOTS["humanoid"].file, None), ROBOTS["humanoid"].targets
    else:
        model, targets = ARM_MODEL, "link7"
    words = [f"model={model}", f"targets=[{targets!r}]", "origin_box_m=0.3", "metric=seen"]
    return ["mujoco", *(part for word in words for part in ("--set", word))]


def measured(run: Path, goal: float, least: str, sensors: int) -> dict[str, Any]:
    """What was found for a goal, and its rows of `evaluate` on the scenes of each seed."""
    name = f"{least}-{goal:g}"
    path = run.parent / f"{run.name}-{name}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    words = [] if least == "sensors" else ["--sensors", str(sensors)]
    done = run_process(lidardesign("fit", run, "--goal", str(goal), "--least", least, *words, "--name", name, "--json"))
    document = json.loads(done.output)
    found: dict[str, Any] = {"code": done.code, "seconds": done.cpu, "goal": document.get("goal"), "held_out": []}
    found["error"] = document.get("error")
    if not done.code:
        design, rays = run / "designs" / f"{name}.yaml", str(document["goal"]["found"]["rays"])
        for seed in HELD_OUT_SEEDS:
            words = ["--rays", rays, "--baseline", "none", "--scenes-seed", str(seed), "--json"]
            found["held_out"] += run_process(lidardesign("evaluate", design, *words)).document()["rows"]
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def is_kept(row: Mapping[str, Any], goal: float, is_lower: bool) -> bool:
    """Whether the interval of a held-out score reaches a goal or is better."""
    return row["ci_low"] <= goal if is_lower else row["ci_high"] >= goal


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--only", action="append", choices=list(GOALS), help="this run alone; repeatable")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows, kept, missed = [], {}, {}
    for name in options.only or GOALS:
        run, (sensors, goals) = options.folder / name, GOALS[name]
        if not run.exists():
            words = [*learning_words(name), "--preset", "draft", "--seed", name.rpartition("-")[2]]
            run_process(lidardesign("learn", *words, "--out", run, "--json")).document()
        for least, goal in ((least, goal) for least, some in goals.items() for goal in some):
            case, found = f"{name}, {goal:g}, {least}", measured(run, goal, least, sensors)
            if found["code"]:
                rows.append([name, goal, least, found["error"]["message"][-120:], "", "", "", "", found["seconds"]])
                kept[case] = False
                continue
            one, tried = found["goal"]["found"], found["goal"]["tried"]
            key = {"bandwidth": "bandwidth_mbps"}.get(least, least)
            cheaper = max((each for each in tried if each[key] < one[key]), key=lambda each: each[key], default=None)
            is_lower = found["goal"]["unit"] != "%" or name.startswith("aisle")
            kept[case] = all(is_kept(row, goal, is_lower) for row in found["held_out"])
            missed[case] = cheaper is None or not cheaper["keeps"]
            score = lambda each: f"{each['value']:.3g} ({each['ci_low']:.3g} to {each['ci_high']:.3g})"  # noqa: E731
            design = f"{one['rays']} rays, {one['sensors']} sensors, {one['bandwidth_mbps']:.3g} Mbit/s"
            held_out = [score(row) for row in found["held_out"]]
            rows.append([name, goal, least, design, score(one), score(cheaper) if cheaper else "-", *held_out])
            rows[-1].append(found["seconds"])
    seeds = [f"held out, {seed}" for seed in HELD_OUT_SEEDS]
    columns = ["run", "goal", "least", "found", "held back", "next cheaper", *seeds, "CPU s"]
    lines = [
        verdict("the goal is kept on held-out scenes of both seeds, within their intervals", kept),
        verdict("the next cheaper design that was tried misses it on scenes held back", missed),
    ]
    report("Goals", {"fit --goal": (columns, rows)}, lines, options.json)


if __name__ == "__main__":
    main()
