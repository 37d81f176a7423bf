"""What rangefinders cost MuJoCo at every step: a design among many bodies, exported with and without a frame rate.

Models take turns; the mean step of a second of simulation is the best of all rounds.

    python benchmarks/mujoco_step.py [--rays 576] [--bodies 100] [--rate-hz 20]
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import parser, report

SECONDS = 1.0


def models(options: Any, folder: Path) -> dict[str, Any]:
    """The compiled models by what they are: without rays, firing at every step, and at the frame rate."""
    import mujoco

    from lidardesign.formats import FORMATS, write_design
    from lidardesign.parts.catalogue import Pose, find_part, part_design

    generator = np.random.default_rng(0)
    geoms = "".join(
        f'<body pos="{x:.3f} {y:.3f} {0.2 + z:.3f}"><geom type="box" size=".05 .05 .05"/></body>'
        for x, y, z in generator.uniform((0.5, -2, 0), (4, 2, 1.5), (options.bodies, 3))
    )
    poses = [Pose(np.array([0.0, 0.0, 1.0]), turn, -0.2, 0.0) for turn in np.linspace(-1.2, 1.2, 9)]
    design = part_design(find_part("vl53l8cx"), poses, min(options.rays, 576))
    found = {}
    for name, rate_hz in (("no rays", None), ("every step", 0.0), ("at the frame rate", options.rate_hz)):
        include = ""
        if rate_hz is not None:
            file = folder / f"{name.replace(' ', '-')}.xml"
            write_design(FORMATS.load("mjcf"), design, design.rays(), file, rate_hz)
            include = f'<include file="{file.name}"/>'
        world = folder / f"world-{name.replace(' ', '-')}.xml"
        floor = '<geom type="plane" size="9 9 .1"/>'
        world.write_text(f"<mujoco>{include}<worldbody>{floor}{geoms}</worldbody></mujoco>", encoding="utf-8")
        found[name] = mujoco.MjModel.from_xml_path(str(world))
    return found


def mean_step_us(model: Any) -> float:
    """The mean time of a step over a second of simulation [us]."""
    import mujoco

    data = mujoco.MjData(model)
    steps = round(SECONDS / model.opt.timestep)
    mujoco.mj_step(model, data)
    started = time.perf_counter()
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return 1e6 * (time.perf_counter() - started) / steps


def main() -> None:
    """Measure and print everything."""
    made = parser(__doc__, rounds=5)
    made.add_argument("--rays", type=int, default=576, help="(default %(default)s)")
    made.add_argument("--bodies", type=int, default=100, help="(default %(default)s)")
    made.add_argument("--rate-hz", type=float, default=20.0, help="(default %(default)s)")
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        compiled = models(options, Path(folder))
        times = {name: [] for name in compiled}
        for _ in range(options.rounds):
            for name, model in compiled.items():
                times[name].append(mean_step_us(model))
    best = {name: min(values) for name, values in times.items()}
    every = best["every step"]
    rows = [[name, value, every / value] for name, value in best.items()]
    columns = ["rangefinders", "mean step us", "times as fast"]
    report("MuJoCo's step", {f"{options.rays} rays, {options.bodies} bodies": (columns, rows)}, path=options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
