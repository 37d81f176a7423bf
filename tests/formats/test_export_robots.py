"""What robots' tools make of an exported design: MuJoCo runs it, libsdformat, check_urdf and xacro parse it."""

import importlib.util
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.exports import write_as
from support.rays import rays_along
from support.rigs import NASTY, even, farthest_nearest, read_sdf, rig, sdf_reader, spinning

from lidardesign.api.export import DesignSource, ExportRequest
from lidardesign.errors import ConfigError, DataError
from lidardesign.formats import FORMATS
from lidardesign.formats.designs import load_design
from lidardesign.formats.mounts import mounts
from lidardesign.formats.names import identifier
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.mujoco_models import RobotFile, bodies_from_mujoco, load_model
from lidardesign.scenes.scene import Body, Box, Mesh, Scene, Sphere, rigid
from lidardesign.sensors.design import DesignSpec

ROBOTS = ("mjcf", "sdf", "urdf", "xacro", "carla", "isaac-usd")
GRIDS = ("sdf", "urdf", "xacro", "carla")
DESIGN, RAYS = rig()
NAMES = ("front_left", "b_script_amp_o_x_y", "down", "front_left_2")
# libsdformat turns URDF into SDF with six digits
URDF_DIGITS = 2e-5


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The rig in every format, with its notes."""
    folder = tmp_path_factory.mktemp("robots")
    found = {}
    for name in ROBOTS:
        path = folder / f"rig{FORMATS.load(name).suffix}"
        found[name] = (path, write_as(name, DESIGN, RAYS, path))
    return found


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    return sdf_reader(tmp_path_factory.mktemp("reader"))


TURNS = Rotation.random(2, random_state=1).as_matrix()


def scene():
    """Boxes, balls and a mesh around the rig, with gaps between them."""
    octahedron = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    return Scene(
        (
            Body(Box((1.5, 0.05, 1.2)), "wall", poses=rigid(TURNS[0], (-1.6, 0.9, 0.9))),
            Body(Box((2.0, 2.0, 0.1)), "floor", poses=rigid(translation_m=(0.2, 0.1, -0.4))),
            Body(Sphere(0.6), "ball", poses=rigid(translation_m=(0.9, -1.2, 1.4))),
            Body(Sphere(0.3), "near", poses=rigid(translation_m=(-0.5, 0.3, 0.7))),
            Body(Mesh(octahedron * (0.6, 0.5, 0.9), faces), "mesh", poses=rigid(TURNS[1], (1.3, -0.3, 0.6))),
        ),
        "around",
    )


def mujoco_scene(include):
    """The same scene in MuJoCo's own words, with a file of sensors included."""
    geoms, assets = [], ""
    for index, body in enumerate(scene().bodies):
        place = " ".join(map(repr, body.poses[:3, 3].tolist()))
        axes = " ".join(repr(value) for value in body.poses[:3, :2].T.ravel().tolist())
        shape = body.shape
        if isinstance(shape, Box):
            kind = f'type="box" size="{" ".join(map(str, shape.half_extents_m))}"'
        elif isinstance(shape, Sphere):
            kind = f'type="sphere" size="{shape.radius_m}"'
        else:
            vertex, face = (" ".join(map(str, values.ravel())) for values in (shape.vertices, shape.faces))
            assets += f'<mesh name="m{index}" vertex="{vertex}" face="{face}"/>'
            kind = f'type="mesh" mesh="m{index}"'
        geoms.append(f'<geom {kind} pos="{place}" xyaxes="{axes}"/>')
    return f'<mujoco><include file="{include}"/><asset>{assets}</asset><worldbody>{"".join(geoms)}</worldbody></mujoco>'


def simulated(path):
    """MuJoCo's model of a file, and its state when everything is in place."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_mujoco_measures_our_distances(exported):
    path, _ = exported["mjcf"]
    main = path.with_name("main.xml")
    main.write_text(mujoco_scene(path.name), encoding="utf-8")
    model, data = simulated(main)
    ours = SceneCaster(scene()).first_hit(RAYS.origin_m, RAYS.direction)
    hit = ours.body >= 0
    assert set(ours.body[hit]) == set(range(5))
    assert (~hit).any()
    beyond = hit & (ours.range_m > RAYS.gate_m[:, 1])
    assert beyond.any()
    expected = np.where(hit, np.minimum(ours.range_m, RAYS.gate_m[:, 1]), -1.0)
    np.testing.assert_allclose(data.sensordata, expected, atol=1e-4)
    np.testing.assert_array_equal(model.sensor_user[:, :2], RAYS.gate_m)
    np.testing.assert_array_equal(model.sensor_user[:, 2], RAYS.sensor)
    np.testing.assert_array_equal(model.sensor_user[:, 3], RAYS.time_s)
    bodies = {model.body(int(model.site_bodyid[model.sensor_objid[ray]])).name for ray in range(len(RAYS))}
    assert bodies == {one.name for one in DESIGN.sensors}


ROBOT = """<mujoco><compiler meshdir="parts"/><asset><mesh name="foot" file="foot.obj"/><material name="skin"/></asset>
<default><site type="box" size="9 9 9" euler="10 20 30"/>
<default class="hull"><geom material="skin" group="3"/></default></default>
<worldbody><geom type="plane" size="0 0 1" pos="0 0 -2"/>
<body name="torso" pos="0 0 1" childclass="main"><freejoint/>
<geom type="ellipsoid" size=".6 .3 .2" pos="0 0 -.6" material="skin"/>
<geom size="3" class="hull"/>
<site name="imu"/><body name="front_left" pos=".9 .2 -.3"><joint axis="0 1 0"/><geom type="cylinder" size=".2 .5"/>
<body pos="0 0 -.6"><joint axis="1 0 0"/><geom type="mesh" mesh="foot"/></body></body>
<body name="tail" pos="-1 0 0"><joint axis="0 0 1"/><geom type="capsule" size=".2 .4"/></body></body></worldbody>
<sensor><rangefinder site="imu"/></sensor></mujoco>"""
FOOT = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def quadruped():
    """The model of a real one, where its package is installed, which is never imported."""
    package = importlib.util.find_spec("dm_control")
    if package is None:
        pytest.skip("dm_control is not installed: make consumers")
    return Path(package.submodule_search_locations[0]) / "suite" / "quadruped.xml"


def own_robot(folder):
    (folder / "parts").mkdir()
    (folder / "parts" / "foot.obj").write_text(FOOT)
    (folder / "robot.xml").write_text(ROBOT)
    return folder / "robot.xml"


@pytest.mark.parametrize("mount", [None, "torso"])
@pytest.mark.parametrize("robot_of", [own_robot, lambda folder: quadruped()], ids=["small", "quadruped"])
def test_sensors_on_a_robot_measure_our_distances_wherever_it_is(tmp_path, robot_of, mount):
    import mujoco

    robot = robot_of(tmp_path)
    (tmp_path / "exports").mkdir()
    path = tmp_path / "exports" / "with.xml"
    design = replace(DESIGN, mount=mount)
    write_as("mjcf", design, RAYS, path, robot=RobotFile(robot))
    alone, _ = load_model(robot)
    model = mujoco.MjModel.from_xml_path(str(path))
    assert (model.nq, model.nu) == (alone.nq, alone.nu)
    data, generator = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] = alone.qpos0 + generator.normal(0, 0.3, model.nq)
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    # what a sensor is on is not in its way
    parts = bodies_from_mujoco(alone, data.qpos)
    scene = Scene(tuple(part.body for part in parts if mount is None or part.body_name != mount))
    torso = rigid(data.body("torso").xmat.reshape(3, 3), data.body("torso").xpos)
    pose = np.eye(4) if mount is None else torso
    ours = SceneCaster(scene).first_hit(RAYS.origin_m @ pose[:3, :3].T + pose[:3, 3], RAYS.direction @ pose[:3, :3].T)
    hit = ours.body >= 0
    assert hit.sum() > 20
    expected = np.where(hit, np.minimum(ours.range_m, RAYS.gate_m[:, 1]), -1.0)
    found = data.sensordata[-len(RAYS) :]
    # but for a ray that grazes an edge, which the six digits of MuJoCo's own files move
    assert np.isclose(found, expected, rtol=0, atol=1e-4).mean() > 0.99
    np.testing.assert_array_equal(model.sensor_user[-len(RAYS) :, 2], RAYS.sensor)


def test_the_lines_of_the_docs_read_the_points_inside_gates(exported):
    import mujoco

    path, _ = exported["mjcf"]
    main = path.with_name("read.xml")
    main.write_text(mujoco_scene(path.name), encoding="utf-8")
    model, data = simulated(main)
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"```python\n(mujoco.mj_step.*?)```", page, re.DOTALL)
    names = {"mujoco": mujoco, "model": model, "data": data}
    exec(lines, names)
    ours = SceneCaster(scene()).first_hit(RAYS.origin_m, RAYS.direction)
    inside = (ours.range_m >= RAYS.gate_m[:, 0]) & (ours.range_m < RAYS.gate_m[:, 1])
    assert inside.any()
    expected = (RAYS.origin_m + ours.range_m[:, None] * RAYS.direction)[inside]
    np.testing.assert_allclose(names["points"], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("rate_hz", [0, 10, 20, 33])
def test_rangefinders_fire_at_the_frame_rate_and_keep_what_they_read(tmp_path, rate_hz):
    import mujoco

    path = tmp_path / "with.xml"
    write_as("mjcf", replace(DESIGN, mount="torso"), RAYS, path, rate_hz, RobotFile(own_robot(tmp_path)))
    model = mujoco.MjModel.from_xml_path(str(path))
    every = mujoco.MjModel.from_xml_path(str(path))
    every.sensor_interval[:] = 0
    read = []
    for one in (model, every):
        data, steps = mujoco.MjData(one), []
        for _ in range(200):
            mujoco.mj_step(one, data)
            steps.append(data.sensordata[-len(RAYS) :].copy())
        read.append(np.array(steps))
    held, always = read
    fires = np.flatnonzero(np.abs(np.diff(held, axis=0)).max(axis=1) > 0) + 1
    if rate_hz == 0:
        np.testing.assert_array_equal(held, always)
        return
    period = 1 / rate_hz / model.opt.timestep
    assert len(fires) >= 0.6 * 200 / period  # what it reads may be the same again
    assert all(min(step % period, period - step % period) <= 1 + 1e-6 for step in fires)
    np.testing.assert_array_equal(held[fires], always[fires])


def test_sensors_on_a_robot_are_read_back(tmp_path):
    path, robot = tmp_path / "with.xml", own_robot(tmp_path)
    robot.write_text(ROBOT.replace('name="torso" pos="0 0 1"', 'name="torso"'))
    write_as("mjcf", replace(DESIGN, mount="torso"), RAYS, path, robot=RobotFile(robot))
    again = load_design(path, reach_m=9.0)
    assert len(again.sensors) == len(DESIGN.sensors) + 1  # and the robot's own rangefinder
    rays = again.rays(len(RAYS) + 1)
    np.testing.assert_allclose(rays.direction[-len(RAYS) :], RAYS.direction, rtol=0, atol=1e-5)
    np.testing.assert_allclose(rays.gate_m[-len(RAYS) :, 0], RAYS.gate_m[:, 0], rtol=0, atol=1e-5)


def test_a_mounted_design_goes_into_the_model_of_its_run(tmp_path):
    config = SimpleNamespace(task=SimpleNamespace(model=own_robot(tmp_path), folder=tmp_path))
    fixed = replace(DESIGN, mount="torso")
    source = DesignSource(fixed, SimpleNamespace(config=config, folder=tmp_path))
    exported = ExportRequest(source, FORMATS.load("mjcf"), tmp_path / "with.xml").write()
    assert exported.rays == len(RAYS)
    model, data = simulated(exported.path)
    assert {model.body(int(body)).name for body in model.site_bodyid} == {"torso"}
    assert len(data.sensordata) == len(RAYS) + 1
    again = ExportRequest(source, FORMATS.load("mjcf"), tmp_path / "both.xml", robot=exported.path).write()
    model, data = simulated(again.path)
    assert len(data.sensordata) == 2 * len(RAYS) + 1
    with pytest.raises(ConfigError, match=r"robot\.xml is the robot's model"):
        ExportRequest(source, FORMATS.load("mjcf"), tmp_path / "robot.xml").write()
    assert (tmp_path / "robot.xml").read_text() == ROBOT


def test_a_robot_without_the_body_that_carries_the_sensors_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"no body 'torsos'[\s\S]*torso"):
        write_as(
            "mjcf", replace(DESIGN, mount="torsos"), RAYS, tmp_path / "a.xml", robot=RobotFile(own_robot(tmp_path))
        )
    with pytest.raises(ConfigError, match="cannot hold a robot"):
        write_as("csv", DESIGN, RAYS, tmp_path / "a.csv", robot=RobotFile(tmp_path / "robot.xml"))
    notes = write_as("mjcf", replace(DESIGN, mount="torso"), RAYS, tmp_path / "a.xml")
    assert any("the robot's body 'torso'; --robot MODEL" in note for note in notes)


def test_a_ray_along_any_axis_is_a_site_that_looks_there(tmp_path):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    path = tmp_path / "axes.xml"
    for one in DESIGN.sensors:
        write_as("mjcf", DesignSpec("axes", (one,)), rays_along(axes, (0.0, 0.0)), path)
        _, data = simulated(path)
        np.testing.assert_allclose(data.site_xmat.reshape(-1, 3, 3)[:, :, 2], axes, atol=1e-15)
        np.testing.assert_allclose(data.site_xpos, 0.0, atol=1e-15)


def test_two_sensors_of_one_name_are_two_bodies(tmp_path):
    twins = DesignSpec("twins", (DESIGN.sensors[0], DESIGN.sensors[0]))
    path = tmp_path / "twins.xml"
    write_as("mjcf", twins, twins.rays(2), path)
    model, _ = simulated(path)
    assert {model.body(index).name for index in (1, 2)} == {"front left", "front left 2"}


def test_no_name_is_a_word_of_the_format(reader, tmp_path):
    for name in ("world", "include", "__model__", "a::b", "a\x00\nb", "x" * 5000):
        design = DesignSpec(name, tuple(replace(one, name=name) for one in DESIGN.sensors[:1]))
        rays = RAYS.subset(RAYS.sensor == 0)
        path = tmp_path / "named"
        write_as("mjcf", design, rays, path)
        assert simulated(path)[0].nsensor == len(rays)
        if name in ("world", "__model__"):
            write_as("sdf", design, rays, path)
            check_gazebo(read_sdf(reader, path), design, rays, 1e-9)


@pytest.mark.parametrize("name", ["mjcf", "sdf"])
def test_what_is_written_for_a_simulator_is_a_design_again(tmp_path, name):
    design, rays = spinning()
    path = tmp_path / f"spin{FORMATS.load(name).suffix}"
    write_as(name, design, rays, path)
    found = load_design(path).rays()
    assert len(found) == len(rays)
    assert farthest_nearest(rays.direction, found.direction) < 1e-7
    np.testing.assert_allclose(found.origin_m, rays.origin_m, atol=1e-12)
    np.testing.assert_allclose(found.gate_m, rays.gate_m, atol=1e-12)


def fired(sensor):
    """Unit vectors in the model that a gpu_lidar of these values fires."""
    w, x, y, z = (sensor[key] for key in ("qw", "qx", "qy", "qz"))
    columns, rows = int(sensor["columns"]), int(sensor["rows"])
    local = even(columns, rows, (sensor["left"], sensor["right"]), (sensor["low"], sensor["high"]))
    axis = np.array([x, y, z])
    return local + 2 * np.cross(axis, np.cross(axis, local) + w * local)


def check_gazebo(found, design, rays, tolerance, rate_hz=10.0):
    """That sensors as Gazebo sees them fire a design's rays, where those are on even grids."""
    assert [one["kind"] for one in found] == ["gpu_lidar"] * len(design.sensors)
    assert len({one["topic"] for one in found}) == len(found)
    for index, one in enumerate(found):
        mine = rays.sensor == index
        place = np.array([one[key] for key in "xyz"])
        np.testing.assert_allclose(place, rays.origin_m[mine].mean(axis=0), atol=tolerance)
        gate = rays.gate_m[mine]
        np.testing.assert_allclose(one["start"], max(gate[:, 0].min(), 0.001), atol=tolerance)
        np.testing.assert_allclose(one["end"], gate[:, 1].max(), atol=tolerance)
        assert one["rate"] == rate_hz
        assert one["horizontal_resolution"] == one["vertical_resolution"] == 1
        if index != 1:
            assert one["columns"] * one["rows"] == mine.sum()
            assert farthest_nearest(rays.direction[mine], fired(one)) < max(tolerance, 1e-7)


def test_gazebo_fires_the_rays_that_are_on_even_grids(reader, exported):
    path, notes = exported["sdf"]
    found = read_sdf(reader, path)
    check_gazebo(found, DESIGN, RAYS, 1e-9)
    assert [one["name"] for one in found] == list(NAMES)
    told = np.radians(float(next(one for one in notes if "even grid" in one).split("at most ")[1].split(" deg")[0]))
    # the note is of each ray's own cell: its nearest ray may be in the next one
    assert farthest_nearest(RAYS.direction[RAYS.sensor == 1], fired(found[1])) <= told * 1.05
    assert told < 0.3


def test_a_spinning_sensor_is_one_whole_turn(reader, tmp_path):
    design, rays = spinning()
    path = tmp_path / "spin.sdf"
    notes = write_as("sdf", design, rays, path, rate_hz=20.0)
    check_gazebo(read_sdf(reader, path), design, rays, 1e-9, rate_hz=20.0)
    assert not any("even grid" in note for note in notes)


def test_gazebo_finds_the_sensors_of_a_description(reader, exported):
    # in the order of their links' names
    found = {one["name"]: one for one in read_sdf(reader, exported["urdf"][0])}
    check_gazebo([found[name] for name in NAMES], DESIGN, RAYS, URDF_DIGITS)


def check_urdf(path):
    """The links that urdfdom finds below their parents."""
    if shutil.which("check_urdf") is None:
        pytest.skip("needs check_urdf: tools/install-consumers.sh")
    done = subprocess.run(["check_urdf", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Error" not in done.stdout + done.stderr
    return {line.split(":")[1].strip() for line in done.stdout.splitlines() if line.strip().startswith("child(")}


def test_urdfdom_finds_a_link_per_sensor(exported):
    assert check_urdf(exported["urdf"][0]) == {"lidar_base", *(f"{name}_link" for name in NAMES)}


@pytest.mark.parametrize("name", ["lidar_base", "World", "world link"])
def test_no_sensor_takes_the_name_of_what_holds_it(tmp_path, name):
    one = replace(DESIGN.sensors[0], name=name)
    path = tmp_path / "named.urdf"
    write_as("urdf", DesignSpec(name, (one,)), RAYS.subset(RAYS.sensor == 0), path)
    assert len(check_urdf(path)) == 2


def test_xacro_mounts_the_sensors_on_a_robot(reader, exported, tmp_path):
    xacro = pytest.importorskip("xacro", reason="needs xacro: the extra `consumers`")
    robot = tmp_path / "robot.xacro"
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    robot.write_text(
        f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="arm"><inertial><mass value="1"/>'
        f'{inertia}</inertial></link><xacro:include filename="{exported["xacro"][0]}"/>'
        '<xacro:a_rig parent="arm" prefix="left_"/></robot>'
    )
    expanded = tmp_path / "robot.urdf"
    expanded.write_text(xacro.process_file(str(robot)).toprettyxml())
    assert "left_down_link" in check_urdf(expanded)
    assert {identifier(word) for word in ("include", "if", "property")} == {"s_include", "s_if", "s_property"}
    found = {one["name"]: one for one in read_sdf(reader, expanded)}
    check_gazebo([found[f"left_{name}"] for name in NAMES], DESIGN, RAYS, URDF_DIGITS)


# words of a note, and the formats that have it
COUNTED = {
    "beside their sensor's middle": set(ROBOTS) - {"mjcf"},
    "gates of their own": set(GRIDS),
    "23 of 50 rays are not on an even grid": set(GRIDS),
    # Gazebo has a start of gates, but sees through what is nearer
    "3 of 4 sensors look through it": set(GRIDS[:3]),
    f"{RAYS.gate_m[RAYS.gate_m[:, 0] > 0, 0].min():.3g} to 1 m": {"mjcf", "carla"},
}


@pytest.mark.parametrize("words", COUNTED)
def test_what_a_format_cannot_hold_is_counted(exported, words):
    assert {name for name in ROBOTS if any(words in note for note in exported[name][1])} == COUNTED[words]


@pytest.mark.parametrize("rate_hz", [np.nan, np.inf, 0.0, -1.0, 1e-320, 1e300])
def test_no_sensor_has_such_a_frame_rate(tmp_path, rate_hz):
    with pytest.raises(ConfigError, match=r"0\.001 to 1e"):
        write_as("sdf", DESIGN, RAYS, tmp_path / "out", rate_hz)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["mjcf", "sdf", "urdf", "xacro"])
def test_names_cannot_leave_their_attribute(exported, name):
    path, notes = exported[name]
    text = path.read_text(encoding="utf-8")
    ElementTree.fromstring(text)
    assert NASTY not in text
    assert "</script>" not in text
    assert "${y}" not in text or name == "mjcf"
    assert any("letters, digits and underscores" in note for note in notes) == (name != "mjcf")


def test_libsdformat_finds_the_sensors_of_a_ray_pattern_plugin_where_they_stand(reader, tmp_path):
    write_as("rgl", DESIGN, RAYS, tmp_path / "rig.rgl")
    found = read_sdf(reader, tmp_path / "rig.rgl" / "model.sdf")
    assert [sensor["name"] for sensor in found] == [mount.name for mount in mounts(DESIGN, RAYS)]
    for sensor, mount in zip(found, mounts(DESIGN, RAYS), strict=True):
        assert sensor["kind"] == "custom"
        place = RAYS.origin_m[mount.ray[0]]
        np.testing.assert_allclose([sensor[axis] for axis in "xyz"], place, atol=1e-12)
        quaternion = np.array([sensor[f"q{axis}"] for axis in "wxyz"])
        assert abs(quaternion @ mount.quaternion) == pytest.approx(1, abs=1e-9)
