"""Everything that this checkout prints and writes, compared with another's, from the same learned runs.

Both checkouts go through one table of commands, each in a folder of its own with copies of runs that the other checkout
learned once. Exit codes, what is printed and every file that is written have to be equal but for seconds, memory,
versions and paths. What is in the folder is not made again; an interpreter in `.venv` of a checkout is used for it.

    python benchmarks/unchanged.py --folder unchanged --before ../before [--only 'fit-*'] [--again]
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import fnmatch
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FEW = "--set learning.steps=60 --preset draft"
ROBOT = """<mujoco><worldbody>
<body name="arm" pos="0 0 0.3"><joint name="turn" axis="0 0 1" range="-1.5 1.5" limited="true"/>
<geom name="link" type="capsule" size="0.04" fromto="0 0 0 0.3 0 0"/>
<body name="hand" pos="0.35 0 0"><joint name="lift" axis="0 1 0" range="-1 1" limited="true"/>
<geom name="palm" type="box" size="0.06 0.04 0.03"/></body></body>
<geom name="floor" type="plane" size="2 2 0.1"/>
</worldbody></mujoco>
"""
MESH = """import trimesh
for number in range(4):
    trimesh.creation.box((0.2, 0.1 + 0.03 * number, 0.15)).export(f"boxes/box-{number}.ply")
"""
LIMITS = "field_of_view: {horizontal_deg: {max: 20}}\ngate: {width_m: {max: 0.4}}\n"
RUNS = {
    "flat": f"learn flatland {FEW}",
    "two": f"learn flatland --seed 1 {FEW}",
    "meshes": f"learn meshes --set folder=boxes {FEW}",
    "face": f"learn face --set train=8 --set test=6 {FEW}",
    "aisle": f"learn warehouse --set train=8 --set test=6 {FEW}",
    "arm": f"learn arm --set train=8 --set test=6 {FEW}",
    "emitter": f"learn emitter --set train=8 --set test=6 {FEW}",
    "robot": f"learn mujoco --set model=robot.xml --set targets=[hand] --set train=8 --set test=6 {FEW}",
}
BASELINES = "--baseline lloyd --baseline occupancy --baseline no-visibility"
DESIGNS = {
    "fit-flat": "fit runs/flat --rays 16",
    "fit-two": "fit runs/two --rays 16",
    "fit-numbers": "fit runs/flat --name numbers --certify",
    "fit-even": "fit runs/flat --layout even --name even",
    "fit-even-best": "fit runs/face --layout even --name even",
    "fit-sensors": "fit runs/flat --sensors 2 --rays 12 --name pair",
    "fit-ray-gates": "fit runs/flat --gates ray --rays 16 --name gates",
    "fit-survive": "fit runs/flat --survive 1 --sensors 3 --rays 12 --name survive",
    "fit-adaptive": "fit runs/flat --adaptive 3 --rays 16 --name adaptive",
    "fit-goal": "fit runs/flat --goal 40 --name goal",
    "fit-goal-rays": "fit runs/flat --goal 40 --least rays --name fewest",
    "fit-goal-even": "fit runs/flat --goal 60 --layout even --least sensors --name cheap",
    "fit-weight": "fit runs/face --weight region_centre_m=[0,0,0] --weight region_radius_m=0.03 --rays 36 --name nose",
    "fit-face": "fit runs/face --rays 64",
    "fit-face-level": "fit runs/face --rays 64 --level 0.9 --seed 5 --name level",
    "fit-spinning": "fit runs/meshes --layout spinning --rays 64 --channels 4 --sensors 1 --name spinning",
    "fit-meshes": "fit runs/meshes --rays 36",
    "fit-parts": "fit runs/meshes --parts vl53l8cx,tmf8828 --sensors 2 --name parts",
    "fit-parts-table": "fit runs/meshes --parts vl53l8cx --sensors 1-2 --name table",
    "fit-parts-goal": "fit runs/meshes --parts vl53l8cx --goal 30 --least parts --name fewest-parts",
    "fit-modules": "fit runs/face --modules 2 --fov 45x45 --zones 8x8 --name modules",
    "fit-detector": "fit runs/face --rays 36 --sensors best --detector single-photon --name dark",
    "fit-set": "fit runs/face --rays 36 --set test=3 --set train=5 --name settings",
    "fit-aisle": "fit runs/aisle --rays 12",
    "fit-aisle-at": "fit runs/aisle --rays 12 --at x_m=0.37 --name place",
    "fit-aisle-even": "fit runs/aisle --layout even --rays 12 --name even",
    "fit-aisle-gates": "fit runs/aisle --rays 12 --gates sensor --name one-gate",
    "fit-arm": "fit runs/arm --rays 36 --sensors 2",
    "fit-arm-even": "fit runs/arm --rays 36 --layout even --sensors 2 --name even",
    "fit-arm-like": "fit runs/arm --like runs/arm/designs/even.yaml --name like",
    "fit-emitter": "fit runs/emitter --rays 36 --sensors 2",
    "fit-robot": "fit runs/robot --rays 36 --sensors 2",
    "constrain-flat": "constrain runs/flat --constraints limits.yaml --rays 16",
    "constrain-set": "constrain runs/flat --set gate.width_m.max=0.3 --set sensors.max=2 --rays 16 --name narrow",
    "constrain-budget": "constrain runs/face --set budget.bandwidth_mbps=0.3 --name budget",
    "constrain-design": "constrain runs/face/designs/fit.yaml --set field_of_view.horizontal_deg.max=15 --name again",
    "constrain-even": "constrain runs/face --layout even --constraints limits.yaml --name even-limits",
    "constrain-arm": "constrain runs/arm --set origin.spread_m.max=10 --rays 36 --name region",
    "constrain-impossible": "constrain runs/flat --set gate.width_m.max=0.0000001 --name impossible",
    "constrain-few": "constrain runs/face --set budget.bandwidth_mbps=0.000001 --name too-few",
}
SCORES = {
    "evaluate-flat": f"evaluate runs/flat --json {BASELINES} --losses --csv flat.csv",
    "evaluate-text": "evaluate runs/flat --designs fit -v",
    "evaluate-seeds": "evaluate runs/flat runs/two --json --designs fit",
    "evaluate-face": f"evaluate runs/face --json {BASELINES}",
    "evaluate-dark": f"evaluate runs/face --designs fit --designs modules --json --detector single-photon {BASELINES}",
    "evaluate-audit": "evaluate runs/face --designs fit --json --effects audit --rays 64",
    "evaluate-set": "evaluate runs/face --designs fit --json --set illuminance_lux=10000 --set test=4 --rays 64",
    "evaluate-scenes": "evaluate runs/face --designs fit --json --seed 3 --scenes-seed 9 --rays 64 --fail-above 100",
    "evaluate-mounting": "evaluate runs/face --designs fit --json --mount-error 5mm,0.5deg --rays 64",
    "evaluate-better": "evaluate runs/face --designs fit --json --fail-unless-better greedy --rays 64",
    "evaluate-meshes": f"evaluate runs/meshes --json {BASELINES} --report meshes.html",
    "evaluate-aisle": f"evaluate runs/aisle --json {BASELINES}",
    "evaluate-arm": f"evaluate runs/arm --json {BASELINES}",
    "evaluate-emitter": f"evaluate runs/emitter --json {BASELINES}",
    "evaluate-robot": f"evaluate runs/robot --json {BASELINES} --workers 2",
    "evaluate-report": "evaluate runs/face --designs fit --designs even --rays 64 --report face.html",
    "evaluate-rig": "evaluate flat.rays.csv --in runs/flat --json --baseline none",
    "simulate-face": "simulate runs/face/designs/fit.yaml --out cloud --rays 64",
    "simulate-dark": "simulate runs/meshes/designs/parts.yaml --out parts --detector single-photon --format pcd",
    "compare": "show runs/face --json",
    "show-design": "show runs/face/designs/fit.yaml --json",
    "show-parts": "show runs/meshes/designs/parts.yaml",
}
FORMATS = (
    "csv", "npz", "sensors-csv", "galvo", "mjcf", "sdf", "urdf", "xacro", "carla", "isaac-usd", "helios", "osi", "rgl",
    "mitsuba", "mounts", "ply", "stl",
)  # fmt: skip
EXPORTS = {
    f"export-{title}-{name}": f"export runs/{path} --format {name} --out {title}.{name} {words}"
    for title, path, words in (
        ("arm", "arm/designs/fit.yaml", ""),
        ("gates", "flat/designs/gates.yaml", ""),
        ("parts", "meshes/designs/parts.yaml", ""),
        ("aisle", "aisle/designs/even.yaml", "--rays 9 --at x_m=0.4"),
        ("follow", "flat/designs/adaptive.yaml", ""),
    )
    for name in FORMATS
}
COMMANDS = ("learn", "fit", "constrain", "evaluate", "export", "simulate", "show", "studio", "capture")
HELP = {"help": "--help", **{f"help-{name}": f"{name} --help" for name in COMMANDS}}
MISTAKES = {
    f"mistake-{number}": line
    for number, line in enumerate(
        """fit nowhere
fit runs/flat --layout round
fit runs/flat --layout even --gates ray
fit runs/flat --layout even --survive 1
fit runs/flat --rays 0
fit runs/flat --rays 1_0
fit runs/flat --sensors none
fit runs/flat --sensors 1-4
fit runs/flat --channels 3
fit runs/flat --channels 100000 --layout spinning
fit runs/flat --gates all
fit runs/flat --level 2
fit runs/flat --level much
fit runs/flat --at x_m
fit runs/flat --at x_m=1 --at x_m=2
fit runs/aisle --at x_m=1e9
fit runs/flat --weight unknown=1
fit runs/flat --parts nothing
fit runs/flat --parts a,,b
fit runs/flat --modules 2
fit runs/flat --name .hidden
fit runs/flat --name a/b
fit runs/flat --seed -1
fit runs/flat --detector none
fit runs/flat --set unknown=2
fit runs/flat --survive 2
fit runs/flat --goal -5
fit runs/flat --goal x
fit runs/flat --least rays
fit runs/flat --goal 5 --least parts
fit runs/flat --adaptive 0
fit runs/flat --adaptive 100
fit runs/flat --adaptive 2 --survive 1
fit runs/flat --workers many
fit runs/flat --like nothing.csv
fit runs/arm --layout spinning --sensors best
fit runs/meshes --layout spinning --goal 5
constrain runs/flat --set gate.width_m.max=-1
constrain runs/flat --set unknown.key=1
constrain runs/flat --constraints nothing.yaml
constrain nowhere.yaml
evaluate runs/flat --baseline best
evaluate runs/flat --rays 0
evaluate runs/flat --rays 7
evaluate runs/flat --designs nothing
evaluate runs/flat --cma-seconds 5
evaluate runs/flat --cma-seconds 0 --baseline cma
evaluate runs/flat --effects some
evaluate runs/flat --detector none
evaluate runs/flat --range-tolerance-mm -1
evaluate runs/flat --return-tolerance 2
evaluate runs/flat --set x_m=3
evaluate runs/flat --fail-above nan
evaluate runs/flat --fail-unless-better best
evaluate runs/flat --mount-error 5
evaluate runs/flat --seed 99999999999999999999
evaluate runs/flat runs/face
evaluate nothing.yaml
evaluate
export runs/flat/designs/fit.yaml --format best
export runs/flat/designs/fit.yaml
export runs/flat/designs/fit.yaml --format csv --rays 7
export runs/flat/designs/fit.yaml --format csv --rate-hz 10
export runs/flat/designs/fit.yaml --format mjcf --rate-hz 0
export --list --json
export --list
simulate runs/flat --out out
learn nothing
learn flatland --preset quick
learn flatland --set unknown=1
learn flatland --seed -1
learn flatland --tolerance 2
learn flatland --device tpu
learn flatland --out runs/flat
show nothing
capture nothing
tasks show nothing""".splitlines()
    )
}
STEPS = {**DESIGNS, "export-rays": "export runs/flat/designs/fit.yaml --format csv --out flat.rays.csv"}
STEPS |= {**EXPORTS, **SCORES, **HELP, **MISTAKES}

# Parts of keys of documents whose values differ from one time to the next
TIMED = (
    "seconds", "timings", "memory", "mib", "version", "created", "machine", "platform", "rays_per_s", "cpu", "time",
)  # fmt: skip
TIMES = re.compile(
    r"\b\d[\d,.]*(e-?\d+)? ?(s|ms|us|min|h|MiB|GiB|kB|MB|M? ?rays/s)\b|\d+:\d\d(:\d\d)?|20\d\d-\d\d-\d\d"
)


def python_of(checkout: Path) -> Path:
    """The interpreter of a checkout's own environment, if it has one."""
    own = checkout / ".venv" / "bin" / "python"
    return own if own.exists() else Path(sys.executable)


def call(checkout: Path, place: Path, words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of a checkout in a folder."""
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("PYTHON")},
        "COLUMNS": "120", "LC_ALL": "C.UTF-8", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        "LIDARDESIGN_CACHE": str(place / "cache"), "LIDARDESIGN_COMMAND": "lidardesign",
    }  # fmt: skip
    program = [python_of(checkout), "-P", "-m", "lidardesign", *shlex.split(words)]
    return subprocess.run(program, cwd=place, env=environment, capture_output=True, text=True, stdin=subprocess.DEVNULL)


def prepare(place: Path) -> None:
    """Write what commands read."""
    place.mkdir(parents=True)
    (place / "boxes").mkdir()
    (place / "robot.xml").write_text(ROBOT, encoding="utf-8")
    (place / "limits.yaml").write_text(LIMITS, encoding="utf-8")
    subprocess.run([sys.executable, "-c", MESH], cwd=place, check=True)


def learned(folder: Path, before: Path) -> Path:
    """The folder with the runs of the other checkout, learned where they are not there."""
    place = folder / "learned"
    if not place.exists():
        prepare(place)
    for name, words in RUNS.items():
        if not (place / "runs" / name / "samples.npz").exists():
            done = call(before, place, f"{words} --out runs/{name}")
            print(f"learned {name}: {done.returncode}", file=sys.stderr, flush=True)
            if done.returncode:
                sys.exit(done.stderr)
    return place


def without_times(document: Any) -> Any:
    """A document without values that differ each time."""
    if isinstance(document, dict):
        kept = {key: each for key, each in document.items() if not any(part in str(key).lower() for part in TIMED)}
        return {key: without_times(each) for key, each in kept.items()}
    return [without_times(each) for each in document] if isinstance(document, list) else document


def comparable(text: str, place: Path) -> str:
    """A text without paths, times and versions."""
    for path, name in ((place, "PLACE"), (ROOT, "CHECKOUT")):
        text = text.replace(str(path), name)
    text = re.sub(r"/\S*/(?=docs\b)", "CHECKOUT/", text)
    return TIMES.sub("TIME", text)


def content(path: Path, place: Path) -> str:
    """A file as text that can be compared."""
    data = path.read_bytes()
    if path.suffix == ".npz" or b"\0" in data[:4096]:
        return hashlib.sha256(data).hexdigest()
    text = data.decode(errors="replace")
    if path.suffix == ".json":
        with contextlib.suppress(ValueError):
            return json.dumps(without_times(json.loads(text)), indent=1)
    lines = [line for line in text.splitlines() if not re.match(r"\s*['\"]?\w*(seconds|created|version|memory)", line)]
    return comparable("\n".join(lines), place)


def state(place: Path) -> dict[str, tuple[int, int]]:
    """What is in a folder, by size and time of change."""
    paths = (path for path in place.rglob("*") if path.is_file() and "cache" not in path.parts)
    return {str(path.relative_to(place)): (path.stat().st_size, path.stat().st_mtime_ns) for path in paths}


def results(checkout: Path, place: Path, source: Path, only: str, again: bool) -> Iterator[str]:
    """Go through the table; what is printed and written is kept, a file per command."""
    kept = place.with_name(f"{place.name}-results")
    kept.mkdir(exist_ok=True)
    if not place.exists():
        shutil.copytree(source, place)
    for name, words in STEPS.items():
        path = kept / f"{name}.txt"
        if not fnmatch.fnmatch(name, only) or (path.exists() and not again):
            continue
        earlier = state(place)
        done = call(checkout, place, words)
        printed = done.stdout
        if "--json" in words:
            with contextlib.suppress(ValueError):
                printed = json.dumps(without_times(json.loads(printed)), indent=1)
        text = f"$ {words}\nexit {done.returncode}\n{printed}\n{done.stderr}"
        written = [file for file, found in state(place).items() if earlier.get(file) != found]
        for file in sorted(file for file in written if not file.endswith("manifest.json")):
            text += f"\n--- {file}\n{content(place / file, place)}"
        path.write_text(comparable(text, place), encoding="utf-8")
        yield name


def main() -> None:
    """Make what is missing, compare all, and end with 1 where anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    parser.add_argument("--before", type=Path, required=True, help="another checkout")
    parser.add_argument("--only", default="*", help="only these commands, a pattern of their names")
    parser.add_argument("--again", action="store_true", help="make this checkout's once more")
    options = parser.parse_args()
    folder, before = options.folder.resolve(), options.before.resolve()
    source = learned(folder, before)
    places = {"before": before, "now": ROOT}

    def make(side: str) -> None:
        again = options.again and side == "now"
        for name in results(places[side], folder / side, source, options.only, again):
            print(f"{side}: {name}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(make, places))
    differing = []
    for name in (name for name in STEPS if fnmatch.fnmatch(name, options.only)):
        one, other = ((folder / f"{side}-results" / f"{name}.txt").read_text(encoding="utf-8") for side in places)
        if one != other:
            differing.append(name)
            lines = list(difflib.unified_diff(one.splitlines(), other.splitlines(), "before", "now", lineterm="", n=1))
            print(f"== {name}", *(line[:240] for line in lines[:40]), sep="\n")
    print(f"{len(differing)} of {len(STEPS)} commands differ: {', '.join(differing) or 'none'}")
    sys.exit(bool(differing))


if __name__ == "__main__":
    main()
