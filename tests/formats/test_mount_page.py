"""The folder to mount from: whoever has only its numbers builds the design."""

import csv
import math
import re
import shlex
from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.exports import write_as
from support.rigs import NASTY, rig

from lidardesign.formats.mount_page import mounted_parts
from lidardesign.parts.catalogue import Pose, find_part, part_design
from lidardesign.scenes.rays import rotation_of_quaternion

poses = st.builds(
    lambda place, azimuth, elevation, roll: Pose(np.array(place), azimuth, elevation, roll),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.floats(-math.pi, math.pi),
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(-math.pi, math.pi),
)


def written(design, folder, count=None):
    rays = design.rays(design.count if count is None else count)
    notes = write_as("mounts", design, rays, folder)
    with (folder / "mounts.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file)), notes


def values(row, *names):
    return np.array([float(row[name]) for name in names])


def axes_of(row):
    """Forward, left and up of a row, from its quaternion."""
    return rotation_of_quaternion(*values(row, "qw", "qx", "qy", "qz")).T


def looking(row):
    """The directions of a row's zones or pixels in its own frame, by what docs/formats.md says of the columns."""
    across, up = np.meshgrid(
        *(
            low + (high - low) * (np.arange(number) + 0.5) / number
            for number, (low, high) in (
                (int(row["columns"]), values(row, "field_right_deg", "field_left_deg")),
                (int(row["rows"]), values(row, "field_bottom_deg", "field_top_deg")),
            )
        )
    )
    angle = np.radians(np.hypot(across, up).ravel())
    turn = np.arctan2(up, across).ravel()
    return np.stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)], axis=1)


@settings(max_examples=10, deadline=None)
@given(pose=poses, name=st.sampled_from(["vl53l5cx", "tmf8828", "vl53l8cx:4x4"]))
def test_the_zones_of_a_row_are_the_rays_of_the_design(tmp_path_factory, pose, name):
    design = part_design(find_part(name), pose)
    (row,), _ = written(design, tmp_path_factory.mktemp("mounts"))
    rays = design.rays(design.count)
    np.testing.assert_allclose(looking(row) @ axes_of(row), rays.direction, rtol=0, atol=1e-9)
    np.testing.assert_allclose(values(row, "x_mm", "y_mm", "z_mm") / 1000, rays.origin_m[0], rtol=0, atol=1e-12)


@settings(max_examples=10, deadline=None)
@given(pose=poses)
def test_every_form_of_a_pose_is_the_same_pose(tmp_path_factory, pose):
    folder = tmp_path_factory.mktemp("mounts")
    # a part whose field is not about its own axis
    design = part_design(find_part("hdl-64e"), pose, 64)
    (row,), _ = written(design, folder)
    axes = axes_of(row)
    np.testing.assert_allclose(axes, pose.frame, rtol=0, atol=1e-9)
    np.testing.assert_allclose(axes[0], values(row, "forward_x", "forward_y", "forward_z"), rtol=0, atol=1e-9)
    np.testing.assert_allclose(axes[2], values(row, "up_x", "up_y", "up_z"), rtol=0, atol=1e-9)
    roll, pitch, yaw = np.radians(values(row, "roll_deg", "elevation_deg", "azimuth_deg")) * (1, -1, 1)
    joint = ElementTree.parse(folder / "mounts.urdf").find("joint/origin")
    line, _, end = (folder / "static_transforms.sh").read_text(encoding="utf-8").partition(" &\n")
    words = shlex.split(line)
    named = {name: word for name, word in pairwise(words) if name.startswith("--")}
    assert (named["--frame-id"], named["--child-frame-id"], end) == ("world", "s0_link", "wait\n")
    for found in (
        [float(word) for word in (joint.get("xyz") + " " + joint.get("rpy")).split()],
        [float(named[f"--{name}"]) for name in ("x", "y", "z", "roll", "pitch", "yaw")],
    ):
        np.testing.assert_allclose(found, [*pose.origin_m, roll, pitch, yaw], rtol=0, atol=1e-9)
        # fixed axes, as URDF and tf2 mean them
        np.testing.assert_allclose(Rotation.from_euler("xyz", found[3:]).as_matrix().T, axes, rtol=0, atol=1e-9)


def test_the_page_says_what_no_source_says(tmp_path):
    written(part_design(find_part("tmf8828"), Pose()), tmp_path)
    page = (tmp_path / "mounts.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 3
    assert "<script" not in page
    assert page.count("unknown") >= 5
    for text in ("Before you drill", "41 x 52", "static_transform_publisher", "built in hardware"):
        assert text in page


def test_nothing_in_a_name_becomes_markup(tmp_path):
    design, rays = rig()
    rows, _ = written(design, tmp_path, len(rays))
    text = (tmp_path / "mounts.html").read_text(encoding="utf-8")
    assert any(sensor.name == NASTY for sensor in design.sensors)
    assert NASTY not in text
    assert len({row["sensor"] for row in rows}) == len(design.sensors)
    assert {row["pattern"] for row in rows} == {"any rays: --format csv lists them"}
    assert [one.name for one in mounted_parts(design)] == [row["sensor"] for row in rows]


def test_no_link_is_the_one_that_it_is_mounted_on(tmp_path):
    design, rays = rig()
    sensors = tuple(replace(one, name=name) for one, name in zip(design.sensors, ("base", "s", "t", "u"), strict=False))
    write_as("mounts", replace(design, sensors=sensors, mount="base_link"), rays, tmp_path)
    links = [link.get("name") for link in ElementTree.parse(tmp_path / "mounts.urdf").findall("link")]
    assert len(set(links)) == len(links) == len(sensors) + 1


def test_labels_of_many_sensors_stay_on_the_sheet(tmp_path):
    poses = [Pose(np.array([0.01 * number, 0.02 * number, 0.0])) for number in range(40)]
    written(part_design(find_part("vl53l8cx"), poses), tmp_path)
    text = (tmp_path / "mounts.html").read_text(encoding="utf-8")
    places = re.findall(r'<text x="([-\d.]+)" y="([-\d.]+)" text-anchor="end"', text)
    assert len(places) > 80
    assert all(0 <= float(x) <= 340 and 0 <= float(y) <= 270 for x, y in places)
