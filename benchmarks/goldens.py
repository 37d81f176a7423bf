"""Designs of this checkout beside those of another, at equal rays and equal bandwidth, from the same learned runs.

The other checkout learns every run and makes its designs; this one makes them again from a copy of the run, within the
bandwidth that the other's take. Both are scored in the same held-out scenes, whose seed nothing was chosen on. Where
origins are free, designs whose rays start all over regions stand beside those that stand at one place each. What is in
the folder is not made again.

    python benchmarks/goldens.py --folder goldens --before ../before [--only faces]
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from common import ARM_MODEL, FACE_MODEL, ROOT, parser, report, run_process, verdict
from returns import humanoid_settings

HELD_OUT_SEED = "2026"
REGION = "origin.spread_m.max=10"
TOLERATED = {"arm": 1.02, "aisle": 1.02}


@dataclass(frozen=True)
class Case:
    """What is designed for.

    Arguments:
        task, preset, settings: Of `learn`.
        rays: A number of rays, and words of `constrain` beside it.
        seeds: How many runs are learned.
        words: Of every `constrain`.
        is_free: Whether origins are free.
    """

    task: str
    preset: str
    settings: Mapping[str, Any]
    rays: Sequence[int]
    seeds: int
    words: Sequence[str] = ("--sensors", "4")
    is_free: bool = False


def cases() -> dict[str, Case]:
    """By title; those whose models are not here are left out."""
    found = {
        "faces": Case("face", "draft", {}, (196, 361), 3),
        "arm": Case("arm", "draft", {}, (400, 1000), 5, is_free=True),
        "aisle": Case("warehouse", "draft", {}, (12, 18), 5),
    }
    if FACE_MODEL.exists():
        found["head model"] = Case("face", "standard", {"model": FACE_MODEL}, (196, 361), 3)
    box = {"origin_box_m": 0.3, "metric": "seen"}
    if ARM_MODEL.exists():
        settings = {"model": ARM_MODEL, "targets": ["link7"], **box}
        found["7-axis arm"] = Case("mujoco", "draft", settings, (64, 196), 3, is_free=True)
    if (settings := humanoid_settings()) is not None:
        found["humanoid"] = Case("mujoco", "draft", settings, (64, 196), 3, is_free=True)
    return found


def command(root: Path, caches: Path, *words: object) -> dict[str, Any]:
    """The document that a command of a checkout prints."""
    environment = {
        "PYTHONPATH": os.pathsep.join(map(str, (root, root / "tasks"))),
        "NUMBA_CACHE_DIR": str(caches / "numba"),
        "LIDARDESIGN_CACHE": str(caches / "fields"),
        "PYTHONPYCACHEPREFIX": str(caches / "bytecode"),
    }
    return run_process([sys.executable, "-P", "-m", "lidardesign", *words, "--json"], environment).document()


def setting_words(settings: Mapping[str, Any]) -> list[str]:
    """Settings as `--set KEY=VALUE`."""
    texts = {key: json.dumps(value) if isinstance(value, list) else str(value) for key, value in settings.items()}
    return [word for key, text in texts.items() for word in ("--set", f"{key}={text}")]


def scored(root: Path, caches: Path, run: Path, names: Sequence[str], rays: int) -> dict[str, dict[str, Any]]:
    """Value and bandwidth of designs by name."""
    designs = [word for name in names for word in ("--designs", name)]
    words = ("--rays", rays, "--scenes-seed", HELD_OUT_SEED, "--baseline", "none")
    found = command(root, caches, "evaluate", run, *designs, *words)
    return {row["design"]: {"value": row["value"], "mbps": row["bandwidth_mbps"]} for row in found["rows"]}


def measured(title: str, seed: int, before: Path, folder: Path) -> list[dict[str, Any]]:
    """What both checkouts make of a run, one entry per number of rays; kept once it is there."""
    place = folder / f"{title.replace(' ', '-')}-{seed}"
    kept = place.with_suffix(".json")
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    case, old, new = cases()[title], place / "before", place / "now"
    caches = {before: folder / "before", ROOT: folder / "now"}
    shutil.rmtree(place, ignore_errors=True)
    learn = ("learn", case.task, "--preset", case.preset, "--seed", seed, "--out", old)
    learned = command(before, caches[before], *learn, *setting_words(case.settings))
    shutil.copytree(old, new)
    found = []
    for rays in case.rays:
        words = (*case.words, "--rays", rays)
        command(before, caches[before], "constrain", old, *words, "--name", f"free-{rays}")
        limit = scored(before, caches[before], old, [f"free-{rays}"], rays)[f"free-{rays}"]["mbps"]
        within = (*words, "--set", f"budget.bandwidth_mbps={limit * (1 + 1e-9)}")
        command(before, caches[before], "constrain", old, *within, "--name", f"before-{rays}")
        entry: dict[str, Any] = {"rays": rays, "mbps": limit, "verdict": learned["verdict"]}
        entry |= {"before": scored(before, caches[before], old, [f"before-{rays}"], rays)[f"before-{rays}"]}
        entry["before"]["gap"] = gap_of(old, f"before-{rays}")
        variants = {"now": (), "region": ("--set", REGION)} if case.is_free else {"now": ()}
        for label, more in variants.items():
            command(ROOT, caches[ROOT], "constrain", new, *within, *more, "--name", f"{label}-{rays}")
            entry[label] = scored(ROOT, caches[ROOT], new, [f"{label}-{rays}"], rays)[f"{label}-{rays}"]
            entry[label]["gap"] = gap_of(new, f"{label}-{rays}")
        found.append(entry)
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def gap_of(run: Path, name: str) -> float | None:
    """By how much any other choice of rays could lose less, relative."""
    design = yaml.safe_load((run / "designs" / f"{name}.yaml").read_text(encoding="utf-8"))
    entries = design.get("certificates") or design["provenance"].get("certificates") or [{}]
    return entries[-1].get("gap")


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--before", type=Path, required=True, help="another checkout")
    made.add_argument("--only", action="append", choices=list(cases()), help="only this case; repeatable")
    options = made.parse_args()
    options.folder = options.folder.resolve()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows, held = [], {}
    for title in options.only or cases():
        case = cases()[title]
        better = "higher" if case.settings.get("metric") == "seen" else "lower"
        each = []
        for seed in range(case.seeds):
            print(f"{title}, seed {seed}", file=sys.stderr, flush=True)
            each.append(measured(title, seed, options.before.resolve(), options.folder))
        for number, rays in enumerate(case.rays):
            entries = [one[number] for one in each]
            for label in ("region", "now") if case.is_free else ("now",):
                sign = 1.0 if better == "lower" else -1.0
                ratios = np.exp(sign * np.log([one[label]["value"] / one["before"]["value"] for one in entries]))
                means = [float(np.mean([one[key]["value"] for one in entries])) for key in ("before", label)]
                gaps = [100 * float(np.mean([one[key]["gap"] for one in entries])) for key in ("before", label)]
                mean = float(np.exp(np.log(ratios).mean()))
                span = f"{mean:.3f} ({ratios.min():.3f} to {ratios.max():.3f})"
                mbps = float(np.mean([one["mbps"] for one in entries]))
                origins = ("one place" if label == "now" else "region") if case.is_free else "given"
                rows.append([title, rays, origins, mbps, *means, span, *gaps])
                if label == "region" or not case.is_free:
                    held[f"{title}, {rays} rays"] = mean <= TOLERATED.get(title, 1.01)
    names = ("case", "rays", "origins", "Mbit/s", "before", "now", "now / before (seeds)", "gap % before", "gap % now")
    line = verdict("no golden worse by more than 1 % in the mean (arm, aisle 2 %)", held)
    report("Designs of two checkouts", {"Equal rays, equal bandwidth": ([*names], rows)}, [line], options.json)


if __name__ == "__main__":
    main()
