"""What rays look at: the mean surface of their likes, and nothing undefined where the density has nothing."""

from __future__ import annotations

import numpy as np
import pytest

from lidardesign.mixture.components import NEIGHBOURS, Axes, Features, ray_features
from lidardesign.space import RANGE, DesignSpace, observed_point

SPACE = DesignSpace((0, 0, 0, 0.5, 0, 0.2), (1, 0, 0, 2.5, 0, 1.2))


def features_of(points, weights, space=SPACE):
    return Features.of(points, weights, Axes.of(space), space)


def test_rays_whose_likes_weigh_nothing_look_where_they_listen():
    points = SPACE.sample(400, np.random.default_rng(0))
    points[:, 0] = np.where(np.arange(400) < 200, 0.1 * points[:, 0], 0.9 + 0.1 * points[:, 0])
    weights = np.where(points[:, 0] < 0.5, 1.0, 0.0)
    found = ray_features(features_of(points, weights))
    assert np.isfinite(found).all()
    # origins on the far side are as far from the weighted ones as the space is wide: their neighbours are their own
    far = weights == 0
    np.testing.assert_array_equal(found[far], observed_point(points[far]))


def test_samples_that_weigh_nothing_do_not_move_what_others_look_at():
    generator = np.random.default_rng(1)
    points = np.tile(SPACE.sample(1, generator), (NEIGHBOURS, 1))
    points[:, RANGE] = generator.uniform(0.2, 1.2, NEIGHBOURS)
    weights = np.r_[np.zeros(NEIGHBOURS // 2), np.ones(NEIGHBOURS - NEIGHBOURS // 2)]
    mean = points[0].copy()
    mean[RANGE] = points[NEIGHBOURS // 2 :, RANGE].mean()
    found = ray_features(features_of(points, weights))
    np.testing.assert_allclose(found, np.tile(observed_point(mean), (NEIGHBOURS, 1)))


@pytest.mark.parametrize("share", [1e-300, 1e-320])
def test_likes_of_hardly_any_weight_have_a_mean_within_their_ranges(share):
    points = np.tile(SPACE.sample(1, np.random.default_rng(2)), (2 * NEIGHBOURS, 1))
    points[:NEIGHBOURS, 0], points[NEIGHBOURS:, 0] = 0.0, 1.0
    points[:, RANGE] = np.tile(np.linspace(0.4, 0.6, NEIGHBOURS), 2)
    weights = np.repeat([1.0, share], NEIGHBOURS)
    reach = np.linalg.norm(ray_features(features_of(points, weights)) - points[:, :3], axis=1)
    # of the smallest float64 numbers only three digits are left
    assert ((reach > 0.4 - 1e-3) & (reach < 0.6 + 1e-3)).all()
