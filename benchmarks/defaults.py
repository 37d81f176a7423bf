"""What `fit RUN` makes without options, against the plain in its own bandwidth, on all shipped tasks and five robots.

For each seed a draft is learned and one design fitted by default. In held-out scenes, on which nothing was chosen, it
stands beside unchosen rays (`--layout even`, as many, in no more bandwidth than it takes) and, with the gates that give
each its bandwidth, beside the baselines `bounding` and `silhouette`. What was measured is kept in the folder.

    python benchmarks/defaults.py --folder defaults [--seeds 3] [--only face]
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from baselines import standing, told
from common import ARM_MODEL, face_settings, lidardesign, parser, report, run_process, verdict, without_traceback
from journey import bottles
from robots import CASES as ROBOTS
from robots import WORLD, found_file

HELD_OUT_SEED = "2027"
PLAIN = ("bounding", "silhouette")


def cases(folder: Path, models: Path | None) -> dict[str, Callable[[], tuple[str, list[str]]]]:
    """Task and settings by name."""

    def robot(name: str) -> tuple[str, list[str]]:
        case = ROBOTS[name]
        keys = [f"model={found_file(case.file, models)}", f"targets=['{case.targets}']", *WORLD, "metric=seen"]
        return "mujoco", keys + ([] if case.folder is None else [f"folder={found_file(case.folder, models)}"])

    def real_head() -> tuple[str, list[str]]:
        return "face", [f"{key}={value}" for key, value in face_settings("ict").items()]

    def real_arm() -> tuple[str, list[str]]:
        return "mujoco", [f"model={ARM_MODEL}", "targets=[link7]", *WORLD, "metric=seen"]

    found: dict[str, Callable[[], tuple[str, list[str]]]] = {
        name: lambda name=name: (name, []) for name in ("face", "flatland", "emitter", "warehouse", "arm")
    }
    found |= {"head model": real_head, "meshes": lambda: ("meshes", bottles(folder))}
    if ARM_MODEL.exists():
        found["7-axis arm"] = real_arm
    return found | {name: lambda name=name: robot(name) for name in ROBOTS}


def measured(title: str, task: str, settings: list[str], options: Any) -> dict[str, Any]:
    """What `evaluate` prints of a case's designs of all seeds; made where it is missing."""
    place = options.folder / title.replace(", ", "-").replace(" ", "-")
    kept = place.with_suffix(f".{options.seeds}.json")
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    runs, rays = [], "1"
    for seed in range(options.seeds):
        print(f"{title}, seed {seed}", file=sys.stderr, flush=True)
        runs.append(place / str(seed))
        if not (runs[-1] / "samples.npz").exists():
            words = [word for key in settings for word in ("--set", key)]
            document("learn", task, "--preset", "draft", "--seed", str(seed), "--out", runs[-1], *words)
        fit = document("fit", runs[-1])
        rays = str(fit["certificates"][-1]["rays"])
        alone = document("evaluate", runs[-1], "--designs", "fit", "--rays", rays, "--baseline", "none")
        spent = alone["rows"][0]["bandwidth_mbps"]
        limit = f"budget.bandwidth_mbps={spent * (1 + 1e-9)}"
        even = ("--layout", "even", "--rays", rays, "--sensors", str(len(fit["sensors"])), "--set", limit)
        document("constrain", runs[-1], *even, "--name", "unchosen")
    designs = ("--designs", "fit", "--designs", "unchosen")
    found = document("evaluate", *runs, *designs, "--rays", rays, "--scenes-seed", HELD_OUT_SEED)
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def document(*words: str | Path) -> dict[str, Any]:
    """The document that a command prints."""
    return run_process(lidardesign(*words, "--json")).document()


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--models", type=Path, help="where packages of robots were unpacked (default: those installed)")
    made.add_argument("--seeds", type=int, default=3, help="how many runs are learned (default %(default)s)")
    made.add_argument("--only", action="append", metavar="CASE", help="only this case; repeatable")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    every, rows, better, worse = cases(options.folder, options.models), [], {}, {}
    for title in options.only or every:
        found = measured(title, *every[title](), options)
        metric, values = found["metric"], {row["design"]: row for row in found["rows"]}
        ours = values["fit"]
        cells: list[object] = [title, ours["rays"], ours["bandwidth_mbps"], metric["unit"], ours["value"]]
        pairs = [*found["paired"], *found["paired_equal_bandwidth"]]
        for name in ("unchosen", *PLAIN):
            others = [pair for pair in pairs if (pair["a"], pair["b"]) == ("fit", name)]
            pair = others[0] if name == "unchosen" else others[-1]
            cells.append(told(pair, metric["better"]))
            lower = pair["difference"] < 0
            better[f"{title}, {name}"] = lower == (metric["better"] == "lower")
            worse[f"{title}, {name}"] = standing(pair, metric["better"]) != "worse"
        rows.append(cells)
    columns = ["case", "rays", "Mbit/s", "unit", "fit", *(f"against {name}, %" for name in ("unchosen", *PLAIN))]
    lines = [verdict("fit is not worse by the interval", worse), verdict("fit is better by the mean", better)]
    report("Defaults", {"In the bandwidth of fit": (columns, rows)}, lines, options.json)


if __name__ == "__main__":
    without_traceback(main)
