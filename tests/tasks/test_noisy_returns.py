"""Every shipped task scores what noisy detectors report: nothing at all, or returns that no surface sent."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.emitter import EmitterTask
from lidardesign_tasks.face import FaceTask
from lidardesign_tasks.flatland import FlatlandTask
from lidardesign_tasks.meshes import MeshesTask
from lidardesign_tasks.robot.task import MujocoTask
from lidardesign_tasks.surface import surface_score, with_visible_truth
from lidardesign_tasks.warehouse import WarehouseTask
from support.meshes import write_ball
from support.rays import rays_along, rays_of_points

from lidardesign.methods.laid_out import rays_at
from lidardesign.scenes.scene import Body, Box, Mesh, Scene, rigid
from lidardesign.scoring.scene_scores import checked_score, score_lists
from lidardesign.simulate.detector.physics import Detector, Physics
from lidardesign.simulate.returns import build_casters, simulate
from lidardesign.space import DIMENSIONS, RANGE, DesignSpace
from lidardesign.task import Metric, Score, conditions_of, scenes_of

ARM = Path(str(files("lidardesign_tasks") / "data" / "iiwa14.xml"))
TASKS = {
    "arm": (ArmTask, {"train": 1, "test": 1, "frames": 12}),
    "emitter": (EmitterTask, {"train": 1, "test": 1, "truth_points": 800}),
    "face": (FaceTask, {"train": 1, "test": 1, "truth_points": 800}),
    "flatland": (FlatlandTask, {"train": 1, "test": 1}),
    "mujoco": (MujocoTask, {"model": ARM, "targets": ("link7",), "train": 1, "test": 1, "frames": 6}),
    "meshes": (MeshesTask, {"folder": "balls", "truth_points": 800, "poses": 2}),
    "warehouse": (WarehouseTask, {"train": 1, "test": 1}),
}


def measure(name, tmp_path):
    """A task, a scene of it, and what even rays return there, one list per condition value and frame."""
    make, options = TASKS[name]
    task = make()
    if "folder" in options:
        for number in range(3):
            write_ball(tmp_path / "balls" / f"{number}.stl", (0.1, 0.12, 0.2))
        options = {**options, "folder": tmp_path / "balls"}
    config = task.Config(**options)
    space = task.space(config)
    scene = scenes_of(task, config, "test", 0, space)[0]
    returns = []
    for condition in conditions_of(task, config, space):
        points = space.sample(300, np.random.default_rng(1))
        for name, value in condition.items():
            points[:, DIMENSIONS.index(name)] = value
        returns += simulate(scene, rays_of_points(points, (space.low[RANGE], space.high[RANGE])))
    return task, scene, returns


def turned(returns, chosen, outcome, range_m):
    """Returns in which chosen rays have another outcome and range, of no body."""
    mask = np.broadcast_to(chosen, returns.outcome.shape)
    return replace(
        returns,
        outcome=np.where(mask, outcome, returns.outcome),
        range_m=np.where(mask, range_m, returns.range_m),
        body=np.where(mask, -1, returns.body),
    )


@pytest.mark.parametrize("name", TASKS)
def test_invented_returns_are_scored_as_returns_of_no_body(name, tmp_path):
    task, scene, returns = measure(name, tmp_path)
    generator = np.random.default_rng(2)
    noisy = []
    for one in returns:
        gate = one.rays.gate_m
        noisy.append(turned(one, generator.uniform(size=len(gate)) < 0.3, 0, generator.uniform(gate[:, 0], gate[:, 1])))
    clean, score = (checked_score(task, task.metric, scene, each) for each in (returns, noisy))
    sign = 1 if task.metric.better == "lower" else -1
    assert np.isfinite(score.value)
    # where even clean returns are too few, chance may do better
    assert clean.failed or sign * score.value >= sign * clean.value
    invented = [turned(one, True, 0, one.rays.gate_m[:, 1] * 0.999) for one in returns]
    assert clean.failed or sign * checked_score(task, task.metric, scene, invented).value >= sign * clean.value


@pytest.mark.parametrize("radius_m", [0.1, 3.0])
def test_outliers_are_returns_off_the_surface_however_large_it_is(radius_m):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
    space = DesignSpace(
        (4 * radius_m, 0, 0, np.pi - 0.25, -0.25, 0.0), (4 * radius_m, 0, 0, np.pi + 0.25, 0.25, 5 * radius_m)
    )
    scene = Scene((Body(Mesh(ball.vertices, ball.faces), "ball"),))
    scene = with_visible_truth(scene, space, 5000, np.random.default_rng(0))
    (found,) = simulate(scene, rays_at(space.sample(400, np.random.default_rng(1)), np.array([0.0, 5 * radius_m])))
    metric = MeshesTask.metric
    assert surface_score(metric, scene, [found]).details["outliers_percent"] == 0.0
    wrong = np.flatnonzero(found.returned)[::4]
    off_m = np.zeros(len(found.rays))
    off_m[wrong] = -radius_m
    score = surface_score(metric, scene, [replace(found, range_m=found.range_m + off_m)])
    assert score.details["outliers_percent"] == pytest.approx(100 * len(wrong) / found.returned.sum())


class Remembering:
    """A task that keeps the returns that it is asked to score."""

    name, metric = "remembering", Metric("nothing", "m", "lower", worst=1.0, tolerance=0.1)

    def __init__(self):
        self.ranges = []

    def score(self, scene, returns):
        self.ranges.append([one.range_m for one in returns])
        return Score(0.0)


def test_chance_is_the_same_for_baseline_rays_and_another_one_at_each_position():
    wall = Body(Box((0.05, 2, 2)), "wall", poses=rigid(translation_m=(1.05, 0, 0)))
    scene, count = Scene((wall,)), 50
    rays = rays_along(np.tile((1.0, 0.0, 0.0), (count, 1)), (0.5, 2.0))
    task, detector = Remembering(), Detector("timed", jitter_sigma_s=1e-11)
    jobs = [(rays, rays), (rays, rays)]
    list(score_lists(task, task.metric, scene, jobs, build_casters(scene), Physics(detector, frozenset({"jitter"}))))
    (here, there), (other_here, other_there) = task.ranges
    assert np.array_equal(here, other_here)
    assert np.array_equal(there, other_there)
    assert abs(np.corrcoef(here, there)[0, 1]) < 4 / np.sqrt(count)
