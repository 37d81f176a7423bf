"""Robots that nobody here made: from a model to a report and a model with sensors in it, without a line of code.

Each model goes from `learn` (draft) to `export --robot`, with sensors in the world and on the robot; in random
configurations the rangefinders of what was exported are read beside our first hits. In the world, where places are free
in a box, sensors at one place each stand beside such whose rays start all over regions. What is in the folder is not
made again.

    python benchmarks/robots.py --folder robots [--models FOLDER] [--set KEY=VALUE]
"""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import lidardesign, parser, report, run_process, verdict

TOLERATED_M = 1e-4
CONFIGURATIONS = 10
RAYS = "64"
WORLD = ("origin_box_m=0.3",)
# Regions of any size
REGIONS = "origin.spread_m.max=10"


@dataclass(frozen=True)
class Case:
    """A model, and where sensors are.

    Arguments:
        file: The model, inside the package that it comes with.
        targets: What is to be found.
        mounts: Keys of the task that put sensors into the world, or on the robot.
        folder: What holds all files of the model.
    """

    file: str
    targets: str
    mounts: Mapping[str, tuple[str, ...]]
    folder: str | None = None


HAND = "gymnasium_robotics/envs/assets"
CASES = {
    "quadruped, height field": Case(
        "dm_control/suite/quadruped.xml", "toe*",
        {"world": WORLD, "torso": ("mount_body=torso", "origin_m=[0,0,-0.25]", "metric=seen")},
    ),
    "humanoid": Case(
        "dm_control/suite/humanoid.xml", "*hand",
        {"world": WORLD, "torso": ("mount_body=torso", "origin_m=[0.15,0,0.05]", "metric=seen")},
    ),
    "dog": Case("dm_control/suite/dog.xml", "toe_*", {"world": WORLD, "skull": ("mount_body=skull", "metric=seen")}),
    "hand": Case(
        f"{HAND}/hand/reach.xml", "*distal", {"world": WORLD, "palm": ("mount_body=robot0:palm", "metric=seen")}, HAND
    ),
    "gripper arm": Case(
        f"{HAND}/fetch/pick_and_place.xml", "*finger_link",
        {"world": WORLD, "gripper": ("mount_body=robot0:gripper_link", "origin_m=[-0.02,0,0.06]", "metric=seen")}, HAND,
    ),
}  # fmt: skip


def found_file(name: str, models: Path | None) -> Path:
    """A file of a package, which is not imported, or of a folder that packages were unpacked into."""
    if models is not None:
        return models / name
    package = importlib.util.find_spec(name.split("/")[0])
    if package is None or not package.submodule_search_locations:
        sys.exit(f"{name.split('/')[0]} is not installed: pip install --no-deps, or --models FOLDER")
    return Path(next(iter(package.submodule_search_locations))).parent / name


def chain(case: Case, mount: str, folder: Path, options: Any) -> dict[str, Any]:
    """The commands from a model to a model with sensors, with their times [s]; made where it is missing."""
    kept = folder / "chain.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    model, run = found_file(case.file, options.models), folder / "run"
    keys = [f"model={model}", f"targets=['{case.targets}']", *case.mounts[mount], *options.set]
    if case.folder is not None:
        keys.append(f"folder={found_file(case.folder, options.models)}")
    words = [word for key in keys for word in ("--set", key)]
    exported = folder / "scene.xml"
    commands = {
        "learn": ("learn", "mujoco", "--preset", "draft", "--out", run, *words),
        "fit": ("fit", run, "--sensors", "2", "--rays", RAYS, "--name", "two"),
        "regions": ("constrain", run, "--set", REGIONS, "--sensors", "2", "--rays", RAYS, "--name", "regions"),
        "evaluate": ("evaluate", run, "--rays", RAYS, "--report", folder / "report.html"),
        "export": (
            "export",
            run / "designs" / "two.yaml",
            "--format",
            "mjcf",
            "--robot",
            model,
            "--out",
            exported,
        ),
    }
    seconds, scores = {}, {}
    if mount != "world":
        del commands["regions"]
    for name, command in commands.items():
        result = run_process(lidardesign(*command, "--json"))
        if result.code:
            sys.exit(f"{folder.name}: {name} ended with exit code {result.code}:\n{result.errors or result.output}")
        seconds[name] = result.wall
        if name == "evaluate":
            scores = {row["design"]: row["value"] for row in result.document()["rows"]}
    found = {"seconds": seconds, "scores": scores, "off_m": misread_m(run, model, exported, case, options).tolist()}
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def misread_m(run: Path, model_file: Path, exported: Path, case: Case, options: Any) -> np.ndarray:
    """How far each rangefinder of an exported model is from our first hit, in random configurations, (C, R) [m]."""
    import mujoco

    from lidardesign import load_design
    from lidardesign.scenes.casting import SceneCaster
    from lidardesign.scenes.mujoco_models import bodies_from_mujoco, load_model
    from lidardesign.scenes.scene import Scene, rigid

    design = load_design(run / "designs" / "two.yaml")
    rays, mount = design.rays(int(RAYS)), design.specification.mount
    alone, _ = load_model(model_file, folder=None if case.folder is None else found_file(case.folder, options.models))
    with_sensors = mujoco.MjModel.from_xml_path(str(exported))
    data, generator, off = mujoco.MjData(with_sensors), np.random.default_rng(0), []
    for _ in range(CONFIGURATIONS):
        data.qpos[:] = with_sensors.qpos0
        mujoco.mj_integratePos(with_sensors, data.qpos, generator.normal(0.0, 0.2, with_sensors.nv), 1.0)
        mujoco.mj_forward(with_sensors, data)
        pieces = bodies_from_mujoco(alone, data.qpos)
        # rays pass through what carries the sensors
        scene = Scene(tuple(piece.body for piece in pieces if mount is None or piece.body_name != mount))
        pose = np.eye(4)
        if mount is not None:
            pose = rigid(data.body(mount).xmat.reshape(3, 3), data.body(mount).xpos)
        turned = rays.direction @ pose[:3, :3].T
        ours = SceneCaster(scene).first_hit(rays.origin_m @ pose[:3, :3].T + pose[:3, 3], turned)
        # MuJoCo cuts its -1 off, too
        ends_m = rays.gate_m[:, 1]
        expected = np.where(ours.body >= 0, np.minimum(ours.range_m, ends_m), np.maximum(-1.0, -ends_m))
        off.append(np.abs(data.sensordata[-len(rays) :] - expected))
    return np.array(off)


def chains(options: Any) -> tuple[list[list[object]], list[str]]:
    """One row per model and place of sensors, and whether rangefinders say what we say."""
    rows: list[list[object]] = []
    for name, case in CASES.items():
        for mount in case.mounts:
            folder = options.folder / f"{name.replace(', ', '-').replace(' ', '-')}-{mount}"
            folder.mkdir(parents=True, exist_ok=True)
            print(f"{folder.name} ...", file=sys.stderr, flush=True)
            found = chain(case, mount, folder, options)
            off_m = np.array(found["off_m"])
            seconds = [found["seconds"][step] for step in ("learn", "fit", "evaluate", "export")]
            scores = [found["scores"].get(design, float("nan")) for design in ("two", "regions")]
            rows.append(
                [name, mount, *seconds, *scores, off_m.size, int((off_m > TOLERATED_M).sum()), 1e3 * np.median(off_m)]
            )
    same = {f"{row[0]}, {row[1]}": not row[-2] for row in rows}
    return rows, [verdict("every rangefinder reads our first hit within 0.1 mm", same)]


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs, reports and models are kept")
    made.add_argument("--models", type=Path, help="where packages were unpacked (default: those installed)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    options = made.parse_args()
    rows, lines = chains(options)
    steps = ["learn s", "fit s", "evaluate s", "export s"]
    columns = [
        "model",
        "sensors",
        *steps,
        "score, places",
        "score, regions",
        "readings",
        "off by more than 0.1 mm",
        "median off mm",
    ]
    report("Robots of others", {"From a model to a model with sensors": (columns, rows)}, lines, options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
