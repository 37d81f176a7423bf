"""Tracking a ball by returns: the path distance, the place per frame, the gaps in time."""

from __future__ import annotations

import numpy as np
import pytest
from lidardesign_tasks.arm_tracking import filled_path, tracked_places
from support.rays import rays_along, rays_of_points
from support.references import recursive_frechet
from support.tables import each_row

from lidardesign.evaluate.metrics import discrete_frechet_m
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Outcome, Returns
from lidardesign.scene import Body, Scene, Sphere, rigid
from lidardesign.simulate.simulate import simulate
from lidardesign.space import aim

RADIUS_M = 0.02
STANDARD_ERRORS = 4


def path(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).normal(size=(count, 3)), axis=0)


@each_row(("rows", "columns"), [(1, 1), (1, 6), (6, 1), (2, 2), (9, 9), (5, 12), (12, 5), (50, 50)])
def test_the_frechet_distance_agrees_with_its_recursive_definition(rows, columns):
    for seed in range(4):
        first, second = path(rows, seed), path(columns, seed + 100)
        expected = recursive_frechet(tuple(map(tuple, first)), tuple(map(tuple, second)))
        assert discrete_frechet_m(first, second) == pytest.approx(expected, rel=1e-12)


def test_the_frechet_distance_is_symmetric_and_zero_only_from_a_path_to_itself():
    for seed in range(5):
        first, second = path(20, seed), path(15, seed + 50)
        assert discrete_frechet_m(first, second) == pytest.approx(discrete_frechet_m(second, first))
        assert discrete_frechet_m(first, first) == 0
        assert discrete_frechet_m(first, second) > 0


def test_the_frechet_distance_keeps_the_triangle_inequality_and_ignores_rigid_motion():
    a, b, c = (path(12, seed) for seed in range(3))
    assert discrete_frechet_m(a, c) <= discrete_frechet_m(a, b) + discrete_frechet_m(b, c)
    shift = np.array([3.0, -1.0, 0.5])
    assert discrete_frechet_m(a + shift, b + shift) == pytest.approx(discrete_frechet_m(a, b))
    assert discrete_frechet_m(a, a + shift) <= np.linalg.norm(shift) + 1e-12


def test_a_path_walked_backwards_is_far_from_itself():
    line = np.outer(np.linspace(0, 1, 11), [1.0, 0.0, 0.0])
    assert discrete_frechet_m(line, line[::-1]) == pytest.approx(1.0)


def test_repeated_points_do_not_change_the_frechet_distance():
    first, second = path(10, 1), path(10, 2)
    assert discrete_frechet_m(np.repeat(first, 3, axis=0), second) == discrete_frechet_m(first, second)


def ball_scene(places):
    poses = np.stack([rigid(translation_m=place) for place in places])
    screen = Body(Sphere(0.1), "screen", "occluder", rigid(translation_m=(0.0, 0.0, 0.3)))
    return Scene((screen, Body(Sphere(RADIUS_M), "ball", "target", poses)), "ball")


def even_disc_rays(origin, places, count, seed):
    """Rays whose lines cross the balls' discs evenly, gates wide open."""
    generator = np.random.default_rng(seed)
    toward = (places - origin)[generator.integers(len(places), size=count)]
    axis = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    across = np.cross(axis, generator.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    starts = origin + RADIUS_M * np.sqrt(generator.uniform(0, 1, (count, 1))) * across
    return rays_along(axis, (0.0, 10.0), starts)


def test_the_place_of_a_ball_is_unbiased_when_its_disc_is_hit_evenly():
    place, count = np.array([[0.4, 0.1, 0.2]]), 4000
    returns = simulate(ball_scene(place), even_disc_rays(np.array([0.3, 0.5, 1.0]), place, count, 0))
    frames, places = tracked_places(returns, 1, RADIUS_M)
    assert frames.tolist() == [0]
    assert np.abs(places - place).max() < STANDARD_ERRORS * RADIUS_M / 2 / np.sqrt(count)


def test_returns_from_other_bodies_and_lost_rays_do_not_move_the_ball():
    place = np.array([[0.4, 0.1, 0.2]])
    scene = ball_scene(place)
    origin = np.array([0.0, 0.0, 1.0])
    ball = aim(np.tile(origin, (5, 1)), place + np.linspace(-0.01, 0.01, 5)[:, None])
    other = aim(np.tile(origin, (3, 1)), np.array([[0.0, 0.0, 0.3], [0.02, 0.0, 0.3], [3.0, 0.0, 0.0]]))
    points = np.concatenate([ball, other])
    rays = rays_of_points(points, (0.0, 9.0))
    everything, alone = simulate(scene, rays), simulate(scene, rays.subset(np.arange(5)))
    np.testing.assert_allclose(tracked_places(everything, 1, RADIUS_M)[1], tracked_places(alone, 1, RADIUS_M)[1])
    (frame,) = everything
    lost = Returns(rays, np.full(8, Outcome.NOT_DETECTED), frame.range_m, frame.body, 0)
    frames, places = tracked_places([lost], 1, RADIUS_M)
    assert frames.shape == (0,)
    assert places.shape == (0, 3)


def test_frames_that_were_not_seen_are_left_to_the_spline():
    places = np.column_stack([np.linspace(-0.3, 0.3, 7), np.full(7, 0.2), np.full(7, 0.1)])
    scene = ball_scene(places)
    rays = even_disc_rays(np.array([0.0, 0.4, 1.0]), places[[1, 4]], 60, 3)
    frames, _ = tracked_places(simulate(scene, rays), 1, RADIUS_M)
    hits = [SceneCaster(scene, frame).first_hit(rays.origin_m, rays.direction).body == 1 for frame in range(7)]
    assert frames.tolist() == [frame for frame in range(7) if hits[frame].any()]
    assert {1, 4} <= set(frames.tolist()) < set(range(7))


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
