"""Means over seeds of learning and fitting, with intervals over seeds and scenes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t
from support.scoring import design, make_request, rows_by_key

from lidardesign.errors import NumericalError
from lidardesign.estimates import mean_interval
from lidardesign.evaluation.score import evaluate
from lidardesign.evaluation.seeds import over_seeds, two_way_interval

TRIALS = 1500
# Four standard errors of a share of 95 % over so many trials.
SLACK = 4 * np.sqrt(0.95 * 0.05 / TRIALS)


def naive_variance(table):
    """The variance of a table's mean by sums over its cells."""
    (seeds, groups), mean = table.shape, table.mean()
    rows, columns = table.mean(axis=1), table.mean(axis=0)
    of_seeds = sum(groups * (row - mean) ** 2 for row in rows) / (seeds - 1)
    of_groups = sum(seeds * (column - mean) ** 2 for column in columns) / (groups - 1)
    errors = sum((table[s, g] - rows[s] - columns[g] + mean) ** 2 for s in range(seeds) for g in range(groups)) / (
        (seeds - 1) * (groups - 1)
    )
    return (of_seeds + of_groups - errors) / (seeds * groups), (of_seeds, of_groups, errors)


def drawn(generator, seeds, groups, of_seeds, of_groups, error):
    rows, columns = generator.normal(size=(seeds, 1)), generator.normal(size=(1, groups))
    return of_seeds * rows + of_groups * columns + error * generator.normal(size=(seeds, groups))


def nearer(interval):
    """The distance of the end that the skewness of the mean does not move."""
    return min(interval.high - interval.mean, interval.mean - interval.low)


def test_intervals_have_the_variance_of_a_naive_sum_and_the_degrees_of_satterthwaite():
    table = drawn(np.random.default_rng(1), 4, 9, 1.0, 1.0, 0.5)
    variance, squares = naive_variance(table)
    freedom = (variance * 36) ** 2 / sum(s**2 / d for s, d in zip(squares, (3, 8, 24), strict=True))
    interval = two_way_interval(table)
    assert nearer(interval) == pytest.approx(t.ppf(0.975, freedom) * np.sqrt(variance))
    np.testing.assert_allclose(two_way_interval(table.T), interval)


@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize(
    "effects", [(1.0, 0.0, 0.0), (1.0, 0.0, 0.3), (0.0, 1.0, 0.0), (0.0, 1.0, 0.3), (1.0, 1.0, 0.3), (0.3, 1.0, 1.0)]
)
def test_intervals_cover_the_truth_at_their_level(seeds, effects):
    generator = np.random.default_rng(2)
    intervals = [two_way_interval(drawn(generator, seeds, 30, *effects)) for _ in range(TRIALS)]
    covered = np.mean([one.low <= 0.0 <= one.high for one in intervals])
    # the mean squares of few seeds and of many groups add up to no exact chi-square
    assert 0.95 - SLACK - 0.02 <= covered <= 0.95 + SLACK + 0.02


def test_intervals_have_no_fewer_degrees_than_the_smaller_factor():
    table = np.array([[-0.9, 1.6, -1.3], [-0.4, -0.4, -1.2]])
    variance, squares = naive_variance(table)
    assert variance * 6 > squares[2]
    # the variance is a difference of uncertain mean squares
    assert (variance * 6) ** 2 / sum(s**2 / d for s, d in zip(squares, (1, 2, 2), strict=True)) < 0.7
    interval = two_way_interval(table)
    assert nearer(interval) == pytest.approx(t.ppf(0.975, 1) * np.sqrt(variance))


def test_without_any_effect_intervals_are_wide_rather_than_narrow():
    generator = np.random.default_rng(3)
    intervals = [two_way_interval(drawn(generator, 5, 12, 0.0, 0.0, 1.0)) for _ in range(TRIALS)]
    assert np.mean([one.low <= 0.0 <= one.high for one in intervals]) >= 0.95 - SLACK


def test_one_effect_alone_has_the_interval_of_its_means():
    values = np.random.default_rng(4).gamma(1.0, size=7)
    for table in (np.tile(values, (3, 1)), np.tile(values[:, None], (1, 20))):
        np.testing.assert_allclose(two_way_interval(table), mean_interval(values), rtol=1e-9)


def test_a_single_group_or_seed_has_no_interval_and_equal_values_no_width():
    assert two_way_interval([[1.0], [3.0]]) == (2.0, None, None)
    assert two_way_interval([[1.0, 3.0]]) == (2.0, None, None)
    assert two_way_interval(np.full((3, 4), 0.1)) == (0.1, 0.1, 0.1)


@pytest.mark.parametrize("table", [[], [1.0, 2.0], [[np.nan, 1.0], [0.0, 1.0]], [[np.inf, 1.0], [0.0, 1.0]]])
def test_what_is_no_table_of_numbers_is_refused(table):
    with pytest.raises(NumericalError):
        two_way_interval(table)


def three_seeds(groups=None):
    requests = [make_request([design("own", azimuth=0.02 * seed)], seed=seed) for seed in range(3)]
    if groups is not None:
        test = [replace(scene, group=group) for scene, group in zip(requests[0].test, groups, strict=True)]
        requests = [replace(request, test=test) for request in requests]
    return [evaluate(request) for request in requests]


def test_rows_and_differences_are_means_over_seeds():
    single = three_seeds()
    joint = over_seeds(single, (0, 1, 2), 7)
    assert list(joint.seeds) == joint.as_dict()["seeds"] == [0, 1, 2]
    by_seed = [rows_by_key(each) for each in single]
    assert [(row.design, row.rays) for row in joint.rows] == [(row.design, row.rays) for row in single[0].rows]
    for row in joint.rows:
        table = np.stack([rows[row.design, row.rays].per_scene for rows in by_seed])
        assert (row.value, row.ci_low, row.ci_high) == two_way_interval(table, limits=(0.0, 150.0))
        assert row.per_seed == pytest.approx(table.mean(axis=1))
        assert row.failures == sum(rows[row.design, row.rays].failures for rows in by_seed)
    for pair in joint.paired:
        apart = [rows[pair.a, pair.rays].per_scene - rows[pair.b, pair.rays].per_scene for rows in by_seed]
        assert (pair.difference, pair.ci_low, pair.ci_high) == two_way_interval(np.stack(apart), limits=(-150.0, 150.0))
    assert len(joint.paired_bandwidth) == len(joint.equal_bandwidth) == len(single[0].equal_bandwidth)
    assert any("seeds 0, 1, 2" in note and "seed 7" in note for note in joint.notes)


def test_scenes_of_one_group_count_once():
    # six scenes: three groups of two
    joint = over_seeds(three_seeds(["a", "b", "c", "a", "b", "c"]), (0, 1, 2), 0)
    single = [rows_by_key(each) for each in three_seeds()]
    for row in joint.rows:
        table = np.stack([rows[row.design, row.rays].per_scene.reshape(2, 3).mean(axis=0) for rows in single])
        np.testing.assert_allclose((row.value, row.ci_low, row.ci_high), two_way_interval(table, limits=(0.0, 150.0)))
    # of unequal groups the mean is still that over scenes
    uneven = over_seeds(three_seeds(["a", "a", "a", "b", "b", "c"]), (0, 1, 2), 0)
    assert uneven.rows[0].value == pytest.approx(joint.rows[0].value)


def test_rows_that_a_seed_lacks_are_left_out_with_a_note():
    first, second = three_seeds()[:2]
    lacking = replace(second, rows=[row for row in second.rows if row.design != "random"])
    joint = over_seeds([first, lacking], (0, 1), 0)
    assert {row.design for row in joint.rows} == {"own", "uniform", "bounding", "silhouette"}
    assert {pair.b for pair in joint.paired} == {"uniform", "bounding", "silhouette"}
    assert any("left out: random" in note for note in joint.notes)
