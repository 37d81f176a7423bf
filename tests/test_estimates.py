"""Standard errors are the spreads that they claim to be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lidardesign.estimates import (
    Estimate,
    as_documents,
    effective_share_error,
    figure_and_interval,
    log_mean_error,
    median_error,
    share_error,
    standard_error,
    weighted_mean_error,
)
from lidardesign.numerics import effective_count

REPEATS = 500
# A standard deviation of so many values is known to 1 / sqrt(2 n).
FOUR_ERRORS = 4 / math.sqrt(2 * REPEATS)


@pytest.mark.parametrize(
    ("figure", "error"),
    [
        (lambda w, v: effective_count(w) / len(w), lambda w, v: effective_share_error(w)),
        (lambda w, v: math.log(w.mean()), lambda w, v: log_mean_error(w)),
        (lambda w, v: (w @ v) / w.sum(), lambda w, v: weighted_mean_error(v, w)),
    ],
    ids=["effective share", "log mean", "weighted mean"],
)
def test_errors_are_the_spread_over_other_samples(figure, error):
    generator = np.random.default_rng(1)
    drawn = [(generator.gamma(2.0, size=800), generator.normal(size=800)) for _ in range(REPEATS)]
    spread = np.std([figure(w, v) for w, v in drawn])
    stated = np.mean([error(w, v) for w, v in drawn])
    assert stated == pytest.approx(spread, rel=FOUR_ERRORS)


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_the_error_of_a_share_is_its_spread(share):
    counts = np.random.default_rng(4).binomial(200, share, 5000)
    stated = np.mean([share_error(count, 200) for count in counts])
    assert stated == pytest.approx(np.std(counts / 200), rel=0.1)
    assert 0 < share_error(0, 200) == pytest.approx(share_error(200, 200))


def test_the_error_of_a_median_is_its_spread():
    generator = np.random.default_rng(5)
    drawn = generator.normal(size=(REPEATS, 401))
    stated = np.mean([median_error(values) for values in drawn])
    # sqrt(pi / 2n) for a normal distribution
    assert stated == pytest.approx(math.sqrt(math.pi / 2 / 401), rel=0.05)
    assert stated == pytest.approx(np.median(drawn, axis=1).std(), rel=FOUR_ERRORS)
    assert median_error(np.array([3.0])) == 0.0


def test_only_ratios_of_weights_count():
    generator = np.random.default_rng(2)
    weights, values = generator.gamma(2.0, size=100), generator.normal(size=100)
    for scale in (1e-300, 1e300):
        assert effective_share_error(scale * weights) == pytest.approx(effective_share_error(weights))
        assert log_mean_error(scale * weights) == pytest.approx(log_mean_error(weights))
        assert weighted_mean_error(values, scale * weights) == pytest.approx(weighted_mean_error(values, weights))


def test_equal_weights_leave_the_usual_standard_error_and_no_error_of_their_own():
    values = np.random.default_rng(3).normal(size=50)
    assert weighted_mean_error(values, np.full(50, 0.3)) == pytest.approx(values.std() / math.sqrt(50))
    assert effective_share_error(np.full(50, 7.0)) == pytest.approx(0.0, abs=1e-12)
    assert log_mean_error(np.full(50, 7.0)) == pytest.approx(0.0, abs=1e-12)
    assert standard_error(np.zeros(0)) == 0.0


def test_estimates_become_documents():
    found = as_documents({"ess": Estimate(0.5, 0.01), "kl": Estimate(0.1, None, "nats")})
    assert found["ess"] == {"value": 0.5, "error": 0.01, "unit": "", "kind": "standard error"}
    assert found["kl"]["error"] is None
    assert found["kl"]["unit"] == "nats"


@pytest.mark.parametrize(
    ("figure", "expected"),
    [
        ((0.0485, -0.0653, 0.159), ("+0.05", "-0.07", "0.16")),
        ((-12.764, -13.6, -11.93), ("-12.76", "-13.60", "-11.93")),
        ((4321.0, 4000.0, 4700.0), ("+4321", "4000", "4700")),
        ((-0.001, -0.3, 0.3), ("+0.00", "-0.30", "0.30")),
        ((0.12345, None, None), ("+0.123", "-", "-")),
        ((0.12345, 0.12345, 0.12345), ("+0.123", "0.123", "0.123")),
        ((5.0, 5.0, 5.0 + 1e-12), ("+5.000", "5.000", "5.000")),
    ],
)
def test_a_figure_is_as_fine_as_its_interval_says(figure, expected):
    assert figure_and_interval(*figure, sign="+") == expected
