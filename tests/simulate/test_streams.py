"""Random numbers by key, row and draw: uniform, independent of each other, the same in every order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import chi2, kstest, poisson
from support.references import STANDARD_ERRORS

from lidardesign.simulate.detector.streams import (
    MOST_COUNTS,
    normal,
    normal_quantile,
    normals,
    poisson_quantile,
    uniform,
    uniforms,
)

COUNT = 1 << 18
# the chance that one of the fixed samples below lies beyond this is one in a million
UNLIKELY = 1e-6


def along_rows(key):
    return uniforms(key, np.arange(COUNT), 0)


def along_draws(key):
    return uniforms(key, 7, np.arange(COUNT))


def along_keys(key):
    return np.array([uniform(np.uint64(key + i), 0, 0) for i in range(COUNT // 16)])


DIRECTIONS = {"rows": along_rows, "draws": along_draws, "keys": along_keys}


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("key", [0, 1, 2**63 - 1, 2**64 - 2**20])
def test_numbers_are_uniform_along_rows_draws_and_keys(direction, key):
    values = DIRECTIONS[direction](key)
    counts = np.bincount((values * 256).astype(int), minlength=256)
    expected = len(values) / 256
    assert chi2.sf(np.sum((counts - expected) ** 2 / expected), 255) > UNLIKELY
    assert kstest(values, "uniform").pvalue > UNLIKELY
    assert 0 < values.min() < values.max() < 1


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_neighbours_fill_the_square_evenly(direction):
    values = DIRECTIONS[direction](11)
    cells = (values[:-1] * 32).astype(int) * 32 + (values[1:] * 32).astype(int)
    # pairs that do not overlap, so that they are independent
    counts = np.bincount(cells[::2], minlength=1024)
    expected = counts.sum() / 1024
    assert chi2.sf(np.sum((counts - expected) ** 2 / expected), 1023) > UNLIKELY


def test_one_more_in_any_word_and_other_places_of_words_change_everything():
    base, rows = along_rows(3), np.arange(COUNT)
    for other in (uniforms(4, rows, 0), uniforms(3, rows, 1), uniforms(3, rows + 1, 0)):
        correlation = np.corrcoef(base, other)[0, 1]
        assert abs(correlation) < STANDARD_ERRORS / np.sqrt(COUNT)
    assert uniform(np.uint64(1), 2, 3) != uniform(np.uint64(1), 3, 2)
    assert uniform(np.uint64(2), 1, 3) != uniform(np.uint64(1), 2, 3)


def test_numbers_do_not_depend_on_order_or_company():
    rows = np.random.default_rng(0).permutation(1000)
    together = uniforms(9, rows[:, None], np.arange(3))
    for place in (0, 17, 999):
        for draw in range(3):
            assert together[place, draw] == uniform(np.uint64(9), rows[place], draw)
    assert normals(9, rows, 1)[5] == normal(np.uint64(9), rows[5], 1)


def test_normal_quantiles_agree_with_scipy():
    shares = np.concatenate([10.0 ** np.arange(-300, 0, 7), np.linspace(1e-6, 1 - 1e-6, 999), [1 - 1e-15]])
    ours = np.array([normal_quantile(share) for share in shares])
    # two rational approximations of nearly full precision
    np.testing.assert_allclose(ours, ndtri(shares), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("mean", [1e-9, 0.3, 4.0, 31.9])
def test_small_poisson_quantiles_are_exact(mean):
    shares = along_rows(8)[:5000]
    assert np.array_equal([poisson_quantile(mean, share) for share in shares], poisson.ppf(shares, mean))


@pytest.mark.parametrize("mean", [32.1, 500.0, 1e6])
def test_large_poisson_quantiles_are_off_by_one_count_at_most_and_seldom(mean):
    shares = along_rows(8)[:5000]
    off = np.array([poisson_quantile(mean, share) for share in shares]) - poisson.ppf(shares, mean)
    assert np.abs(off).max() <= 1
    assert np.mean(off != 0) < 0.02


def test_poisson_quantiles_of_no_and_of_endless_light_and_of_extreme_shares_are_counts():
    assert poisson_quantile(0.0, 0.5) == poisson_quantile(-1.0, 0.5) == 0
    assert abs(poisson_quantile(np.inf, 0.5) - MOST_COUNTS) < 10
    for share in (1e-17, 1 - 2.0**-54):
        for mean in (1e-12, 1.0, 30.0, 1e9):
            assert 0 <= poisson_quantile(mean, share) < mean + 100 + 20 * np.sqrt(mean)
