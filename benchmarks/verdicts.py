"""What designs lose by a density that was learned badly: figures of `learn` beside what the chosen rays leave unknown.

Each task is learned for a few steps and to ever smaller shares of misplaced mass, from several seeds. To every
density the same number of sensors is fitted from three seeds, for fits differ too, and the mean loss of the rays that
are chosen is measured on training scenes that the choice did not see, the same ones for all. It stands beside the
mean of the task's good densities; a density that is refused as too rough by one of the fits costs +inf. What was
measured is kept.

    python benchmarks/verdicts.py --folder verdicts
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import lidardesign, parser, report, run_process

# label -> (task and its settings, sensors, rays)
TASKS = {
    "flatland": (("flatland",), 3, 32),
    "flatland, discs": (("flatland", "scene=discs"), 3, 32),
    "flatland, occluded": (("flatland", "scene=occluded"), 3, 32),
    "face": (("face",), 2, 361),
    "face, box of origins": (("face", "origin_box_m=0.15"), 3, 361),
    "emitter": (("emitter",), 2, 300),
    "warehouse": (("warehouse",), 2, 24),
    "arm": (("arm",), 4, 400),
}
# The share of misplaced mass at which learning stops and the most steps: those of the finest preset, or too few.
MANY = 2000
LENGTHS = ((0.0, 10), (0.0, 30), (0.25, MANY), (0.15, MANY), (0.1, MANY), (0.05, MANY))
FIGURES = ("misplaced", "kl_nats", "ess")
FITS = 3
REFUSED = (3, 4)  # samples that count as too few, or as too few for the sensors


def measured(folder: Path, label: str, length: tuple[float, int], seed: int) -> dict[str, Any]:
    """The figures of a density, and the loss of rays that are chosen with it."""
    (task, *settings), sensors, rays = TASKS[label]
    goal, steps = length
    run = folder / f"{label.replace(', ', '-').replace(' ', '-')}-{goal}-{steps}-{seed}"
    path = folder / f"{run.name}.json"
    if not path.exists():
        settings += [f"learning.misplaced={goal}", f"learning.steps={steps}"]
        words = [word for setting in settings for word in ("--set", setting)]
        learn = ("learn", task, "--seed", str(seed), "--out", run, "--overwrite", *words)
        learned = run_process(lidardesign(*learn, "--json")).document()
        losses = []
        for number in range(FITS):
            fit = ("fit", run, "--seed", number, "--sensors", sensors, "--rays", rays, "--name", f"fit{number}")
            fitted = run_process(lidardesign(*fit, "--json"))
            if fitted.code in REFUSED:
                losses.append(math.inf)
            else:
                losses.append(fitted.document()["certificates"][0]["held_back_value"])
        found = {**{name: learned[name] for name in ("steps", *FIGURES, "verdict")}, "loss": sum(losses) / FITS}
        path.write_text(json.dumps(found) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def rows_of(folder: Path, label: str, lengths: Sequence[tuple[float, int]], seeds: int) -> list[list[object]]:
    """A task's densities, from the best design to the worst."""
    found = [(length, seed, measured(folder, label, length, seed)) for length in lengths for seed in range(seeds)]
    usual = statistics.mean(one["loss"] for _, _, one in found if one["verdict"] == "good")
    rows = [
        [label, goal, seed, *(one[name] for name in ("steps", *FIGURES, "verdict")), f"{one['loss'] / usual - 1:+.1%}"]
        for (goal, _), seed, one in found
    ]
    return sorted(rows, key=lambda row: float(str(row[-1]).rstrip("%")))


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--seeds", type=int, default=2, help="how many runs of each length (default %(default)s)")
    made.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS), help="these alone")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows = [row for label in options.tasks for row in rows_of(options.folder, label, LENGTHS, options.seeds)]
    columns = ["task", "goal", "seed", "steps", *FIGURES, "verdict", "loss above good ones"]
    summary = []
    for verdict in ("good", "usable", "poor"):
        losses = [float(str(row[-1]).rstrip("%")) for row in rows if row[-2] == verdict]
        if losses:
            spread = f"{min(losses):.1f} to {max(losses):.1f} %, median {statistics.median(losses):.1f} %"
            summary.append(f"{len(losses)} {verdict} densities lose, beside good ones, {spread}")
    report("What designs lose by rough densities", {"held-back scenes": (columns, rows)}, summary, options.json)


if __name__ == "__main__":
    main()
