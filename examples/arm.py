"""Sensors on the ceiling that track what a robot arm carries: scenes that move, places that are free.

python examples/arm.py [--out FOLDER] [--set KEY=VALUE]...

It learns a small draft, so that all of it takes a minute or two: the figures are those of a draft, on 4 motions.
For the README's, learn with `lidardesign learn arm` alone.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from demo import new_folder, step

MOUNTS = """\
# two sensors, at the best two of four places where one can be screwed to the ceiling
sensors: {count: 2}
origin:
  mounts_m: [[0.2, 0, 1], [0.6, 0, 1], [0.4, 0.5, 1], [0.4, -0.5, 1]]
budget: {rays: 400}
"""
RAILS = """\
# four regions along rails: rays start all over them, thin across and no more than 0.2 m of spread along them
sensors: {count: 4}
origin: {spread_m: {max: 0.2}, thickness_m: {max: 0.002}}
budget: {rays: 400}
"""


def main() -> None:
    """Run the chain and say where the results are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/arm-example"), help="where to put everything")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="further settings of `learn`")
    options = parser.parse_args()
    folder, started = new_folder(options.out), time.perf_counter()
    run, settings = folder / "run", [word for value in options.set for word in ("--set", value)]
    folder.mkdir(parents=True)

    step(
        "Learn which rays are worth firing: from where on the ceiling, where to, and when to listen.",
        "learn", "arm", "--set", "size=small", "--preset", "draft", *settings, "--out", run,
    )  # fmt: skip
    step(
        "Fit four sensors, each where it stands best, and choose their rays on training motions.",
        "fit", run, "--sensors", "4", "--rays", "400", "--name", "free",
    )  # fmt: skip
    for name, text, explanation in (
        ("mounted", MOUNTS, "Sensors that cannot move: the program picks the mounting points."),
        ("rails", RAILS, "Rays that start all over rails: thin regions, of any direction."),
    ):
        path = folder / f"{name}.yaml"
        path.write_text(text, encoding="utf-8")
        print(f"\n# {path}:\n{text}", end="")
        step(explanation, "constrain", run, "--constraints", path, "--name", name)
    step(
        "Score all three on motions that were held out. `occupancy` aims at where the ball was in training, from "
        "anywhere;\n# `no-visibility` is the first design fitted without knowing that the arm hides the ball.",
        "evaluate", *(run / "designs" / f"{name}.yaml" for name in ("free", "mounted", "rails")),
        "--rays", "400", "--baseline", "occupancy", "--baseline", "no-visibility",
        "--report", folder / "report.html",
    )  # fmt: skip
    print(f"\nDone in {time.perf_counter() - started:.0f} s. Curves and a 3D view: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
