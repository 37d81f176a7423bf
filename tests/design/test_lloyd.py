"""Weighted Lloyd seeds mixtures: never worse than its seeds, no empty cells, deterministic, whatever the unit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidardesign.errors import ConfigError
from lidardesign.mixture.em import Nearest, lloyd


def cost(features, weights, centres):
    squared = np.square(features[:, None] - centres[None]).sum(-1)
    return (weights * squared.min(axis=1)).sum() / weights.sum()


def cloud(seed, count=400, dimensions=2):
    generator = np.random.default_rng(seed)
    return generator.normal(size=(count, dimensions)), generator.uniform(0.1, 3.0, count)


@pytest.mark.parametrize("count", [1, 2, 7, 40])
@pytest.mark.parametrize("dimensions", [1, 2, 5])
def test_every_centre_is_the_weighted_mean_of_its_cell_and_every_label_the_nearest_centre(count, dimensions):
    features, weights = cloud(count, dimensions=dimensions)
    centres, labels = lloyd(features, weights, count, np.random.default_rng(0), iterations=2000)
    assert centres.shape == (count, dimensions)
    squared = np.square(features[:, None] - centres[None]).sum(-1)
    assert (labels == squared.argmin(axis=1)).all()
    for k in range(count):
        mean = np.average(features[labels == k], axis=0, weights=weights[labels == k])
        np.testing.assert_allclose(centres[k], mean, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(
    points=st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=60),
    count=st.integers(1, 12),
    iterations=st.integers(0, 30),
    seed=st.integers(0, 9),
)
def test_no_cell_is_empty_while_there_are_enough_distinct_points(points, count, iterations, seed):
    features = np.array(points, dtype=float)
    generator = np.random.default_rng(seed)
    weights = generator.uniform(0.01, 1, len(features))
    centres, labels = lloyd(features, weights, count, generator, iterations=iterations)
    assert centres.shape == (count, 2)
    assert np.isfinite(centres).all()
    distinct = len(np.unique(features, axis=0))
    assert len(np.unique(labels)) == min(distinct, count)
    if distinct <= count:
        assert cost(features, weights, centres) == 0


@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e7)])
def test_the_cells_do_not_depend_on_the_unit_or_the_place_of_the_origin(scale, shift):
    features, weights = cloud(9)
    features = np.round(features, 3) * 1024
    _, labels = lloyd(features, weights, 8, np.random.default_rng(0))
    _, moved = lloyd(scale * features + shift, weights, 8, np.random.default_rng(0))
    assert (labels == moved).all()


def test_a_weight_of_two_is_a_point_given_twice():
    features, _ = cloud(10, 60)
    weights = np.where(np.arange(60) < 20, 2.0, 1.0)
    weighted, _ = lloyd(features, weights, 6, np.random.default_rng(0))
    doubled, _ = lloyd(np.concatenate([features, features[:20]]), np.ones(80), 6, np.random.default_rng(0))
    np.testing.assert_allclose(weighted, doubled, atol=1e-12)


def test_weight_draws_the_centres_and_points_without_weight_do_not():
    generator = np.random.default_rng(0)
    features = np.concatenate([generator.normal(-5, 1, (500, 2)), generator.normal(5, 1, (500, 2))])
    weights = np.where(np.arange(1000) < 500, 30.0, 1.0)
    centres, _ = lloyd(features, weights, 60, np.random.default_rng(1))
    assert (centres[:, 0] < 0).sum() > 1.5 * (centres[:, 0] > 0).sum()
    weights[500:] = 0
    centres, labels = lloyd(features, weights, 60, np.random.default_rng(1))
    assert (centres[:, 0] < 0).all()
    assert len(labels) == 1000


def test_weights_of_any_size_stay_finite():
    features, _ = cloud(11, 50)
    weights = np.full(50, 1e-300)
    weights[0] = 1e300
    centres, labels = lloyd(features, weights, 5, np.random.default_rng(0))
    assert np.isfinite(centres).all()
    assert len(np.unique(labels)) == 5


@pytest.mark.parametrize(
    ("features", "weights", "count"),
    [
        (np.zeros((0, 2)), np.zeros(0), 1),
        (np.zeros((3, 2)), np.ones(2), 1),
        (np.full((3, 2), np.nan), np.ones(3), 1),
        (np.zeros((3, 2)), np.zeros(3), 1),
        (np.zeros((3, 2)), -np.ones(3), 1),
        (np.zeros((3, 2)), np.ones(3), 0),
    ],
)
def test_what_cannot_be_quantised_is_refused(features, weights, count):
    with pytest.raises(ConfigError, match="quantisation"):
        lloyd(features, weights, count, np.random.default_rng(0))


@pytest.mark.parametrize("moved", [1e-6, 0.02, 1.0])
@pytest.mark.parametrize("count", [1, 2, 40])
def test_bounds_spare_searches_and_change_no_answer(count, moved):
    points, _ = cloud(11, count=600, dimensions=3)
    centres = points[:count].copy()
    nearest, generator = Nearest(points), np.random.default_rng(4)
    for _ in range(12):
        distance, labels = nearest.of(centres)
        squared = np.square(points[:, None] - centres[None]).sum(-1)
        assert (labels == squared.argmin(axis=1)).all()
        np.testing.assert_allclose(distance, np.sqrt(squared.min(axis=1)), rtol=1e-9, atol=1e-12)
        # what is asked for may be changed by who asks
        labels[:] = 0
        centres = centres + moved * generator.normal(size=centres.shape) * (generator.random((count, 1)) < 0.5)
