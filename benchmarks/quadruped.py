"""Four distance sensors on a quadruped's torso that look for a ball: chosen and placed, and placed by hand.

The model is dm_control's, whose recordings this writes: the robot stands and moves its legs, and a ball rolls by,
mostly ahead of it. By hand four parts of a kind look forward, backward, left and right, at several elevations. Scores
are the share of frames in which the ball is seen; intervals are over recordings.

    python benchmarks/quadruped.py --recordings FOLDER
    python benchmarks/quadruped.py --design RUN/designs/NAME.yaml
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import parser, report, verdict

RECORDINGS, FRAMES, RATE_HZ = 120, 60, 10.0
BALL_M, NEAR_M, FAR_M = 0.15, 1.2, 3.5
PARTS, ELEVATIONS_DEG = ("vl53l8cx", "tmf8828"), (-30, -20, -10, 0)
# by azimuth [deg]: on the edges of the box of origins
PLACES_M = {0: (0.3, 0, 0.3), 90: (0, 0.3, 0.3), 180: (-0.3, 0, 0.3), 270: (0, -0.3, 0.3)}
HELD_OUT = 180


def write_recordings(folder: Path) -> None:
    """Joint positions of the robot and places of the ball, a file each."""
    from lidardesign_tasks.robot.motion import Wanderer

    from lidardesign.mujoco_model import load_model

    package = find_spec("dm_control")
    if package is None or package.submodule_search_locations is None:
        raise SystemExit("dm_control is not installed: make consumers")
    path = Path(next(iter(package.submodule_search_locations))) / "suite" / "quadruped.xml"
    model, _ = load_model(path)
    wanderer, time_s = Wanderer(model, str(path)), np.arange(FRAMES) / RATE_HZ
    start = int(model.joint("ball_root").qposadr[0])
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(RECORDINGS):
        generator = np.random.default_rng(number)
        qpos = wanderer.draw(FRAMES, RATE_HZ, generator)
        azimuth = generator.normal(0, 0.7) + generator.normal(0, 0.5) * time_s
        away = np.clip(generator.uniform(NEAR_M, FAR_M) + generator.normal(0, 0.3) * time_s, NEAR_M, FAR_M)
        ball = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), np.full(FRAMES, BALL_M)], axis=1)
        qpos[:, start : start + 3] = ball
        np.savez(folder / f"{number:03}.npz", time_s=time_s, qpos=qpos)
    print(f"{path}: {RECORDINGS} recordings in {folder}")


def by_hand() -> dict[str, Any]:
    """The rays of four parts of a kind, by its name and where they look."""
    from lidardesign.design.catalog.library import find_part, looking_at, part_rays

    found = {}
    for name in PARTS:
        part = find_part(name)
        for elevation in ELEVATIONS_DEG:
            poses = [
                looking_at(part, np.array(place), math.radians(azimuth), math.radians(elevation))
                for azimuth, place in PLACES_M.items()
            ]
            found[f"{name} at {elevation} deg"] = part_rays(part, poses)
    return found


def main() -> None:
    """Measure and print."""
    import lidardesign as ld
    from lidardesign.simulate.simulate import simulate
    from lidardesign.task import scenes_of

    made = parser(__doc__)
    made.add_argument("--recordings", type=Path, help="write recordings into this folder, and stop")
    made.add_argument("--design", type=Path, help="a design of parts, in its run")
    options = made.parse_args()
    if options.recordings is not None:
        write_recordings(options.recordings)
        return
    run, design = ld.open_run(options.design.parents[1]), ld.load_design(options.design)
    config = run.config.task.model_copy(update={"test": HELD_OUT})
    scenes = scenes_of(run.task, config, "test", 0, run.config.space)
    group = np.unique([scene.group for scene in scenes], return_inverse=True)[1]
    seen = {
        name: np.array([run.task.score(scene, simulate(scene, rays)).value for scene in scenes])
        for name, rays in {"chosen": design.rays(design.specification.rays), **by_hand()}.items()
    }
    rows: list[list[object]] = []
    for name, values in seen.items():
        more = np.bincount(group, seen["chosen"] - values) / np.bincount(group)
        half = 1.96 * float(more.std(ddof=1)) / math.sqrt(len(more))
        rows.append([name, float(values.mean()), float(more.mean()), half])
    columns = ["four parts", "seen %", "chosen sees more %", "half interval"]
    better = {str(row[0]): float(str(row[2])) > float(str(row[3])) for row in rows[1:]}
    claim = verdict("better by the interval", better)
    report("Four parts on a quadruped", {f"{len(scenes)} held-out scenes": (columns, rows)}, [claim], options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
