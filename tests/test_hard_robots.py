"""Robot files that are none: refused at once, never waited for."""

from __future__ import annotations

import os

import pytest
from lidardesign_tasks.arm_files import model_files

from lidardesign.errors import DataError


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_no_robot_and_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "robot.xml")
    with pytest.raises(DataError, match="no regular file"):
        model_files(tmp_path / "robot.xml")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "garbage",
        "<urdf/>",
        '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><mujoco model="&x;"/>',
        '<mujoco><include file="../other.xml"/></mujoco>',
        '<mujoco><asset><mesh name="m" file="/etc/passwd"/></asset></mujoco>',
        '<mujoco><compiler meshdir="../.."/><asset><mesh name="m" file="a.stl"/></asset></mujoco>',
    ],
)
def test_what_is_no_model_or_leads_out_of_its_folder_is_refused(tmp_path, text):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    with pytest.raises(DataError) as refused:
        model_files(path)
    assert str(path) in str(refused.value)
