"""Patterns that follow what they see against the best single pattern, in equal rays and bandwidth, on held-out scenes.

For each seed a draft is learned and one design with `--adaptive` fitted, whose best single pattern is scored beside it,
in an ideal world and with single photons. What was measured is kept in the folder.

    python benchmarks/adaptive.py --folder adaptive [--seeds 5] [--only faces]
"""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines import told
from common import ARM_MODEL, face_settings, lidardesign, parser, report, run_process, without_traceback
from returns import humanoid_settings

HELD_OUT_SEED = "2031"  # nothing was tried on its scenes
DETECTORS = {"ideal": (), "0 klux": ("--detector", "single-photon", "--set", "illuminance_lux=0")}
DETECTORS |= {"100 klux": ("--detector", "single-photon", "--set", "illuminance_lux=100000", "--set", "light=sun")}


@dataclass(frozen=True)
class Case:
    """What is designed for: task, settings, numbers of rays, words of `fit`, and scenes that detectors are tried in."""

    task: str
    settings: tuple[str, ...]
    rays: tuple[int, ...]
    words: tuple[str, ...] = ("--sensors", "4", "--adaptive", "8")
    lit_scenes: int = 0


def cases() -> dict[str, Case]:
    """By title."""
    fine = ("--sensors", "4", "--gates", "ray", "--adaptive", "8")
    model = tuple(f"{key}={value}" for key, value in face_settings("ict").items())
    found = {
        "faces": Case("face", (), (361,), fine, lit_scenes=100),
        "faces, a gate per sensor": Case("face", (), (196,)),
        "heads held less still": Case("face", ("jitter_translation_m=0.03", "jitter_rotation_deg=12"), (361,), fine),
        "arm": Case("arm", (), (100, 400), ("--sensors", "4", "--adaptive", "16"), lit_scenes=20),
        "head model": Case("face", model, (361,), fine),
    }
    links = f"folder={ARM_MODEL.parent / 'assets'}"
    if ARM_MODEL.exists():
        found["meshes of a robot's links"] = Case("meshes", (links, "poses=40"), (100,))
        found["piles of four links"] = Case("meshes", (links, "poses=40", "clutter=4"), (100,))
    humanoid = humanoid_settings()
    if humanoid is not None:
        keys = tuple(f"{k}={json.dumps(v) if isinstance(v, list) else v}" for k, v in humanoid.items() if k != "metric")
        found["humanoid"] = Case("mujoco", (*keys, "metric=position"), (100,))
    return found


def document(*words: str | Path) -> dict[str, Any]:
    """The document that a command prints."""
    return run_process(lidardesign(*words, "--json")).document()


def measured(title: str, options: Any) -> list[dict[str, Any]]:
    """What `evaluate` prints for each number of rays and detector; made where it is missing."""
    case, place = cases()[title], options.folder / re.sub("[^a-z]+", "-", title)
    kept = place.with_suffix(f".{options.seeds}.json")
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    runs, found = [place / str(seed) for seed in range(options.seeds)], []
    for seed, run in enumerate(runs):
        print(f"{title}, seed {seed}", file=sys.stderr, flush=True)
        if not (run / "samples.npz").exists():
            words = [word for key in case.settings for word in ("--set", key)]
            document("learn", case.task, "--preset", "draft", "--seed", str(seed), "--out", run, *words)
        for rays in case.rays:
            if not (run / "designs" / f"a{rays}.yaml").exists():
                document("fit", run, *case.words, "--rays", str(rays), "--name", f"a{rays}")
    for rays in case.rays:
        for light, words in DETECTORS.items() if case.lit_scenes else [("ideal", ())]:
            scenes = 100 if light == "ideal" else case.lit_scenes
            which = ("--designs", f"a{rays}", "--rays", str(rays), "--scenes-seed", HELD_OUT_SEED, "--baseline", "none")
            shown = ("--set", "poses=20" if case.task == "meshes" else f"test={scenes}")  # of six or seven links
            scores = document("evaluate", *runs, *which, *shown, *words)
            found.append({"rays": rays, "light": light, **scores})
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--seeds", type=int, default=5, help="how many runs are learned (default %(default)s)")
    made.add_argument("--only", action="append", choices=list(cases()), help="only this case; repeatable")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows: list[list[object]] = []
    for title in options.only or cases():
        for found in measured(title, options):
            by_name, metric = {row["design"]: row for row in found["rows"]}, found["metric"]
            name = f"a{found['rays']}"
            one, single = by_name[name], by_name.get(f"{name}-single")
            row = [title, found["rays"], found["light"], metric["unit"], one["value"]]
            if single is None:
                rows.append([*row, "", "one pattern", one["bandwidth_mbps"], ""])
                continue
            pair = next(pair for pair in found["paired"] if pair["a"] == name)
            against = told(pair, metric["better"])
            rows.append([*row, single["value"], against, one["bandwidth_mbps"], single["bandwidth_mbps"]])
    columns = ["case", "rays", "light", "unit", "adaptive", "single", "against single, %", "Mbit/s", "single Mbit/s"]
    report("Patterns that follow what they see", {"Equal rays": (columns, rows)}, path=options.json)


if __name__ == "__main__":
    without_traceback(main)
