"""What a design sees: the very returns that are scored, read back by the libraries that others use."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.sensors import normal_sensor

from lidardesign.api.design import Design
from lidardesign.api.run import open_run
from lidardesign.clouds.files import write_clouds
from lidardesign.clouds.seen import COLUMNS, Measuring, SeenScene, scene_of_file, seen_in_file
from lidardesign.errors import ConfigError, DataError
from lidardesign.scenes.rays import Outcome
from lidardesign.scenes.scene import Body, Box, Scene, Sphere, rigid
from lidardesign.sensors.design import DesignSpec

BALL = Body(Sphere(0.3), "ball", "target", rigid(translation_m=(1.0, 0.0, 0.0)))
WALL = Body(Box((0.05, 2.0, 2.0)), "wall", "occluder", rigid(translation_m=(2.0, 0.0, 0.0)))
ROOM = Scene((BALL, WALL), "ball & wall")


def looking(*places, field_rad=1.2, gate_m=(0.2, 3.0), aim=(1.0, 0.0, 0.0), mount=None):
    """A design of sensors at places that look at the ball."""
    sensors = []
    for number, place in enumerate(places):
        away = np.subtract(aim, place)
        middle, width = sum(gate_m) / 2, gate_m[1] - gate_m[0]
        azimuth, elevation = np.arctan2(away[1], away[0]), np.arctan2(away[2], np.hypot(*away[:2]))
        sensor = normal_sensor(f"s{number}", 1 / len(places), place, azimuth, elevation, 0.0, (0.2, 0.2), middle, width)
        sensors.append(replace(sensor, field_of_view_rad=(field_rad, field_rad), gate_m=gate_m))
    return DesignSpec("eye", tuple(sensors), mount=mount)


@pytest.fixture(scope="module")
def seen():
    return [seen_in_file(ROOM, looking((0, 0, 0), (0, 0.8, 0)), 200, Measuring())]


@pytest.mark.parametrize("detector", ["ideal", "single-photon"])
def test_a_cloud_is_what_evaluate_scores_to_the_last_bit(flat, monkeypatch, detector):
    run = open_run(flat)
    design, scored = run.fit(sensors=2, rays=16, layout="even", name="two"), []
    score = type(run.task).score

    def spied(self, scene, returns):
        scored.append((scene.name, returns))
        return score(self, scene, returns)

    monkeypatch.setattr(type(run.task), "score", spied)
    run.evaluate([design], rays=[16], baselines=["none"], detector=detector)
    held_out = scored[-len(run.scenes("test", run.config.seed)) :]
    found = design.simulate(scenes=len(held_out), rays=16, detector=detector)
    assert [one.scene.name for one in found] == [name for name, _ in held_out]
    for one, (_, returns) in zip(found, held_out, strict=True):
        for mine, theirs in zip(one.returns, returns, strict=True):
            for name in ("outcome", "range_m", "body"):
                np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))


def test_a_table_has_every_ray_with_its_outcome(seen):
    one, table = seen[0].returns[0], seen[0].cloud(0)
    returned = table["outcome"] == Outcome.RETURN
    assert table["ray"].tolist() == list(range(200))
    np.testing.assert_array_equal(table["ring"], one.rays.sensor)
    np.testing.assert_array_equal(np.isfinite(table["x"]), returned)
    points = np.stack([table[name] for name in "xyz"], axis=1)[returned]
    np.testing.assert_array_equal(points, one.points_m.astype(np.float32))
    on_ball = np.isclose(np.linalg.norm(points - (1, 0, 0), axis=1), 0.3, atol=1e-5)
    np.testing.assert_array_equal(table["occluder"][returned] == 0, on_ball)
    assert set(on_ball.tolist()) == {True, False}


def test_trimesh_and_pypcd_read_what_was_written(seen, tmp_path):
    import trimesh

    pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is not installed (extra: consumers)")
    table = seen[0].cloud(0)
    for form in ("ply", "pcd"):
        assert write_clouds(seen, tmp_path / form, form) == []
    (ply,) = (tmp_path / "ply").glob("000_ball_wall_000.ply")
    cloud = trimesh.load(ply)
    expected = np.stack([table[name] for name in "xyz"], axis=1)
    np.testing.assert_array_equal(np.asarray(cloud.vertices, dtype=np.float32), expected)
    read = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name, _ in COLUMNS[3:]:
        np.testing.assert_array_equal(read[f"scalar_{name}"].ravel(), table[name])
    points = pypcd4.PointCloud.from_path(next((tmp_path / "pcd").glob("*.pcd")))
    assert points.fields == tuple(name for name, _ in COLUMNS)
    for name, kind in COLUMNS:
        np.testing.assert_array_equal(points.pc_data[name].astype(kind), table[name])


def test_rosbags_reads_clouds_and_frames(seen, tmp_path):
    rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed (extra: consumers)")
    pytest.importorskip("mcap", reason="mcap is not installed (extra: mcap)")
    from rosbags.typesys import Stores, get_typestore

    path = tmp_path / "seen.mcap"
    write_clouds([*seen, *seen], path, "mcap")
    table, messages = seen[0].cloud(0), {}
    with rosbags.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        qos = {one.topic: one.ext.offered_qos_profiles[0] for one in reader.connections}
        for connection, time_ns, raw in reader.messages():
            messages.setdefault(connection.topic, []).append((time_ns, reader.deserialize(raw, connection.msgtype)))
    assert qos["/tf_static"].durability.name == "TRANSIENT_LOCAL"
    assert [time_ns for time_ns, _ in messages["/points"]] == [0, 100_000_000]  # a frame of the design
    cloud = messages["/points"][1][1]
    assert (cloud.header.frame_id, cloud.header.stamp.nanosec, cloud.width) == ("world", 100_000_000, 200)
    assert [(field.name, field.offset) for field in cloud.fields] == [
        (name, table.dtype.fields[name][1]) for name in table.dtype.names
    ]
    assert bytes(cloud.data) == table.tobytes()
    (frames,) = (message.transforms for _, message in messages["/tf_static"])
    assert [frame.child_frame_id for frame in frames] == ["s0_link", "s1_link"]
    place = frames[1].transform.translation
    np.testing.assert_allclose((place.x, place.y, place.z), (0, 0.8, 0), atol=1e-15)
    turn, sensor = frames[1].transform.rotation, seen[0].design.sensors[1]
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    forward = (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w))
    np.testing.assert_allclose(forward, sensor.boresight, atol=1e-12)


def outward(found):
    """Middles of the triangles of a surface, from the ball's centre in its radii."""
    vertices, faces = found.unseen()
    return (vertices[faces].mean(axis=1) - (1.0, 0.0, 0.0)) / 0.3


def of(*places, scene=ROOM, **changes):
    return seen_in_file(scene, looking(*places, **changes), 60, Measuring())


def test_what_no_sensor_sees_is_the_far_side(seen):
    assert outward(of((0, 0, 0)))[:, 0].min() > -0.35  # the horizon of a ball at 1 m is at 0.3 radii
    assert len(outward(of((0, 0, 0)))) == pytest.approx(0.65 * len(outward(of((0, 0, 0), gate_m=(4.0, 5.0)))), rel=0.1)
    around = [(1 + x, y, z) for x, y, z in 0.9 * np.concatenate([np.eye(3), -np.eye(3)])]
    assert len(outward(of(*around))) == 0
    assert len(outward(of((2.5, 0, 0)))) == len(outward(of((0, 0, 0), gate_m=(4.0, 5.0))))  # behind the wall
    assert len(outward(of((0, 0, 0), field_rad=0.1))) > len(outward(of((0, 0, 0))))


def area_m2(found):
    vertices, faces = found.unseen()
    first, second, third = np.moveaxis(vertices[faces], 1, 0)
    return np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2


def test_of_a_large_face_the_part_in_the_field_is_seen():
    wall = Scene((replace(WALL, role="target"),), "wall")
    whole = 2 * (4 * 4 + 2 * 0.1 * 4)  # six faces of 4 x 4 x 0.1 m
    field_m2 = 4 * np.tan(0.3) ** 2 * 1.95**2
    unseen_m2 = area_m2(of((0, 0, 0), scene=wall, field_rad=0.6, gate_m=(1.0, 3.0)))
    assert unseen_m2 == pytest.approx(whole - field_m2, rel=0.02)


def test_a_sensor_is_where_its_rays_start():
    seen = of((0, 0, 0))
    moved = replace(seen.returns[0].rays, origin_m=seen.returns[0].rays.origin_m - (0, 0, 5.0))
    there = SeenScene(seen.design, seen.scene, [replace(seen.returns[0], rays=moved)])
    assert len(outward(there)) > len(outward(seen))  # from there the ball is not in the field
    assert len(outward(SeenScene(seen.design, seen.scene, [*seen.returns, *there.returns]))) == len(outward(seen))


@pytest.mark.parametrize("choice", [{"scenes": 2}, {"settings": ["test=3"]}])
def test_a_scene_of_ones_own_has_no_settings_of_the_task(tmp_path, choice):
    with pytest.raises(ConfigError, match="scene of your own"):
        Design(looking((0, 0, 0))).simulate(tmp_path / "robot.xml", rays=9, **choice)


def test_a_ball_that_turns_up_elsewhere_is_seen_there():
    poses = np.stack([rigid(translation_m=(9.0, 0.0, 0.0)), rigid(translation_m=(1.0, 0.0, 0.0))])
    moving = Scene((replace(BALL, poses=poses),), "moving")
    still = Scene((replace(BALL, poses=poses[0]),), "still")
    assert len(outward(of((0, 0, 0), scene=moving))) < len(outward(of((0, 0, 0), scene=still)))


ROBOT = """<mujoco><worldbody><body name="base" pos="0 0 1"><geom size=".1"/><body name="hand" pos="0 0 1">
<geom size=".2"/></body></body></worldbody></mujoco>"""


def test_a_mesh_and_a_robot_of_ones_own_are_scenes(tmp_path):
    import trimesh

    trimesh.creation.box((100, 100, 100)).export(tmp_path / "cube.stl")
    (cube,) = scene_of_file(tmp_path / "cube.stl", None, 0.001).bodies
    assert (cube.is_target, np.ptp(cube.shape.vertices)) == (True, pytest.approx(0.1))
    # files with y up stand upright
    trimesh.creation.box((0.1, 1.0, 0.2)).export(tmp_path / "tall.glb")
    (tall,) = scene_of_file(tmp_path / "tall.glb", None).bodies
    np.testing.assert_allclose(np.ptp(tall.shape.vertices, axis=0), (0.2, 0.1, 1.0), atol=1e-6)
    (tmp_path / "robot.xml").write_text(ROBOT, encoding="utf-8")
    for mount, height in ((None, 2.0), ("base", 1.0), ("hand", 0.0)):
        bodies = scene_of_file(tmp_path / "robot.xml", mount).bodies
        assert bodies[-1].poses[2, 3] == pytest.approx(height)
    with pytest.raises(DataError, match="no body 'foot'"):
        scene_of_file(tmp_path / "robot.xml", "foot")
    found = Design(looking((0, 0, 0), aim=(0, 0, 1.0))).simulate(tmp_path / "robot.xml", rays=400)
    assert any(one.returned.any() for one in found[0].returns)


def test_mcap_says_what_is_missing(seen, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(ConfigError, match="mcap is not installed"):
        write_clouds(seen, tmp_path / "a.mcap", "mcap")


def test_the_command_writes_clouds_and_says_how_many_returns(lidardesign, flat):
    for name in ("one", "two"):
        open_run(flat).fit(sensors=1, rays=16, layout="even", name=name).save()
    done = lidardesign("simulate", "run/designs/one.yaml", "--scenes", 2, "--rays", 16, "--out", "clouds", "--json")
    assert done.code == 0, done.err
    assert len(done.json["scenes"]) == 2
    assert len(list(Path("clouds").glob("*_unseen.ply"))) == 2
    for words, code, said in (
        ("run", 2, "2 designs"),
        ("run/designs/one.yaml --format las", 2, "ply, pcd, mcap"),
        ("run/designs/one.yaml --scenes 0", 2, "--scenes"),
        ("run/designs/one.yaml --scene no.stl", 3, "no.stl"),
    ):
        refused = lidardesign("simulate", *words.split(), "--out", "x")
        assert refused.code == code
        assert said in refused.err
        assert not Path("x").exists()
