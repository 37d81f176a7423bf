"""Arms read from MJCF: the embedded one, the real one where it is at hand, and files that are refused."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from lidardesign_tasks.robot import arm_motion
from lidardesign_tasks.robot.arm_motion import import_mink
from lidardesign_tasks.robot.arm_robot import BALL, load_robot
from support.robots import PIECE, TOOL_M, mjcf, written

from lidardesign.errors import ConfigError, DataError
from lidardesign.scenes.scene import Cylinder, Mesh, Sphere

REAL = Path(__file__).parents[3] / "shared" / "data" / "iiwa14" / "iiwa14.xml"
needs_real = pytest.mark.skipif(not REAL.exists(), reason="the real arm's model is not at ../shared/data/iiwa14")


def frames_at(robot, joints):
    """Positions of the bodies and the place and axes of the tool."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = joints
    mujoco.mj_kinematics(robot.model, data)
    site = robot.model.site(BALL).id
    return data.xpos[1:].copy(), data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy()


def test_the_embedded_arm_has_the_lengths_of_the_real_one():
    bodies, ball, axes = frames_at(load_robot(None, TOOL_M), np.zeros(7))
    heights = bodies[:, 2]
    shoulder, elbow, wrist = heights[[2, 4, 6]]
    assert shoulder == pytest.approx(0.36)
    assert elbow - shoulder == pytest.approx(0.42)
    assert wrist - elbow == pytest.approx(0.40)
    np.testing.assert_allclose(ball, [0, 0, wrist + 0.126 + TOOL_M], atol=1e-9)
    np.testing.assert_allclose(axes, np.eye(3), atol=1e-9)


def test_the_embedded_arm_points_down_and_touches_nothing_at_home():
    robot = load_robot(None, TOOL_M)
    _, ball, axes = frames_at(robot, robot.home_rad)
    np.testing.assert_allclose(axes[:, 2], [0, 0, -1], atol=1e-5)
    assert 0.4 < np.hypot(*ball[:2]) < 0.7
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home_rad
    mujoco.mj_forward(robot.model, data)
    assert data.ncon == 0


def test_the_tool_ends_where_the_ball_begins():
    for tool_m in (0.05, 0.15, 0.3):
        robot = load_robot(None, tool_m)
        tool = robot.links[-1]
        assert tool.name == "tool"
        end = tool.pose[2, 3] + tool.shape.half_length_m + tool.shape.radius_m
        site = robot.model.site(BALL)
        assert end == pytest.approx(site.pos[2] - 0.02, abs=1e-9)
        assert site.pos[2] - 0.045 == pytest.approx(tool_m)


def test_an_arm_is_read_once_and_again_when_its_file_changes(tmp_path):
    path = written(tmp_path, mjcf())
    first = load_robot(path, TOOL_M)
    assert load_robot(path, TOOL_M) is first
    written(tmp_path, mjcf(inside="<!-- changed -->"))
    assert load_robot(path, TOOL_M) is not first


def test_shapes_of_the_world_are_left_out_with_a_note_and_cylinders_stay_cylinders(tmp_path):
    world = '<geom type="plane" size="1 1 1"/><geom type="box" size=".1 .1 .1" pos="2 0 0"/>'
    piece = PIECE.replace('"capsule"', '"cylinder"')
    robot = load_robot(written(tmp_path, mjcf(world=world, piece=piece)), TOOL_M)
    assert len(robot.links) == 8
    assert any("not on the arm, are left out: 2" in note for note in robot.notes)
    for link in robot.links[:-1]:
        assert link.shape == Cylinder(0.03, 0.09)
        np.testing.assert_allclose(link.pose[:3, 3], [0, 0, 0.09], atol=1e-9)


def test_only_the_visual_group_is_seen_where_a_model_has_one(tmp_path):
    piece = PIECE + '<geom type="sphere" size=".05" group="2"/>'
    robot = load_robot(written(tmp_path, mjcf(piece=piece)), TOOL_M)
    assert all(isinstance(link.shape, Sphere) for link in robot.links[:-1])


REFUSED = {
    "an empty file": ("", "is not XML"),
    "no joints": (mjcf(0), "has 0 joints"),
    "six hinges": (mjcf(6), "has 6 joints"),
    "a free body beside": (mjcf().replace("<worldbody>", "<worldbody><body><freejoint/><geom size='.1'/></body>"), "8"),
    "a slide": (mjcf().replace("<joint", '<joint type="slide"', 1), "6 of them hinges"),
    "a bush": (
        "<mujoco><worldbody>" + "<body><joint/><geom size='.1'/></body>" * 7 + "</worldbody></mujoco>",
        "not one chain",
    ),
    "no shapes": (
        mjcf(piece=PIECE.split("<geom")[0] + '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'),
        "no visible shapes",
    ),
    "itself": ('<mujoco><include file="arm.xml"/></mujoco>', "already included"),
    "a mesh that is missing": (mjcf(inside='<asset><mesh name="m" file="m.obj"/></asset>'), "m.obj"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_model_that_cannot_be_used_is_refused_with_its_path(tmp_path, monkeypatch, case):
    text, message = REFUSED[case]
    folder = tmp_path / "model"
    folder.mkdir()
    monkeypatch.chdir(folder)
    with pytest.raises(DataError) as error:
        load_robot(written(folder, text), TOOL_M)
    assert message in str(error.value)
    assert "arm.xml" in str(error.value.where)
    assert {file.name for file in folder.iterdir()} <= {"arm.xml"}


def test_a_mesh_of_garbage_is_refused(tmp_path):
    (tmp_path / "m.obj").write_bytes(bytes(range(256)) * 20)
    path = written(tmp_path, mjcf(inside='<asset><mesh name="m" file="m.obj"/></asset>'))
    with pytest.raises(DataError, match="MuJoCo cannot read it"):
        load_robot(path, TOOL_M)


def test_a_missing_package_is_named_with_what_to_install(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(arm_motion, "import_module", missing)
    with pytest.raises(ConfigError, match="pip install mujoco mink"):
        import_mink()


@needs_real
def test_the_embedded_arm_moves_as_the_real_one():
    own, real = load_robot(None, TOOL_M), load_robot(REAL, TOOL_M)
    np.testing.assert_allclose(own.model.jnt_range, real.model.jnt_range, atol=1e-4)
    generator = np.random.default_rng(0)
    for _ in range(20):
        joints = generator.uniform(*own.model.jnt_range.T)
        for ours, theirs in zip(frames_at(own, joints), frames_at(real, joints), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-9)


@needs_real
def test_the_real_arm_has_one_mesh_per_link_of_the_embedded_ones_size():
    own, real = load_robot(None, TOOL_M), load_robot(REAL, TOOL_M)
    assert [link.name for link in real.links] == ["base", *(f"link{i}" for i in range(1, 8)), "tool"]
    assert all(isinstance(link.shape, Mesh) for link in real.links[:-1])
    assert {link.name.split()[0] for link in own.links} == {link.name for link in real.links}
    for link in real.links[:-1]:
        size = np.ptp(link.shape.bounds_m, axis=0)
        assert (size > 0.05).all()
        assert (size < 0.4).all()
