"""Experiments A to D of the paper (Behari et al. 2026): sensors, rays, scores and bandwidth, the paper's beside ours.

Five seeds are learned as drafts and evaluated together on held-out scenes of another seed. The paper gives bandwidth as
numbers and scores as curves; it sends 40 bits a bin at 10 Hz, so that every bandwidth is a number of bins per ray. What
was made is kept in the folder.

    python benchmarks/paper.py --folder paper [--seeds 5] [--only faces] [--page docs/paper.md]
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import lidardesign, parser, report, run_process, table, without_traceback

HELD_OUT_SEED = "2033"  # nothing was tried on its scenes
BITS_PER_S = 40 * 10  # of a bin
BIN_M = 0.015  # ours, of 100 ps


@dataclass(frozen=True)
class Experiment:
    """One experiment.

    Arguments:
        task: Its task.
        sensors: Numbers of sensors; None: those of the task's own design.
        rays: Numbers of rays.
        uniform_mbps, paper_mbps: The paper's bandwidth, by rays; of designs also by sensors.
    """

    task: str
    sensors: Sequence[int | None]
    rays: Sequence[int]
    uniform_mbps: Sequence[float]
    paper_mbps: Mapping[int | None, Sequence[float]]


EXPERIMENTS = {
    "faces": Experiment(
        "face", (2, 4, 10), (196, 361, 576), (5.2, 9.5, 15.2),
        {2: (0.9, 1.6, 2.5), 4: (0.9, 1.7, 2.7), 10: (0.8, 1.5, 2.3)},
    ),
    "arm": Experiment(
        "arm", (2, 4, 8), (400, 1000, 1200), (10.7, 26.8, 32.2),
        {2: (6.9, 17.3, 20.8), 4: (5.4, 13.4, 16.1), 8: (4.7, 11.7, 14.0)},
    ),
    "aisle": Experiment("warehouse", (None,), (6, 12, 18), (1.9, 3.8, 5.8), {None: (0.3, 0.4, 0.6)}),
}  # fmt: skip


EMITTERS = "emitters"
EMITTER_RAYS = 576
# Where emitters may stand: at the detector, beside it, or three around it with none where the camera is.
CAMERA = {"low_m": [0.3, -0.025, -0.02], "high_m": [0.5, 0.025, 0.02]}
BOXES = (
    ([0.39, 0.02, -0.03], [0.41, 0.08, 0.03]), ([0.39, -0.08, -0.03], [0.41, -0.02, 0.03]),
    ([0.39, -0.03, 0.01], [0.41, 0.03, 0.07]),
)  # fmt: skip
PLACEMENTS: dict[str, dict[str, Any]] = {
    "at the detector": {"sensors": {"count": 1}, "origin": {"fixed_m": [0.4, 0.0, 0.0]}},
    "8 cm aside": {"sensors": {"count": 1}, "origin": {"fixed_m": [0.4, 0.08, 0.0]}},
    "three around the camera": {
        "sensors": {"count": 3},
        "origin": {"exclude": [CAMERA]},
        "each": [{"origin": {"low_m": low, "high_m": high}} for low, high in BOXES],
    },
}
LIGHTS = {"geometry": (), "light transport": ("--detector", "single-photon", "--effects", "all")}


def document(*words: str | Path) -> dict[str, Any]:
    """The document that a command prints."""
    return run_process(lidardesign(*words, "--json")).document()


def measured(title: str, options: Any) -> dict[str, Any]:
    """What `evaluate` prints of all designs and seeds; made where it is missing."""
    one, place = EXPERIMENTS[title], options.folder / title
    kept = options.folder / f"{title}.{options.seeds}.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    runs, names = [place / str(seed) for seed in range(options.seeds)], [f"s{count or 0}" for count in one.sensors]
    for seed, run in enumerate(runs):
        print(f"{title}, seed {seed}", file=sys.stderr, flush=True)
        if not (run / "samples.npz").exists():
            document("learn", one.task, "--preset", options.preset, "--seed", str(seed), "--out", run)
        for count, name in zip(one.sensors, names, strict=True):
            if not (run / "designs" / f"{name}.yaml").exists():
                document("fit", run, *(("--sensors", str(count)) if count else ()), "--name", name)
    words = [word for name in names for word in ("--designs", name)]
    words += [word for count in one.rays for word in ("--rays", str(count))]
    scenes = ("--scenes-seed", HELD_OUT_SEED, "--set", f"test={options.scenes}")
    found = document("evaluate", *runs, *words, *scenes)
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def emitters(options: Any) -> dict[str, Any]:
    """What `evaluate` prints of emitters at each placement, by geometry and by light transport; made where missing."""
    place, kept = options.folder / EMITTERS, options.folder / f"{EMITTERS}.{options.seeds}.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    runs = [place / str(seed) for seed in range(options.seeds)]
    names = {title: title.replace(" ", "-") for title in PLACEMENTS}
    for seed, run in enumerate(runs):
        print(f"{EMITTERS}, seed {seed}", file=sys.stderr, flush=True)
        if not (run / "samples.npz").exists():
            document("learn", "emitter", "--preset", options.preset, "--seed", str(seed), "--out", run)
        for title, rules in PLACEMENTS.items():
            if not (run / "designs" / f"{names[title]}.yaml").exists():
                file = options.folder / f"{names[title]}.yaml"
                file.write_text(json.dumps(rules), encoding="utf-8")
                words = ("--rays", str(EMITTER_RAYS), "--name", names[title])
                document("constrain", run, "--constraints", file, *words)
    words = ("--rays", str(EMITTER_RAYS), "--scenes-seed", HELD_OUT_SEED, "--set", "test=20", "--baseline", "none")
    found = {light: document("evaluate", *runs, *words, *choice) for light, choice in LIGHTS.items()}
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def emitter_rows(found: Mapping[str, Any]) -> list[list[object]]:
    """One row per placement with its scores by geometry and by light transport."""
    rows = []
    for title in PLACEMENTS:
        by_light = [
            next(row for row in one["rows"] if row["design"] == title.replace(" ", "-")) for one in found.values()
        ]
        cells = [f"{row['value']:.3g} ({row['ci_low']:.3g} to {row['ci_high']:.3g})" for row in by_light]
        rows.append([title, *cells])
    return rows


def bins(mbps: float, rays: int) -> float:
    """Bins per ray of a bandwidth [Mbit/s]."""
    return 1e6 * mbps / (rays * BITS_PER_S)


def rows_of(title: str, found: Mapping[str, Any]) -> list[list[object]]:
    """One row per design and for uniform rays, with figures at all numbers of rays and the paper's bandwidth."""
    one, rows = EXPERIMENTS[title], []
    by_name = {(row["design"], row["rays"]): row for row in found["rows"]}
    theirs: dict[str, Sequence[float]] = {f"s{count or 0}": mbps for count, mbps in one.paper_mbps.items()}
    for name, mbps in {**theirs, "uniform": one.uniform_mbps}.items():
        own = [by_name[name, rays] for rays in one.rays]
        middle = own[len(own) // 2]
        called = f"{name[1:]} sensors" if re.fullmatch(r"s[1-9]\d*", name) else name if name != "s0" else "design"
        figures = [
            [row["value"] for row in own],
            [row["bandwidth_mbps"] for row in own],
            [bins(row["bandwidth_mbps"], row["rays"]) for row in own],
            list(mbps),
            [bins(value, rays) for value, rays in zip(mbps, one.rays, strict=True)],
        ]
        score, *others = (", ".join(f"{value:.3g}" for value in values) for values in figures)
        rows.append([called, score, f"{middle['ci_low']:.3g} to {middle['ci_high']:.3g}", *others])
    return rows


def main() -> None:
    """Measure what is missing, and print or write everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--seeds", type=int, default=5, help="how many runs are learned (default %(default)s)")
    made.add_argument("--scenes", type=int, default=50, help="held-out scenes (default %(default)s)")
    made.add_argument("--preset", default="draft", help="of learning (default %(default)s)")
    made.add_argument("--only", action="append", choices=[*EXPERIMENTS, EMITTERS], help="only this one; repeatable")
    made.add_argument("--page", type=Path, help="a page whose tables between <!-- NAME --> marks are replaced")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    tables = {}
    for title in options.only or [*EXPERIMENTS, EMITTERS]:
        if title == EMITTERS:
            tables[title] = (["emitters", *(f"{light} [mm]" for light in LIGHTS)], emitter_rows(emitters(options)))
            continue
        found = measured(title, options)
        unit = found["metric"]["unit"]
        counts = EXPERIMENTS[title].rays
        score = f"score [{unit}] at {', '.join(map(str, counts))} rays"
        columns = ["", score, f"interval at {counts[1]}", "Mbit/s", "bins", "paper's Mbit/s", "its bins"]
        tables[title] = (columns, rows_of(title, found))
    if options.page is not None:
        text = options.page.read_text(encoding="utf-8")
        for title, (columns, rows) in tables.items():
            mark = f"<!-- {title} -->"
            before, _, after = text.split(mark)
            text = f"{before}{mark}\n\n{table(columns, rows)}\n\n{mark}{after}"
        options.page.write_text(text, encoding="utf-8")
    report("The paper's experiments", tables, path=options.json)


if __name__ == "__main__":
    without_traceback(main)
