"""The arm task: motions that an arm can do, scenes of them, and what tracking the ball is worth."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.robot.arm_motion import (
    CLEARANCE_M,
    PICK_M,
    PLACE_M,
    POSITION_RESIDUAL_M,
    Arm,
    RejectedError,
    ball_path,
    draw_waypoints,
    highest_m,
    phase_shares,
)
from lidardesign_tasks.robot.arm_robot import BALL, load_robot
from lidardesign_tasks.robot.motion import minimum_jerk
from lidardesign_tasks.robot.tracking import MEAN_DEPTH, REACH_FRAMES, filled_path, tracked_places
from support.rays import rays_along
from support.references import recursive_frechet

from lidardesign.errors import ConfigError
from lidardesign.rays.information import checked_information
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Returns
from lidardesign.scenes.scene import Body, Mesh, Scene, Sphere, rigid
from lidardesign.scoring.metrics import discrete_frechet_m
from lidardesign.simulate.returns import simulate
from lidardesign.space import aim

REAL = Path(__file__).parents[3] / "shared" / "data" / "iiwa14" / "iiwa14.xml"
needs_real = pytest.mark.skipif(not REAL.exists(), reason="the real arm's model is not at ../shared/data/iiwa14")
SMALL = {"size": "small"}
TASK = ArmTask()


@pytest.fixture(scope="module")
def config():
    return TASK.Config(**SMALL)


@pytest.fixture(scope="module")
def scenes(config):
    return {split: TASK.scenes(config, split, 0) for split in ("train", "test")}


@pytest.fixture(scope="module")
def arm():
    return Arm(load_robot(None, 0.15), 1.0)


def exact_returns(scene, places, frames=None, target=0):
    """One return per frame that puts the ball exactly at `places`, from right above."""
    radius = scene.bodies[target].shape.radius_m
    returns = []
    for frame in range(scene.frames) if frames is None else frames:
        origin = places[frame] + np.array([0.0, 0.0, 0.5])
        rays = rays_along([0.0, 0.0, -1.0], (0.0, 2.0), origin)
        range_m = np.array([0.5 - 2 / 3 * radius])
        returns.append(Returns(rays, np.array([Outcome.RETURN]), range_m, np.array([target]), frame))
    return returns


def test_a_small_size_sets_only_what_was_not_set():
    assert TASK.Config(size="small", train=7).train == 7
    assert TASK.Config(size="small").model_dump()["frames"] == 12
    full = TASK.Config()
    assert (full.train, full.test, full.frames) == (40, 40, 50)
    small = TASK.Config(size="small")
    assert TASK.Config(**small.model_dump()) == small


def test_minimum_jerk_starts_and_ends_at_rest_without_acceleration():
    share, step = np.linspace(0, 1, 2001), 1 / 2000
    way = minimum_jerk(share)
    velocity = np.gradient(way, step)
    acceleration = np.gradient(velocity, step)
    assert way[0] == 0
    assert way[-1] == pytest.approx(1)
    assert np.abs(velocity[[0, -1]]).max() < 1e-5
    assert np.abs(acceleration[[0, -1]]).max() < 0.05
    assert velocity.max() == pytest.approx(1.875, rel=1e-5)
    assert np.abs(acceleration).max() == pytest.approx(10 / math.sqrt(3), rel=1e-3)
    np.testing.assert_allclose(way + way[::-1], 1)
    assert minimum_jerk(np.array([-1.0, 2.0])).tolist() == [0, 1]


def test_phases_pass_their_waypoints_at_rest_and_in_order():
    waypoints = draw_waypoints(0.1, np.random.default_rng(0))
    ends = phase_shares(waypoints)
    np.testing.assert_allclose(ball_path(waypoints, ends), waypoints, atol=1e-12)
    assert (np.diff(ends) > 0).all()
    assert ends[[0, -1]].tolist() == [0, 1]
    step = 1e-4
    speed = np.linalg.norm(ball_path(waypoints, ends[1:-1] + step) - ball_path(waypoints, ends[1:-1] - step), axis=1)
    assert (speed / (2 * step) < 1e-2).all()


@pytest.mark.parametrize("jitter_m", [0.02, 0.1, 0.3])
def test_pick_and_place_points_differ_by_the_jitter_and_stay_above_the_floor(jitter_m):
    drawn = np.stack([draw_waypoints(jitter_m, np.random.default_rng(seed)) for seed in range(200)])
    for column, nominal in ((2, PICK_M), (6, PLACE_M)):
        offset = drawn[:, column] - nominal
        assert np.abs(offset).max() <= jitter_m
        assert np.abs(offset[:, :2]).max() > 0.9 * jitter_m
    assert drawn[:, :, 2].min() >= 0.03


def test_the_ball_is_where_forward_kinematics_says_and_near_the_planned_path(scenes):
    import mujoco

    robot = load_robot(None, TASK.Config().tool_m)
    data = mujoco.MjData(robot.model)
    for scene in scenes["train"]:
        for frame in range(scene.frames):
            data.qpos[:] = scene.truth["joints_rad"][frame]
            mujoco.mj_kinematics(robot.model, data)
            np.testing.assert_allclose(data.site(BALL).xpos, scene.truth["ball_m"][frame], atol=1e-12)
            np.testing.assert_allclose(data.site(BALL).xpos, scene.bodies[0].pose(frame)[:3, 3], atol=1e-12)
            tool = scene.bodies[-1].pose(frame)
            assert np.linalg.norm(tool[:2, 3] - data.site(BALL).xpos[:2]) < 2e-3
            assert tool[2, 3] > data.site(BALL).xpos[2]


def test_inverse_kinematics_keeps_the_path_the_limits_and_the_tool_upright(arm):
    waypoints = draw_waypoints(0.1, np.random.default_rng(4))
    motion = arm.follow(waypoints, 40, 5.0, Counter())
    planned = ball_path(waypoints, np.linspace(0, 1, 40))
    assert np.linalg.norm(motion.ball_m - planned, axis=1).max() <= POSITION_RESIDUAL_M
    low, high = arm.robot.model.jnt_range.T
    assert (motion.joints_rad >= low).all()
    assert (motion.joints_rad <= high).all()
    down = motion.links[-1][:, :3, 2]  # the tool's capsule lies along the flange's axis
    assert np.abs(down[:, 2]).min() > math.cos(math.radians(0.5))


def test_motions_are_smooth_and_the_yaw_stays_near_home(arm):
    generator = np.random.default_rng(1)
    for _ in range(3):
        motion = arm.draw(0.1, 50, 6.25, generator, "smooth")
        assert np.abs(np.diff(motion.joints_rad, axis=0)).max() < 0.3
        assert np.abs(motion.joints_rad[:, 6] - arm.robot.home_rad[6]).max() < math.radians(30)


def test_every_body_stays_below_the_ceiling_and_above_the_floor(scenes):
    for scene in (*scenes["train"], *scenes["test"]):
        for body in scene.bodies:
            poses = body.poses if body.poses.ndim == 3 else body.poses[None]
            assert highest_m(body.shape, poses) <= 1.0 - CLEARANCE_M
        assert scene.truth["ball_m"][:, 2].min() > 0.02


def test_a_motion_near_the_ceiling_or_too_fast_is_rejected():
    robot = load_robot(None, 0.15)
    waypoints = draw_waypoints(0.1, np.random.default_rng(0))
    with pytest.raises(RejectedError, match="ceiling"):
        Arm(robot, 0.7).follow(waypoints, 10, 1.0, Counter())
    with pytest.raises(RejectedError, match="too fast"):
        Arm(robot, 1.0).follow(waypoints, 10, 500.0, Counter())


def test_scenes_without_jitter_are_refused():
    with pytest.raises(ConfigError, match="jitter_m"):
        TASK.scenes(TASK.Config(jitter_m=0, size="small"), "train", 0)


def test_a_score_uses_time_stamps_and_not_the_order_of_returns(scenes):
    scene = scenes["test"][0]
    returns = exact_returns(scene, scene.truth["ball_m"] + 0.01)
    assert TASK.score(scene, returns).value == pytest.approx(0.01 * math.sqrt(3))
    assert TASK.score(scene, returns).details["tracked_share"] == 1
    lost = [returns[frame] for frame in (0, 3, 11)]
    assert TASK.score(scene, lost).value > TASK.score(scene, returns).value
    assert TASK.score(scene, lost).details["tracked_share"] == 3 / 12


def test_fewer_than_two_tracked_frames_fail_with_the_worst_value(scenes):
    scene = scenes["test"][0]
    none = simulate(scene, rays_along(np.zeros((0, 3))))
    for returns in (none, exact_returns(scene, scene.truth["ball_m"], frames=[5])):
        score = TASK.score(scene, returns)
        assert score.failed
        assert score.value == TASK.metric.worst
    two = TASK.score(scene, exact_returns(scene, scene.truth["ball_m"], frames=[2, 9]))
    assert not two.failed
    assert 0 < two.value < 1


def test_returns_on_the_ball_tell_of_frames_by_the_way_in_between(scenes):
    scene = scenes["test"][0]
    ball, hit = scene.truth["ball_m"], [2, 5]
    empty = simulate(scene, exact_returns(scene, ball)[0].rays.subset(np.zeros(1, dtype=int)))
    silent = [replace(one, outcome=np.full(1, Outcome.MISS), body=np.full(1, -1)) for one in empty]
    seen = {one.frame: one for one in exact_returns(scene, ball, frames=hit)}
    found = checked_information(TASK, scene, [seen.get(one.frame, one) for one in silent])
    steps = np.linalg.norm(np.diff(ball, axis=0), axis=1)
    assert found.complete == pytest.approx(REACH_FRAMES * steps.mean())
    naive = {
        (frame, other): found.complete - steps[min(frame, other) : max(frame, other)].sum()
        for frame in hit
        for other in range(scene.frames)
    }
    told = dict(zip(zip(found.seen_in.tolist(), found.item.tolist(), strict=True), found.worth, strict=True))
    assert told == pytest.approx({pair: worth for pair, worth in naive.items() if worth > 0})


def seen_share(scene, config, frame, count=4000):
    """Of admissible rays from the ceiling towards the ball's centre, the share that nothing stops."""
    space, ball = TASK.space(config), scene.truth["ball_m"][frame]
    generator = np.random.default_rng(frame)
    origins = np.column_stack([generator.uniform(-1, 1, (count, 2)), np.ones(count)])
    design = aim(origins, ball)
    origins, design = origins[space.contains(design)], design[space.contains(design)]
    hits = SceneCaster(scene, frame).first_hit(origins, (ball - origins) / design[:, 5:])
    return (hits.body == 0).mean()


def test_the_arm_hides_the_ball_from_above_but_not_from_everywhere(config, scenes):
    for scene in scenes["test"]:
        for frame in range(scene.frames):
            ball = scene.truth["ball_m"][frame]
            above = np.array([[ball[0], ball[1], 1.0]])
            assert SceneCaster(scene, frame).first_hit(above, np.array([[0.0, 0.0, -1.0]])).body[0] != 0
            assert 0.2 < seen_share(scene, config, frame) < 0.8


@needs_real
def test_the_real_arms_meshes_are_shared_by_all_scenes_and_hide_the_ball_likewise():
    config = TASK.Config(robot=REAL, size="small", train=2, test=1)
    made = [*TASK.scenes(config, "train", 0), *TASK.scenes(config, "test", 0)]
    meshes = [[id(body.shape) for body in scene.bodies if isinstance(body.shape, Mesh)] for scene in made]
    assert len(meshes[0]) == 8
    assert meshes[0] == meshes[1] == meshes[2]
    own = TASK.scenes(TASK.Config(**SMALL, train=1), "train", 0)[0]
    np.testing.assert_allclose(made[0].truth["ball_m"], own.truth["ball_m"], atol=2.5e-3)
    for frame in (0, 6, 11):
        assert seen_share(made[0], config, frame) == pytest.approx(seen_share(own, config, frame), abs=0.15)


RADIUS_M = 0.02
STANDARD_ERRORS = 4


def path(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).normal(size=(count, 3)), axis=0)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 6), (6, 1), (2, 2), (9, 9), (5, 12), (12, 5), (50, 50)])
def test_the_frechet_distance_agrees_with_its_recursive_definition(rows, columns):
    for seed in range(4):
        first, second = path(rows, seed), path(columns, seed + 100)
        expected = recursive_frechet(tuple(map(tuple, first)), tuple(map(tuple, second)))
        assert discrete_frechet_m(first, second) == pytest.approx(expected, rel=1e-12)
    line = np.outer(np.linspace(0, 1, 11), [1.0, 0.0, 0.0])
    assert discrete_frechet_m(line, line[::-1]) == pytest.approx(1.0)


def test_the_place_of_a_ball_is_unbiased_when_its_disc_is_hit_evenly():
    place, origin, count = np.array([0.4, 0.1, 0.2]), np.array([0.3, 0.5, 1.0]), 4000
    generator = np.random.default_rng(0)
    axis = (place - origin) / np.linalg.norm(place - origin)
    across = np.cross(axis, generator.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    starts = origin + RADIUS_M * np.sqrt(generator.uniform(0, 1, (count, 1))) * across
    scene = Scene((Body(Sphere(RADIUS_M), "ball", poses=rigid(translation_m=place)),))
    returns = simulate(scene, rays_along(np.tile(axis, (count, 1)), (0.0, 10.0), starts))
    frames, places = tracked_places(returns, [one.body == 0 for one in returns], MEAN_DEPTH * RADIUS_M)
    assert frames.tolist() == [0]
    assert np.abs(places - place).max() < STANDARD_ERRORS * RADIUS_M / 2 / np.sqrt(count)


def test_a_filled_path_keeps_what_was_tracked_and_holds_its_ends():
    frames, places = np.array([2, 5, 9]), path(3)
    filled = filled_path(frames, places, 12)
    np.testing.assert_allclose(filled[frames], places)
    np.testing.assert_allclose(filled[:2], places[[0, 0]])
    np.testing.assert_allclose(filled[10:], places[[2, 2]])


def test_a_filled_path_is_exact_on_a_straight_even_motion_and_never_overshoots():
    line = np.outer(np.arange(20.0), [0.1, -0.2, 0.05])
    np.testing.assert_allclose(filled_path(np.array([0, 7, 19]), line[[0, 7, 19]], 20), line, atol=1e-12)
    step = np.array([[0.0] * 3, [0.0] * 3, [1.0] * 3, [1.0] * 3])
    filled = filled_path(np.array([0, 4, 8, 12]), step, 13)
    assert filled.min() >= 0
    assert filled.max() <= 1
    assert (np.diff(filled, axis=0) >= 0).all()
