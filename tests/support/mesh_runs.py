"""A finished run whose sensors stand at one given place: two small balls of triangles, seen from the front."""

from __future__ import annotations

import numpy as np

from lidardesign.config import resolve, save_run_config
from lidardesign.density.objective.proposals import samples_without_visibility
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import save_samples
from lidardesign.task import load_task
from support.meshes import write_ball


def make_mesh_run(folder, count=3000, seed=3, overrides=()):
    """The run as `learn` leaves it, with samples of the density without occlusion; meshes lie beside its folder."""
    meshes = folder.parent / "balls"
    for number, length in enumerate((0.5, 0.7)):
        write_ball(meshes / f"{number}.stl", (length, 0.4, 0.2))
    task = load_task("meshes")
    settings = [f"task.folder={meshes}", "task.poses=4", "task.truth_points=100", *overrides]
    config = resolve(task, preset="draft", seed=seed, overrides=settings)
    start_manifest(folder, command=["lidardesign", "learn"], seed=seed)
    save_run_config(config, folder)
    scenes = list(task.scenes(config.task, "train", seed))
    generator = np.random.default_rng(seed)
    save_samples(samples_without_visibility(scenes, config.space, config.density, count, generator), folder)
    return folder
