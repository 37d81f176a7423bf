"""Emitters for the detector of a smartphone: floods beside it, around what is in the way, against a co-located laser.

python examples/emitter.py [--out FOLDER] [--set KEY=VALUE]...

It learns a draft, so that all of it takes about a minute; docs/emitter.md has the figures of a standard run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path

from demo import new_folder, program, step

LASER = """\
# what everything else is measured by: a laser at the detector itself
sensors: {count: 1}
origin: {fixed_m: [0.40, 0, 0]}
budget: {rays: 576}
"""
FLOOD = """\
# one flood above the detector; no emitter may be where the camera is, 5 cm wide and 4 cm high
sensors: {count: 1}
origin:
  low_m: [0.39, -0.03, 0]
  high_m: [0.41, 0.03, 0.06]
  exclude: [{low_m: [0.3, -0.025, -0.02], high_m: [0.5, 0.025, 0.02]}]
budget: {rays: 576}
"""
FLOODS = """\
# three floods, each in a part of the phone of its own, around the same camera
sensors: {count: 3}
origin:
  exclude: [{low_m: [0.3, -0.025, -0.02], high_m: [0.5, 0.025, 0.02]}]
budget: {rays: 576}
each:
- origin: {low_m: [0.39, 0.02, -0.03], high_m: [0.41, 0.08, 0.03]}
- origin: {low_m: [0.39, -0.08, -0.03], high_m: [0.41, -0.02, 0.03]}
- origin: {low_m: [0.39, -0.03, 0.01], high_m: [0.41, 0.03, 0.07]}
"""
BISTATIC = """\
# a narrow emitter 10 cm above the detector
sensors: {count: 1}
origin: {fixed_m: [0.40, 0, 0.10]}
field_of_view: {horizontal_deg: {max: 26}, vertical_deg: {max: 38}}
budget: {rays: 576}
"""
EMITTERS = {
    "laser": ("A laser at the detector: there both see the same.", LASER),
    "flood": ("One flood, kept off a forbidden region.", FLOOD),
    "floods": ("Three floods: what one leaves in the shadow, another may light.", FLOODS),
    "bistatic": ("One emitter at a given place, with a narrow field of view.", BISTATIC),
}


def main() -> None:
    """Run the chain and say where the results are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/emitter-example"), help="where to put everything")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="further settings of `learn`")
    options = parser.parse_args()
    folder, started = new_folder(options.out), time.perf_counter()
    run, settings = folder / "run", [word for value in options.set for word in ("--set", value)]
    folder.mkdir(parents=True)

    step(
        "Learn which emitted rays are worth firing: those that end where the detector sees the face.",
        "learn", "emitter", "--preset", "draft", *settings, "--out", run,
    )  # fmt: skip
    for name, (explanation, text) in EMITTERS.items():
        path = folder / f"{name}.yaml"
        path.write_text(text, encoding="utf-8")
        print(f"\n# {path}:\n{text}", end="")
        step(explanation, "constrain", run, "--layout", "even", "--constraints", path, "--name", name)
    designs = [run / "designs" / f"{name}.yaml" for name in EMITTERS]
    print("\n# Score them on held-out heads at equal rays; what the detector cannot see does not count.", flush=True)
    compare(evaluated(designs, folder / "report.html"))
    print(f"\nDone in {time.perf_counter() - started:.0f} s. Curves and a 3D view: {folder / 'report.html'}")


def evaluated(designs: list[Path], report: Path) -> dict:
    """The JSON document of `lidardesign evaluate` at 576 rays."""
    words = ["evaluate", *map(str, designs), "--rays", "576", "--report", str(report), "--json"]
    return json.loads(subprocess.run([*program(), *words], check=True, stdout=subprocess.PIPE).stdout)


def compare(evaluation: dict) -> None:
    """Every emitter beside the co-located laser."""
    unit = evaluation["metric"]["unit"]
    rows = {row["design"]: row for row in evaluation["rows"]}
    print(f"{'':10} {'Chamfer [' + unit + ']':>14} {'95 % interval':>16} {'to the laser':>13}")
    for name in EMITTERS:
        row = rows[name]
        interval = f"{row['ci_low']:.2f} to {row['ci_high']:.2f}"
        change = 100 * (row["value"] / rows["laser"]["value"] - 1)
        print(f"{name:10} {row['value']:14.2f} {interval:>16} {change:+11.1f} %")


if __name__ == "__main__":
    main()
