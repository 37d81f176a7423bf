"""Intervals over groups of scenes, and paired differences."""

import numpy as np
import pytest
from scipy.stats import t, ttest_1samp

from lidardesign.errors import NumericalError
from lidardesign.estimates import mean_interval, paired_difference, relative_difference, student_interval

TRIALS = 1000
# Of scores of two designs with mean 1: what one group adds, and a usual scene.
SKEWED = {
    "gamma": lambda generator, size: generator.gamma(2.0, 0.5, size),
    "lognormal": lambda generator, size: generator.lognormal(-0.125, 0.5, size),
    "failures": lambda generator, size: np.where(generator.random(size) < 0.3, 10.0, 1.0) / 3.7,
}


@pytest.mark.parametrize("count", [2, 4, 10, 50, 400])
def test_the_interval_of_a_sample_without_skewness_is_that_of_student(count):
    half = np.random.default_rng(count).normal(size=count // 2)
    values = 2.0 + np.concatenate([half, -half])
    expected = ttest_1samp(values, 0.0).confidence_interval(0.95)
    np.testing.assert_allclose(mean_interval(values)[1:], (expected.low, expected.high), rtol=1e-9)


@pytest.mark.parametrize("skewness", [-1e-6, -1e-17, 1e-300, 1e-12, 1e-7])
def test_hardly_any_skewness_hardly_moves_an_end(skewness):
    found, straight = (student_interval(1.0, 0.5, 9.0, one) for one in (skewness, 0.0))
    np.testing.assert_allclose(found, straight, rtol=10 * abs(skewness) + 1e-15)


@pytest.mark.parametrize("count", [3, 10, 50])
def test_the_end_towards_which_values_are_skewed_is_further_out_and_none_is_nearer_than_that_of_student(count):
    values = np.random.default_rng(count).lognormal(size=count)
    expected = ttest_1samp(values, 0.0).confidence_interval(0.95)
    interval, mirrored = mean_interval(values), mean_interval(-values)
    assert interval.low == pytest.approx(expected.low)
    assert interval.high > expected.high
    np.testing.assert_allclose(mirrored, [-interval.mean, -interval.high, -interval.low])


@pytest.mark.parametrize("groups", [10, 50])
@pytest.mark.parametrize("sizes", [(4,), (2, 3, 4, 5, 6)], ids=["even", "uneven"])
@pytest.mark.parametrize("name", SKEWED)
def test_intervals_cover_the_truth_also_of_skewed_scores(name, sizes, groups):
    generator, counts = np.random.default_rng(groups), np.tile(sizes, groups // len(sizes))
    group, covered = np.repeat(np.arange(groups), counts), np.zeros(3)
    for _ in range(TRIALS):
        difficulty = generator.gamma(16, 1 / 16, groups)[group]
        first, second = (
            scale * difficulty * SKEWED[name](generator, groups)[group] * generator.gamma(8, 1 / 8, group.size)
            for scale in (1.0, 1.3)
        )
        found = (
            mean_interval(first, group), paired_difference(first, second, group),
            relative_difference(first, second, group),
        )  # fmt: skip
        truths = (1.0, -0.3, 100 * (1 / 1.3 - 1))
        covered += [one.low <= truth <= one.high for one, truth in zip(found, truths, strict=True)]
    # 2.5 standard errors of a share of 0.94
    assert (covered / TRIALS >= 0.92).all(), covered / TRIALS


def test_no_end_lies_beyond_what_there_can_be():
    first, second = [0.0, 0.0, 9.0], [10.0, 10.0, 2.0]
    assert mean_interval(first).low < 0 < 10 < mean_interval(first).high
    assert mean_interval(first, limits=(0.0, 10.0)) == (3.0, 0.0, 10.0)
    assert paired_difference(first, second).low < -10.0
    assert paired_difference(first, second, limits=(0.0, 10.0)).low == -10.0
    assert mean_interval([1.0, 3.0, 2.0], limits=(0.0, 1.0)).high == 2.0  # the mean is always inside


def test_ratios_turn_over_with_their_pair_and_none_is_below_nothing():
    first, second = np.random.default_rng(0).gamma(0.3, 1.0, (2, 12)) * [[0.05], [1.0]]
    assert (paired_difference(first, second).low / second.mean()) < -1
    forth, back = relative_difference(first, second), relative_difference(second, first)
    assert -100 < forth.low < forth.mean < forth.high < 0
    assert forth.mean == pytest.approx(100 * (first.mean() / second.mean() - 1))
    turned = [100 * (1 / (1 + end / 100) - 1) for end in (back.mean, back.high, back.low)]
    np.testing.assert_allclose(forth, turned)
    np.testing.assert_allclose(relative_difference(7 * first, 7 * second), forth)
    assert relative_difference(-first, second) is None


@pytest.mark.parametrize("values", [[0.1, 0.1, 0.1], [0.0, 0.0], [0.1] * 20])
def test_equal_values_have_no_width(values):
    assert mean_interval(values) == (values[0], values[0], values[0])


@pytest.mark.parametrize(("values", "groups"), [([0.5], None), ([1.0, 2.0, 6.0], [0, 0, 0])])
def test_a_single_group_has_a_mean_and_no_interval(values, groups):
    assert mean_interval(values, groups) == (np.mean(values), None, None)


@pytest.mark.parametrize("count", [3, 9, 10, 40])
def test_repeating_every_scene_within_its_group_changes_nothing(count):
    values = np.random.default_rng(count).normal(size=count)
    repeated = mean_interval(np.repeat(values, 4), np.repeat(np.arange(count), 4))
    np.testing.assert_allclose(repeated, mean_interval(values), atol=1e-12)


def test_unequal_groups_have_the_spread_of_leaving_out_each_and_are_worth_fewer_of_equal_size():
    values, groups = np.array([1.0, 2.0, 6.0, 3.0, 5.0]), np.array([0, 0, 1, 2, 2])
    without = np.array([values[groups != group].mean() for group in range(3)])
    error = np.sqrt(2 / 3 * np.sum((without - values.mean()) ** 2))
    interval = mean_interval(values, groups)
    nearer = min(interval.mean - interval.low, interval.high - interval.mean)
    assert nearer == pytest.approx(t.ppf(0.975, 25 / 9 - 1) * error)


def test_swapping_the_pair_turns_the_sign():
    first, second = np.random.default_rng(6).normal(size=(2, 25))
    forth, back = paired_difference(first, second), paired_difference(second, first)
    np.testing.assert_allclose(forth, [-back.mean, -back.high, -back.low], atol=1e-12)


@pytest.mark.parametrize("values", [[], [np.nan, 1.0], [np.inf]])
def test_values_that_are_not_numbers_are_refused(values):
    with pytest.raises(NumericalError):
        mean_interval(values)


def test_differences_of_other_scenes_are_refused():
    with pytest.raises(NumericalError, match="do not pair"):
        paired_difference([1.0, 2.0], [1.0])
