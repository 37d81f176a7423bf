"""The laws that every shipped task keeps, over one table of configurations."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.emitter import EmitterTask
from lidardesign_tasks.face import FaceTask
from lidardesign_tasks.flatland import FlatlandTask
from lidardesign_tasks.meshes import MeshesTask
from lidardesign_tasks.poses import jittered_pose
from lidardesign_tasks.surface import fewer_points
from lidardesign_tasks.warehouse import WarehouseTask
from support.meshes import write_ball
from support.rays import rays_of_points

from lidardesign.contract import contract_of
from lidardesign.contract.contract import LAWS
from lidardesign.errors import ConfigError, DataError
from lidardesign.rays.coverage import SceneInformation, gather
from lidardesign.rays.information import checked_information
from lidardesign.run.content import fingerprint
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Scene, group_numbers
from lidardesign.simulate.returns import simulate
from lidardesign.space import aim
from lidardesign.task import scenes_of

REAL_MODEL = Path(__file__).parents[3] / "shared" / "data" / "ict_face.h5"
SMALL = {"train": 2, "test": 2, "truth_points": 800}
HALF_GATE_M = 0.02
MOST_ITEMS = 200

CASES = {
    "flatland surface": (FlatlandTask, {"train": 3, "test": 2}),
    "flatland discs": (FlatlandTask, {"train": 3, "test": 2, "scene": "discs"}),
    "flatland occluded": (FlatlandTask, {"train": 3, "test": 2, "scene": "occluded"}),
    "face embedded": (FaceTask, SMALL),
    "face with a free origin": (FaceTask, {**SMALL, "origin_box_m": 0.05}),
    "face of the real model": (FaceTask, {**SMALL, "train": 1, "test": 1, "model": str(REAL_MODEL)}),
    "emitter": (EmitterTask, SMALL),
    "meshes": (MeshesTask, {"folder": "three", "truth_points": 800, "poses": 2}),
    "one mesh": (MeshesTask, {"folder": "one", "truth_points": 800, "poses": 2}),
    "meshes in a bin": (MeshesTask, {"folder": "three", "clutter": 4, "truth_points": 800, "poses": 2}),
    "meshes behind an occluder": (MeshesTask, {"folder": "three", "occluders": "front", "truth_points": 800}),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("meshes")
    for index, radii in enumerate([(0.1, 0.12, 0.2), (0.12, 0.1, 0.22), (0.11, 0.13, 0.18)]):
        write_ball(root / "three" / f"ball{index}.stl", radii)
    write_ball(root / "one" / "only.stl", (0.1, 0.12, 0.2))
    write_ball(root / "front" / "post.stl", (0.02, 0.02, 0.3), shift=(0.4, 0.05, 0.0))
    return root


if not REAL_MODEL.exists():
    del CASES["face of the real model"]
each_case = pytest.mark.parametrize("name", CASES)


def placed(folders, values):
    """Values of a configuration with their folders where these are."""
    return {key: str(folders / value) if key in ("folder", "occluders") else value for key, value in values.items()}


@pytest.fixture(scope="module")
def case(folders):
    """Task, configuration, and its scenes by split, by name."""

    @cache
    def made(name):
        kind, values = CASES[name]
        task, config = kind(), kind.Config(**placed(folders, values))
        return task, config, {split: list(task.scenes(config, split, 0)) for split in ("train", "test")}

    return made


def truth_points(scene: Scene) -> np.ndarray:
    if "curve_m" in scene.truth:
        return np.column_stack([scene.truth["curve_m"], np.zeros(len(scene.truth["curve_m"]))])
    return scene.truth["surface"].points


def rays_at_truth(task, config, scene, count) -> Rays:
    """Rays from admissible origins at points spread over the truth, listening around them."""
    points = truth_points(scene)
    points = points[np.linspace(0, len(points) - 1, count).astype(int)]
    origins = task.space(config).sample(count, np.random.default_rng(3))[:, :3]
    design = aim(origins, points)
    gates = np.clip(design[:, 5:] + np.array([-HALF_GATE_M, HALF_GATE_M]), 0, None)
    return rays_of_points(design, gates)


@each_case
def test_the_task_keeps_every_law_of_the_contract(folders, name):
    kind, values = CASES[name]
    found = contract_of(kind(), overrides=[f"{key}={value}" for key, value in placed(folders, values).items()])
    # in another process they are made again by the tests of workers, and geometry has tests of its own
    laws = [law.name for law in LAWS if law.group != "geometry" and law.name != "scenes repeat elsewhere"]
    assert not [finding for finding in map(found.finding, laws) if finding.outcome == "fail"]


@each_case
def test_every_scene_has_a_target_and_a_truth_inside_the_design_space(case, name):
    task, config, scenes = case(name)
    space = task.space(config)
    fixed = space.low[:3] == space.high[:3]
    for scene in scenes["train"]:
        assert any(body.is_target for body in scene.bodies)
        points = truth_points(scene)
        assert len(points) > 100
        assert np.isfinite(points).all()
        if fixed:
            assert space.contains(aim(np.array(space.low[:3]), points)).all()


@each_case
def test_a_score_reads_rays_and_ranges_alone(case, name):
    task, config, scenes = case(name)
    scene = scenes["train"][0]
    (returns,) = simulate(scene, rays_at_truth(task, config, scene, 120))
    lost = np.where(returns.returned, returns.outcome, Outcome.NOT_DETECTED)
    for outcome, body in ((lost, returns.body), (returns.outcome, np.zeros_like(returns.body))):
        other = Returns(returns.rays, outcome, returns.range_m, body)
        assert task.score(scene, [other]).value == task.score(scene, [returns]).value


def told_by(information, returns, rays):
    """What a choice of the candidates, at these indices, knows of what there is to know, from 0 to 1."""
    count = len(returns[0].rays)
    informed, open_gates = SceneInformation.of(information, returns), np.tile([0.0, np.inf], (count, 1, 1))
    coverage = gather([informed], open_gates, np.zeros((count, 1)))
    gate = np.full(count, -1)
    gate[rays] = 0
    return coverage.value_of(gate) / coverage.complete


@each_case
def test_rays_that_tell_more_score_better_and_more_rays_never_tell_less(case, name):
    task, config, scenes = case(name)
    for scene in scenes["train"]:
        rays = rays_at_truth(task, config, scene, 300)
        returns = simulate(scene, rays)
        information = checked_information(task, scene, returns)
        assert 0 < len(information.frame) <= MOST_ITEMS
        # every tenth ray, and as many that look at one end of the truth's longest axis
        aimed = rays.origin_m + rays.direction * rays.gate_m.mean(axis=1, keepdims=True)
        order = np.argsort(aimed[:, np.ptp(truth_points(scene), axis=0).argmax()])
        choices = {"spread": order[::10], "crowded": order[:30], "more": order[:150], "all": order}
        told = {what: told_by(information, returns, chosen) for what, chosen in choices.items()}
        assert 0 < told["crowded"] <= told["more"] <= told["all"] <= 1
        assert told["crowded"] < told["spread"] < told["all"]
        seen = {what: simulate(scene, rays.subset(np.sort(chosen))) for what, chosen in choices.items()}
        values = {what: task.score(scene, one).value for what, one in seen.items()}
        assert values["all"] < values["spread"] < values["crowded"]


def test_points_of_a_region_count_as_much_as_it_does():
    centre, radius_m, edge_m, weight = np.array([-0.02, 0.0, 0.0]), 0.03, 0.01, 8.0
    region = {"region_radius_m": radius_m, "region_edge_m": edge_m, "region_weight": weight}
    # heads that stand still are where their region is
    still = {"jitter_rotation_deg": 0, "jitter_translation_m": 0}
    task, config = FaceTask(), FaceTask.Config(**SMALL, **still, region_centre_m=tuple(centre), **region)
    scene = task.scenes(config, "train", 0)[0]
    points = fewer_points(scene.truth, MOST_ITEMS)["surface"].points
    found = checked_information(task, scene, simulate(scene, rays_at_truth(task, config, scene, 60)))
    away = np.linalg.norm(points - centre, axis=1)
    spacing_m = 0.01  # of vertices, and of heads from their mean
    assert (found.weight[away < radius_m - spacing_m] == weight).all()
    assert (found.weight[away > radius_m + edge_m + spacing_m] == 1).all()
    assert 3 < (found.weight > 1).sum() < len(points) / 2


def test_more_scenes_keep_the_first_ones():
    for kind, values in ((FaceTask, {"truth_points": 200}), (FlatlandTask, {})):
        few, more = (kind().scenes(kind.Config(**values, train=n), "train", 0) for n in (1, 3))
        assert fingerprint(few[0]) == fingerprint(more[0])


def test_the_truth_follows_a_design_space_that_a_run_sets():
    task = FaceTask()
    config = FaceTask.Config(train=1, truth_points=300)
    space = task.space(config)
    narrow = type(space)(
        (*space.low[:3], np.pi - 0.1, -0.1, space.low[5]), (*space.high[:3], np.pi + 0.1, 0.1, space.high[5])
    )
    (scene,) = scenes_of(task, config, "train", 0, narrow)
    assert narrow.contains(aim(np.array(narrow.low[:3]), truth_points(scene))).all()


def test_what_gives_no_scenes_or_the_same_ones_everywhere_is_refused(folders, tmp_path):
    still = {"jitter_rotation_deg": 0, "jitter_translation_m": 0}
    for task, call, values, error, words in (
        (MeshesTask(), "scenes", {}, ConfigError, "no folder"),
        (MeshesTask(), "space", {"folder": str(tmp_path)}, DataError, "holds no mesh file"),
        (MeshesTask(), "space", {"folder": str(tmp_path / "nowhere")}, DataError, "is not a folder"),
        (MeshesTask(), "scenes", {"folder": str(folders / "one"), **still}, ConfigError, "the same"),
        (FaceTask(), "scenes", {"identity_scale": 0, **still}, ConfigError, "all heads are the same"),
    ):
        split = ("train", 0) if call == "scenes" else ()
        with pytest.raises(error, match=words):
            getattr(task, call)(task.Config(**values), *split)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_turning_the_up_axis_keeps_handedness(folders, up):
    config = MeshesTask.Config(folder=str(folders / "one"), up=up, truth_points=100, poses=1)
    mesh = MeshesTask().scenes(config, "train", 0)[0].bodies[0].shape
    assert mesh.sign == "solid"
    assert not any("inside out" in note for note in mesh.notes)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert np.einsum("fk,fk->f", a, np.cross(b, c)).sum() > 0
    height = {"x": 0.2, "y": 0.24, "z": 0.4}[up]
    assert np.ptp(mesh.bounds_m[:, 2]) == pytest.approx(height, rel=0.02)


@pytest.mark.parametrize("origin", [None, (0.0, 0.0, 1.0), (-0.7, 0.7, 0.4), (0.0, 0.0, 0.0), (0.5, 0.0, -0.6)])
@pytest.mark.parametrize("box", [0.0, 0.1])
def test_the_derived_design_space_sees_the_whole_of_every_mesh(folders, origin, box):
    config = MeshesTask.Config(folder=str(folders / "one"), origin_m=origin, origin_box_m=box)
    space = MeshesTask().space(config)
    corners = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.12, 0.12) for z in (-0.2, 0.2)])
    for place in (space.low[:3], space.high[:3]):
        assert space.contains(aim(np.array(place), corners)).all()


def test_jitter_is_rigid_about_its_centre_and_bounded():
    centre = np.array([0.1, -0.2, 0.3])
    for seed in range(20):
        pose = jittered_pose(np.random.default_rng(seed), 4.0, 0.0, centre)
        np.testing.assert_allclose(pose[:3, :3] @ centre + pose[:3, 3], centre, atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        angle = np.rad2deg(np.arccos((np.trace(pose[:3, :3]) - 1) / 2))
        assert angle <= 4.0 * 2.5 * np.sqrt(3) + 1e-9


def test_poses_of_one_mesh_are_one_group_and_other_scenes_are_their_own(tmp_path):
    for number in range(4):
        write_ball(tmp_path / "balls" / f"ball{number}.stl", 0.1 + 0.01 * number)
    config = MeshesTask.Config(folder=tmp_path / "balls", poses=3, truth_points=200)
    scenes = MeshesTask().scenes(config, "train", 0)
    assert [scene.group for scene in scenes] == [scene.bodies[0].name for scene in scenes]
    assert len(scenes) == 3 * (group_numbers(scenes).max() + 1)
    for task in (FlatlandTask(), WarehouseTask(), ArmTask()):
        scenes = task.scenes(task.Config(train=2), "train", 0)
        np.testing.assert_array_equal(group_numbers(scenes), [0, 1])
