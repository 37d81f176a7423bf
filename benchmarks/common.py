"""What the benchmarks share: the machine, repeated timing, tables, and JSON output.

Contestants are timed interleaved, one after the other in every round, so that a machine that slows down slows all of
them; figures are medians over rounds, and ratios are medians of the ratios within a round. No script fails on a slow
machine: it prints what it measured.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Thread pools that share cores with other programs slow each other down; set before numpy and torch are imported.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

ROOT = Path(__file__).resolve().parents[1]
FACE_MODEL = ROOT.parent / "shared" / "data" / "ict_face.h5"
ARM_MODEL = ROOT.parent / "shared" / "data" / "iiwa14" / "iiwa14.xml"
MEBIBYTE = 2**20
# Rays start all over regions of any size, as on the paper's ceiling; without it every sensor stands at one place.
REGIONS = {"origin": {"spread_m": {"max": 10.0}}}


@dataclass(frozen=True)
class Timing:
    """Repeated times of one contestant [s]: wall clock and processor time of this process, one entry per round."""

    wall: tuple[float, ...]
    cpu: tuple[float, ...]

    @property
    def wall_median(self) -> float:
        """Median wall time [s]."""
        return statistics.median(self.wall)

    @property
    def cpu_median(self) -> float:
        """Median processor time [s]."""
        return statistics.median(self.cpu)


def interleaved(contestants: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, Timing]:
    """Time each contestant once per round, after one round that is not counted (compilation, caches)."""
    wall: dict[str, list[float]] = {name: [] for name in contestants}
    cpu: dict[str, list[float]] = {name: [] for name in contestants}
    for index in range(rounds + 1):
        for name, run in contestants.items():
            started, spent = time.perf_counter(), time.process_time()
            run()
            if index:
                wall[name].append(time.perf_counter() - started)
                cpu[name].append(time.process_time() - spent)
    return {name: Timing(tuple(wall[name]), tuple(cpu[name])) for name in contestants}


@functools.cache
def installed(library: str) -> bool:
    """Whether a library that is compared with is there; said where it is not."""
    found = importlib.util.find_spec(library) is not None
    if not found:
        print(f"{library} is not installed, its rows are left out: see benchmarks/requirements.txt", file=sys.stderr)
    return found


def median_ratio(first: Sequence[float], second: Sequence[float]) -> float:
    """Median over rounds of first / second."""
    return statistics.median(a / b for a, b in zip(first, second, strict=True))


@dataclass(frozen=True)
class ProcessResult:
    """A finished command: exit code, output, wall and processor time [s], largest resident memory [MiB]."""

    code: int
    output: str
    errors: str
    wall: float
    cpu: float
    peak_mib: float

    def document(self) -> dict[str, Any]:
        """The JSON document on its standard output.

        Raises:
            SystemExit: The command failed.
        """
        if self.code:
            sys.exit(f"the command ended with exit code {self.code}:\n{self.errors or self.output}")
        return json.loads(self.output)


# A helper of its own per command: the memory maximum of finished children never falls again within one process.
_HELPER = """
import json, resource, subprocess, sys, time
started = time.perf_counter()
done = subprocess.run(sys.argv[1:], capture_output=True, text=True)
wall = time.perf_counter() - started
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([done.returncode, done.stdout, done.stderr, wall, used.ru_utime + used.ru_stime, used.ru_maxrss]))
"""


def run_process(command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> ProcessResult:
    """Run a command to its end and measure it from outside."""
    helper = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _HELPER, *map(str, command)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **(environment or {})},
    )
    code, output, errors, wall, cpu, peak = json.loads(helper.stdout)
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, KiB on Linux
    return ProcessResult(code, output, errors, wall, cpu, peak * unit / MEBIBYTE)


def lidardesign(*arguments: str | Path) -> list[str]:
    """The command line of the `lidardesign` that belongs to this Python."""
    beside = Path(sys.executable).with_name("lidardesign")
    found = str(beside) if beside.exists() else shutil.which("lidardesign")
    if found is None:
        sys.exit("lidardesign is not installed here: run `pip install .`")
    return [found, *map(str, arguments)]


def face_settings(model: str) -> dict[str, Any]:
    """Keys of the face task for `--model`: `ict` (said and replaced where it is missing), `embedded`, or a path."""
    if model == "embedded":
        return {}
    path = FACE_MODEL if model == "ict" else Path(model)
    if not path.exists():
        print(f"{path.name} is not here: the embedded head model is used instead", file=sys.stderr)
        return {}
    return {"model": path}


def face_scenes(model: str, count: int, seed: int = 0) -> list[Any]:
    """Training heads of the face task."""
    from lidardesign_tasks.face import FaceTask

    task = FaceTask()
    config = task.Config(train=count, **face_settings(model))
    return list(task.scenes(config, "train", seed))


def robot_settings(robot: str) -> dict[str, Any]:
    """Keys of the arm task for `--robot`: `embedded`, `iiwa14` (said and replaced where it is missing), or a path."""
    if robot == "embedded":
        return {}
    path = ARM_MODEL if robot == "iiwa14" else Path(robot)
    if not path.exists():
        print(f"{path.name} is not here: the embedded arm is used instead", file=sys.stderr)
        return {}
    return {"robot": path}


def learned(task: str, folder: Path, options: Any, settings: Mapping[str, Any]) -> Path:
    """The run that `--run` names; without one a run of the task, learned into a folder.

    Arguments:
        task: Its name.
        folder: Where the run is made.
        options: Of `run_options`.
        settings: Keys that the benchmark itself sets; `--set` comes after them.

    Raises:
        SystemExit: A run is given together with what only learning could heed.
    """
    if options.run is not None:
        if options.preset or options.set or settings:
            sys.exit("--run takes a run as it is: leave out what is said about learning and about the arm")
        return options.run
    from lidardesign import learn

    chosen = [*(f"{key}={value}" for key, value in settings.items()), *options.set]
    return learn(task, preset=options.preset or "standard", out=folder / "run", settings=chosen).folder


def fitted(run: Path, name: str, **choices: Any) -> Any:
    """A design that is fitted to a run and saved there."""
    from lidardesign import open_run

    design = open_run(run).fit(name=name, **choices)
    design.save()
    return design


def scored(
    run: Path, designs: Mapping[str, Mapping[str, Any]], rays: Sequence[int], rounds: int, baselines: Sequence[str] = ()
) -> tuple[dict[str, Any], list[list[object]], dict[tuple[str, int], Any]]:
    """Designs that are fitted for each number of rays, since rays are chosen for a number, and their scores.

    Arguments:
        run: The run.
        designs: Choices of `fit` by the name of a design.
        rays: Numbers of rays.
        rounds: How often each is evaluated.
        baselines: Beside those that `evaluate` always has.

    Returns:
        What `evaluate` prints, with the rows of all numbers; numbers of rays with wall and processor time [s] and
        memory [MiB]; designs by name and number.
    """
    fits, times, found, rows = {}, [], {}, []
    words = [word for name in baselines for word in ("--baseline", name)]
    for count in rays:
        here = {name: fitted(run, f"{name}-{count}", rays=count, **choices) for name, choices in designs.items()}
        paths = [design.path for design in here.values()]
        results = [
            run_process(lidardesign("evaluate", *paths, "--rays", str(count), *words, "--json")) for _ in range(rounds)
        ]
        found = results[0].document()
        rows += [{**row, "design": row["design"].removesuffix(f"-{count}")} for row in found["rows"]]
        times += [[count, one.wall, one.cpu, one.peak_mib] for one in results]
        fits |= {(name, count): design for name, design in here.items()}
    return {**found, "rows": rows}, times, fits


def without_traceback(main: Callable[[], None]) -> None:
    """Run a benchmark; what the library refuses ends it with the library's message."""
    from lidardesign.errors import LidardesignError

    try:
        main()
    except LidardesignError as error:
        sys.exit(f"{error.kind}: {error}")


def verdict(claim: str, cases: Mapping[str, bool]) -> str:
    """Whether a claim holds in every case, and where it does not."""
    broken = [name for name, holds in cases.items() if not holds]
    word = "does not hold" if broken else "holds"
    where = f"; not for {', '.join(broken)}" if broken else ""
    return f"{word}: {claim} ({len(cases) - len(broken)} of {len(cases)}{where})"


def machine() -> dict[str, Any]:
    """What was measured on."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": int(os.environ["OMP_NUM_THREADS"]),
        "system": platform.system(),
        "python": platform.python_version(),
        "load_at_start": round(load, 2),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def parser(description: str | None, **defaults: int) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    made = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--rounds", type=int, default=defaults.get("rounds", 5), help="repetitions (default %(default)s)")
    made.add_argument("--json", type=Path, metavar="FILE", help="also write everything measured to FILE")
    return made


def model_option(made: argparse.ArgumentParser) -> None:
    """Add `--model`."""
    made.add_argument("--model", default="ict", help="face model: ict, embedded, or a file (default %(default)s)")


def run_options(made: argparse.ArgumentParser) -> None:
    """Add `--run`, `--preset` and `--set`."""
    made.add_argument("--run", type=Path, help="a run of this task, which gets the designs (default: learn one)")
    made.add_argument("--preset", help="what is learned (default standard)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")


def robot_option(made: argparse.ArgumentParser) -> None:
    """Add `--robot`."""
    made.add_argument("--robot", default="embedded", help="arm: embedded, iiwa14, or a file (default %(default)s)")


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown, numbers to three significant figures."""
    cells = [[_cell(value) for value in row] for row in rows]
    widths = [max(len(text) for text in column) for column in zip(columns, *cells, strict=True)]
    lines = [[*columns], ["-" * width for width in widths], *cells]
    return "\n".join(
        "| " + " | ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) + " |" for line in lines
    )


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)


def report(
    title: str,
    tables: Mapping[str, tuple[Sequence[str], Sequence[Sequence[object]]]],
    lines: Sequence[str] = (),
    path: Path | None = None,
) -> None:
    """Print the machine, the tables and the conclusions, and write them as JSON where that is asked for."""
    where = machine()
    print(f"## {title}\n")
    print(
        f"{where['processor']}, {where['cores']} cores, {where['threads']} thread(s), "
        f"Python {where['python']}, load {where['load_at_start']}\n"
    )
    for caption, (columns, rows) in tables.items():
        print(f"{caption}\n\n{table(columns, rows)}\n")
    for line in lines:
        print(line)
    if path is not None:
        document = {
            "title": title,
            "machine": where,
            "tables": {
                caption: [dict(zip(c, row, strict=True)) for row in rows] for caption, (c, rows) in tables.items()
            },
            "conclusions": list(lines),
        }
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
