"""The whole chain on the built-in faces: learn, fit, constrain, evaluate, export. `make demo` runs it.

python examples/demo.py [--out FOLDER] [--task TASK]
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import lidardesign

CONSTRAINTS = """\
# a sensor that one can buy: 20 degrees at most, a gate of 10 cm
field_of_view: {horizontal_deg: {max: 20}, vertical_deg: {max: 20}}
gate: {width_m: {max: 0.10}}
"""


def program() -> list[str]:
    """The `lidardesign` that belongs to this Python."""
    beside = Path(sys.executable).with_name("lidardesign")
    found = str(beside) if beside.exists() else shutil.which("lidardesign")
    if found is None:
        sys.exit("lidardesign is not installed here: run `pip install .` or `make demo`")
    return [found]


def step(explanation: str, *arguments: str | Path) -> None:
    """Explain a command, print it, run it; end the demo with its exit code if it fails."""
    words = [str(argument) for argument in arguments]
    print(f"\n# {explanation}\n$ lidardesign {shlex.join(words)}", flush=True)
    started = time.perf_counter()
    result = subprocess.run([*program(), *words], check=False)
    if result.returncode:
        sys.exit(result.returncode)
    print(f"({time.perf_counter() - started:.1f} s)", flush=True)


def new_folder(wanted: Path) -> Path:
    """A folder that does not exist yet: the wanted one, or the first with a number behind its name."""
    candidates = [wanted, *(wanted.with_name(f"{wanted.name}-{number}") for number in range(2, 1000))]
    return next(folder for folder in candidates if not folder.exists())


def main() -> None:
    """Run the chain and say where the results are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/demo"), help="where to put everything")
    parser.add_argument("--task", default="face", help="a task that `lidardesign tasks` lists")
    options = parser.parse_args()
    folder = new_folder(options.out)
    run, designs = folder / "run", folder / "run" / "designs"
    folder.mkdir(parents=True)
    constraints = folder / "constraints.yaml"
    constraints.write_text(CONSTRAINTS, encoding="utf-8")

    started = time.perf_counter()
    step("Which tasks are there?", "tasks")
    step("Learn which rays are worth firing.", "learn", options.task, "--preset", "draft", "--out", run)
    step(
        "Fit sensors to what was learned, as many as score best on training scenes, and choose their rays.",
        "fit", run, "--name", "free",
    )  # fmt: skip
    print(f"\n# The constraints of {constraints}:\n{CONSTRAINTS}", end="")
    step(
        "Fit again under these constraints, without learning again.",
        "constrain", run, "--constraints", constraints, "--name", "buyable",
    )  # fmt: skip
    step(
        "Score all on held-out scenes against what one would build without learning.",
        "evaluate", run, "--report", folder / "report.html", "--csv", folder / "scores.csv",
    )  # fmt: skip
    step(
        "Hand the rays to another program.",
        "export",
        designs / "buyable.yaml",
        "--format",
        "csv",
        "--out",
        folder / "rays.csv",
    )
    print(f"\nDone in {time.perf_counter() - started:.0f} s.")
    print(f"The report with curves and a 3D view: {os.path.relpath(folder / 'report.html')}")
    quality = lidardesign.open_run(run).quality
    print(f"How well the density was learned: ESS {quality.ess:.3f}, coverage {quality.coverage:.3f}")


if __name__ == "__main__":
    main()
