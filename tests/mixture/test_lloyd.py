"""Weighted Lloyd seeds mixtures: no empty cells, deterministic, whatever the unit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidardesign.mixture.em import lloyd


def cloud(seed, count=400, dimensions=2):
    generator = np.random.default_rng(seed)
    return generator.normal(size=(count, dimensions)), generator.uniform(0.1, 3.0, count)


def means(features, weights, labels):
    return np.array(
        [np.average(features[labels == k], axis=0, weights=weights[labels == k]) for k in np.unique(labels)]
    )


@pytest.mark.parametrize("count", [1, 2, 7, 40])
@pytest.mark.parametrize("dimensions", [1, 2, 5])
def test_in_the_end_the_cell_of_every_point_is_that_of_the_nearest_mean(count, dimensions):
    features, weights = cloud(count, dimensions=dimensions)
    labels = lloyd(features, weights, count, np.random.default_rng(0), iterations=200)
    squared = np.square(features[:, None] - means(features, weights, labels)[None]).sum(-1)
    assert squared.shape[1] == count
    assert (labels == squared.argmin(axis=1)).all()


place = st.tuples(st.integers(0, 5), st.integers(0, 5))


@settings(max_examples=60, deadline=None)
@given(st.lists(place, min_size=1, max_size=60), st.integers(1, 12), st.integers(0, 30), st.integers(0, 9))
def test_no_cell_is_empty_while_there_are_enough_distinct_points(points, count, iterations, seed):
    features = np.array(points, dtype=float)
    generator = np.random.default_rng(seed)
    weights = generator.uniform(0.01, 1, len(features))
    labels = lloyd(features, weights, count, generator, iterations=iterations)
    distinct = len(np.unique(features, axis=0))
    assert len(np.unique(labels)) == min(distinct, count)
    if distinct <= count:
        np.testing.assert_array_equal(means(features, np.ones(len(features)), labels)[labels], features)


@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e7)])
def test_the_cells_do_not_depend_on_the_unit_or_the_place_of_the_origin(scale, shift):
    features, weights = cloud(9)
    features = np.round(features, 3) * 1024
    labels = lloyd(features, weights, 8, np.random.default_rng(0), iterations=50)
    moved = lloyd(scale * features + shift, weights, 8, np.random.default_rng(0), iterations=50)
    assert (labels == moved).all()


def test_a_weight_of_two_is_a_point_given_twice():
    features, _ = cloud(10, 60)
    weights = np.where(np.arange(60) < 20, 2.0, 1.0)
    twice = np.concatenate([features, features[:20]])
    weighted = lloyd(features, weights, 6, np.random.default_rng(0), iterations=50)
    doubled = lloyd(twice, np.ones(80), 6, np.random.default_rng(0), iterations=50)
    assert (weighted == doubled[:60]).all()


def test_weight_draws_the_cells_and_points_without_weight_do_not():
    generator = np.random.default_rng(0)
    features = np.concatenate([generator.normal(-5, 1, (500, 2)), generator.normal(5, 1, (500, 2))])
    weights = np.where(np.arange(1000) < 500, 30.0, 1.0)
    labels = lloyd(features, weights, 60, np.random.default_rng(1), iterations=50)
    assert len(np.unique(labels[:500])) > 1.5 * len(np.unique(labels[500:]))
    weights[500:] = 0
    labels = lloyd(features, weights, 60, np.random.default_rng(1), iterations=50)
    assert len(np.unique(labels[:500])) == 60
    assert len(labels) == 1000


def test_weights_of_any_size_leave_no_cell_empty():
    features, _ = cloud(11, 50)
    weights = np.full(50, 1e-300)
    weights[0] = 1e300
    assert len(np.unique(lloyd(features, weights, 5, np.random.default_rng(0), iterations=50))) == 5
