"""Your own robot: laws of the task on small models that are written here, and on models that nobody here made."""

from __future__ import annotations

import itertools
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
from lidardesign_tasks.robot.motion import DEPTH_M, Wanderer, joined, spans, window_frames, windows
from lidardesign_tasks.robot.recordings import Recording, columns, read_recordings
from lidardesign_tasks.robot.targets import mean_depth_m, refuse_sensors_inside
from lidardesign_tasks.robot.task import MujocoTask, model_of
from support.rays import rays_of_points
from support.robots import written

from lidardesign.config import resolve, save_run_config
from lidardesign.contract import contract_of
from lidardesign.contract.contract import LAWS
from lidardesign.density.training.learn import prepare_training_data
from lidardesign.errors import ConfigError, DataError
from lidardesign.rays.information import checked_information
from lidardesign.run.manifest import note, start_manifest
from lidardesign.run_folder import RunFolder, input_hashes
from lidardesign.scenes.rays import Outcome, Returns
from lidardesign.scenes.scene import Sphere
from lidardesign.scenes.surface import sample_body
from lidardesign.simulate.returns import simulate
from lidardesign.space import aim
from lidardesign.task import load_task

TASK = MujocoTask()
ROBOT = """<mujoco><worldbody>
<geom name="ground" type="box" size="2 2 .1" pos="0 0 -.1"/>
<body name="base" pos="0 0 .5"><geom name="trunk" type="box" size=".1 .1 .4"/>
<body name="arm" pos=".15 0 .4"><joint name="lift" axis="0 1 0" range="-80 80"/>
<geom name="upper" type="capsule" size=".04" fromto="0 0 0 .4 0 0"/>
<body name="hand" pos=".5 0 0"><joint name="turn" axis="0 0 1" range="-90 90"/>
<geom name="palm" type="sphere" size=".06"/></body></body></body>
<body name="parcel" pos="1 0 .1"><freejoint name="parcel"/><geom name="lid" type="box" size=".1 .1 .1"/></body>
</worldbody><keyframe><key qpos="0 0 1 0 .1 1 0 0 0"/><key qpos=".5 -1 1 0 .1 1 0 0 0"/></keyframe></mujoco>"""
REST = [1, 0, 0.1, 1, 0, 0, 0]


@pytest.fixture
def folder(tmp_path):
    written(tmp_path, ROBOT, "robot.xml")
    return tmp_path


@pytest.fixture
def model(folder):
    return mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))


@pytest.fixture
def configured(folder):
    def configure(**keys):
        return TASK.Config(**{"model": folder / "robot.xml", "targets": ("hand",), "train": 3, "test": 3, **keys})

    return configure


def table(lift, **more):
    """A recording of the robot by columns."""
    names = ["parcel.x", "parcel.y", "parcel.z", "parcel.qw", "parcel.qx", "parcel.qy", "parcel.qz"]
    rest = {name: np.full(len(lift), value) for name, value in zip(names, REST, strict=True)}
    return {"time_s": np.arange(len(lift)) / 10, "lift": lift, "turn": np.zeros(len(lift)), **rest, **more}


def write_csv(path, table):
    rows = [",".join(table), *(",".join(map(str, row)) for row in zip(*table.values(), strict=True))]
    path.write_text("\n".join(rows) + "\n")
    return path


# The contract


@pytest.mark.slow
@pytest.mark.parametrize(
    "keys",
    [
        "metric=position",
        "metric=surface",
        "motion=keyframes metric=seen",
        "mount_body=base origin_m=[0,-.4,.3]",
        "mount_body=hand targets=[parcel] origin_m=[.1,0,-.1] metric=seen",
    ],
)
def test_the_task_keeps_the_contract(folder, keys):
    usual = [f"model={folder / 'robot.xml'}", "train=2", "test=2", "frames=4"]
    targets = [] if "targets" in keys else ["targets=[hand]"]
    found = contract_of(TASK, overrides=[*usual, *targets, *keys.split()])
    # in another process they are made again by the tests of workers
    laws = [law.name for law in LAWS if law.name != "scenes repeat elsewhere"]
    assert not [finding for finding in map(found.finding, laws) if finding.outcome == "fail"]


# Motion


def test_a_csv_and_an_npz_of_one_motion_are_one_motion(folder, model):
    motion = table(np.linspace(-1, 1, 30))
    write_csv(folder / "walk.csv", motion)
    np.savez(folder / "walk.npz", **motion)
    whole = np.stack([motion[name] for name in columns(model)], axis=1)
    np.savez(folder / "whole.npz", time_s=motion["time_s"], qpos=whole)
    (folder / "walks").mkdir()
    for name in ("walk.csv", "walk.npz", "whole.npz"):
        (folder / name).rename(folder / "walks" / name)
    found = read_recordings(model, folder / "walks")
    assert [one.name for one in found] == ["walk.csv", "walk.npz", "whole.npz"]
    for one in found:
        np.testing.assert_allclose(one.qpos, whole)
        np.testing.assert_allclose(one.at(model, np.array([0.05])), (whole[:1] + whole[1:2]) / 2)


def test_a_quaternion_is_unit_between_rows_whatever_its_sign_and_length(folder, model):
    signs = np.where(np.arange(20) % 2, -3e-200, 2e300)
    angle = np.linspace(0, 3, 20)
    turned = {"parcel.qw": signs * np.cos(angle / 2), "parcel.qz": signs * np.sin(angle / 2)}
    (one,) = read_recordings(model, write_csv(folder / "turn.csv", table(np.zeros(20), **turned)))
    qpos = one.at(model, np.linspace(0, 1.9, 77))
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 5:9], axis=1), 1.0)
    found = 2 * np.arctan2(qpos[:, 8], qpos[:, 5])
    np.testing.assert_allclose(found, np.interp(np.linspace(0, 1.9, 77), one.time_s, angle), atol=1e-4)


BAD = {
    "a joint by another name": (
        lambda t: {("lft" if k == "lift" else k): v for k, v in t.items()},
        "did you mean 'lift'",
    ),
    "a joint that is missing": (lambda t: {k: v for k, v in t.items() if k != "turn"}, "joints are missing: turn"),
    "no time": (lambda t: {k: v for k, v in t.items() if k != "time_s"}, "has no column time_s"),
    "time that goes back": (lambda t: {**t, "time_s": -t["time_s"]}, "does not ascend"),
    "a joint beyond its limits": (
        lambda t: {**t, "turn": t["turn"] + 2.0},
        "'turn' is at 2 at 0 s; allowed: -1.571",
    ),
    "degrees": (lambda t: {**t, "turn": t["turn"] + 45.0}, "are they degrees"),
    "no number": (lambda t: {**t, "turn": ["x"] * len(t["lift"])}, "turn is 'x'"),
    "NaN": (lambda t: {**t, "turn": [np.nan] * len(t["lift"])}, "turn is 'nan'"),
    "no quaternion": (lambda t: {**t, "parcel.qw": np.zeros(len(t["lift"]))}, "a quaternion of 'parcel' is 0"),
    "one row": (lambda t: {k: v[:1] for k, v in t.items()}, "less than 2 rows"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_motion_that_cannot_be_used_is_refused_with_its_file(folder, configured, case):
    change, said = BAD[case]
    path = write_csv(folder / "walk.csv", change(table(np.zeros(10))))
    with pytest.raises(DataError) as error:
        TASK.scenes(configured(motion=path), "train", 0)
    assert said in str(error.value).replace("\n  ", "; ")
    assert "walk.csv" in str(error.value)


def test_an_archive_whose_time_is_one_number_is_refused(folder, model):
    np.savez(folder / "walk.npz", time_s=0.5, qpos=np.zeros((12, model.nq)))
    np.savez(folder / "point.npz", **{name: 0.5 for name in ("time_s", *columns(model))})
    for name, said in (("walk.npz", "'qpos' is not a joint"), ("point.npz", "less than 2 rows")):
        with pytest.raises(DataError, match=said):
            read_recordings(model, folder / name)


def test_several_recordings_are_split_by_file_and_one_in_its_middle():
    whole = [Recording(f"{i}.csv", np.arange(50) / 10, np.zeros((50, 1))) for i in range(5)]
    parts = {split: [one.name for one, _, _ in spans(whole, split)] for split in ("train", "test")}
    assert sorted(parts["train"] + parts["test"]) == [one.name for one in whole]
    (_, first, end), (_, begin, last) = spans(whole[:1], "train")[0], spans(whole[:1], "test")[0]
    assert (first, last) == (0.0, 4.9)
    assert end == begin
    assert window_frames(whole, 20, 10.0) == 20
    assert window_frames(whole[:1], 40, 10.0) == 25


def test_few_windows_of_many_recordings_are_of_others_with_every_seed(folder, model):
    many = [Recording(f"{i}.csv", np.arange(50) / 10, np.tile([0, 0, *REST], (50, 1))) for i in range(60)]
    shown = [{one.group for one in windows(model, many, "train", 10, 5, 10.0, seed)} for seed in range(6)]
    assert all(len(names) == 10 for names in shown)
    assert len(set.union(*shown)) > 15


def test_recordings_go_a_little_beyond_limits_as_those_of_mujoco_do(folder, model):
    beyond = np.radians(80) + 0.04 * np.radians(160)
    (one,) = read_recordings(model, write_csv(folder / "walk.csv", table(np.full(5, beyond))))
    assert one.qpos[0, 0] == pytest.approx(beyond)


def test_windows_of_one_recording_stay_in_the_half_of_their_split(folder, configured):
    lift = np.linspace(-1, 1, 101)
    config = configured(motion=write_csv(folder / "walk.csv", table(lift)), frames=10, train=8, test=8)
    heights = {
        split: [TASK.scenes(config, split, 0)[i].truth["places_m"][0, :, 2] for i in range(8)]
        for split in ("train", "test")
    }
    assert min(map(np.min, heights["train"])) >= max(map(np.max, heights["test"])) - 1e-9
    assert "one recording" in TASK.notes(config, TASK.space(config))[1]


@pytest.mark.parametrize(
    ("step_s", "rows", "is_doubtful"), [(0.001, 60, False), (0.5, 60, False), (10.0, 60, True), (5.0, 8, False)]
)
def test_times_in_another_unit_than_seconds_are_told(folder, configured, step_s, rows, is_doubtful):
    moments = {"time_s": step_s * np.arange(rows)}
    walk = write_csv(folder / "walk.csv", table(np.linspace(-1, 1, rows), **moments))
    config = configured(motion=walk, frames=4)
    told = [note for note in TASK.notes(config, TASK.space(config)) if "are they milliseconds" in note]
    assert bool(told) == is_doubtful
    assert all("walk.csv" in note and f"{step_s:.4g} s apart" in note for note in told)


def test_one_long_pause_among_short_steps_is_told(folder, configured):
    moments = {"time_s": np.arange(30) / 10 + 1e6 * (np.arange(30) > 20)}
    config = configured(motion=write_csv(folder / "walk.csv", table(np.linspace(-1, 1, 30), **moments)), frames=4)
    told = " ".join(TASK.notes(config, TASK.space(config)))
    assert "walk.csv: two of its rows are 1e+06 s apart" in told


@pytest.mark.parametrize("task", ["meshes", "mujoco", "face"])
@pytest.mark.parametrize("half", [-1, [0.1, -0.1, 0]])
def test_a_box_of_origins_has_no_negative_size(task, half):
    with pytest.raises(ConfigError, match="half sizes are 0 m or more"):
        resolve(load_task(task), overrides=[f"origin_box_m={half}"])


def test_a_folder_of_the_model_that_is_none_is_called_so(configured, tmp_path):
    with pytest.raises(DataError, match="is not a folder"):
        TASK.space(configured(folder=tmp_path / "absent"))


def test_a_run_tells_that_what_its_task_reads_has_changed(folder, tmp_path):
    config = resolve(TASK, overrides=[f"model={folder / 'robot.xml'}", "targets=hand"])
    run = tmp_path / "run"
    run.mkdir()
    start_manifest(run, command=["learn"], seed=0)
    note(run, inputs=input_hashes(config.task))
    save_run_config(config, run)
    assert RunFolder.open(run).input_notes() == []
    (folder / "robot.xml").write_text(ROBOT.replace(" ", "  ", 1))
    assert "robot.xml changed since" in RunFolder.open(run).input_notes()[0]
    (folder / "robot.xml").unlink()
    assert "robot.xml is gone since" in RunFolder.open(run).input_notes()[0]


def test_keyframes_are_passed_at_rest(folder, model):
    way = joined(model, model.key_qpos[0], model.key_qpos[1], np.linspace(0, 1, 101))
    np.testing.assert_allclose(way[[0, -1]], model.key_qpos[:2])
    assert np.abs(np.diff(way, axis=0)[[0, -1]]).max() < np.abs(np.diff(way, axis=0)).max() / 1000


def test_random_ways_do_not_collide_and_contacts_at_rest_are_none(folder, model):
    wanderer = Wanderer(model, "robot.xml")
    data = mujoco.MjData(model)
    ways = [wanderer.draw(20, 10.0, np.random.default_rng(seed)) for seed in range(10)]
    for qpos in itertools.chain(*ways):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        names = {tuple(sorted(model.geom(geom).name for geom in pair)) for pair in data.contact.geom}
        deep = {pair for pair, dist in zip(names, data.contact.dist, strict=False) if dist < -DEPTH_M}
        assert deep <= {("ground", "lid")}
    assert np.ptp(np.concatenate(ways)[:, 0]) > 1.0
    limits = model.jnt_range[:2]
    assert all(((way[:, :2] >= limits[:, 0]) & (way[:, :2] <= limits[:, 1])).all() for way in ways)


def test_what_stands_free_is_raised_out_of_the_ground(tmp_path):
    standing = """<mujoco><worldbody><geom name="floor" type="plane" size="2 2 .1"/><body pos="0 0 .5"><freejoint/>
    <geom type="box" size=".1 .1 .1"/><body><joint axis="0 1 0" range="-90 90"/>
    <geom name="leg" type="capsule" size=".03" fromto=".2 0 0 .2 0 -.46"/></body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_path(str(written(tmp_path, standing, "leg.xml")))
    data, wanderer = mujoco.MjData(model), Wanderer(model, "leg.xml")
    way = np.concatenate([wanderer.draw(30, 10.0, np.random.default_rng(seed)) for seed in range(5)])
    for qpos in way:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        assert data.contact.dist.min(initial=0.0) > -2 * DEPTH_M
    assert np.ptp(way[:, 2]) > 0.02
    np.testing.assert_array_equal(way[:, :2], 0.0)


def test_a_target_that_rests_in_all_scenes_is_named(configured):
    config = configured(targets=("parcel",))
    assert any("parcel: at the same place in all scenes" in note for note in TASK.notes(config, TASK.space(config)))


def test_what_collides_at_rest_may_collide(tmp_path):
    jammed = """<mujoco><worldbody><body name="wall"><geom type="box" size="1 1 .1"/></body>
    <body pos="0 0 .2"><joint type="slide" axis="0 0 1" range="-1 -.05"/><geom name="head" type="sphere" size=".1"/>
    </body></worldbody></mujoco>"""
    config = TASK.Config(model=written(tmp_path, jammed, "jam.xml"), targets=("head",), train=1, test=1)
    assert len(TASK.scenes(config, "train", 0)) == 1


# Scenes


def test_bodies_are_where_mujoco_puts_them_seen_from_the_world_or_from_a_body(folder, configured):
    keys = {"motion": "keyframes", "frames": 5, "metric": "seen"}
    world = TASK.scenes(configured(**keys), "train", 0)
    there = TASK.scenes(configured(**keys, mount_body="arm", origin_m=(0, 0, 0.3)), "train", 0)
    for one, other in zip(world, there, strict=True):
        names = [body.name for body in one.bodies]
        arm, base = names.index("arm"), names.index("base")
        assert other.bodies[arm].poses.ndim == 2
        assert other.bodies[base].poses.ndim == 3
        for frame in range(5):
            # whatever the frame, bodies are where they are to each other
            for first, second in zip(one.bodies, other.bodies, strict=True):
                there_to_arm = np.linalg.inv(other.bodies[arm].pose(frame)) @ second.pose(frame)
                np.testing.assert_allclose(
                    np.linalg.inv(one.bodies[arm].pose(frame)) @ first.pose(frame), there_to_arm, atol=1e-9
                )


def test_roles_and_groups_follow_the_names(configured):
    (scene, *_) = TASK.scenes(configured(ignored=("ground",), targets=("pa*",)), "train", 0)
    roles = {body.name: body.role for body in scene.bodies}
    assert roles == {"base": "occluder", "arm": "occluder", "hand": "both", "parcel": "both"}
    assert scene.group == "train 0"


WRONG = {
    "no model": ({"model": None}, "no model is set"),
    "no targets": ({"targets": ()}, "no targets are set"),
    "a target that is not there": ({"targets": ("hnad*",)}, "did you mean 'hand'"),
    "a known part that is not there": ({"known": ("trnk",)}, "did you mean 'trunk'"),
    "a mount that is not there": ({"mount_body": "bse"}, "did you mean 'base'"),
    "a mount that is the world": ({"mount_body": "world"}, "no body is called 'world'"),
    "a target that carries the sensors": ({"mount_body": "hand", "targets": ("hand",)}, "is a target"),
    "targets alone as known": ({"known": ("hand",), "targets": ("hand",)}, "all known pieces are targets"),
    "sensors inside geometry": ({"origin_m": (0, 0, 0.5)}, "inside 'base'"),
    "sensors inside the mount": ({"mount_body": "base", "origin_m": (0, 0, 0)}, "inside 'base'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_configuration_that_cannot_be_used_says_what_to_do(configured, case):
    keys, said = WRONG[case]
    with pytest.raises(ConfigError) as error:
        TASK.scenes(configured(**keys), "train", 0)
    assert said in str(error.value)
    assert "task." in str(error.value.where)


def test_links_without_a_shape_that_can_be_read_are_named_before_anything_is_learned(tmp_path):
    ball = '<visual><geometry><sphere radius=".1"/></geometry></visual>'
    mesh = '<visual><geometry><mesh filename="t.dae"/></geometry></visual>'
    links = f'<link name="base">{ball}</link><link name="arm">{ball}</link><link name="tip">{mesh}</link>'
    joints = "".join(
        f'<joint name="{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        '<origin xyz="0 0 .4"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for parent, child in (("base", "arm"), ("arm", "tip"))
    )
    text = f'<robot name="r">{links}{joints}</robot>'
    keys = [f"model={written(tmp_path, text, 'r.urdf')}", "train=2", "test=2", "frames=3"]
    with pytest.raises(ConfigError, match=r"(?s)is called 'tip'.*links without any: tip"):
        resolve(TASK, overrides=[*keys, "targets=tip"])
    said = []
    prepare_training_data(TASK, resolve(TASK, overrides=[*keys, "targets=arm"]), said.append)
    assert any("links without any: tip" in note for note in said)
    assert any("refuses its masses" in note for note in said)


def test_what_passes_through_a_sensor_is_no_error_and_what_stays_there_is(configured):
    model = model_of(configured())
    through = model.poses(np.array([[lift, 0, *REST] for lift in (0, -1, -1)]))
    at_the_hand = np.array([[0.65, 0.0, 0.9]])
    refuse_sensors_inside(model, through, at_the_hand)
    with pytest.raises(ConfigError, match="inside 'hand'"):
        refuse_sensors_inside(model, through[:1], at_the_hand)


def test_one_name_needs_no_list(folder):
    given = [f"model={folder / 'robot.xml'}"]
    alone, listed = (resolve(TASK, overrides=[*given, f"targets={names}"]).task for names in ("hand", "[hand]"))
    assert alone == listed


def test_words_for_motions_are_no_paths(folder, monkeypatch):
    given = [f"model={folder / 'robot.xml'}", "targets=[hand]"]
    walk = write_csv(folder / "walk.csv", table(np.zeros(10)))
    assert resolve(TASK, overrides=[*given, "motion=keyframes"]).task.motion == "keyframes"
    monkeypatch.chdir(folder)
    assert resolve(TASK, overrides=[*given, "motion=walk.csv"]).task.motion == walk


# Metrics


def test_the_mean_depth_of_a_ball_is_two_thirds_of_its_radius():
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points *= 0.3 / np.linalg.norm(points, axis=1, keepdims=True)
    assert mean_depth_m(points) == pytest.approx(0.2, rel=0.01)


def disc_rays(scene, target, origin, count=2000):
    """Rays that cross the disc of a ball evenly, in the scene's first frame."""
    generator, body = np.random.default_rng(0), scene.bodies[target]
    assert isinstance(body.shape, Sphere)
    places = body.pose(0)[:3, 3] + 0.06 * generator.uniform(-1, 1, (count, 3))
    return rays_of_points(aim(np.tile(origin, (count, 1)), places), (0.0, 10.0))


@pytest.fixture
def resting(configured, folder):
    """Scenes in which nothing moves, by keys of the configuration."""

    def scenes(**keys):
        motion = write_csv(folder / "rest.csv", table(np.zeros(50)))
        return TASK.scenes(configured(motion=motion, **{"frames": 3, **keys}), "train", 0)

    return scenes


def test_the_position_of_a_ball_is_found_by_returns_on_it(resting):
    (scene, *_) = resting()
    target = next(i for i, body in enumerate(scene.bodies) if body.is_target)
    found = TASK.score(scene, simulate(scene, disc_rays(scene, target, [0.65, -1.0, 0.9])))
    assert found.value < 0.005
    assert found.details["seen_percent"] == 100.0


def test_what_is_not_known_is_mistaken_for_the_target(resting):
    told_apart, mistaken = (resting(known=known)[0] for known in (("*",), ()))
    target = next(i for i, body in enumerate(told_apart.bodies) if body.is_target)
    rays = disc_rays(told_apart, target, [0.65, -0.5, 2.0])
    apart, alike = simulate(told_apart, rays), simulate(mistaken, rays)
    assert (apart[0].body != target).any()
    assert TASK.score(told_apart, apart).value < TASK.score(mistaken, alike).value
    assert checked_information(TASK, told_apart, apart).harm.max() == 0
    assert checked_information(TASK, mistaken, alike).harm.max() > 0


def test_seen_counts_targets_and_frames_with_a_return(resting):
    (scene, *_) = resting(metric="seen", targets=("hand", "parcel"))
    target = next(i for i, body in enumerate(scene.bodies) if body.name == "hand")
    returns = simulate(scene, disc_rays(scene, target, [0.65, -1.0, 0.9], 50))
    assert TASK.score(scene, returns).value == pytest.approx(50.0)
    nothing = [Returns(one.rays, np.full(50, Outcome.MISS), one.range_m, np.full(50, -1), one.frame) for one in returns]
    assert TASK.score(scene, nothing).value == 0.0


def test_a_surface_that_no_sensor_can_see_is_lost_and_tells_nothing(resting):
    (scene, *_) = resting(metric="surface", mount_body="base", origin_m=(-0.2, 0.0, 0.0), train=1, frames=2)
    returns = simulate(scene, rays_of_points(np.array([[-0.2, 0.0, 0.0, 0.0, 0.0, 1.0]]), (0.0, 10.0)))
    assert TASK.score(scene, returns).failed
    told = checked_information(TASK, scene, returns)
    assert len(told.worth) == 0


# Models that nobody here made: `make consumers` installs them

ASSETS = "envs/assets"
REAL = {
    "a quadruped, its own toes from its torso": ("dm_control", "suite/quadruped.xml", "", {
        "targets": ("toe*",), "mount_body": "torso", "origin_m": (0.0, 0.0, -0.25), "metric": "seen",
    }),
    "a quadruped with a height field": ("dm_control", "suite/quadruped.xml", "", {"targets": ("terrain",)}),
    "a hand of meshes": ("gymnasium_robotics", f"{ASSETS}/hand/reach.xml", ASSETS, {"targets": ("*ffdistal",)}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_targets_of_a_model_of_others_are_found_and_tell(name):
    package, file, folder, keys = REAL[name]
    home = find_spec(package)
    if home is None:
        pytest.skip(f"{package} is not installed: make consumers")
    root = Path(next(iter(home.submodule_search_locations)))
    config = TASK.Config(model=root / file, folder=root / folder if folder else None, train=2, frames=4, **keys)
    (scene, _), space = TASK.scenes(config, "train", 0), TASK.space(config)
    generator, wanted = np.random.default_rng(0), [body for body in scene.bodies if body.is_target]
    seen = np.concatenate([sample_body(wanted, space, 500, generator, frame).points for frame in range(4)])
    points = aim(generator.uniform(space.low[:3], space.high[:3], seen.shape), seen)
    returns = simulate(scene, rays_of_points(points, (0.0, 1e3)))
    targets = {index for index, body in enumerate(scene.bodies) if body.is_target}
    assert targets & set(np.concatenate([one.body for one in returns]).tolist())
    informed = checked_information(TASK, scene, returns)
    assert informed.worth.max() > 0
    assert np.isfinite(TASK.score(scene, returns).value)
