"""What holds for landing alone."""

import numpy as np
import pytest
from lidardesign import Body, Box, Plane, Rays, Scene, rigid
from lidardesign.simulate.returns import simulate

from lidardesign_landing.hazards import seen
from lidardesign_landing.task import LandingTask

HEIGHT_M = 4.0


@pytest.fixture
def scene():
    """Two boxes of 1 m on flat ground, 2 m to either side of the landing place."""
    boxes = [Body(Box((0.5, 0.5, 0.5)), f"box {x}", poses=rigid(translation_m=(x, 0.0, 0.5))) for x in (-2.0, 2.0)]
    return Scene((Body(Plane(), "ground", "occluder"), *boxes))


def rays_at(points):
    """A ray from above the landing place to each point (N, 3)."""
    origin = np.tile([0.0, 0.0, HEIGHT_M], (len(points), 1))
    offset = points - origin
    count = len(points)
    looking = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    return Rays(origin, looking, np.tile([0.1, 20.0], (count, 1)), np.zeros(count), np.zeros(count))


def on_top(x, count=2):
    return np.column_stack([x + np.linspace(-0.2, 0.2, count), np.zeros(count), np.ones(count)])


def test_each_box_that_two_rays_hit_is_found(scene):
    task = LandingTask()
    for points, value in ((on_top(2.0), 50.0), (np.concatenate([on_top(-2.0), on_top(2.0)]), 0.0)):
        assert task.score(scene, simulate(scene, rays_at(points))).value == value


def test_one_ray_on_a_box_is_not_enough(scene):
    assert LandingTask().score(scene, simulate(scene, rays_at(on_top(2.0, 1)))).value == 100.0


def test_the_ground_is_no_hazard_and_noise_makes_phantoms(scene):
    points = np.column_stack([np.linspace(-1, 1, 9), np.zeros(9), np.zeros(9)])
    assert seen(scene, points, 0).raised == 0
    raised = seen(scene, points + np.array([0.0, 0.0, 0.3]), 0)
    assert (raised.raised, len(raised.phantoms_m)) == (9, 9)


def test_the_second_return_of_a_box_tells_as_much_as_the_first_and_the_third_nothing(scene):
    returns = simulate(scene, rays_at(np.concatenate([on_top(2.0, 3), np.zeros((1, 3))])))
    found = LandingTask().informs(scene, returns)
    assert found.ray.tolist() == [0, 1, 2]
    assert found.item.tolist() == [1, 1, 1]
    assert np.interp([0, 1, 2, 3], np.arange(3), found.sums).tolist() == [0, 1, 2, 2]


def test_more_scenes_keep_the_first_ones():
    task = LandingTask()
    few, more = (task.scenes(task.Config(train=n), "train", 3) for n in (2, 5))
    for one, other in zip(few, more, strict=False):
        assert [body.poses.tolist() for body in one.bodies] == [body.poses.tolist() for body in other.bodies]
