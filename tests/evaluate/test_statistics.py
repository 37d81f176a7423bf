"""Intervals over groups of scenes, and paired differences."""

import numpy as np
import pytest
from scipy.stats import binom, t, ttest_1samp

from lidardesign.errors import NumericalError
from lidardesign.scoring.statistics import mean_interval, paired_difference


def test_the_interval_of_a_normal_sample_is_the_textbook_one():
    values = np.random.default_rng(0).normal(2.0, 1.0, 400)
    mean, low, high = mean_interval(values, seed=3)
    half = 1.96 * values.std() / np.sqrt(400)
    assert mean == pytest.approx(values.mean())
    # the percentile ends carry the Monte-Carlo error of 4000 resamples, about 2 % of the width each
    assert low == pytest.approx(mean - half, abs=0.1 * half)
    assert high == pytest.approx(mean + half, abs=0.1 * half)


def test_intervals_cover_the_truth_at_about_their_level():
    generator = np.random.default_rng(5)
    covered = 0
    for trial in range(200):
        interval = mean_interval(generator.normal(0.0, 1.0, 40), seed=trial, resamples=500)
        covered += interval.low <= 0.0 <= interval.high
    # a percentile bootstrap of 40 values covers about 93.5 %; four standard errors of 200 trials are 7 %
    assert 0.865 <= covered / 200 <= 0.995


def test_resampled_means_have_the_distribution_that_they_should():
    interval = mean_interval([1.0] * 3 + [0.0] * 7, seed=0, level=0.5)
    # the ones among ten drawn with replacement are binomial; its quantiles are exact up to one step
    assert binom.ppf(0.2, 10, 0.3) / 10 <= interval.low <= binom.ppf(0.3, 10, 0.3) / 10
    assert binom.ppf(0.7, 10, 0.3) / 10 <= interval.high <= binom.ppf(0.8, 10, 0.3) / 10


@pytest.mark.parametrize("count", [2, 3, 9])
def test_below_ten_groups_the_interval_is_that_of_student(count):
    values = np.random.default_rng(count).gamma(2.0, 1.0, count)
    expected = ttest_1samp(values, 0.0).confidence_interval(0.95)
    np.testing.assert_allclose(mean_interval(values, seed=0)[1:], (expected.low, expected.high), rtol=1e-12)


@pytest.mark.parametrize("values", [[0.1, 0.1, 0.1], [0.0, 0.0], [0.1] * 20])
def test_equal_values_have_no_width(values):
    assert mean_interval(values, seed=1) == (values[0], values[0], values[0])


@pytest.mark.parametrize(("values", "groups"), [([0.5], None), ([1.0, 2.0, 6.0], [0, 0, 0])])
def test_a_single_group_has_a_mean_and_no_interval(values, groups):
    assert mean_interval(values, 1, groups) == (np.mean(values), None, None)


@pytest.mark.parametrize("count", [3, 9, 10, 40])
def test_repeating_every_scene_within_its_group_changes_nothing(count):
    values = np.random.default_rng(count).normal(size=count)
    repeated = mean_interval(np.repeat(values, 4), 7, np.repeat(np.arange(count), 4))
    np.testing.assert_allclose(repeated, mean_interval(values, 7), atol=1e-12)


def test_the_order_of_scenes_within_groups_does_not_matter():
    generator = np.random.default_rng(3)
    values, groups = generator.normal(size=60), generator.integers(0, 12, 60)
    order = generator.permutation(60)
    np.testing.assert_allclose(
        mean_interval(values[order], 7, groups[order]), mean_interval(values, 7, groups), atol=1e-12
    )


@pytest.mark.parametrize("groups", [5, 30])
@pytest.mark.parametrize("even", [True, False])
def test_intervals_over_groups_cover_the_truth_where_those_over_scenes_do_not(groups, even):
    generator = np.random.default_rng(5)
    sizes = np.full(groups, 8) if even else 4 + 8 * (np.arange(groups) % 2)
    members = np.repeat(np.arange(groups), sizes)
    covered = {"groups": 0, "scenes": 0}
    for trial in range(300):
        values = generator.normal(size=groups)[members] + 0.3 * generator.normal(size=len(members))
        for name, of in (("groups", members), ("scenes", None)):
            interval = mean_interval(values, trial, of, resamples=300)
            covered[name] += interval.low <= 0.0 <= interval.high
    assert covered["groups"] / 300 >= 0.89
    assert covered["scenes"] / 300 < 0.65


def test_unequal_groups_below_ten_have_the_spread_of_a_ratio():
    values, groups = np.array([1.0, 2.0, 6.0, 3.0, 5.0]), np.array([0, 0, 1, 2, 2])
    mean, totals, sizes = values.mean(), np.array([3.0, 6.0, 8.0]), np.array([2, 1, 2])
    error = np.sqrt(np.sum((totals - mean * sizes) ** 2) * 3 / 2) / 5
    interval = mean_interval(values, 0, groups)
    assert interval.high - interval.mean == pytest.approx(t.ppf(0.975, 2) * error)


def test_the_same_seed_gives_the_same_interval_and_shifting_shifts_it():
    values = np.random.default_rng(2).gamma(2.0, 1.0, 30)
    first = mean_interval(values, seed=9)
    assert first == mean_interval(values, seed=9)
    np.testing.assert_allclose(np.array(mean_interval(values + 10, seed=9)) - 10, first, atol=1e-12)


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
        mean_interval(values, seed=0)


def test_differences_of_other_scenes_are_refused():
    with pytest.raises(NumericalError, match="do not pair"):
        paired_difference([1.0, 2.0], [1.0], seed=0)
