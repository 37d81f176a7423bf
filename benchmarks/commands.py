"""Processor time of every command on the embedded faces, as a ratio to a fixed piece of work on the same machine.

The fixed work is numpy's and Python's own, in a process of its own between commands, so that ratios of different
machines and days can be compared: a command whose ratio grows became slower. Every command runs once for its caches
(compiled loops, what training scenes show), and then so often; the median counts.

    python benchmarks/commands.py                    # some five minutes
    python benchmarks/commands.py --rounds 1 --set learning.steps=80
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
from pathlib import Path

from common import lidardesign, parser, report, run_process

FIXED_WORK = """
import numpy as np
generator = np.random.default_rng(0)
for _ in range(40):
    values = np.sort(generator.standard_normal(400_000))
    np.linalg.svd(generator.standard_normal((200, 200)))
    sum(int(value > 0) for value in values[:100_000].tolist())
"""


def commands(folder: Path, settings: list[str]) -> dict[str, list[str | Path]]:
    """The words of every command by its name, in the order in which they need each other."""
    run, keys = folder / "run", [word for key in settings for word in ("--set", key)]
    free, narrow = run / "designs" / "fit.yaml", run / "designs" / "narrow.yaml"
    bound = ["--set", "field_of_view.horizontal_deg.max=60"]
    return {
        "learn": ["learn", "face", "--preset", "draft", *keys, "--out", run],
        "learn --dry-run": ["learn", "face", *keys, "--out", folder / "other", "--dry-run"],
        "fit": ["fit", run],
        "fit --sensors 2": ["fit", run, "--sensors", "2"],
        "constrain": ["constrain", run, *bound, "--sensors", "2", "--name", "narrow"],
        "constrain, even rays": ["constrain", run, *bound, "--layout", "even", "--sensors", "2", "--name", "even"],
        "evaluate": ["evaluate", narrow, "--report", folder / "report.html"],
        "evaluate --detector": ["evaluate", narrow, "--detector", "single-photon", "--baseline", "none"],
        "show RUN": ["show", run],
        "show DESIGN": ["show", free],
        "export csv": ["export", free, "--format", "csv", "--out", folder / "rays.csv"],
        "export mounts": ["export", free, "--format", "mounts", "--out", folder / "mounts"],
        "simulate": ["simulate", free, "--format", "ply", "--out", folder / "clouds"],
        "tasks list": ["tasks", "list"],
        "tasks check": ["tasks", "check", "face"],
        "config init": ["config", "init", "face"],
        "catalog list": ["catalog", "list"],
    }


def measured_s(words: list[str | Path], folder: Path) -> float:
    """Processor time of a command [s], whose outputs of an earlier round are taken away."""
    if "--out" in words:
        out = Path(words[words.index("--out") + 1])
        shutil.rmtree(out, ignore_errors=True)
        out.unlink(missing_ok=True)
    done = run_process(lidardesign(*words), {"LIDARDESIGN_CACHE": str(folder / "fields")})
    if done.code:
        sys.exit(f"{' '.join(map(str, words))} ended with exit code {done.code}:\n{done.errors}")
    return done.cpu


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    options = made.parse_args()
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for command, words in commands(folder, options.set).items():
            measured_s(words, folder)
            taken_s, fixed_s = [], []
            for _ in range(options.rounds):
                taken_s.append(measured_s(words, folder))
                fixed_s.append(run_process([sys.executable, "-c", FIXED_WORK]).cpu)
            ratio = statistics.median(one / fixed for one, fixed in zip(taken_s, fixed_s, strict=True))
            rows.append([command, statistics.median(taken_s), ratio])
            print(f"{command}: {rows[-1][1]:.2f} s, {ratio:.2f} of the fixed work", file=sys.stderr)
    tables = {f"Medians of {options.rounds}": (["command", "CPU s", "of the fixed work"], rows)}
    report("Processor time of every command", tables, path=options.json)


if __name__ == "__main__":
    main()
