"""Bootstrap intervals and paired differences."""

import numpy as np
import pytest

from lidardesign.errors import NumericalError
from lidardesign.evaluate.statistics import bootstrap_interval, paired_difference


def test_the_interval_of_a_normal_sample_is_the_textbook_one():
    values = np.random.default_rng(0).normal(2.0, 1.0, 400)
    mean, low, high = bootstrap_interval(values, seed=3)
    half = 1.96 * values.std() / np.sqrt(400)
    assert mean == pytest.approx(values.mean())
    # the percentile ends carry the Monte-Carlo error of 4000 resamples, about 2 % of the width each
    assert low == pytest.approx(mean - half, abs=0.1 * half)
    assert high == pytest.approx(mean + half, abs=0.1 * half)


def test_intervals_cover_the_truth_at_about_their_level():
    generator = np.random.default_rng(5)
    covered = 0
    for trial in range(200):
        interval = bootstrap_interval(generator.normal(0.0, 1.0, 40), seed=trial, resamples=500)
        covered += interval.low <= 0.0 <= interval.high
    # a percentile bootstrap of 40 values covers about 93.5 %; four standard errors of 200 trials are 7 %
    assert 0.865 <= covered / 200 <= 0.995


def test_a_naive_loop_draws_the_same_distribution():
    values = np.array([0.0, 1.0, 5.0])
    interval = bootstrap_interval(values, seed=0, level=0.5)
    grid = np.array([[a, b, c] for a in values for b in values for c in values]).mean(axis=1)
    # all 27 resamples are equally likely, so their quantiles are exact up to one step of the distribution
    assert np.quantile(grid, 0.2) <= interval.low <= np.quantile(grid, 0.3)
    assert np.quantile(grid, 0.7) <= interval.high <= np.quantile(grid, 0.8)


@pytest.mark.parametrize("values", [[0.1], [0.1, 0.1, 0.1], [0.0, 0.0]])
def test_equal_values_and_single_scenes_have_no_width(values):
    assert bootstrap_interval(values, seed=1) == (values[0], values[0], values[0])


def test_the_same_seed_gives_the_same_interval_and_shifting_shifts_it():
    values = np.random.default_rng(2).gamma(2.0, 1.0, 30)
    first = bootstrap_interval(values, seed=9)
    assert first == bootstrap_interval(values, seed=9)
    np.testing.assert_allclose(np.array(bootstrap_interval(values + 10, seed=9)) - 10, first, atol=1e-12)


def test_a_paired_difference_ignores_what_the_scenes_share():
    generator = np.random.default_rng(4)
    scenes = generator.normal(0.0, 100.0, 50)
    mean, low, high = paired_difference(scenes + 1.0, scenes + generator.normal(0.0, 0.1, 50), seed=0)
    assert low > 0.9
    assert high < 1.1
    assert mean == pytest.approx(1.0, abs=0.1)


def test_swapping_the_pair_turns_the_sign():
    first, second = np.random.default_rng(6).normal(size=(2, 25))
    forth, back = paired_difference(first, second, seed=0), paired_difference(second, first, seed=0)
    np.testing.assert_allclose(forth, [-back.mean, -back.high, -back.low], atol=1e-12)


@pytest.mark.parametrize("values", [[], [np.nan, 1.0], [np.inf]])
def test_values_that_are_not_numbers_are_refused(values):
    with pytest.raises(NumericalError):
        bootstrap_interval(values, seed=0)


def test_differences_of_other_scenes_are_refused():
    with pytest.raises(NumericalError, match="do not pair"):
        paired_difference([1.0, 2.0], [1.0], seed=0)
