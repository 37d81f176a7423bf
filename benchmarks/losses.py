"""What the loss of a sensor costs, with rays chosen for it and without.

Designs of four sensors, with `--survive 1` and without, are scored on held-out scenes with all sensors and with each of
them lost. The one that may lose a sensor has the bandwidth that the other one takes. Runs are learned where there are
none; `--run` takes one that there is, of any task.

    python benchmarks/losses.py --folder losses
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common import lidardesign, parser, report, run_process

SENSORS, HELD_OUT_SEED = "4", "2026"


def learned_face(folder: Path, seed: int) -> Path:
    """A draft run of faces, learned unless it is there."""
    run = folder / f"face-{seed}"
    if not run.exists():
        words = ("learn", "face", "--preset", "draft", "--seed", str(seed), "--out", run)
        run_process(lidardesign(*words, "--json")).document()
    return run


def measured(run: Path, rays: str, gates: str) -> dict[str, dict[str, Any]]:
    """The rows of both designs, by name; that for losses has the other's bandwidth, and once more no limit."""
    command = ("--sensors", SENSORS, "--rays", rays, "--gates", gates, "--json")
    score = ("--rays", rays, "--scenes-seed", HELD_OUT_SEED, "--baseline", "none", "--losses", "--json")

    def row(name: str, *words: str) -> dict[str, Any]:
        run_process(lidardesign(*words, *command, "--name", name)).document()
        found = run_process(lidardesign("evaluate", run, "--designs", name, *score)).document()
        return found["rows"][0]

    plain = row("plain", "fit", str(run))
    limit = f"budget.bandwidth_mbps={plain['bandwidth_mbps']!r}"
    constrain = ("constrain", str(run), "--set", limit)
    return {
        "as chosen": plain,
        "as chosen, limited": row("limited", *constrain),
        "survive": row("survive", "fit", str(run), "--survive", "1"),
        "survive, limited": row("survive-limited", *constrain, "--survive", "1"),
    }


def cells(name: str, row: Mapping[str, Any]) -> list[object]:
    """What a design scores, and what the loss of a sensor takes."""
    cost = f"{100 * (row['worst_lost'] / row['value'] - 1):+.0f} %"
    spread = f"{min(row['lost']):.4g} to {max(row['lost']):.4g}"
    return [name, row["value"], row["worst_decile"], spread, cost, row["bandwidth_mbps"]]


def main() -> None:
    """Measure, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs of faces are kept")
    made.add_argument("--seeds", type=int, default=3, help="how many are learned (default %(default)s)")
    made.add_argument("--run", type=Path, action="append", default=[], help="a run instead of faces; repeatable")
    made.add_argument("--rays", default="361", help="rays per frame (default %(default)s)")
    made.add_argument("--gates", default="ray", help="ray or sensor (default %(default)s)")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    runs = options.run or [learned_face(options.folder, seed) for seed in range(options.seeds)]
    rows = [
        [run.name, *cells(name, row)]
        for run in runs
        for name, row in measured(run, options.rays, options.gates).items()
    ]
    columns = ["run", "design", "all sensors", "worst tenth of scenes", "one of four lost", "worst loss", "Mbit/s"]
    title = f"{options.rays} rays, {SENSORS} sensors, a gate per {options.gates}"
    report("What the loss of a sensor costs", {title: (columns, rows)}, [], options.json)


if __name__ == "__main__":
    main()
