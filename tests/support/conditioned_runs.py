"""A finished run whose density has a condition."""

from __future__ import annotations

import numpy as np

from lidardesign.config import resolve, save_run_config
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import Samples, save_samples
from lidardesign.task import load_task
from support.spaces import log_volume


def log_target(points):
    """A spot of flatland's line of sensors that every position sees under another azimuth."""
    azimuth = np.pi / 2 + 0.4 * (0.5 - points[:, 0])
    return -0.5 * (np.square((points[:, 3] - azimuth) / 0.1) + np.square((points[:, 5] - 0.6) / 0.05))


def make_conditioned_run(folder, count=6000, condition="[x_m]"):
    """A run of flatland, conditioned on where the sensor is, as `learn` leaves it."""
    task = load_task("flatland")
    config = resolve(task, preset="draft", seed=3, overrides=[f"space.condition={condition}", "train=8", "test=6"])
    generator = np.random.default_rng(0)
    points = config.space.sample(count, generator)
    start_manifest(folder, command=["lidardesign", "learn"], seed=3)
    save_run_config(config, folder)
    log_prob = np.full(count, -log_volume(config.space))
    save_samples(Samples(points, log_prob, log_target(points), config.space), folder)
    return folder
