"""The folder to mount from: whoever has only its numbers builds the design."""

import csv
import math
import re
import shlex
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rigs import NASTY, rig

from lidardesign.errors import ConfigError
from lidardesign.formats.mount_page import mounted_parts
from lidardesign.formats.registry import EXPORTERS
from lidardesign.parts.catalogue import Pose, find_part, part_design
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import rotation_of_quaternion
from lidardesign.scenes.scene import Body, Box, Scene, Sphere, rigid

ROOM = Scene(
    (
        Body(Box((9.0, 9.0, 0.1)), "floor", poses=rigid(translation_m=(0.0, 0.0, -1.5))),
        Body(Box((0.1, 9.0, 9.0)), "wall", poses=rigid(translation_m=(3.0, 0.0, 0.0))),
        Body(Sphere(0.6), "ball", poses=rigid(translation_m=(1.4, 0.4, 0.2))),
    ),
    "room",
)
GEOMS = """<geom type="box" size="9 9 .1" pos="0 0 -1.5"/><geom type="box" size=".1 9 9" pos="3 0 0"/>
<geom size=".6" pos="1.4 .4 .2"/>"""
poses = st.builds(
    lambda place, azimuth, elevation, roll: Pose(np.array(place), azimuth, elevation, roll),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.floats(-math.pi, math.pi),
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(-math.pi, math.pi),
)


def written(design, folder, count=None):
    rays = design.rays(design.count if count is None else count)
    notes = EXPORTERS["mounts"].write(design, rays, folder)
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


def test_whoever_builds_it_by_hand_in_mujoco_measures_our_distances(tmp_path):
    import mujoco

    design = part_design(
        find_part("vl53l8cx"), [Pose(np.array([0.1, -0.4, 0.3]), 0.4, -0.3, 2.1), Pose(np.zeros(3), -0.2, -1.2, -0.7)]
    )
    bodies, sensors, number = [], [], 0
    for row in written(design, tmp_path)[0]:
        sites = []
        for looks in looking(row):
            sites.append(f'<site name="r{number}" zaxis="{" ".join(map(repr, looks.tolist()))}"/>')
            sensors.append(f'<rangefinder site="r{number}"/>')
            number += 1
        place = values(row, "x_mm", "y_mm", "z_mm") / 1000
        turn = values(row, "qw", "qx", "qy", "qz")
        pose = f'pos="{" ".join(map(repr, place.tolist()))}" quat="{" ".join(map(repr, turn.tolist()))}"'
        bodies.append(f"<body {pose}>{''.join(sites)}</body>")
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{GEOMS}{''.join(bodies)}</worldbody><sensor>{''.join(sensors)}</sensor></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rays = design.rays(design.count)
    ours = SceneCaster(ROOM).first_hit(rays.origin_m, rays.direction)
    assert set(ours.body.tolist()) >= {0, 2}
    np.testing.assert_allclose(data.sensordata, np.where(ours.body >= 0, ours.range_m, -1.0), rtol=0, atol=1e-4)


@settings(max_examples=30, deadline=None)
@given(pose=poses, name=st.sampled_from(["vl53l5cx", "tmf8828", "vl53l8cx:4x4"]))
def test_the_zones_of_a_row_are_the_rays_of_the_design(tmp_path_factory, pose, name):
    design = part_design(find_part(name), pose)
    (row,), _ = written(design, tmp_path_factory.mktemp("mounts"))
    rays = design.rays(design.count)
    np.testing.assert_allclose(looking(row) @ axes_of(row), rays.direction, rtol=0, atol=1e-9)
    np.testing.assert_allclose(values(row, "x_mm", "y_mm", "z_mm") / 1000, rays.origin_m[0], rtol=0, atol=1e-12)


@settings(max_examples=30, deadline=None)
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
        about = [np.eye(3) for _ in range(3)]
        for axis, angle in enumerate(found[3:]):
            one, other = [number for number in range(3) if number != axis]
            sine = math.sin(angle) * (-1 if axis == 1 else 1)
            about[axis][[one, other], [one, other]] = math.cos(angle)
            about[axis][one, other], about[axis][other, one] = -sine, sine
        np.testing.assert_allclose((about[2] @ about[1] @ about[0]).T, axes, rtol=0, atol=1e-9)


class Texts(HTMLParser):
    """The tags and the text of a page."""

    def __init__(self):
        super().__init__()
        self.tags, self.text = [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text += data


def test_the_page_says_what_no_source_says(tmp_path):
    written(part_design(find_part("tmf8828"), Pose()), tmp_path)
    read = Texts()
    read.feed((tmp_path / "mounts.html").read_text(encoding="utf-8"))
    assert read.tags.count("svg") == 3
    assert "script" not in read.tags
    assert read.text.count("unknown") >= 5
    for text in ("Before you drill", "41 x 52", "static_transform_publisher", "built in hardware"):
        assert text in read.text


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
    EXPORTERS["mounts"].write(replace(design, sensors=sensors, mount="base_link"), rays, tmp_path)
    links = [link.get("name") for link in ElementTree.parse(tmp_path / "mounts.urdf").findall("link")]
    assert len(set(links)) == len(links) == len(sensors) + 1


def test_labels_of_many_sensors_stay_on_the_sheet(tmp_path):
    poses = [Pose(np.array([0.01 * number, 0.02 * number, 0.0])) for number in range(40)]
    written(part_design(find_part("vl53l8cx"), poses), tmp_path)
    text = (tmp_path / "mounts.html").read_text(encoding="utf-8")
    places = re.findall(r'<text x="([-\d.]+)" y="([-\d.]+)" text-anchor="end"', text)
    assert len(places) > 80
    assert all(0 <= float(x) <= 340 and 0 <= float(y) <= 270 for x, y in places)


def test_it_has_no_frame_rate(tmp_path):
    design, rays = rig()
    with pytest.raises(ConfigError, match="frame rate"):
        EXPORTERS["mounts"].write(design, rays, tmp_path / "x", rate_hz=5)
