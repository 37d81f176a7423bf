"""Four range cameras on a quadruped's torso that look for balls: chosen and placed, and placed by hand.

The model is dm_control's. MuJoCo moves it: its legs swing, and a ball rolls at it from anywhere around. By hand four
parts of a kind look forward, backward, left and right, at several elevations. What docs/benchmarks.md says of it:

    python benchmarks/quadruped.py quadruped.xml --recordings walks
    lidardesign learn mujoco --preset draft --set model=quadruped.xml --set motion=walks --set 'targets=[ball]' \\
        --set 'ignored=[terrain, "wall*"]' --set mount_body=torso --set 'origin_m=[0,0,0.16]' \\
        --set 'origin_box_m=[0.34,0.3,0.06]' --set metric=seen --set frames=12 --set frame_rate_hz=5 --set train=200 \\
        --set test=200 --set density.sigma_m=0.05 --out runs/walks
    python benchmarks/quadruped.py quadruped.xml --by-hand runs/walks
    lidardesign constrain runs/walks --constraints runs/walks/parts.yaml --name chosen
    lidardesign evaluate runs/walks/designs/vl53l8cx-30.yaml runs/walks/designs/chosen.yaml --rays 256
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np

RECORDINGS, SETTLED_S, SECONDS, RATE_HZ = 400, 0.5, 2.5, 20.0
BALL_M = 0.15
OFFERED = ("vl53l8cx", "vl53l5cx", "tmf8828")
PARTS, DOWN_DEG = ("vl53l8cx", "tmf8828"), (20, 30, 40, 50)
# of the torso: four that look out by hand, the corners, the top
OUT_M = {0: (0.34, 0.0, 0.1), 180: (-0.33, 0.0, 0.1), 90: (0.0, 0.29, 0.1), -90: (0.0, -0.29, 0.1)}
CORNERS_M = tuple((x, y, 0.18) for x in (0.26, -0.26) for y in (0.22, -0.22))
MOUNTS_M = (*OUT_M.values(), *CORNERS_M, (0.0, 0.0, 0.22))


def recording(model: object, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and configurations while legs swing and a ball rolls at the robot."""
    import mujoco

    assert isinstance(model, mujoco.MjModel)
    data, turn = mujoco.MjData(model), 2 * math.pi * generator.uniform(0.8, 1.5)
    phases = np.array([0, math.pi, 0, math.pi]) + generator.uniform(0, 2 * math.pi)
    swings = generator.uniform([[0.2], [0.2], [0.1]], [[0.6], [0.5], [0.4]], (3, 4)).T  # of yaw, lift and extend
    rest, ball = np.array([0.0, 0.25, 0.1]), model.joint("ball_root")
    start, speed = int(ball.qposadr[0]), int(ball.dofadr[0])

    def step() -> None:
        angles = turn * data.time + phases
        waves = np.stack([np.sin(angles), np.cos(angles), np.cos(angles)], axis=1)
        data.ctrl[:] = (rest + swings * waves).ravel()
        mujoco.mj_step(model, data)

    data.qpos[2], data.qpos[start : start + 3] = 0.6, (5.0, 5.0, BALL_M)
    while data.time < SETTLED_S:
        step()
    azimuth, here = generator.uniform(-math.pi, math.pi), data.qpos[:2].copy()
    begin = here + generator.uniform(1.2, 2.2) * np.array([math.cos(azimuth), math.sin(azimuth)])
    way = here + generator.uniform(-0.8, 0.8, 2) - begin
    velocity = generator.uniform(0.5, 1.5) * way / np.linalg.norm(way)
    data.qpos[start : start + 3] = *begin, BALL_M
    data.qvel[speed : speed + 6] = *velocity, 0.0, -velocity[1] / BALL_M, velocity[0] / BALL_M, 0.0
    rows, began_s = [], data.time
    while data.time < began_s + SECONDS:
        if data.time >= began_s + len(rows) / RATE_HZ:
            rows.append(data.qpos.copy())
        step()
    return np.arange(len(rows)) / RATE_HZ, np.array(rows)


def write_recordings(path: Path, folder: Path) -> None:
    """Joint positions of the robot and places of the ball, a file each."""
    from lidardesign.scenes.mujoco_models import load_model

    model, _ = load_model(path)
    terrain = model.geom("terrain")  # flat, below the floor
    terrain.contype = terrain.conaffinity = 0
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(RECORDINGS):
        time_s, qpos = recording(model, np.random.default_rng(number))
        np.savez(folder / f"{number:03}.npz", time_s=time_s, qpos=qpos)


def write_by_hand(run: Path) -> None:
    """Designs of four parts of a kind that look out and down, and the constraints of the choice as `parts.yaml`."""
    from lidardesign.parts.catalogue import find_part, looking_at, part_design
    from lidardesign.run.yaml import dump_yaml
    from lidardesign.sensors.design_file import save_design

    mounts = {"mounts_m": [list(mount) for mount in MOUNTS_M]}
    bought = {"origin": mounts, "parts": {"names": list(OFFERED), "count": len(OUT_M)}}
    (run / "parts.yaml").write_text(dump_yaml(bought), encoding="utf-8")
    for name in PARTS:
        part = find_part(name)
        for down in DOWN_DEG:
            poses = [
                looking_at(part, np.array(place), math.radians(azimuth), math.radians(-down))
                for azimuth, place in OUT_M.items()
            ]
            design = part_design(part, poses, name=f"{name}-{down}")
            design = replace(
                design, mount="torso", constraints={"origin": mounts}, provenance={**design.provenance, "run": ".."}
            )
            save_design(design, run / "designs" / f"{design.name}.yaml")


def main() -> None:
    """Write what is asked for."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("model", type=Path, help="dm_control/suite/quadruped.xml")
    made.add_argument("--recordings", type=Path, metavar="FOLDER", help="write recordings into this folder")
    made.add_argument(
        "--by-hand", type=Path, metavar="RUN", help="write designs by hand, and constraints, into this run"
    )
    options = made.parse_args()
    if options.recordings is not None:
        write_recordings(options.model, options.recordings)
    if options.by_hand is not None:
        write_by_hand(options.by_hand)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
