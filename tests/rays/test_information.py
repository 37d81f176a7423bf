"""What returns tell about surfaces: worth falls with distance, more rays never tell less, and silence tells nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.rays import rays_along

from lidardesign.rays.information import (
    CHOSEN_SHARE,
    REACH_SPACINGS,
    checked_information,
    return_reach_m,
    scattered_area_m2,
    surface_information,
)
from lidardesign.scenes.rays import Outcome, Returns
from lidardesign.scenes.scene import Body, Scene, Sphere

seeds = st.integers(0, 10_000)
SIDE_M, HEIGHT_M = 0.3, 1.0
TARGET, OCCLUDER, NOTHING = 0, 1, -1


def square(generator, count):
    """Random points of a square that lies below the sensor."""
    return np.column_stack([generator.uniform(0, SIDE_M, (count, 2)), np.full(count, -HEIGHT_M)])


def returns_at(points, body, frame=0):
    """Returns of rays from the origin at points, of the given bodies (N,); those of nothing have none."""
    range_m = np.linalg.norm(points, axis=1)
    outcome = np.where(body >= 0, Outcome.RETURN, Outcome.MISS)
    rays = rays_along(points / range_m[:, None], (0.0, 10.0))
    return Returns(rays, outcome, np.where(body >= 0, range_m, np.nan), body, frame)


def random_look(seed, rays=60, items=50):
    generator = np.random.default_rng(seed)
    places = square(generator, rays)
    body = generator.choice([TARGET, TARGET, OCCLUDER, NOTHING], rays)
    places[body == OCCLUDER, 2] += generator.uniform(0, 0.2, (body == OCCLUDER).sum())
    return square(generator, items), returns_at(places, body), places


def dense(found, rays):
    worth = np.zeros((rays, len(found.frame)))
    worth[found.ray, found.item] = found.worth
    return worth


@given(seed=seeds)
def test_a_return_is_worth_what_it_lacks_of_the_reach(seed):
    points, returns, places = random_look(seed)
    found = surface_information([points], [returns], [True, False], SIDE_M**2)
    away = np.linalg.norm(points[None] - places[:, None], axis=2)
    naive = np.where((returns.body == TARGET)[:, None], np.maximum(found.complete - away, 0.0), 0.0)
    np.testing.assert_allclose(dense(found, len(places)), naive, atol=1e-12)
    assert len(np.unique(np.stack([found.ray, found.item]), axis=1).T) == len(found.ray)


@given(seed=seeds)
def test_only_returns_of_something_else_spoil_and_no_more_than_a_place_that_nothing_tells_about(seed):
    points, returns, places = random_look(seed)
    found = surface_information([points], [returns], [True, False], SIDE_M**2)
    nearest = np.linalg.norm(points[None] - places[:, None], axis=2).min(axis=1)
    naive = np.where(returns.body == OCCLUDER, np.minimum(nearest, found.complete) / returns.returned.sum(), 0.0)
    np.testing.assert_allclose(found.harm[0], naive, atol=1e-12)


@given(seed=seeds)
def test_looks_tell_about_their_own_points_alone(seed):
    points, returns, _ = random_look(seed)
    none = np.zeros((0, 3))
    found = surface_information([none, points, points[:7]], [returns] * 3, [True, False], 2 * SIDE_M**2)
    assert found.frame.tolist() == [1] * len(points) + [2] * 7
    assert not found.harm[0].any()
    worth = dense(surface_information([points], [returns], [True, False], 2 / 3 * SIDE_M**2), 60)
    both = np.zeros((60, len(points) + 7))
    both[found.ray, found.item] = found.worth
    np.testing.assert_allclose(both, np.concatenate([worth, worth[:, :7]], axis=1), atol=1e-12)


@pytest.mark.parametrize(("dimensions", "spacings"), [(2, 5.0), (1, REACH_SPACINGS / CHOSEN_SHARE)])
def test_the_reach_is_so_many_spacings_of_the_candidates(dimensions, spacings):
    assert return_reach_m(0.5**dimensions, 3**dimensions, dimensions) == pytest.approx(spacings * 0.5 / 3)
    # of what is chosen it is the same number of spacings in any dimension
    chosen = CHOSEN_SHARE * 3**dimensions
    assert return_reach_m(1.0, 3**dimensions, dimensions) * chosen ** (1 / dimensions) == pytest.approx(math.sqrt(5))


def test_the_share_that_will_be_chosen_sets_the_reach_where_a_task_asks_for_it():
    (points, returns, _), scene = random_look(0), Scene((Body(Sphere(1.0), "ball", "target"),))

    class Asking:
        name = "asking"

        def informs(self, scene, returns, share):
            return surface_information([points], returns, [True, False], SIDE_M**2, share=share)

    usual, all_chosen = (checked_information(Asking(), scene, [returns], share) for share in (CHOSEN_SHARE, 1.0))
    assert usual.complete == surface_information([points], [returns], [True, False], SIDE_M**2).complete
    assert all_chosen.complete == pytest.approx(math.sqrt(CHOSEN_SHARE) * usual.complete)


@pytest.mark.parametrize("body", [OCCLUDER, NOTHING])
def test_where_no_target_is_met_nothing_is_known_or_asked_for(body):
    generator = np.random.default_rng(0)
    returns = returns_at(square(generator, 9), np.full(9, body))
    found = surface_information([square(generator, 20)], [returns], [True, False], SIDE_M**2)
    assert (len(found.ray), len(found.frame), found.complete) == (0, 20, 0)
    assert not found.harm.any()


def test_random_points_tell_the_area_that_they_lie_on():
    points = square(np.random.default_rng(3), 4000)
    assert scattered_area_m2(points) == pytest.approx(SIDE_M**2, rel=0.05)
    assert scattered_area_m2(np.tile(points, (2, 1))) == scattered_area_m2(points)
    assert scattered_area_m2(points[:1]) == 0.0
