"""Moving robots: motions that MuJoCo cannot vouch for, poses out of reach, files where none belong."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.robot import arm_motion
from lidardesign_tasks.robot.arm_motion import (
    PENETRATION_M,
    TRIES,
    Arm,
    RejectedError,
    draw_waypoints,
)
from lidardesign_tasks.robot.arm_robot import load_robot
from support.robots import TOOL_M, mjcf, written

from lidardesign.errors import DataError
from lidardesign.scenes.mujoco_models import MAX_INCLUDES, model_files, mujoco_warnings

TASK = ArmTask()
WARNINGS = [mujoco.mjtWarning(number) for number in range(int(mujoco.mjtWarning.mjNWARNING))]


@pytest.fixture(scope="module")
def arm():
    return Arm(load_robot(None, TOOL_M), 1.0)


@pytest.mark.hard_case(
    "M1",
    "A rollout is unstable: MuJoCo warns, bodies sink into each other, numbers are NaN",
    done="the motion is rejected and drawn anew, at most 50 times, from the stream of the run's seed",
)
class TestUnstableRollouts:
    @pytest.mark.parametrize("warning", WARNINGS, ids=lambda w: w.name)
    def test_any_warning_of_mujoco_rejects_the_motion(self, arm, warning):
        data = mujoco.MjData(arm.robot.model)
        arm._check_state(data)
        data.warning[warning].number = 1
        with pytest.raises(RejectedError, match="warned"):
            arm._check_state(data)

    @pytest.mark.parametrize("name", ["qpos", "qacc", "xpos"])
    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_numbers_that_are_not_finite_reject_the_motion(self, arm, name, value):
        data = mujoco.MjData(arm.robot.model)
        getattr(data, name).flat[0] = value
        with pytest.raises(RejectedError, match="diverged"):
            arm._check_state(data)

    def test_a_motion_whose_velocities_overflow_is_rejected(self, arm):
        joints = np.zeros((3, 7))
        joints[1] = 1e200
        with mujoco_warnings(), pytest.raises(RejectedError):
            arm._forward(joints, 1.0)

    def test_links_that_are_deeper_in_each_other_than_the_tolerance_reject_the_motion(self, arm):
        folded = np.tile([0.0, 1.2, 0.0, -2.05, 0.0, 1.5, 0.0], (3, 1))  # the tool reaches into the pedestal
        with pytest.raises(RejectedError, match="collide"):
            arm._forward(folded, 1.0)
        data = mujoco.MjData(arm.robot.model)
        data.qpos[:] = folded[0]
        mujoco.mj_forward(arm.robot.model, data)
        assert data.contact.dist[: data.ncon].min() < -PENETRATION_M

    def test_rejected_motions_are_drawn_again_counted_and_noted(self):
        config = TASK.Config(train=6, frames=6, jitter_m=0.3)
        made = TASK.scenes(config, "train", 0)
        counted = sum((Counter(scene.truth["rejected"]) for scene in made), Counter())
        assert len(made) == 6
        assert counted.total() > 0
        (note,) = made[0].notes
        assert note.startswith("train: motions that the arm cannot perform were drawn again: ")
        assert all(f"{count} {reason}" in note for reason, count in counted.items())
        again = TASK.scenes(config, "train", 0)
        for first, second in zip(made, again, strict=True):  # the seed tells which ones were rejected
            assert first.truth["rejected"] == second.truth["rejected"]
            np.testing.assert_array_equal(first.truth["ball_m"], second.truth["ball_m"])


@pytest.mark.hard_case(
    "M2",
    "Inverse kinematics has no solution: the place is out of reach",
    done="the pose's error is checked against 1 mm and half a degree after every way-point",
)
class TestPosesOutOfReach:
    @pytest.mark.parametrize("away", [(1.0, 0, 0), (0, 0, 1.5), (0, -2.0, 0), (1e6, 0, 0)])
    def test_a_place_out_of_reach_is_rejected(self, arm, away):
        far = draw_waypoints(0.1, np.random.default_rng(0)) + np.array(away)
        with pytest.raises(RejectedError, match="out of reach"):
            arm.follow(far, 10, 1.0, Counter())

    def test_a_place_that_is_no_place_is_rejected(self, arm):
        nowhere = draw_waypoints(0.1, np.random.default_rng(0))
        nowhere[3] = np.nan
        with pytest.raises(RejectedError):
            arm.follow(nowhere, 10, 1.0, Counter())

    def test_an_arm_that_reaches_nothing_is_refused_with_the_reasons(self, arm, monkeypatch):
        monkeypatch.setattr(arm_motion, "HOVER_M", np.array([5.0, 0.0, 0.35]))
        match = rf"none of {TRIES} drawn motions \({TRIES} out of reach\)"
        with pytest.raises(DataError, match=match) as refused:
            arm.draw(0.1, 4, 1.0, np.random.default_rng(0), "train 0")
        assert "trajectory train 0" in str(refused.value)
        assert refused.value.exit_code == 3


@pytest.mark.hard_case(
    "M3",
    "MuJoCo warns: it writes MUJOCO_LOG.TXT into the working folder",
    done="warnings are collected while robots are read and moved, become notes or reasons, and no file is written",
)
class TestNoLogFile:
    def test_warnings_are_collected_the_handler_is_put_back_and_no_file_is_written(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        before = mujoco.get_mju_user_warning()
        model = mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
        )
        data = mujoco.MjData(model)
        data.qvel[0] = math.nan

        def unstable():
            mujoco.mj_step(model, data)
            raise RejectedError("MuJoCo warned")

        with pytest.raises(RejectedError), mujoco_warnings() as warnings:
            unstable()
        assert any("QVEL" in line or "Nan" in line for line in warnings)
        assert mujoco.get_mju_user_warning() is before
        path = written(tmp_path, mjcf(inside='<asset><mesh name="m" file="m.obj"/></asset>'))
        with pytest.raises(DataError):
            load_robot(path, TOOL_M)
        assert list(tmp_path.iterdir()) == [path]

    def test_no_log_file_is_written_and_importing_the_task_imports_no_mujoco(self, tmp_path):
        code = (
            "import sys; from lidardesign_tasks.arm import ArmTask as T; "
            "assert not {'mujoco', 'mink', 'scipy.spatial'} & set(sys.modules), sorted(sys.modules); "
            "c = T.Config(size='small', train=1, frames=4); T().scenes(c, 'train', 0); assert 'mujoco' in sys.modules"
        )
        subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=120)
        assert not list(tmp_path.iterdir())


OUTSIDE = {
    "an include of the folder above": '<mujoco><include file="../other.xml"/></mujoco>',
    "an absolute include": '<mujoco><include file="/etc/hostname"/></mujoco>',
    "an include by way of a folder inside": '<mujoco><include file="parts/../../other.xml"/></mujoco>',
    "an attached model": '<mujoco><asset><model name="m" file="../other.xml"/></asset></mujoco>',
    "an absolute mesh": '<mujoco><asset><mesh name="m" file="/etc/passwd"/></asset></mujoco>',
    "a folder of meshes above": '<mujoco><compiler meshdir=".."/><asset><mesh name="m" file="a.stl"/></asset></mujoco>',
    "a folder of textures elsewhere": '<mujoco><compiler texturedir="/tmp"/></mujoco>',
    "a side of a texture": '<mujoco><asset><texture type="cube" fileright="../t.png"/></asset></mujoco>',
    "a height field": '<mujoco><asset><hfield name="h" file="../h.png"/></asset></mujoco>',
    "a skin": '<mujoco><asset><skin file="../s.skn"/></asset></mujoco>',
}


@pytest.mark.hard_case(
    "M4",
    "A robot's XML reads files outside of its folder: includes, meshes, links, entities",
    done="every file that a model names is resolved, links followed, before MuJoCo sees the model",
)
class TestFilesOutsideTheFolder:
    @pytest.mark.parametrize("case", OUTSIDE)
    def test_what_leads_out_of_the_folder_is_refused(self, tmp_path, case):
        (tmp_path / "model").mkdir()
        written(tmp_path, "<mujoco/>", "other.xml")
        path = written(tmp_path / "model", OUTSIDE[case])
        with pytest.raises(DataError, match="outside the model's folder") as refused:
            load_robot(path, TOOL_M)
        assert str(path) in str(refused.value)

    def test_an_included_file_leads_no_further_out(self, tmp_path):
        (tmp_path / "model").mkdir()
        written(tmp_path / "model", '<mujoco><include file="../third.xml"/></mujoco>', "second.xml")
        path = written(tmp_path / "model", '<mujoco><include file="second.xml"/></mujoco>')
        with pytest.raises(DataError, match=r"'\.\./third\.xml', which is outside"):
            load_robot(path, TOOL_M)

    def test_includes_inside_the_folder_are_read_and_watched(self, tmp_path):
        body = mjcf().replace("<mujoco>", "").replace("</mujoco>", "")
        included = written(tmp_path, f"<mujoco>{body}</mujoco>", "body.xml")
        path = written(tmp_path, '<mujoco><include file="body.xml"/></mujoco>')
        assert [Path(name) for name, *_ in model_files(path)] == [path, included]
        assert load_robot(path, TOOL_M).model.njnt == 7

    def test_more_includes_than_anybody_needs_are_refused(self, tmp_path):
        for number in range(MAX_INCLUDES + 2):
            written(tmp_path, f'<mujoco><include file="{number + 1}.xml"/></mujoco>', f"{number}.xml")
        with pytest.raises(DataError, match=f"more than {MAX_INCLUDES}"):
            model_files(tmp_path / "0.xml")
