"""Runs that a page is opened on, and what tests of the page wait with."""

from __future__ import annotations

import time

import numpy as np

from lidardesign.config import resolve, save_run_config
from lidardesign.density.objective.proposals import samples_without_visibility
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import save_samples
from lidardesign.task import load_task

PATIENCE_S = 60.0
# A torso with an arm before it, whose end is looked for.
TORSO = """
<mujoco><worldbody><body name="torso" pos="0 0 1"><geom type="box" size=".1 .2 .3"/>
<body name="arm" pos=".1 .25 .1"><joint axis="0 0 1" range="-60 60"/>
<geom type="capsule" size=".03" fromto="0 0 0 .4 0 0"/>
<body name="hand" pos=".45 0 0"><joint axis="0 1 0" range="-60 60"/><geom type="sphere" size=".06"/></body>
</body></body></worldbody></mujoco>
"""


def wait_for(found):
    """What a function gives, once it is true."""
    end = time.monotonic() + PATIENCE_S
    while not (value := found()):
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.02)
    return value


def make_robot_run(folder, count=3000, seed=3):
    """A run of sensors on a robot's torso as `learn` leaves it, with samples of the density without occlusion."""
    model = folder.parent / "robot.xml"
    model.write_text(TORSO)
    settings = {
        "model": model, "targets": "[hand]", "mount_body": "torso", "metric": "seen", "origin_m": "[0.13, 0, 0]",
        "origin_box_m": "[0.01, 0.1, 0.1]", "train": 4, "test": 4, "frames": 3,
    }  # fmt: skip
    task = load_task("mujoco")
    overrides = [f"task.{key}={value}" for key, value in settings.items()]
    config = resolve(task, preset="draft", seed=seed, overrides=overrides)
    start_manifest(folder, command=["lidardesign", "learn"], seed=seed)
    save_run_config(config, folder)
    scenes, generator = list(task.scenes(config.task, "train", seed)), np.random.default_rng(seed)
    save_samples(samples_without_visibility(scenes, config.space, config.density, count, generator), folder)
    return folder
