"""The whole way of a user, command by command: learn, fit, constrain, evaluate with a report, export.

Every command is a process of its own, and is timed from outside. Distance fields are always built. A command that had
to compile loops is run again: the first time is the cold one, the second counts. With `--before`, another checkout does
the same, command by command in turn, so that a machine that slows down slows both; ratios are medians over seeds, and
beside them stands how good densities and designs are, and what of it is the same bit by bit. What is in the folder is
not measured again.

    python benchmarks/journey.py --folder journey                              # some 20 minutes
    python benchmarks/journey.py --folder journey --before ../before --seeds 5
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from common import ARM_MODEL, FACE_MODEL, ROOT, parser, report, run_process, verdict

NOW, BEFORE = "now", "before"
SUMS = ("wall_s", "cpu_s")
# By how much a score may be worse, and time and memory be more.
TOLERATED_SCORE, TOLERATED_TIME, TOLERATED_MEMORY = 1.01, 1.05, 1.05
ROBOT = """<mujoco><worldbody><geom type="plane" size="3 3 .1"/>
<body pos="0 0 .4"><geom type="cylinder" size=".15 .38"/>
<body pos=".2 0 .3"><joint axis="0 1 0" range="-60 60"/><geom type="capsule" size=".04" fromto="0 0 0 .35 0 0"/>
<body pos=".35 0 0"><joint axis="0 0 1" range="-100 100"/><geom type="capsule" size=".035" fromto="0 0 0 .3 0 0"/>
<body name="hand" pos=".36 0 0"><geom type="ellipsoid" size=".06 .05 .03"/></body></body></body></body></worldbody>
</mujoco>"""


def bottles(folder: Path) -> list[str]:
    """Keys of the task for eight bottles of stl files, in millimetres, as in the tutorial."""
    import trimesh

    place = folder / "bottles"
    place.mkdir(exist_ok=True)
    for number, factor in enumerate(np.linspace(0.8, 1.2, 8)):
        profile = np.array([[0, 0], [35, 0], [35, 120], [12, 170], [12, 200], [0, 200]]) * [factor, 1.0]
        trimesh.creation.revolve(profile, sections=48).export(place / f"{number}.stl")
    return [f"folder={place}", "scale=0.001"]


def robot(folder: Path) -> list[str]:
    """Keys of the task for the last link of a real arm, or for the hand of a small one where that is not there."""
    if ARM_MODEL.exists():
        return [f"model={ARM_MODEL}", "targets=[link7]"]
    (folder / "robot.xml").write_text(ROBOT, encoding="utf-8")
    return [f"model={folder / 'robot.xml'}", "targets=[hand]"]


@dataclass(frozen=True)
class Journey:
    """What is designed for.

    Arguments:
        task, preset: Of `learn`.
        settings: Makes the keys of the task, and the files that they name in a folder.
        place: Words of `export` where rays differ from place to place.
    """

    task: str
    preset: str = "draft"
    settings: Callable[[Path], list[str]] = lambda _: []
    place: tuple[str, ...] = ()


JOURNEYS = {
    "face": Journey("face"),
    "own meshes": Journey("meshes", settings=bottles),
    "arm": Journey("arm"),
    "robot": Journey("mujoco", settings=robot),
    "aisle": Journey("warehouse", place=("--at", "x_m=1")),
}
if FACE_MODEL.exists():
    JOURNEYS["head model"] = Journey("face", "standard", lambda _: [f"model={FACE_MODEL}"])


def commands(journey: Journey, folder: Path, here: Path, seed: int, settings: list[str]) -> dict[str, list[str | Path]]:
    """The words of every command by its name."""
    run, rays = here / "run", here / "rays.csv"
    keys = [word for key in [*journey.settings(folder), *settings] for word in ("--set", key)]
    narrow = ["constrain", run, "--set", "field_of_view.horizontal_deg.max=60"]
    return {
        "learn": ["learn", journey.task, "--preset", journey.preset, "--seed", str(seed), "--out", run, *keys],
        "fit": ["fit", run],
        "constrain": [*narrow, "--sensors", "2", "--name", "narrow"],
        "constrain, even rays": [*narrow, "--layout", "even", "--sensors", "2", "--name", "even"],
        "evaluate": ["evaluate", run, "--report", here / "report.html"],
        "export": ["export", run / "designs" / "narrow.yaml", *journey.place, "--format", "csv", "--out", rays],
    }


def measured(root: Path, words: list[str | Path], here: Path, caches: Path) -> dict[str, Any]:
    """Time, memory and figures of a command of a checkout; run again where it had to compile, with its cold time."""
    environment = {
        "PYTHONPATH": os.pathsep.join(map(str, (root, root / "tasks"))),
        "NUMBA_CACHE_DIR": str(caches),
        "LIDARDESIGN_CACHE": str(here / "fields"),
        # what is installed has its bytecode beside it
        "PYTHONDONTWRITEBYTECODE": "",
        "PYTHONPYCACHEPREFIX": str(caches / "bytecode"),
    }
    cold_s = None
    while True:
        before = len([*caches.rglob("*.nbi")])
        if words[0] == "learn":
            shutil.rmtree(here, ignore_errors=True)
            here.mkdir(parents=True)
        done = run_process([sys.executable, "-P", "-m", "lidardesign", *words, "--json"], environment)
        document = done.document()
        if len([*caches.rglob("*.nbi")]) == before or cold_s is not None:
            found = {"wall_s": done.wall, "cpu_s": done.cpu, "mib": done.peak_mib, "cold_s": cold_s}
            return found | figures(document) | {"digest": digest(words, document)}
        cold_s = done.wall


def digest(words: list[str | Path], document: dict[str, Any]) -> str | None:
    """A hash of the design, the scores or the rays that a command made, without times, paths and versions."""
    if words[0] in ("fit", "constrain"):
        design = yaml.safe_load(Path(document["design"]).read_text(encoding="utf-8"))
        made: object = {key: value for key, value in design.items() if key != "provenance"}
    elif words[0] == "evaluate":
        made = [{key: value for key, value in row.items() if key != "seconds"} for row in document["rows"]]
    elif words[0] == "export":
        made = Path(words[-1]).read_text(encoding="utf-8")
    else:
        return None
    return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()


def figures(document: dict[str, Any]) -> dict[str, float]:
    """How good a density is, or the fitted design at the middle number of rays, by what a command prints."""
    if "misplaced" in document:
        return {"misplaced": document["misplaced"]}
    rows = {row["rays"]: row["value"] for row in document.get("rows", []) if row["design"] == "fit"}
    if not rows:
        return {}
    better = -1 if document["metric"]["better"] == "higher" else 1
    return {"score": rows[sorted(rows)[len(rows) // 2]], "better": better}


def travelled(options: Any, roots: dict[str, Path]) -> Iterator[tuple[str, str, int, str, dict[str, Any]]]:
    """What each command took: journey, command, seed, checkout and what was measured, kept where it was once."""
    for seed in range(options.seeds):
        for title in options.only or JOURNEYS:
            kept = {label: options.folder / label / f"{title.replace(' ', '-')}-{seed}" for label in roots}
            words = {
                label: commands(JOURNEYS[title], options.folder, here / "made", seed, options.set)
                for label, here in kept.items()
            }
            for command in words[NOW]:
                for label, here in kept.items():
                    file = here / f"{command}.json"
                    if not file.exists():
                        found = measured(roots[label], words[label][command], here / "made", options.folder / label)
                        file.write_text(json.dumps(found), encoding="utf-8")
                    yield title, command, seed, label, json.loads(file.read_text(encoding="utf-8"))


def median(values: list[Any]) -> Any:
    """The median of what is there; nothing where nothing is."""
    there = [value for value in values if value is not None]
    return statistics.median(there) if there else ""


def same_bits(found: dict[tuple[str, str], dict[str, list[dict[str, Any]]]]) -> dict[str, bool]:
    """Commands of each journey, and whether both checkouts made the same with every seed."""
    return {
        f"{title}, {command}": [one["digest"] for one in taken[NOW]] == [one["digest"] for one in taken[BEFORE]]
        for (title, command), taken in found.items()
        if taken[NOW][0]["digest"] is not None
    }


def time_rows(found: dict[tuple[str, str], dict[str, list[dict[str, Any]]]], pairs: bool) -> list[list[object]]:
    """A row for every command of every journey, and one for each journey whole."""
    rows = []
    for title in dict.fromkeys(title for title, _ in found):
        own = {command: taken for (name, command), taken in found.items() if name == title}
        whole = {
            label: [
                {
                    **{key: math.fsum(one[key] for one in ones) for key in SUMS},
                    "mib": max(one["mib"] for one in ones),
                    "cold_s": None,
                }
                for ones in zip(*(taken[label] for taken in own.values()), strict=True)
            ]
            for label in next(iter(own.values()))
        }
        for command, taken in {**own, "all": whole}.items():
            row = [title, command, *(median([one[key] for one in taken[NOW]]) for key in (*SUMS, "mib", "cold_s"))]
            if pairs:
                together = list(zip(taken[NOW], taken[BEFORE], strict=True))
                row += [median([one[key] for one in taken[BEFORE]]) for key in ("cpu_s", "mib")]
                row.append(median([now["cpu_s"] / before["cpu_s"] for now, before in together]))
            rows.append(row)
    return rows


def quality_rows(found: dict[tuple[str, str], dict[str, list[dict[str, Any]]]], pairs: bool) -> list[list[object]]:
    """A row for each journey: how good its density and its fitted design are, and by what factor the score is worse."""
    rows = []
    for title in dict.fromkeys(title for title, _ in found):
        learned, scored = found[title, "learn"], found[title, "evaluate"]
        row: list[object] = [title]
        for label in (NOW, BEFORE) if pairs else (NOW,):
            row += [
                median([one["misplaced"] for one in learned[label]]),
                median([one["score"] for one in scored[label]]),
            ]
        if pairs:
            both = zip(scored[NOW], scored[BEFORE], strict=True)
            row.append(median([(now["score"] / before["score"]) ** now["better"] for now, before in both]))
        rows.append(row)
    return rows


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    made.add_argument("--before", type=Path, help="another checkout, to be compared with")
    made.add_argument("--seeds", type=int, default=1, help="(default %(default)s)")
    made.add_argument("--only", action="append", choices=list(JOURNEYS), help="only this journey; repeatable")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    options = made.parse_args()
    options.folder = options.folder.resolve()
    options.folder.mkdir(parents=True, exist_ok=True)
    roots = {NOW: ROOT} | ({} if options.before is None else {BEFORE: options.before.resolve()})
    pairs, found = len(roots) > 1, {}
    for title, command, seed, label, one in travelled(options, roots):
        took = f"{one['wall_s']:.1f} s, CPU {one['cpu_s']:.1f} s"
        print(f"{title}, {command}, seed {seed}, {label}: {took}", file=sys.stderr)
        found.setdefault((title, command), {}).setdefault(label, []).append(one)
    times, quality = time_rows(found, pairs), quality_rows(found, pairs)
    lines = []
    if pairs:
        whole = {row[0]: row for row in times if row[1] == "all"}
        lines = [
            verdict("no slower", {f"{row[0]}, {row[1]}": row[-1] <= TOLERATED_TIME for row in times}),
            verdict("no more memory", {title: row[4] <= TOLERATED_MEMORY * row[7] for title, row in whole.items()}),
            verdict("scores within 1 %", {str(row[0]): row[-1] <= TOLERATED_SCORE for row in quality}),
            verdict("the same bits", same_bits(found)),
        ]
    taken = ["journey", "command", "wall s", "CPU s", "peak MiB", "cold s"]
    judged = ["journey", "misplaced", "score"]
    if pairs:
        taken += ["before: CPU s", "before: MiB", "CPU / before"]
        judged += ["before: misplaced", "before: score", "worse by"]
    tables = {f"Medians over {options.seeds} seeds": (taken, times), "How good it is": (judged, quality)}
    report("The whole way of a user", tables, lines, options.json)


if __name__ == "__main__":
    main()
