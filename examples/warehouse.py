"""A robot that scans shelves as it drives past: rays for every position along the aisle.

python examples/warehouse.py [--out FOLDER] [--set KEY=VALUE]...

It learns a small draft, so that all of it takes about a minute: the figures are those of a draft, on 4 shelves.
For the README's, learn with `lidardesign learn warehouse` alone.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from demo import new_folder, step

POSITIONS_M = (0.37, 3.91)


def main() -> None:
    """Run the chain and say where the results are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/warehouse-example"), help="where to put everything")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="further settings of `learn`")
    options = parser.parse_args()
    folder, started = new_folder(options.out), time.perf_counter()
    run, settings = folder / "run", [word for value in options.set for word in ("--set", value)]
    along = run / "designs" / "along.yaml"
    folder.mkdir(parents=True)

    step(
        "Learn which elevations are worth a ray, given where along the aisle the robot is.",
        "learn", "warehouse", "--set", "size=small", "--preset", "draft", *settings, "--out", run,
    )  # fmt: skip
    step(
        "Choose 12 rays with gates of their own at every position; between positions they are linear.",
        "fit", run, "--rays", "12", "--name", "along",
    )  # fmt: skip
    step(
        "The same under a constraint: no gate is wider than 0.3 m, anywhere along the aisle.",
        "constrain", run, "--set", "gate.width_m.max=0.3", "--rays", "12", "--name", "tight",
    )  # fmt: skip
    for x_m in POSITIONS_M:
        step(f"The rays at {x_m} m.", "show", along, "--at", f"x_m={x_m}")
        step(
            "Hand them to another program.",
            "export", along, "--at", f"x_m={x_m}", "--format", "csv", "--out", folder / f"rays_{x_m}.csv",
        )  # fmt: skip
    step(
        "Which boxes of held-out shelves do they miss, at all positions together?",
        "evaluate", along, run / "designs" / "tight.yaml", "--rays", "12", "--report", folder / "report.html",
    )  # fmt: skip
    print(f"\nDone in {time.perf_counter() - started:.0f} s. Curves and a 3D view: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
