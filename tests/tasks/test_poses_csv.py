"""Objects that move along a CSV of poses: what is between its rows, which body is meant, and how every frame counts."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from lidardesign_tasks.meshes import MeshesTask
from lidardesign_tasks.motion import moved_bounds_m
from lidardesign_tasks.moving_surface import SURFACES
from lidardesign_tasks.poses import interpolated, read_poses, rotation_matrix, rotation_vector
from lidardesign_tasks.surface import METRIC
from pydantic import ValidationError
from support.rays import rays_of_points

from lidardesign.errors import ConfigError, DataError
from lidardesign.rays.information import checked_information
from lidardesign.scenes.rays import rotation_of_quaternion, rotation_of_rpy
from lidardesign.scenes.scene import rigid
from lidardesign.simulate.returns import simulate
from lidardesign.space import aim

EXACT = 1e-9
HEADER = "time_s,body,x_m,y_m,z_m"


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_a_rotation_is_that_of_its_vector(values):
    rotation = rotation_matrix(np.array(values))
    np.testing.assert_allclose(rotation_matrix(rotation_vector(rotation)), rotation, atol=1e-7)
    assert np.linalg.norm(rotation_vector(rotation)) <= np.pi + EXACT


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (-1, 2, 3)])
def test_half_a_turn_has_an_axis_too(axis):
    vector = np.pi * np.array(axis) / np.linalg.norm(axis)
    found = rotation_vector(rotation_matrix(vector))
    assert abs(found @ vector) == pytest.approx(np.pi**2)


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 100))
def test_a_body_turns_and_moves_at_an_even_speed(share, other, seed):
    generator = np.random.default_rng(seed)
    first, last = (rigid(rotation_matrix(generator.uniform(-1, 1, 3)), generator.normal(size=3)) for _ in range(2))
    whole = np.linalg.norm(rotation_vector(first[:3, :3].T @ last[:3, :3]))
    one, two = interpolated(first, last, share), interpolated(first, last, other)
    turned = np.linalg.norm(rotation_vector(one[:3, :3].T @ two[:3, :3]))
    assert turned == pytest.approx(abs(share - other) * whole, abs=1e-6)
    np.testing.assert_allclose(two[:3, 3] - one[:3, 3], (other - share) * (last - first)[:3, 3], atol=EXACT)
    np.testing.assert_allclose(interpolated(first, last, 0.0), first, atol=EXACT)
    np.testing.assert_allclose(interpolated(first, last, 1.0), last, atol=EXACT)


def test_rotations_as_quaternions_degrees_and_radians_are_the_same(tmp_path):
    turn = np.array([0.3, -0.7, 2.0])
    rotation = rotation_of_rpy(*turn)
    w, x, y, z = quaternion = np.array([0.5, -0.2, 0.4, 1.7])
    forms = {
        "roll_rad,pitch_rad,yaw_rad": turn,
        "roll_deg,pitch_deg,yaw_deg": np.degrees(turn),
    }
    for names, values in forms.items():
        text = f"{HEADER},{names}\n0,a,1,2,3,{','.join(map(repr, values.tolist()))}\n"
        found = read_poses(write(tmp_path / "p.csv", text))["a"]
        np.testing.assert_allclose(found.poses, [rigid(rotation, (1, 2, 3))], atol=EXACT)
    found = read_poses(write(tmp_path / "p.csv", f"{HEADER},qw,qx,qy,qz\n0,a,0,0,0,{w},{x},{y},{z}\n"))["a"]
    np.testing.assert_allclose(found.poses[0, :3, :3], rotation_of_quaternion(*quaternion), atol=EXACT)
    # Rodrigues' formula, worked out apart from the quaternion's own
    angle = 2 * np.arctan2(np.linalg.norm(quaternion[1:]), w)
    vector = angle * quaternion[1:] / np.linalg.norm(quaternion[1:])
    np.testing.assert_allclose(found.poses[0, :3, :3], rotation_matrix(vector), atol=EXACT)


def test_a_body_rests_before_its_first_and_after_its_last_row(tmp_path):
    path = read_poses(write(tmp_path / "p.csv", f"{HEADER}\n1,a,0,0,0\n\n3,a,2,0,0\n"))["a"]
    np.testing.assert_allclose(path.at(np.array([0, 1, 1.5, 2, 3, 9]))[:, 0, 3], [0, 0, 0.5, 1, 2, 2], atol=EXACT)


def test_names_keep_the_line_ends_of_other_scripts(tmp_path):
    path = write(tmp_path / "p.csv", f"{HEADER}\n0,a\u2028b,0,0,0\n")
    assert list(read_poses(path)) == ["a\u2028b"]


BAD = {
    "no column": ("time_s,body,x_m,y_m\n0,a,0,0\n", "p.csv:1", "^missing columns: z_m$"),
    "another column": (f"{HEADER},colour\n0,a,0,0,0,1\n", "p.csv:1", "colour"),
    "no angle of ours": (f"{HEADER},roll\n0,a,0,0,0,1\n", "p.csv:1", "^unknown or repeated: roll$"),
    "half a rotation": (f"{HEADER},qw,qx,qy\n0,a,0,0,0,1,0,0\n", "p.csv:1", "qz"),
    "two rotations": (f"{HEADER},roll_deg,pitch_deg,yaw_deg,qw,qx,qy,qz\n", "p.csv:1", "given twice, in two forms"),
    "no row": (f"{HEADER}\n", "p.csv", "no pose"),
    "nothing": ("", "p.csv", "0 rows"),
    "a word": (f"{HEADER}\n0,a,0,x,0\n", "p.csv:2:4", "y_m is 'x'"),
    "no number": (f"{HEADER}\n0,a,0,0,0\n\nnan,a,0,0,0\n", "p.csv:4:1", "time_s is 'nan'"),
    "no body": (f"{HEADER}\n0,,0,0,0\n", "p.csv:2:2", "body is empty"),
    "a short row": (f"{HEADER}\n0,a,0,0\n", "p.csv:2", "4 columns"),
    "time that stands": (f"{HEADER}\n0,a,0,0,0\n0,b,0,0,0\n0,a,1,0,0\n", "p.csv:4", "in line 2"),
    "no quaternion": (f"{HEADER},qw,qx,qy,qz\n0,a,0,0,0,0,0,0,0\n", "p.csv:2:6", "no length"),
    "far away": (f"{HEADER}\n0,a,1e12,0,0\n", "p.csv:2:3", "x_m is '1e12'"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_cannot_be_used_is_refused_at_its_cell(tmp_path, monkeypatch, case):
    text, where, message = BAD[case]
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "p.csv", text)
    with pytest.raises(DataError) as refused:
        read_poses(type(tmp_path)("p.csv"))
    assert refused.value.where == where
    assert re.search(message, refused.value.message)


# ------------------------------------------------------------------- the task


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("scans")
    (root / "things").mkdir()
    (root / "front").mkdir()
    for index, radius in enumerate((0.1, 0.12)):
        trimesh.creation.icosphere(2, radius=radius).export(root / "things" / f"ball{index}.stl")
    trimesh.creation.box((0.02, 0.05, 0.3)).export(root / "front" / "post.stl")
    write(root / "way.csv", f"{HEADER},yaw_deg,roll_deg,pitch_deg\n0,*,0,-0.3,0,0,0,0\n0.4,*,0,0.3,0,90,0,0\n")
    return root


def configured(folder, **keys):
    given = {"folder": folder / "things", "motion": folder / "way.csv", "poses": 1, "truth_points": 300, **keys}
    return MeshesTask.Config(**given)


def test_objects_are_in_every_frame_where_the_file_says(folder):
    task, config = MeshesTask(), configured(folder, jitter_rotation_deg=0.0, jitter_translation_m=0.0)
    for split in ("train", "test"):
        (scene,) = task.scenes(config, split, 0)
        assert scene.frames == 5
        assert scene.frame_rate_hz == 10.0
        (body,) = scene.bodies
        np.testing.assert_allclose(body.poses[:, 1, 3], np.linspace(-0.3, 0.3, 5), atol=EXACT)
        turned = [rotation_vector(pose[:3, :3])[2] for pose in body.poses]
        np.testing.assert_allclose(turned, np.radians(np.linspace(0, 90, 5)), atol=EXACT)
        again = pickle.loads(pickle.dumps(scene))
        np.testing.assert_array_equal(again.bodies[0].poses, body.poses)


def test_the_design_space_sees_the_whole_way(folder):
    task, config = MeshesTask(), configured(folder)
    space = task.space(config)
    still = task.space(configured(folder, motion=None))
    for split in ("train", "test"):
        for scene in task.scenes(config, split, 3):
            body = scene.bodies[0]
            for frame in range(scene.frames):
                pose = body.pose(frame)
                points = body.shape.vertices @ pose[:3, :3].T + pose[:3, 3]
                origin = np.array(space.low[:3])
                assert space.contains(aim(origin, points)).all()
    assert space.high[5] > still.high[5]
    mesh = task.scenes(config, "test", 0)[0].bodies[0].shape
    np.testing.assert_allclose(moved_bounds_m(mesh, np.eye(4)[None]), mesh.bounds_m)


def rays_at(scene, frame, count=150):
    """Rays from in front at the truth of one frame."""
    points = scene.truth[SURFACES][frame].points
    points = points[np.linspace(0, len(points) - 1, count).astype(int)]
    seen = aim(np.array([1.5, 0.0, 0.0]), points)
    return rays_of_points(seen, seen[:, 5:] + np.array([-0.02, 0.02]))


def test_every_frame_is_judged_by_where_the_object_is_then(folder):
    task, config = MeshesTask(), configured(folder)
    (scene,) = task.scenes(config, "test", 0)
    assert len(scene.truth[SURFACES]) == scene.frames
    middles = [surface.points.mean(axis=0)[1] for surface in scene.truth[SURFACES]]
    np.testing.assert_allclose(np.diff(middles), 0.15, atol=0.03)
    # rays that wait for the object where it is in one frame see it well in that one alone
    returns = simulate(scene, rays_at(scene, 2))
    found = task.score(scene, returns)
    alone = [
        task.score(
            replace(scene, truth={"surface": surface, METRIC: scene.truth[METRIC]}),
            [one for one in returns if one.frame == frame],
        )
        for frame, surface in enumerate(scene.truth[SURFACES])
    ]
    assert np.argmin([score.value for score in alone]) == 2
    assert alone[2].value < 20
    assert found.value == pytest.approx(np.mean([score.value for score in alone]))
    assert found.details["failed_frames"] == sum(score.failed for score in alone) > 0
    assert not found.failed
    empty = simulate(scene, rays_at(scene, 2).subset(np.zeros(0, dtype=int)))
    assert task.score(scene, empty).failed


def test_an_object_out_of_view_is_not_judged(folder):
    way = write(folder / "away.csv", f"{HEADER}\n0,*,0,0,0\n0.1,*,0,0,0\n0.2,*,0,0,50\n")
    task = MeshesTask()
    space = task.space(configured(folder, motion=None))
    (scene,) = task.scenes(configured(folder, motion=way), "test", 0, space)
    assert [surface is None for surface in scene.truth[SURFACES]] == [False, False, True]
    returns = simulate(scene, rays_at(scene, 1))
    assert not task.score(scene, returns).failed
    information = checked_information(task, scene, returns)
    assert np.unique(information.frame).tolist() == [0, 1]
    assert set(information.source.tolist()) <= {0, 1}
    assert len(information.ray)


def test_occluders_and_single_objects_move_by_their_names(folder):
    rows = "0,ball0.stl,0,0,0\n1,ball0.stl,0,1,0\n0,post,0.5,0,0\n0.5,post,0.5,1,0\n"
    way = write(folder / "names.csv", f"{HEADER}\n{rows}")
    task = MeshesTask()
    config = configured(folder, motion=way, occluders=folder / "front", frame_rate_hz=2.0, jitter_rotation_deg=0.0)
    bodies = {}
    for split in ("train", "test"):
        for scene in task.scenes(config, split, 0):
            assert scene.frames == 3
            bodies |= {body.name: body for body in scene.bodies}
    assert np.ptp(bodies["ball0.stl"].poses[:, 1, 3]) == pytest.approx(1)
    assert bodies["ball1.stl"].poses.ndim == 2
    np.testing.assert_allclose(bodies["post.stl"].poses[:, 1, 3], [0, 1, 1])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,cup,0,0,0\n", "no mesh is called 'cup'"),
        ("0,ball0,0,0,0\n1,ball0.stl,0,0,0\n", "are one mesh"),
        ("0,*,0,0,0\n1000,*,0,0,0\n", "10001 frames"),
    ],
)
def test_a_motion_that_fits_no_mesh_is_refused(folder, rows, message):
    way = write(folder / "wrong.csv", f"{HEADER}\n{rows}")
    with pytest.raises((DataError, ConfigError), match=message):
        MeshesTask().space(configured(folder, motion=way))


def test_there_is_one_way_to_move(folder):
    with pytest.raises(ValidationError, match="speed_m_s"):
        configured(folder, speed_m_s=1.0)
    with pytest.raises(ValidationError, match="frame_rate_hz"):
        configured(folder, motion=None, frame_rate_hz=5.0)
    with pytest.raises(DataError, match=r"gone\.csv"):
        MeshesTask().space(configured(folder, motion=folder / "gone.csv"))
