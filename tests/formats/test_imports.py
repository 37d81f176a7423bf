"""Rigs of others read as designs: what is written comes back, poses are those of the programs that made them."""

from __future__ import annotations

import math
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.exports import write_as
from support.rigs import rig

from lidardesign.constraints.document import Constraints
from lidardesign.errors import DataError
from lidardesign.formats import FORMATS
from lidardesign.formats.designs import load_design
from lidardesign.formats.rig import aim_of, rig_constraints
from lidardesign.scenes.rays import rotation_of_quaternion, rotation_of_rpy
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import save_design
from lidardesign.sensors.sensor import Sensor, boresight_frame, tangent_coordinates
from lidardesign.space import DesignSpace, angles, direction

EXACT = 1e-12


def counted(design):
    """Each sensor's name and how many rays it fires."""
    return [(one.name, int(rays)) for one, rays in zip(design.sensors, design.rays_per_sensor(), strict=True)]


def assert_same_rays(found, expected, tolerance=EXACT):
    np.testing.assert_allclose(found.origin_m, expected.origin_m, atol=tolerance)
    np.testing.assert_allclose(found.direction, expected.direction, atol=tolerance)
    np.testing.assert_allclose(found.gate_m, expected.gate_m, atol=tolerance)
    np.testing.assert_array_equal(found.sensor, expected.sensor)


@pytest.mark.parametrize("name", ["csv", "npz", "mjcf"])
def test_an_exported_rig_comes_back_ray_by_ray(tmp_path, name):
    design, _ = rig()
    expected = design.rays()
    path = tmp_path / f"rig{FORMATS.load(name).suffix}"
    write_as(name, design, expected, path)
    found = load_design(path)
    if name == "mjcf":  # lists sensors in the order in which they first fire
        order = {one: index for index, one in enumerate(dict.fromkeys(expected.sensor.tolist()))}
        expected = replace(expected, sensor=np.array([order[index] for index in expected.sensor.tolist()]))
    assert_same_rays(found.rays(), expected)
    assert found.provenance["notes"] == []
    if name == "npz":
        assert [sensor.name for sensor in found.sensors] == [sensor.name for sensor in design.sensors]
    # and as a design file of ours
    save_design(found, tmp_path / "kept.yaml")
    assert_same_rays(load_design(tmp_path / "kept.yaml").rays(), found.rays(), 0)


def test_a_sensor_looks_along_the_middle_of_its_rays_and_holds_them_all():
    generator = np.random.default_rng(5)
    for _ in range(50):
        elevation = generator.uniform(-1.5, 1.5)
        frame = boresight_frame(generator.uniform(0, 7), elevation)
        seen = generator.uniform(-0.6, 0.3, (30, 2)) * generator.uniform(0.1, 1, 2)
        looking = direction(*angles(np.column_stack([np.ones(30), seen]) @ frame))
        aim = aim_of(looking)
        found = tangent_coordinates(boresight_frame(aim.azimuth_rad, aim.elevation_rad), looking)
        assert np.all(2 * np.abs(found).max(axis=0) <= np.array(aim.field_rad) + EXACT)
        if abs(elevation) < 0.8:
            np.testing.assert_allclose(found.min(axis=0), -found.max(axis=0), atol=1e-3)


def test_rays_all_around_still_have_a_boresight():
    ring = direction(np.linspace(0, 2 * math.pi, 36, endpoint=False), np.zeros(36))
    aim = aim_of(ring)
    assert aim.field_rad[0] == pytest.approx(2 * math.pi, abs=0.4)
    assert aim.field_rad[1] < 1e-6


# ------------------------------------------------------------------- ray lists


def write_rays(path, columns):
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n", encoding="utf-8")
    return path


def test_the_same_directions_in_radians_degrees_and_vectors_are_the_same_rays(tmp_path):
    generator = np.random.default_rng(2)
    azimuth, elevation = generator.uniform(-9, 9, 20), generator.uniform(-1.5, 1.5, 20)
    looking = direction(azimuth, elevation) * generator.uniform(1e-3, 1e3, 20)[:, None]
    end = {"gate_end_m": [2.0] * 20}
    forms = [
        {"azimuth_rad": azimuth, "elevation_rad": elevation},
        {"azimuth_deg": np.degrees(azimuth), "elevation_deg": np.degrees(elevation)},
        {f"direction_{axis}": looking[:, index] for index, axis in enumerate("xyz")},
    ]
    found = [load_design(write_rays(tmp_path / "rays.csv", {**form, **end})).rays() for form in forms]
    for one in found:
        np.testing.assert_allclose(one.direction, direction(azimuth, elevation), atol=1e-12)


def test_what_a_ray_list_leaves_out_is_told_and_not_made_up(tmp_path):
    path = write_rays(tmp_path / "r.csv", {"azimuth_deg": [0, 10], "elevation_deg": [0, 5]})
    with pytest.raises(DataError, match="does not say how far 2 of its 2 rays reach") as refused:
        load_design(path)
    assert "gate_end_m" in str(refused.value)
    design = load_design(path, reach_m=1.5)
    notes = "\n".join(design.provenance["notes"])
    assert "world's origin" in notes
    assert "gates start" in notes
    assert "1.5 m" in notes
    np.testing.assert_array_equal(design.rays().gate_m, [[0, 1.5]] * 2)
    whole = {"origin_x_m": [1, 1], "origin_y_m": [0, 0], "origin_z_m": [0, 0], "gate_start_m": [0.1, 0.2]}
    path = write_rays(path, {"azimuth_deg": [0, 10], "elevation_deg": [0, 5], "gate_end_m": [1, 2], **whole})
    assert load_design(path, reach_m=1.5).provenance["notes"] == []


def test_sensors_are_numbers_or_names(tmp_path):
    looks = {"azimuth_deg": [0, 10, 20], "elevation_deg": [0, 0, 0], "gate_end_m": [1, 1, 1]}
    numbered = load_design(write_rays(tmp_path / "n.csv", {**looks, "sensor": [7, 2, 7]}))
    assert counted(numbered) == [("sensor_3", 1), ("sensor_8", 2)]
    np.testing.assert_array_equal(numbered.rays().sensor, [1, 0, 1])
    named = load_design(write_rays(tmp_path / "n.csv", {**looks, "sensor": ["left", "2", "left"]}))
    assert counted(named) == [("left", 2), ("2", 1)]


def test_names_keep_the_line_ends_of_other_scripts(tmp_path):
    path = tmp_path / "n.csv"
    path.write_text("sensor,azimuth_deg,elevation_deg,gate_end_m\r\nleft\u2028eye,0,0,1\r\n\r\n,0,0,1\r\n", newline="")
    with pytest.raises(DataError) as refused:
        load_design(path)
    assert refused.value.where == f"{path}:4:1"
    path.write_text(path.read_text().rsplit("\n\n", 1)[0])
    (sensor,) = load_design(path).sensors
    assert sensor.name == "left\u2028eye"


def test_firing_times_that_are_not_even_over_a_frame_are_told(tmp_path):
    looks = {"azimuth_deg": [0, 10, 20], "elevation_deg": [0, 0, 0], "gate_end_m": [1, 1, 1], "gate_start_m": [0, 0, 0]}
    for times, told in (([0, 1 / 30, 2 / 30], False), ([0, 0.01, 2 / 30], True), ([0, 0.001, 0.002], True)):
        design = load_design(write_rays(tmp_path / "t.csv", {**looks, "time_s": times}))
        assert any("time_s" in note for note in design.provenance["notes"]) == told


GOOD = "azimuth_rad,elevation_rad,gate_end_m"
BAD_LISTS = {
    "no direction": ("gate_end_m,sensor\n1,0\n", "rays.csv:1", "no column says where rays point"),
    "half a direction": ("azimuth_rad,gate_end_m\n0,1\n", "rays.csv:1", "without elevation_rad"),
    "half a place": (f"{GOOD},origin_x_m\n0,0,1,2\n", "rays.csv:1", "without origin_y_m, origin_z_m"),
    "an unknown column": (f"{GOOD},colour\n0,0,1,2\n", "rays.csv:1", "'colour'"),
    "a column twice": (f"{GOOD},gate_end_m\n0,0,1,2\n", "rays.csv:1", "gate_end_m given twice"),
    "no ray": (f"{GOOD}\n", "rays.csv", "no ray"),
    "a short row": (f"{GOOD}\n0,0,1\n0,0\n", "rays.csv:3", "2 columns"),
    "a word": (f"{GOOD}\n0,0,1\n\n0,x,1\n", "rays.csv:4:2", "elevation_rad is 'x'"),
    "infinity": (f"{GOOD}\n0,0,inf\n", "rays.csv:2:3", "gate_end_m is 'inf'"),
    "an elevation beyond the pole": (f"{GOOD}\n0,0,1\n0,2,1\n", "rays.csv:3:2", "elevation_rad is 2"),
    "a gate that ends before it starts": (f"{GOOD},gate_start_m\n0,0,1,2\n", "rays.csv:2:3", "before the gate's start"),
    "a negative start": (f"{GOOD},gate_start_m\n0,0,1,-2\n", "rays.csv:2:4", "negative"),
    "no vector": ("direction_x,direction_y,direction_z,gate_end_m\n0,0,0,1\n", "rays.csv:2:1", "without length"),
    "two directions": (f"{GOOD},azimuth_deg,elevation_deg\n0,0,1,9,0\n", "rays.csv:2:4", "a different direction"),
    "far away": (f"{GOOD},origin_x_m,origin_y_m,origin_z_m\n0,0,1,1e12,0,0\n", "rays.csv", "a place"),
    "a sensor without a name": (f"{GOOD},sensor\n0,0,1,\n", "rays.csv:2:4", "sensor is empty"),
}


@pytest.mark.parametrize("case", BAD_LISTS)
def test_a_ray_list_that_cannot_be_used_is_refused_at_its_cell(tmp_path, monkeypatch, case):
    content, where, message = BAD_LISTS[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rays.csv").write_text(content)
    with pytest.raises(DataError) as refused:
        load_design(type(tmp_path)("rays.csv"))
    assert refused.value.where == where
    assert message in refused.value.message


@pytest.mark.parametrize(
    "arrays",
    [
        {"azimuth_rad": np.zeros(3), "elevation_rad": np.zeros(2), "gate_end_m": np.ones(3)},
        {"azimuth_rad": np.zeros((3, 1)), "elevation_rad": np.zeros((3, 1))},
        {"azimuth_rad": np.array([np.nan]), "elevation_rad": np.zeros(1), "gate_end_m": np.ones(1)},
        {"azimuth_rad": np.zeros(1), "elevation_rad": np.zeros(1), "gate_end_m": np.ones(1), "sensor": np.array([-1])},
        {"azimuth_rad": [0.0], "elevation_rad": [0.0], "gate_end_m": [1.0], "sensor": [1], "sensor_names": ["a"]},
        {"points": np.zeros((4, 6))},
        {},
    ],
)  # fmt: skip
def test_arrays_that_are_no_rays_are_refused(tmp_path, arrays):
    np.savez(tmp_path / "rays.npz", **arrays)
    with pytest.raises(DataError, match=r"rays\.npz"):
        load_design(tmp_path / "rays.npz")


# ------------------------------------------------------------------- MuJoCo


def random_model(seed):
    """A robot with everything that moves a site: nested bodies and frames, defaults, joints, all kinds of rotations."""
    generator = np.random.default_rng(seed)
    root = ElementTree.Element("mujoco")
    ElementTree.SubElement(root, "compiler", {"angle": "degree", "eulerseq": "ZYx", "meshdir": "missing"})
    outer = ElementTree.SubElement(root, "default")
    ElementTree.SubElement(ElementTree.SubElement(outer, "default", {"class": "eye"}), "site", {"pos": "0.1 0.2 0.3"})
    here = ElementTree.SubElement(root, "worldbody")
    sensors = ElementTree.Element("sensor")

    def numbers(count):
        return " ".join(f"{value:.6f}" for value in generator.normal(size=count))

    turns = [
        lambda: {"quat": numbers(4)},
        lambda: {"euler": " ".join(f"{v:.4f}" for v in generator.uniform(-180, 180, 3))},
        lambda: {"axisangle": numbers(4)},
        lambda: {"xyaxes": numbers(6)},
        lambda: {"zaxis": numbers(3)},
    ]
    for index in range(8):
        kind = "frame" if index % 3 == 2 else "body"
        attributes = {"name": f"b{index}", "pos": numbers(3), **turns[index % 5]()}
        here = ElementTree.SubElement(here, kind, attributes)
        if kind == "body":
            ElementTree.SubElement(here, "joint", {"axis": numbers(3), "ref": "20"})
            ElementTree.SubElement(here, "geom", {"size": "0.1", "mass": "1"})
        site = {"name": f"site{index}", **turns[(index + 2) % 5]()}
        ElementTree.SubElement(here, "site", {**site, "class": "eye"} if index % 2 else {**site, "pos": numbers(3)})
        given = {"cutoff": f"{index + 1}"}
        ElementTree.SubElement(sensors, "rangefinder", {"site": f"site{index}", "name": f"ray{index}", **given})
    root.append(sensors)
    return root


@pytest.mark.parametrize("seed", range(2))
def test_rangefinders_look_from_where_mujoco_says_they_are(tmp_path, seed):
    import mujoco

    root = random_model(seed)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # what ours must not look at: a mesh that is not there, and an actuator
    asset = ElementTree.SubElement(root, "asset")
    ElementTree.SubElement(asset, "mesh", {"name": "m", "file": "nowhere.stl"})
    path = tmp_path / "robot.xml"
    path.write_bytes(ElementTree.tostring(root))
    design = load_design(path)
    rays = design.rays()
    np.testing.assert_allclose(rays.origin_m, data.site_xpos, atol=1e-9)
    np.testing.assert_allclose(rays.direction, data.site_xmat.reshape(-1, 3, 3)[:, :, 2], atol=1e-9)
    np.testing.assert_array_equal(rays.gate_m[:, 1], np.arange(1, 9))
    assert [sensor.name for sensor in design.sensors] == [f"ray{index}" for index in range(8)]
    assert "gates start" in design.provenance["notes"][0]


def model_of(sensors, body='<site name="a" pos="0 0 1"/>', head="", top="mujoco"):
    return f"<{top}>{head}<worldbody>{body}</worldbody><sensor>{sensors}</sensor></{top}>"


def test_rangefinders_of_one_place_are_one_sensor_by_the_name_they_share(tmp_path):
    fan = '<replicate count="5" euler="0 0 0.1"><site name="fan" zaxis="1 0 0"/></replicate>'
    ring = "".join(f'<site name="sonar_{i}" pos="{i} 0 0" zaxis="0 1 0"/>' for i in range(3))
    pair = '<site name="eye_r0" zaxis="0 0 1" pos="0 0 5"/><site name="eye_r1" zaxis="0 1 1" pos="0 0 5"/>'
    body = f'<body name="head" pos="0 0 1">{fan}</body><body name="base">{ring}{pair}</body>'
    names = ["fan", "sonar_0", "sonar_1", "sonar_2", "eye_r0", "eye_r1"]
    path = tmp_path / "m.xml"
    path.write_text(model_of("".join(f'<rangefinder site="{name}" cutoff="3"/>' for name in names), body))
    design = load_design(path)
    assert sorted(counted(design)) == [("eye", 2), ("fan", 5), ("sonar_0", 1), ("sonar_1", 1), ("sonar_2", 1)]


def test_a_model_may_include_files_of_its_own_folder_alone(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "outside.xml").write_text(model_of("", '<site name="a"/>', top="mujocoinclude"))
    (tmp_path / "in" / "part.xml").write_text(model_of('<rangefinder site="a" cutoff="2"/>', top="mujocoinclude"))
    path = tmp_path / "in" / "m.xml"
    path.write_text('<mujoco><include file="part.xml"/></mujoco>')
    assert len(load_design(path).rays()) == 1
    for name in ("../outside.xml", str(tmp_path / "outside.xml"), ""):
        path.write_text(f'<mujoco><include file="{name}"/></mujoco>')
        with pytest.raises(DataError, match=r"m\.xml:1.*outside the model's folder"):
            load_design(path)
    (tmp_path / "in" / "link.xml").symlink_to(tmp_path / "outside.xml")
    path.write_text('<mujoco><include file="link.xml"/></mujoco>')
    with pytest.raises(DataError, match="outside the model's folder"):
        load_design(path)
    path.write_text('<mujoco>\n<include file="m.xml"/></mujoco>')
    with pytest.raises(DataError, match=r"m\.xml:2.*again"):
        load_design(path)


DOCTYPE = '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b SYSTEM "file:///etc/passwd">]>'
BAD_XML = {
    "a document type": (DOCTYPE + model_of('<rangefinder site="a" cutoff="1"/>'), "document type"),
    "no rangefinder": (model_of(""), "has no rangefinder"),
    "an unknown site": (model_of('<rangefinder site="b" cutoff="1"/>'), "MuJoCo cannot read it"),
    "a camera": (model_of('<rangefinder camera="c"/>', '<camera name="c"/>'), "on a camera"),
    "too many copies": (
        model_of("", '<replicate count="999"><replicate count="99"><site/></replicate></replicate>'),
        "replicates too much",
    ),
    "too many sites": (model_of("", "<site/>" * 21), "too many bodies, sites and sensors"),
    "no number of copies": (model_of("", '<replicate count="many"><site/></replicate>'), "count is 'many'"),
    "another model": (model_of("", '<attach model="x"/>'), "attaches another model"),
    "no end": (model_of('<rangefinder site="a"/>'), "does not say how far 1 of its 1 rays reach"),
    "a URDF": ("<robot name='r'/>", "root element is '<robot>'"),
    "nesting": ("<mujoco>" + "<body>" * 300 + "</body>" * 300 + "</mujoco>", "nested too deep"),
    "no lidar": ("<sdf><model name='m'><link name='l'/></model></sdf>", "has no lidar"),
    "an included model": ("<sdf><world><include><uri>x</uri></include></world></sdf>", "includes are not read"),
}


@pytest.mark.parametrize("case", BAD_XML)
def test_xml_that_cannot_be_used_is_refused_by_what_is_wrong(tmp_path, monkeypatch, case):
    monkeypatch.setattr("lidardesign.formats.mjcf.MOST_KEPT", 20)
    content, message = BAD_XML[case]
    path = tmp_path / "m.xml"
    path.write_text(content)
    with pytest.raises(DataError) as refused:
        load_design(path)
    assert message in refused.value.message
    assert refused.value.where.startswith(str(path))


def test_includes_do_not_nest_deeper_than_one_file_may(tmp_path):
    bodies = 150
    for number in range(9):
        inside = f'<include file="part{number + 1}.xml"/>' if number < 8 else '<site name="a"/>'
        text = f"<mujocoinclude>{'<body>' * bodies}{inside}{'</body>' * bodies}</mujocoinclude>"
        (tmp_path / f"part{number}.xml").write_text(text)
    path = tmp_path / "m.xml"
    for part, refused in ((8, False), (7, True), (0, True)):
        path.write_text(
            f'<mujoco><worldbody><include file="part{part}.xml"/></worldbody>'
            '<sensor><rangefinder site="a" cutoff="1"/></sensor></mujoco>'
        )
        if refused:
            with pytest.raises(DataError, match="nested too deep, with what it includes"):
                load_design(path)
        else:
            assert load_design(path).count == 1


# ------------------------------------------------------------------- SDF


GATE = "<min>0.2</min><max>4</max>"


def lidar(name="eye", pose="", columns=(5, -0.4, 0.6), rows=(3, -0.2, 0.1), reach=GATE):
    def axis(tag, values):
        count, low, high = values
        return f"<{tag}><samples>{count}</samples><min_angle>{low}</min_angle><max_angle>{high}</max_angle></{tag}>"

    scan = axis("horizontal", columns) + (axis("vertical", rows) if rows else "")
    inside = f"<lidar><scan>{scan}</scan><range>{reach}</range></lidar>"
    return f'<sensor name="{name}" type="gpu_lidar">{pose}{inside}</sensor>'


def sdf_of(inside):
    return f'<?xml version="1.0"?>\n<sdf version="1.9">\n{inside}\n</sdf>'


def load_sdf(tmp_path, inside, **options):
    path = tmp_path / "robot.sdf"
    path.write_text(sdf_of(inside))
    return load_design(path, **options)


def test_a_scan_fires_every_angle_of_its_rows_both_ends_included(tmp_path):
    design = load_sdf(tmp_path, f'<model name="m"><link name="l">{lidar()}</link></model>')
    rays = design.rays()
    expected = [direction(a, e) for e in np.linspace(-0.2, 0.1, 3) for a in np.linspace(-0.4, 0.6, 5)]
    np.testing.assert_allclose(rays.direction, expected, atol=EXACT)
    np.testing.assert_array_equal(rays.gate_m, [[0.2, 4]] * 15)
    sensor = design.sensors[0]
    assert sensor.name == "eye"
    assert (sensor.azimuth_rad, sensor.elevation_rad) == pytest.approx((0.1, -0.05))
    assert sensor.field_of_view_rad == pytest.approx((math.cos(0.05) * 1.0, 0.3))


def pose_text(generator):
    place, turn = generator.normal(size=3), generator.uniform(-3, 3, 3)
    text = " ".join(f"{value!r}" for value in [*place.tolist(), *turn.tolist()])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_of_rpy(*turn), place
    return text, matrix


@pytest.mark.parametrize("seed", range(3))
def test_poses_multiply_along_links_frames_joints_and_nested_models(tmp_path, seed):
    generator = np.random.default_rng(seed)
    (model, m), (inner, i), (link, k), (frame, f), (joint, j), (second, s), (eye, e) = (
        pose_text(generator) for _ in range(7)
    )
    one, two = lidar("one", f"<pose>{eye}</pose>"), lidar("two", f'<pose relative_to="j">{eye}</pose>')
    text = f"""<world name="w"><model name="out"><pose>{model}</pose>
      <frame name="f" attached_to="in::l"><pose>{frame}</pose></frame>
      <joint name="j" type="fixed"><child>l2</child><pose>{joint}</pose></joint>
      <link name="l2"><pose relative_to="f">{second}</pose>{two}</link>
      <model name="in"><pose>{inner}</pose><link name="l"><pose>{link}</pose>{one}</link>
      </model></model></world>"""
    design = load_sdf(tmp_path, text)
    local = np.array([direction(a, b) for b in np.linspace(-0.2, 0.1, 3) for a in np.linspace(-0.4, 0.6, 5)])
    of_two = m @ i @ k @ f @ s @ j @ e
    of_one = m @ i @ k @ e
    rays = design.rays()
    assert [sensor.name for sensor in design.sensors] == ["two", "one"]
    for index, pose in enumerate((of_two, of_one)):
        own = rays.sensor == index
        np.testing.assert_allclose(rays.origin_m[own], [pose[:3, 3]] * 15, atol=1e-9)
        np.testing.assert_allclose(rays.direction[own], local @ pose[:3, :3].T, atol=1e-9)
        # the frame of the design's sensor is the lidar's: its field is upright in it
        tangent = tangent_coordinates(design.sensors[index].frame, rays.direction[own])
        assert np.abs(tangent.mean(axis=0)).max() < 0.01
        assert np.ptp(tangent[:, 1]) < 0.35
        assert np.ptp(tangent[:, 0]) > 0.9


def test_degrees_and_quaternions_are_the_same_poses(tmp_path):
    turn = np.array([20.0, -30.0, 100.0])
    x, y, z, w = Rotation.from_euler("xyz", turn, degrees=True).as_quat().tolist()
    np.testing.assert_allclose(
        rotation_of_quaternion(3 * w, 3 * x, 3 * y, 3 * z), rotation_of_rpy(*np.radians(turn)), atol=EXACT
    )
    forms = [
        f'<pose degrees="true">1 2 3 {turn[0]} {turn[1]} {turn[2]}</pose>',
        f'<pose rotation_format="quat_xyzw">1 2 3 {x} {y} {z} {w}</pose>',
        f"<pose>1 2 3 {' '.join(map(str, np.radians(turn)))}</pose>",
    ]  # fmt: skip
    models = [f'<model name="m"><link name="l">{lidar(pose=one)}</link></model>' for one in forms]
    found = [load_sdf(tmp_path, model).rays() for model in models]
    for one in found[1:]:
        assert_same_rays(one, found[0], 1e-9)


@pytest.mark.parametrize(("turn", "outer"), [(1, '<world name="w">{}</world>'), (0, "{}")])
def test_a_model_stands_by_its_placement_frame_in_a_world_and_topmost(tmp_path, turn, outer):
    inner = f'<frame name="foot"><pose>0 0 -1 0 0 {turn}</pose></frame>'
    model = f'<pose>5 0 0 0 0 {turn}</pose>{inner}<link name="l">{lidar()}</link>'
    design = load_sdf(tmp_path, outer.format(f'<model name="m" placement_frame="foot">{model}</model>'))
    np.testing.assert_allclose(design.sensors[0].origin_m, [5, 0, 1], atol=EXACT)


@pytest.mark.parametrize(("version", "where"), [("1.5", 6), ("1.6", 6), ("1.7", 2), ("1.9", 2)])
def test_poses_before_version_1_7_count_from_what_they_call_their_frame(tmp_path, version, where):
    """As libsdformat reads them; from 1.7 on the attribute is `relative_to`, and another one says nothing."""
    near, far = '<link name="k"><pose>5 0 0 0 0 0</pose></link>', '<link name="l"><pose>1 0 0 0 0 0</pose>{}</link>'
    eye = lidar(pose='<pose frame="k">1 0 0 0 0 0</pose>')
    path = tmp_path / "old.sdf"
    path.write_text(f'<sdf version="{version}"><model name="m">{near}{far.format(eye)}</model></sdf>')
    np.testing.assert_allclose(load_design(path).sensors[0].origin_m, [where, 0, 0], atol=EXACT)


def test_poses_of_nested_models_are_worked_out_once(tmp_path):
    """Each model stands by a frame two models further in: worked out anew each time, these would be 10^9 poses."""
    deepest = 45
    text = f'<model name="m{deepest}"><pose>1 0 0 0 0 0</pose><link name="l">{lidar()}</link></model>'
    for number in range(deepest - 1, -1, -1):
        by = f' placement_frame="m{number + 1}::m{number + 2}"' if number + 2 <= deepest else ""
        text = f'<model name="m{number}"{by}>{text}<link name="l"/></model>'
    assert load_sdf(tmp_path, text).count == 15


def test_more_lidars_than_a_design_has_are_refused_at_the_first_too_many(tmp_path, monkeypatch):
    monkeypatch.setattr("lidardesign.formats.sdf.MOST_SENSORS", 3)
    with pytest.raises(DataError, match="more rays or sensors than a design") as refused:
        load_sdf(tmp_path, '<model name="m"><link name="l">' + "\n".join([lidar(rows=None)] * 5) + "</link></model>")
    assert refused.value.where == f"{tmp_path / 'robot.sdf'}:6"


def test_what_an_sdf_file_says_beyond_a_design_is_told(tmp_path):
    noise = "<noise><type>gaussian</type></noise><range>"
    extra = lidar(columns=(1, -0.5, 0.5), rows=None, reach="<max>inf</max>").replace("<range>", noise)
    finer = "<samples>5</samples><resolution>2</resolution>"
    two = lidar(name="eye", rows=(2, 0, 0.1)).replace("<samples>5</samples>", finer)
    text = f'<model name="m"><link name="a">{extra}</link><link name="b">{two}</link></model>'
    design = load_sdf(tmp_path, text, reach_m=3.0)
    notes = "\n".join(design.provenance["notes"])
    for said in ("noise is ignored", "resolution is ignored", "gates start", "3 m"):
        assert said in notes
    # one ray along min_angle, and names that say where each is
    assert [sensor.name for sensor in design.sensors] == ["m::a::eye", "m::b::eye"]
    np.testing.assert_allclose(design.rays().direction[0], direction(-0.5, 0.0), atol=EXACT)


CHAIN = "".join(f'<frame name="f{one}" attached_to="f{one + 1}"/>' for one in range(400)) + '<frame name="f400"/>'


def posed(pose, more=""):
    """A model with a lidar that stands by a pose."""
    return f'<model name="m"><link name="a">{pose}{lidar()}</link>{more}</model>'


def beside(frame):
    return f'<pose relative_to="{frame}">0 0 0 0 0 0</pose>'


NAMELESS = f'<world name="w"><model><pose>5 0 0 0 0 0</pose><link name="a">{lidar()}</link></model></world>'
BAD_SDF = {
    "a circle": (posed(beside("b"), '<frame name="b" attached_to="a"/>'), "is relative to itself"),
    "an unknown frame": (posed(beside("z")), "'z'"),
    "five numbers": (posed("<pose>0 0 0 0 0</pose>"), "6 finite numbers"),
    "no quaternion": (posed('<pose rotation_format="quat_xyzw">0 0 0 0 0 0 0</pose>'), "no length"),
    "a link without a name": (f'<model name="m"><link>{lidar()}</link></model>', "no name"),
    "a model without a name": (NAMELESS, "no name"),
    "two links of one name": (posed("", f'<link name="a">{lidar()}</link>'), "a second link is called 'a'"),
    "the world inside a model": (posed(beside("world")), "'world'"),
    "a chain of frames": (posed(beside("f0"), CHAIN), "too many others"),
}


@pytest.mark.parametrize("case", BAD_SDF)
def test_poses_that_cannot_be_found_are_refused_with_their_line(tmp_path, case):
    text, message = BAD_SDF[case]
    with pytest.raises(DataError) as refused:
        load_sdf(tmp_path, text)
    assert message in str(refused.value)
    assert refused.value.where == f"{tmp_path / 'robot.sdf'}:3"


@pytest.mark.parametrize(
    "options",
    [
        {"columns": (0, 0, 1)}, {"columns": (2.5, 0, 1)}, {"columns": (5, 1, 0)}, {"columns": (5, -9, 9)},
        {"columns": ("nan", 0, 1)}, {"columns": (5, "", 1)}, {"rows": (3, 1, 2)},
        {"columns": (99999, 0, 1), "rows": (99, 0, 1)},
        {"reach": "<min>3</min><max>2</max>"}, {"reach": "<min>-1</min><max>2</max>"}, {"reach": "<min>0</min>"},
    ],
)  # fmt: skip
def test_a_scan_that_cannot_be_is_refused(tmp_path, options):
    with pytest.raises(DataError, match=r"robot\.sdf"):
        load_sdf(tmp_path, f'<model name="m"><link name="l">{lidar(**options)}</link></model>')


# ------------------------------------------------------------------- commands


def flat_rig(tmp_path, count=16, end=True):
    """Two fans of flatland, as somebody else would write them down."""
    azimuth = np.linspace(50, 130, count)
    columns = {
        "sensor": ["left"] * (count // 2) + ["right"] * (count - count // 2),
        "origin_x_m": np.repeat([0.2, 0.8], [count // 2, count - count // 2]),
        "origin_y_m": np.zeros(count),
        "origin_z_m": np.zeros(count),
        "azimuth_deg": azimuth,
        "elevation_deg": np.zeros(count),
        "gate_start_m": np.full(count, 0.1),
    }
    return write_rays(tmp_path / "fans.csv", {**columns, "gate_end_m": np.full(count, 0.9)} if end else columns)


def test_a_rig_scores_as_the_design_that_fires_its_rays(call, flat, tmp_path):
    path = flat_rig(tmp_path, end=False)
    save_design(load_design(path, reach_m=1.2), tmp_path / "same.yaml")
    for asked, count in (((), 16), (("--rays", 8), 8)):
        result = call("evaluate", path, "same.yaml", "--in", flat, *asked, "--baseline", "none", "--json")
        assert result.code == 0, result.err
        values = {row["design"]: row["value"] for row in result.json["rows"]}
        assert values["fans"] == values["same"]
        assert {row["rays"] for row in result.json["rows"]} == {count}
        assert "the file does not say how far 16 of 16 rays reach; set to 1.2 m" in result.err
        assert any("subset" in note for note in result.json["notes"]) == bool(asked)


@pytest.mark.parametrize("name", ["sensors-csv", "stl"])
def test_formats_of_sensors_take_no_number_of_rays(call, tmp_path, name):
    result = call("export", flat_rig(tmp_path), "--format", name, "--rays", 20, "--out", "sensors")
    assert result.code == 2
    assert f"{name} holds sensors, not rays" in result.err
    assert not (tmp_path / "sensors").exists()


def test_sensors_like_a_planar_scanner_stay_planar():
    """A field of view of no height is one: only a single ray has none that could be a bound."""
    turn = 2 * math.pi
    fields = {"fan": (1.0, 0.0), "wall": (0.0, 0.5), "turn": (turn, 0.0), "ball": (turn, 7.0), "ray": (0, 0)}
    sensors = tuple(Sensor(name, 0.2, np.zeros(3), 0.0, 0.0, 0.0, field, (0.6, 1.4)) for name, field in fields.items())
    space = DesignSpace((0,) * 3 + (0, -1.5, 0), (0,) * 3 + (6, 1.5, 9))
    found = rig_constraints(DesignSpec("rig", sensors), space, Constraints(), rays=None).as_document()["each"]
    narrow = pytest.approx(1e-3)
    assert [one.get("field_of_view", {}) for one in found] == [
        {"horizontal_deg": {"max": pytest.approx(math.degrees(1))}, "vertical_deg": {"max": narrow}},
        {"horizontal_deg": {"max": narrow}, "vertical_deg": {"max": pytest.approx(math.degrees(0.5))}},
        {"vertical_deg": {"max": narrow}},
        {},
        {},
    ]


def test_what_a_user_asks_for_goes_before_what_the_rig_has(call, flat, tmp_path):
    path = flat_rig(tmp_path)
    asked = ["--set", "gate.width_m.max=0.3", "--set", "origin.low_m=[0.4,0,0]", "--set", "origin.high_m=[0.6,0,0]"]
    result = call("constrain", flat, "--like", path, *asked, "--rays", "24", "--name", "mine", "--json")
    assert result.code == 0, result.err
    found = load_design(flat / "designs" / "mine.yaml")
    assert found.count == 24
    for sensor in found.sensors:
        assert 0.4 <= sensor.origin_m[0] <= 0.6
        assert sensor.gate_m[1] - sensor.gate_m[0] <= 0.3 + 1e-9
    refused = call("constrain", flat, "--like", path, "--sensors", "3")
    assert refused.code == 4
    assert "--sensors" in refused.err
