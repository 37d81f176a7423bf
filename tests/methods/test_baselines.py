"""The simple baselines: exact numbers of rays, inside the space, the same every time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.baselines import balls, problem_of, rays_of

from lidardesign.errors import ConfigError
from lidardesign.evaluation.request import check_baseline
from lidardesign.methods.returns import unrolled
from lidardesign.problem.method import METHODS
from lidardesign.scenes.scene import Body, Box, Scene, rigid
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.simulate.returns import simulate
from lidardesign.space import DesignSpace, angles

FIXED = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
FLAT = DesignSpace((0, 0, 0, math.pi / 4, 0, 0), (1, 0, 0, 3 * math.pi / 4, 0, 1.2))
CEILING = DesignSpace((-1, -1, 1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, 0, 2.0))
FREE = DesignSpace((-0.1, -0.1, -0.1, -0.5, -0.5, 0.05), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
TURN = DesignSpace((0, 0, 0, 0, -0.5, 0.05), (0, 0, 0, 2 * math.pi, 0.5, 4.0))
FROZEN = DesignSpace((0, 0, 0, 0, 0, 3), (0, 0, 0, 0, 0, 3))


# the others need a design, a density or a part
BUILT = ["uniform", "random", "bounding", "silhouette", "occupancy"]


def build_baseline(name, space, train, count, seed, judge=None):
    """A baseline at so many rays, for a space without conditions."""
    return rays_of(name, problem_of(space, train, seed, judge, rays=count))


CASES = {
    "fixed origin": (FIXED, balls(np.array([3.0, 0, 0]))),
    "flatland": (FLAT, balls(np.array([0.5, 0.8, 0.0]), 0.15, 0.0)),
    "ceiling": (CEILING, balls(np.array([0.3, 0.2, 0.0]), 0.2)),
    "free origin": (FREE, balls(np.array([3.0, 0, 0]))),
    "full turn": (TURN, balls(np.array([3.0, 0, 0]))),
    "one point": (FROZEN, balls(np.array([3.4, 0, 0]), jitter=0.0)),
}


def design_points(rays):
    azimuth, elevation = angles(rays.direction)
    return np.column_stack([rays.origin_m, azimuth, elevation, rays.gate_m[:, 0]])


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", BUILT)
def test_any_number_of_rays_is_met_exactly_inside_the_space_and_repeats(case, name):
    space, train = CASES[case]
    source, same = (problem_of(space, train, seed=4) for _ in range(2))
    for count in (0, 1, 2, 36, 101):
        rays, again = (rays_of(name, replace(one, rays=count)) for one in (source, same))
        assert len(rays) == count
        # angles pass through unit vectors and back: near the poles that costs half of the digits
        widened = DesignSpace(space.low, space.high, measure=space.measure)
        points = design_points(rays)
        points[:, 5] = np.clip(points[:, 5], space.low[5], space.high[5])
        polar = np.abs(points[:, 4]) > math.pi / 2 - 1e-6
        points[polar, 3] = space.low[3]
        assert widened.contains(points, tolerance=1e-7).all()
        for key in ("direction", "gate_m", "origin_m"):
            assert np.array_equal(getattr(rays, key), getattr(again, key))


def test_uniform_is_the_regular_grid_in_azimuth_and_elevation_with_the_whole_range():
    rays = build_baseline("uniform", FIXED, [], 25, seed=0)
    azimuth, elevation = angles(rays.direction)
    steps = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])
    signed = np.where(azimuth > math.pi, azimuth - 2 * math.pi, azimuth)
    np.testing.assert_allclose(signed.reshape(5, 5), np.tile(steps, (5, 1)), atol=1e-12)
    np.testing.assert_allclose(elevation.reshape(5, 5), np.tile(steps[:, None], (1, 5)), atol=1e-12)
    np.testing.assert_allclose(rays.gate_m, np.tile([0.05, 4.0], (25, 1)), rtol=1e-12)


def test_bounding_lies_inside_uniforms_box_and_round_the_training_returns():
    space, train = CASES["fixed origin"]
    rays = build_baseline("bounding", space, train, 400, seed=0)
    half = np.abs(np.asarray([math.asin(0.4 / 3.0)]))[0]
    angle = np.arccos(rays.direction[:, 0])
    assert angle.max() < 0.5
    # the corner of a square round the largest ball, moved by up to three times the jitter of 0.05 m at 3 m
    assert angle.max() < math.sqrt(2) * (half + 0.07)
    start, end = rays.gate_m[0]
    assert 2.4 < start < 2.7
    assert end < 3.2
    returned = np.mean([simulate(scene, rays)[0].returned.mean() for scene in train])
    uniform = build_baseline("uniform", space, train, 400, seed=0)
    assert returned > 3 * np.mean([simulate(scene, uniform)[0].returned.mean() for scene in train])


def test_bounding_follows_a_target_across_the_end_of_the_turn():
    space, train = CASES["full turn"]
    rays = build_baseline("bounding", space, train, 100, seed=0)
    assert (rays.direction[:, 0] > math.cos(0.4)).all()


def test_bounding_does_not_count_returns_of_occluders():
    space, train = CASES["fixed origin"]
    post = Body(Box((0.05, 0.05, 0.5)), "post", "occluder", rigid(translation_m=(1.0, 0.35, 0.0)))
    with_post = [Scene((*scene.bodies, post)) for scene in train]
    start, _ = build_baseline("bounding", space, with_post, 100, seed=0).gate_m[0]
    assert start > 2.0


def test_bounding_from_the_ceiling_looks_straight_down_where_that_returns_more():
    space, train = CASES["ceiling"]
    rays = build_baseline("bounding", space, train, 100, seed=0)
    np.testing.assert_allclose(rays.direction, np.tile([0.0, 0.0, -1.0], (100, 1)), atol=1e-12)
    np.testing.assert_allclose(rays.origin_m[:, 2], 1.0)
    assert np.ptp(rays.origin_m[:, 0]) < 1.0


def test_a_judge_decides_between_the_candidates_of_bounding():
    space, train = CASES["ceiling"]

    def judge(sign):
        return lambda lists: [sign * abs(rays.direction[:, 2]).mean() for (rays,) in lists]

    vertical, slanted = (build_baseline("bounding", space, train, 50, 0, judge(sign)) for sign in (-1, 1))
    assert np.abs(vertical.direction[:, 2]).min() > 0.999
    assert np.abs(slanted.direction[:, 2]).mean() < 0.99


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["uniform", "random", "bounding", "occupancy"])
@pytest.mark.parametrize("limit", [0.0, 0.01, 0.5])
def test_as_many_rays_as_fit_in_a_bandwidth_fit_and_one_more_does_not(case, name, limit):
    space, train = CASES[case]
    bandwidth = Bandwidth()
    problem = problem_of(space, train, limit_mbps=limit)
    assert bandwidth.mbps(rays_of(name, problem)) <= limit
    for layout in METHODS.load(name).layouts(problem):
        (rays,) = layout.within(problem)
        assert bandwidth.mbps(rays) <= limit
        assert bandwidth.mbps(layout.positions([space], len(rays) + 1)[0]) > limit


def test_the_seed_moves_only_the_random_baseline():
    space, train = CASES["free origin"]
    for name in BUILT:
        first, second = (build_baseline(name, space, train, 20, seed) for seed in (1, 2))
        assert np.array_equal(first.direction, second.direction) == (name not in ("random", "occupancy"))


@pytest.mark.parametrize("name", ["catalog:vl53l5cx", "cma:5", "uniform:", ""])
def test_a_name_that_is_no_baselines_is_refused(name):
    with pytest.raises(ConfigError, match="unknown baseline"):
        check_baseline(name)


def test_unrolled_azimuths_lie_on_the_smallest_arc():
    azimuth = np.array([6.2, 0.1, 0.3, 6.0])
    arc = unrolled(azimuth)
    assert np.ptp(arc) == pytest.approx(2 * math.pi - 6.0 + 0.3)
    np.testing.assert_allclose(np.cos(arc), np.cos(azimuth), atol=1e-12)
