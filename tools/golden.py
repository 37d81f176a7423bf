"""Record what the program prints and writes for every task, and compare it with what it did before.

All goes through the command line, in this process, so that a record outlives any move of modules.

Usage: python tools/golden.py record FOLDER [--task NAME ...]
       python tools/golden.py compare FOLDER [--task NAME ...] [--tolerance 1e-12] [--keep DIR]
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import math
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
# Libraries read these as they are imported, so the program starts itself anew with them.
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    **{"COLUMNS": "120", "LINES": "50", "TERM": "dumb", "NO_COLOR": "1", "TZ": "UTC", "CUDA_VISIBLE_DEVICES": ""},
    # the length of this path is in the size of an exported file
    **{"TMPDIR": "/tmp"},
    **{"PYTHONHASHSEED": "0"},
}
STARTED = "LIDARDESIGN_GOLDEN"
QUICK = (
    "learning.samples=5000 learning.coverage_proposals=512 learning.balance_proposals=2048 learning.batch=128 "
    "truth_points=500 train=2 test=2"
)
# A blurred density of few scenes is learned in seconds, with far more effective samples than `fit` asks for.
SETTINGS = {
    "flatland": f"{QUICK} learning.steps=60 density.sigma_m=0.06".replace("truth_points=500 ", ""),
    "face": f"{QUICK} learning.steps=60 density.sigma_m=0.04",
    "emitter": f"{QUICK} learning.steps=60 density.sigma_m=0.04",
    "meshes": f"{QUICK} folder=parts learning.steps=60 density.sigma_m=0.02 poses=1".replace("train=2 test=2 ", ""),
    "warehouse": f"{QUICK} learning.steps=100 density.sigma_m=0.15".replace("truth_points=500 ", ""),
    "arm": f"{QUICK} learning.steps=100 density.sigma_m=0.15 frames=8".replace("truth_points=500 ", ""),
}
LEAST_EFFECTIVE_SAMPLES = 150
LAYOUTS = ("grid", "density", "scan", "distributed")
# Designs of these tasks go to all formats: of one place, of a ceiling of places, and of one position of a robot.
EXPORTED = ("face", "arm", "warehouse")
SENSOR_FORMATS = ("sensors-csv", "stl")  # these take no rays
# What each task has beside the others.
FURTHER = {
    "flatland": """
        learn flatland SETTINGS --out runs/flatland --resume
        learn flatland SETTINGS --tolerance 0.9 --out runs/staged
        evaluate runs/flatland/designs/scan.yaml --rays 12
        fit runs/flatland --layout selected --rays 12 --name chosen
        show runs/flatland/designs/chosen.yaml --json
        tasks check flatland --json
        evaluate runs/flatland/designs/scan.yaml --rays 12 --effects all --detector single-photon --json
    """,
    "face": """
        fit runs/face --layout scan --rays 40 --weight area_exponent=0.25 --name weighted --json
        fit runs/face --sensors 2 --parts vl53l5cx,tmf8828 --name bought --json
        constrain runs/face --set 'parts={names: [vl53l5cx, vl53l8cx], count: 2}' --name ours
        constrain runs/face --set gate.start_m.min=0.6 --set gate.end_m.max=0.5
        constrain runs/face --set gate.widht_m.max=0.1
        fit runs/face --like rig.sdf --name alike --json
        show rig.sdf
        show rig.sdf runs/face/designs/alike.yaml
        evaluate rig.sdf runs/face/designs/alike.yaml --rays 40 --baseline none
        export rig.sdf --format csv --out -
        export runs/face/designs/grid.yaml --format galvo --rays 40 --out mirrors.galvo.csv
        capture scan.npz runs/face/designs/grid.yaml --rays 40 --csv points.csv
        capture scan.npz mirrors.galvo.csv
        capture scan.npz runs/face/designs/grid.yaml --estimator matched --rays 40 --json
        evaluate runs/face/designs/scan.yaml --rays 40 --effects audit --detector consumer-8x8 --json
        evaluate runs/face/designs/grid.yaml --rays 40 --fail-above 0.001 --report report.html
        evaluate runs/face/designs/grid.yaml --rays 400 --set truth_points=50000 --baseline cma --cma-seconds 0.1 --json
    """,
    "emitter": "",
    "meshes": "evaluate runs/meshes/designs/grid.yaml --rays 40 --detector single-photon --effects all --json",
    "warehouse": """
        fit runs/warehouse --layout grid --rays 12 --name none
        fit runs/warehouse --rays 12 --name track --json
        constrain runs/warehouse --rays 12 --set gate.width_m.max=0.2 --name tight-track --json
        fit runs/warehouse --rays 12 --at x_m=1.5 --name here
        export runs/warehouse/designs/track.yaml --rays 12 --format csv
        show runs/warehouse/designs/track.yaml --at x_m=2.5
        export runs/warehouse/designs/track.yaml --rays 12 --at x_m=2.5 --format csv --out rays.csv
        show runs/warehouse/designs/track.yaml runs/warehouse/designs/here.yaml --json
        evaluate runs/warehouse/designs/track.yaml runs/warehouse/designs/here.yaml --rays 12 --json
    """,
    "arm": """
        fit runs/arm --name free
        constrain runs/arm --set 'origin.mounts_m=[[0, 0, 1], [0.4, 0, 1]]' --sensors 2 --rays 200 --name mounted --json
        evaluate runs/arm/designs/mounted.yaml --rays 200
    """,
}
# What has no task. `--accuracy`, `--time-budget` and `--workers` are left out: they time this machine, or start others.
GENERAL = """
    --version
    tasks
    tasks list --json
    catalog
    catalog list --reflectance 10 --klux 100 --json
    catalog show vl53l5cx
    catalog show vl53l5cx:4x4 --json
    catalog show vl53l8cx --out bought.yaml --rays 196 --at-origin 0.4,0,0 --azimuth-deg 180
    show bought.yaml --json
    export --list
    export --list --json
    config schema config
    config schema config --task face
    config schema constraints
    config schema design
    config schema evaluate
    tasks new landmark --out landmark
    lern face
    learn face --set density.sigma=1
    learn nothing --json
    fit runs/nothing --json
"""
COMMANDS = (
    "", "learn", "fit", "constrain", "evaluate", "export", "capture", "show", "tasks",
    "tasks list", "tasks show", "tasks check", "tasks new", "catalog", "catalog list", "catalog show", "config",
    "config init", "config schema",
)  # fmt: skip
# Values of these keys are of the moment or of the machine; the laws of `tasks check` measure calls in seconds.
MASKED_KEYS = re.compile(
    r"(.*_)?seconds(_.*)?|when|created|timings|phases|versions|lidardesign_version|peak_memory_bytes|peak_bytes"
    r"|(Config|space|scenes|score)_s"
)
# In text: durations, memory, dates, and lines of progress, which come when they come.
MASKED_TEXT = (
    (re.compile(r"^[^\n]*(: .* left| \.\.\.)\n", re.MULTILINE), ""),
    (re.compile(r"(?<![\w.])(\d+ (h|min) )?\d+(\.\d+)?(e-\d+)? (s|ms|min|MiB)\b *"), "# "),
    (re.compile(r"\d{4}-\d\d-\d\dT?[ ]?\d\d:\d\d(:\d\d)?(\.\d+)?([+-]\d\d:\d\d|Z)?"), "#"),
    (re.compile(r'<table>(?:(?!</table>).)*class="bar(?:(?!</table>).)*</table>', re.DOTALL), ""),
    (re.compile(r"^provenance:\n(?:[ -].*\n)*", re.MULTILINE), ""),
)
HTML_TABLE = re.compile(r'<th scope="col">seconds</th></tr>.*?</table>')
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
# Files that hold times beside what others hold; their sums in the manifest do so too.
TIMED = ("checkpoint.safetensors", "progress.jsonl")
# Its sum in the manifest depends on where the folder is; the file itself is recorded.
PLACED = "config.yaml"
SNAPSHOTS = "snapshots"
PICTURES = (".png", ".svg")
MOST_SHOWN = 20


def main() -> None:
    """Read the command line, and record or compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--task", action="append", choices=("general", *SETTINGS), help="only this; repeatable")
    parser.add_argument("--tolerance", type=float, default=0.0, help="relative difference of numbers that passes")
    parser.add_argument("--keep", type=Path, help="where the new record stays")
    asked = parser.parse_args()
    if asked.keep and asked.keep.resolve() == asked.folder.resolve():
        parser.error("--keep: another folder than the one that is compared with")
    if STARTED not in os.environ:
        paths = [str(ROOT), str(ROOT / "tasks"), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, **ENVIRONMENT, STARTED: "1", "PYTHONPATH": os.pathsep.join(paths)}
        os.execve(sys.executable, [sys.executable, *sys.argv], environment)
    names = asked.task or ["general", *SETTINGS]
    with tempfile.TemporaryDirectory() as folder:
        target = asked.folder if asked.action == "record" else asked.keep or Path(folder)
        target = target.resolve()
        for name in names:
            began = time.process_time()
            shutil.rmtree(target / name, ignore_errors=True)
            record(name, target / name)
            print(f"{name}: {time.process_time() - began:.0f} s", flush=True)
        if asked.action == "compare":
            pairs = [(asked.folder / name, target / name) for name in names]
            found = [line for before, after in pairs for line in differences(before, after, asked.tolerance)]
            print("\n".join(found) or "no difference")
            sys.exit(bool(found))


def record(name: str, target: Path) -> None:
    """Run the commands of a task in an empty folder; what they print and leave there goes to `target`, masked."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            _inputs()
            shown = target / "shown"
            shown.mkdir(parents=True)
            for line in general_lines() if name == "general" else task_lines(name):
                _run(line, shown)
            if name != "general":
                _check_effective_samples(Path("runs", name))
            _keep_files(Path(), target / "files")
        finally:
            os.chdir(before)


def general_lines() -> Iterator[str]:
    """Command lines that need no run."""
    yield from (f"{command} --help" for command in COMMANDS)
    yield from _lines(GENERAL)


def task_lines(task: str) -> Iterator[str]:
    """Command lines of a task: learned small, then all that follows from its run."""
    run, settings = f"runs/{task}", " ".join(f"--set {setting}" for setting in SETTINGS[task].split()) + " --seed 1"
    rays = {"flatland": 12, "warehouse": 12, "arm": 200}.get(task, 40)
    where = " --at x_m=1.5" if task == "warehouse" else ""
    designs = [f"{run}/designs/{layout}.yaml" for layout in LAYOUTS]
    yield f"tasks show {task}"
    yield f"tasks show {task} --json"
    yield f"config init {task} --preset draft"
    yield f"learn {task} {settings} --out {run} --dry-run --json"
    yield f"learn {task} {settings} --out {run}"
    for layout in LAYOUTS:
        how = f"--layout {layout} --rays {rays}" + ("" if layout == "scan" else " --sensors 2") + where
        yield f"fit {run} {how} --name {layout} --json"
        yield f"constrain {run} {how} --set gate.width_m.max=0.2 --name tight-{layout}"
    how = f"--layout density --gates ray --sensors 2{where}"
    yield f"fit {run} {how} --rays {rays} --name gated --json"
    yield f"constrain {run} {how} --set budget.rays={rays} --name few --json"
    yield f"export {designs[0]} --format sdf --rays {rays} --out rig.sdf --json"
    for design in (*designs, f"{run}/designs/gated.yaml", f"{run}/designs/tight-grid.yaml"):
        yield f"show {design}"
        yield f"show {design} --json"
        yield f"export {design} --format csv --rays {rays} --json"
        yield f"export {design} --format npz --rays {rays}"
    for name, suffix in _formats() if task in EXPORTED else ():
        amount = "" if name in SENSOR_FORMATS else f"--rays {rays} "
        yield f"export {designs[0]} --format {name} {amount}--out all/{name}{suffix} --json"
    yield f"evaluate {designs[0]} {designs[1]} --rays {rays} --baseline none"
    yield f"show {designs[1]} {designs[2]} --json"
    yield f"evaluate {run} --rays {rays} --csv rows.csv"
    yield f"evaluate {designs[0]} --rays {rays} --baseline occupancy --json"
    yield f"evaluate {designs[0]} --rays {rays} --baseline no-visibility --json"
    yield from _lines(FURTHER[task].replace("SETTINGS", settings))


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip()]


def _formats() -> list[tuple[str, str]]:
    """Names and suffixes of all formats, as the program lists them."""
    return [(row["name"], row["suffix"]) for row in json.loads(_called("export --list --json")[1])["formats"]]


def _inputs() -> None:
    """Files that commands read: two meshes, and a captured scan of a ball before a wall."""
    import trimesh

    Path("parts").mkdir()
    for name, height in (("short", 0.10), ("long", 0.16)):
        trimesh.creation.capsule(height, 0.05).export(f"parts/{name}.stl")
    generator = np.random.default_rng(0)
    x_deg, y_deg = np.meshgrid(np.linspace(-18, 18, 25), np.linspace(-18, 18, 25))
    range_m = np.where(x_deg**2 + y_deg**2 < 150, 0.45, 0.6)
    counts = generator.poisson(0.05, (25, 25, 400))
    start_ps, bin_ps = 1500.0, 20.0
    peak = ((range_m * 2 / 299_792_458e-12 - start_ps) / bin_ps).astype(int)
    np.put_along_axis(counts, peak[..., None], 40, axis=2)
    np.savez(
        "scan.npz", counts=counts.astype(np.uint16), bin_width_ps=bin_ps, start_ps=start_ps, origin_m=[0.4, 0.0, 0.0],
        x_deg=x_deg, y_deg=y_deg, boresight_azimuth_deg=180.0, boresight_elevation_deg=0.0, true_range_m=range_m,
        pulse_fwhm_ps=60.0,
    )  # fmt: skip


def _called(line: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command line, run in this process."""
    from lidardesign.cli.main import run as run_program

    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    code: object = 0
    # runs and reports tell the command line that made them
    sys.argv = ["lidardesign", *shlex.split(line)]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run_program(sys.argv[1:])
        except SystemExit as ended:
            code = ended.code
    printed = [stream.buffer.getvalue().decode() for stream in (out, err)]  # type: ignore[attr-defined]
    return code if isinstance(code, int) else int(code is not None), printed[0], printed[1]


def _run(line: str, shown: Path) -> None:
    """Run a command line and write what it printed, as files that are named after it."""
    code, out, err = _called(line)
    is_json = "--json" in line and out.startswith(("{", "["))
    printed = _dumped(json.loads(out)) if is_json else _masked_text(out)
    # of the settings of a run the name of the command is enough
    name = re.sub(r"[^\w.=-]+", "_", line.partition(" --set learning")[0] + line.partition(" --seed 1")[2]).strip("_")
    path = shown / f"{name}.{'json' if is_json else 'txt'}"
    if path.exists():
        raise RuntimeError(f"two commands share the name {path.name}")
    path.write_text(printed, encoding="utf-8")
    (shown / f"{name}.err").write_text(f"exit {code}\n{_masked_text(err)}", encoding="utf-8")


def _check_effective_samples(run: Path) -> None:
    """Raises RuntimeError: a run has so few effective samples that the least change might make it useless."""
    learned = json.loads((run / "manifest.json").read_text())["learn"]
    with np.load(run / "samples.npz") as arrays:
        effective = learned["ess"] * len(arrays[arrays.files[0]])
    if effective < LEAST_EFFECTIVE_SAMPLES:
        raise RuntimeError(f"{run}: {effective:.0f} effective samples, {LEAST_EFFECTIVE_SAMPLES} wanted")


def _keep_files(source: Path, target: Path) -> None:
    """Copy the files of a working folder, text masked."""
    for path in sorted(path for path in source.rglob("*") if path.is_file()):
        if path.name in TIMED or SNAPSHOTS in path.parts:
            continue
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        # pictures hold dates and times: that they are there is what counts
        data = path.read_bytes() if path.suffix not in PICTURES else b""
        if path.suffix == ".json":
            data = _dumped(json.loads(data)).encode()
        elif path.suffix == ".csv":
            data = _masked_csv(_masked_text(data.decode())).encode()
        elif b"\0" not in data:
            data = _masked_text(data.decode("utf-8", "surrogateescape")).encode("utf-8", "surrogateescape")
        copy.write_bytes(data)


def _dumped(document: Any) -> str:
    return json.dumps(_masked(document), indent=1, ensure_ascii=False) + "\n"


def _masked(value: Any, key: str = "") -> Any:
    """A JSON document in its own order, without what differs from run to run."""
    if MASKED_KEYS.fullmatch(key) or key in (*TIMED, PLACED):
        return "#"
    if isinstance(value, dict):
        # a manifest is as long as the times in it, a configuration as its paths
        changing = str(value.get("path")).endswith(("manifest.json", PLACED))
        return {name: "#" if changing and name == "bytes" else _masked(part, name) for name, part in value.items()}
    if isinstance(value, list):
        return [_masked(part) for part in value]
    return _masked_text(value) if isinstance(value, str) else value


def _masked_text(text: str) -> str:
    text = text.replace(str(Path.cwd().resolve()), "WORK").replace(str(ROOT), "REPOSITORY")
    for pattern, instead in MASKED_TEXT:
        text = pattern.sub(instead, text)
    return HTML_TABLE.sub(lambda table: re.sub(r"<td>[^<]*</td></tr>", "<td>#</td></tr>", table[0]), text)


def _masked_csv(text: str) -> str:
    """CSV without the values of its columns of seconds."""
    lines = [line.split(",") for line in text.splitlines()]
    timed = [place for place, name in enumerate(lines[0]) if name.startswith("seconds")] if lines else []
    if not timed:
        return text
    for line in lines[1:]:
        for place in timed:
            line[place] = "#"
    return "".join(",".join(line) + "\n" for line in lines)


def differences(before: Path, after: Path, tolerance: float) -> Iterator[str]:
    """Lines that say what differs between two records of a task: file, key and values."""
    files = [{path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} for folder in (before, after)]
    for path in sorted(files[0] | files[1]):
        where = Path(before.name, path)
        if path not in files[1]:
            yield f"{where}: is missing now"
        elif path not in files[0]:
            yield f"{where}: is new"
        elif (before / path).read_bytes() != (after / path).read_bytes():
            parts = [_parts(folder / path) for folder in (before, after)]
            lines = [
                f"{where}: {key}: {_short(parts[0].get(key))} is now {_short(parts[1].get(key))}"
                for key in {**parts[0], **parts[1]}
                # sums of files tell nothing new where their numbers may differ a little
                if not (tolerance and key.endswith("sha256"))
                and not _is_same(parts[0].get(key), parts[1].get(key), tolerance)
            ]
            if not lines and not tolerance:
                lines = [f"{where}: bytes differ, values do not"]
            yield from lines[:MOST_SHOWN]
            if len(lines) > MOST_SHOWN:
                yield f"{where}: and {len(lines) - MOST_SHOWN} more"


def _parts(path: Path) -> dict[str, Any]:
    """What a file holds by key: arrays, values of a document, or lines."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return {name: arrays[name] for name in arrays.files}
    data = path.read_bytes()
    if b"\0" in data:
        return {"bytes": data}
    text = data.decode("utf-8", "surrogateescape")
    if path.suffix == ".html":
        text = text.replace("<", "\n<")
    if path.suffix in (".json", ".yaml"):
        with contextlib.suppress(ValueError, yaml.YAMLError):
            return dict(_flat(json.loads(text) if path.suffix == ".json" else yaml.safe_load(text), ""))
    return {f"line {number}": line for number, line in enumerate(text.splitlines(), 1)}


def _flat(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, (dict, list)) and value:
        for name, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _flat(part, f"{key}.{name}" if key else str(name))
    else:
        yield key, value


def _is_same(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two values are the same, their numbers up to a relative tolerance; numbers in text count too."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        if one.shape != other.shape or one.dtype != other.dtype:
            return False
        if one.dtype.kind not in "fc":
            return bool(np.array_equal(one, other))
        return bool(np.allclose(one, other, rtol=tolerance, atol=0.0, equal_nan=True))
    if isinstance(one, str) and tolerance and NUMBER.sub("#", one) == NUMBER.sub("#", other):
        pairs = zip(NUMBER.findall(one), NUMBER.findall(other), strict=True)
        return all(math.isclose(float(a), float(b), rel_tol=tolerance) for a, b in pairs)
    if isinstance(one, float):
        return math.isclose(one, other, rel_tol=tolerance) or (math.isnan(one) and math.isnan(other))
    return bool(one == other)


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()[:12]}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes {hashlib.sha256(value).hexdigest()[:12]}"
    return repr(value) if len(repr(value)) <= 200 else f"{repr(value)[:200]}..."


if __name__ == "__main__":
    main()
