"""Points are visited neighbour after neighbour, and nothing depends on it."""

from __future__ import annotations

import numpy as np
import pytest

from lidardesign.density.target.target import nearby_order


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_every_point_is_visited_once(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    np.testing.assert_array_equal(np.sort(nearby_order(points)), np.arange(count))


def test_steps_between_successive_points_are_much_shorter_than_in_a_random_order():
    points = np.random.default_rng(1).uniform(size=(2000, 3)) * (1.0, 5.0, 0.1)
    step = np.linalg.norm(np.diff(points[nearby_order(points)], axis=0), axis=1).mean()
    assert step < 0.25 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


def test_points_on_a_line_or_all_in_one_place_have_an_order_too():
    line = np.zeros((50, 3))
    line[:, 1] = np.random.default_rng(2).permutation(50)
    assert (np.diff(line[nearby_order(line), 1]) >= 0).mean() > 0.9
    np.testing.assert_array_equal(nearby_order(np.ones((5, 3))), np.arange(5))


def test_the_order_does_not_depend_on_scale_or_place():
    points = np.random.default_rng(3).integers(0, 1024, size=(300, 3)).astype(float)
    np.testing.assert_array_equal(nearby_order(points), nearby_order(8 * points + 4096))
