"""Surroundings of the shipped tasks: they reach every scene, and change neither its geometry nor its truth."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.emitter import EmitterTask
from lidardesign_tasks.face import FaceTask
from lidardesign_tasks.flatland import FlatlandTask
from lidardesign_tasks.meshes import MeshesTask
from lidardesign_tasks.surroundings import fog
from lidardesign_tasks.warehouse import WarehouseTask
from support.rays import rays_along

from lidardesign.run.content import fingerprint
from lidardesign.scenes.casting import shared_caster
from lidardesign.scenes.scene import Ambient
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import simulate
from lidardesign.space import direction

TASKS = {task.name: task() for task in (FaceTask, EmitterTask, MeshesTask, ArmTask, WarehouseTask, FlatlandTask)}
FEW = {
    "face": {"train": 1, "test": 1},
    "emitter": {"train": 1, "test": 1},
    "meshes": {"poses": 1},
    "arm": {"size": "small", "train": 1, "test": 1, "frames": 4},
    "warehouse": {"size": "small", "train": 1, "test": 1},
    "flatland": {"train": 1, "test": 1},
}
HARSH = {"illuminance_lux": 1e5, "light": "sun", "visibility_m": 10.0, "reflectance": 0.8, "gloss": 0.25}
MOVING = ("face", "emitter", "meshes", "warehouse")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes")
    for index in range(2):
        trimesh.creation.icosphere(subdivisions=2, radius=0.1 + 0.02 * index).export(path / f"ball{index}.ply")
    return path


def scene_of(name, folder, **changes):
    task = TASKS[name]
    given = {**FEW[name], **({"folder": folder} if name == "meshes" else {}), **changes}
    return task.scenes(task.Config(**given), "test", 0)[0]


@pytest.mark.parametrize("name", FEW)
def test_surroundings_reach_the_scene_and_leave_its_geometry_and_truth(name, folder):
    harsh = {**HARSH, **({"speed_m_s": 3.0} if name in MOVING else {})}
    calm, changed = scene_of(name, folder), scene_of(name, folder, **harsh)
    assert changed.ambient == Ambient(1e5, "sun")
    assert changed.medium == fog(10.0)
    assert {(body.reflectance, body.specular) for body in changed.bodies} == {(0.75 * 0.8, 0.25)}
    speeds = [np.linalg.norm(body.velocity_m_s) for body in changed.bodies]
    assert max(speeds) == pytest.approx(3.0 if name in MOVING else 0.0)
    generator = np.random.default_rng(0)
    looking = direction(generator.uniform(0, 2 * math.pi, 2000), generator.uniform(-1.5, 1.5, 2000))
    for frame in range(calm.frames):
        here = shared_caster(calm, frame).first_hit(np.zeros(3), looking)
        there = shared_caster(changed, frame).first_hit(np.zeros(3), looking)
        assert np.array_equal(here.range_m, there.range_m)
    assert fingerprint(dict(calm.truth)) == fingerprint(dict(changed.truth))


@pytest.mark.parametrize("name", ["face", "meshes"])
def test_bodies_of_different_scenes_move_in_different_directions_at_one_speed(name, folder):
    task = TASKS[name]
    given = {"folder": folder, "poses": 6} if name == "meshes" else {"test": 6}
    scenes = task.scenes(task.Config(speed_m_s=2.0, **given), "test", 0)
    velocities = np.array([scene.bodies[0].velocity_m_s for scene in scenes])
    assert np.linalg.norm(velocities, axis=1) == pytest.approx(np.full(6, 2.0))
    assert np.linalg.matrix_rank(velocities) == 3


def test_fog_leaves_a_fiftieth_of_a_contrast_at_its_visibility():
    medium = fog(50.0)
    assert math.exp(-medium.extinction_per_m * 50.0) == pytest.approx(0.02)
    assert medium.extinction_per_m / medium.backscatter_per_m_sr == pytest.approx(18.8)


def test_the_guides_surroundings_change_what_a_photon_counter_reports(folder):
    page = Path(__file__).parents[2] / "docs" / "writing-tasks.md"
    (block,) = re.findall(r"```python\n(from dataclasses.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    namespace: dict[str, object] = {}
    exec(block, namespace)  # the page's own text
    calm = scene_of("face", folder)
    outdoors = namespace["at_noon_in_haze"](calm)
    assert outdoors.truth is calm.truth
    turn = np.linspace(-0.25, 0.25, 12)
    azimuth, elevation = map(np.ravel, np.meshgrid(math.pi + turn, turn))
    rays = rays_along(direction(azimuth, elevation), (0.05, 1.05), (0.4, 0.0, 0.0))
    planner = Planner(load_detector("single-photon"))
    names = {"ambient", "atmosphere", "specular", "pile_up"}
    assert names <= planner.plan(outdoors, [rays]).effects
    assert not names & (planner.plan(calm, [rays]).effects - {"ambient"})
    effects = planner.plan(outdoors, [rays]).effects - {"multipath"}
    (returns,) = simulate(outdoors, rays, physics=Physics(planner.detector, effects))
    (exact,) = simulate(outdoors, rays)
    both = returns.returned & exact.returned
    assert both.sum() > 40
    assert (returns.range_m[both] != exact.range_m[both]).all()
