"""Exact conditions: samples moved to a value of their condition, weighted, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lidardesign.errors import ConfigError, DataError, NumericalError
from lidardesign.mixture.support import at_condition
from lidardesign.samples import Samples
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace

AISLE = DesignSpace((0.0, 0.0, 0.0, -2.0, 0.0, 0.1), (4.0, 0.0, 0.0, 2.0, 0.0, 4.0), condition=("x_m",))
LOG_MASS = 1.7
# Bounds are five standard deviations away, so that cut tails weigh less than a millionth.
TARGET, PROPOSAL = (0.15, 0.1), (0.2, 0.15)


def means(x):
    """Where the planted density lies at a condition: azimuth [rad] and range [m]."""
    return 0.3 * (x - 2), 1.5 + 0.25 * x


def log_normal(values, mean, spread):
    return -0.5 * np.square((values - mean) / spread) - math.log(spread * math.sqrt(2 * math.pi))


def log_target(points, condition=0):
    azimuth, reach = means(points[:, condition])
    planted = log_normal(points[:, AZIMUTH], azimuth, TARGET[0]) + log_normal(points[:, RANGE], reach, TARGET[1])
    return LOG_MASS + planted


def learned(count=40_000, seed=0):
    """Samples of a density that is a little off and too wide, as flows are."""
    generator = np.random.default_rng(seed)
    x = generator.uniform(0.0, 4.0, count)
    azimuth, reach = means(x)
    points = np.zeros((count, 6))
    points[:, 0] = x
    points[:, AZIMUTH] = azimuth + 0.05 + PROPOSAL[0] * generator.standard_normal(count)
    points[:, RANGE] = reach - 0.03 + PROPOSAL[1] * generator.standard_normal(count)
    log_prob = log_normal(points[:, AZIMUTH], azimuth + 0.05, PROPOSAL[0])
    log_prob += log_normal(points[:, RANGE], reach - 0.03, PROPOSAL[1])
    return Samples(points, log_prob - math.log(4.0), log_target(points), AISLE)


SAMPLES = learned()


def estimate(samples, values):
    """Weighted mean and its standard error."""
    mean = samples.weights @ values
    return mean, math.sqrt(np.square(samples.weights) @ np.square(values - mean))


@pytest.mark.parametrize("value", [0.0, 0.37, 1.2, 3.91, 4.0])
def test_moments_at_a_value_are_those_of_the_conditional_density_and_the_mean_weight_is_its_mass(value):
    found = at_condition(SAMPLES, {"x_m": value}, log_target, 20_000, np.random.default_rng(1))
    for column, centre, spread in zip((AZIMUTH, RANGE), means(value), TARGET, strict=True):
        mean, error = estimate(found, found.points[:, column])
        assert abs(mean - centre) < 4 * error
        square, error = estimate(found, np.square(found.points[:, column] - centre))
        assert abs(square - spread**2) < 4 * error
    weights = np.exp(found.log_weights)
    assert abs(weights.mean() - math.exp(LOG_MASS)) < 4 * weights.std() / math.sqrt(len(weights))


def test_samples_so_far_that_they_would_spoil_the_rest_are_left_away():
    worth = []
    for count in (1000, 4000, 16_000, 40_000):
        found = at_condition(SAMPLES, {"x_m": 1.0}, log_target, count, np.random.default_rng(1))
        worth.append(found.effective_sample_size * len(found))
    assert worth[1] > 2 * worth[0]
    assert min(worth[2:]) > 0.9 * worth[1]


def test_every_sample_has_the_value_exactly_and_the_space_fixes_it():
    found = at_condition(SAMPLES, {"x_m": 0.37}, log_target, 500, np.random.default_rng(1))
    assert len(found) in (500, 250)
    np.testing.assert_array_equal(found.points[:, 0], 0.37)
    assert found.space == AISLE.at({"x_m": 0.37})
    assert found.space.conditioned == ()


def test_the_first_samples_are_no_nearer_than_the_last():
    # a density that shows from where a sample came: its azimuth is its own condition
    points = np.zeros((8000, 6))
    points[:, 0] = points[:, AZIMUTH] = np.random.default_rng(0).uniform(0.0, 2.0, 8000)
    points[:, RANGE] = 1.0
    space = DesignSpace((0.0, 0, 0, 0.0, 0, 0.1), (2.0, 0, 0, 2.0, 0, 4.0), condition=("x_m",))
    flat = Samples(points, np.zeros(8000), np.zeros(8000), space)
    found = at_condition(flat, {"x_m": 0.5}, lambda p: np.zeros(len(p)), 4000, np.random.default_rng(2))
    away = np.abs(found.points[:, AZIMUTH] - 0.5)
    half = len(away) // 2
    assert abs(away[:half].mean() - away[half:].mean()) < 4 * away.std() / math.sqrt(half / 2)


def test_a_condition_on_the_elevation_counts_in_its_chart():
    # p(azimuth | elevation) uniform, conditions uniform in sin(elevation): every weight is the target's mass
    space = DesignSpace((0, 0, 0, -1.0, 0.2, 1.0), (0, 0, 0, 1.0, 1.3, 1.0), condition=("elevation_rad",))
    generator = np.random.default_rng(0)
    points = space.sample(3000, generator)
    log_prob = np.full(3000, -math.log(2.0) - math.log(math.sin(1.3) - math.sin(0.2)))
    samples = Samples(points, log_prob, np.zeros(3000), space)
    found = at_condition(samples, {"elevation_rad": 0.7}, lambda p: np.zeros(len(p)), 1000, generator)
    np.testing.assert_allclose(np.exp(found.log_weights), 2.0, rtol=1e-12)
    np.testing.assert_array_equal(found.points[:, ELEVATION], 0.7)


def test_several_conditions_are_met_at_once_or_one_by_one():
    space = DesignSpace((0.0, -1.0, 0, -2.0, 0, 1.0), (4.0, 1.0, 0, 2.0, 0, 1.0), condition=("x_m", "y_m"))
    generator = np.random.default_rng(3)
    count = 30_000
    points = np.zeros((count, 6))
    points[:, 0], points[:, 1], points[:, RANGE] = generator.uniform(0, 4, count), generator.uniform(-1, 1, count), 1.0

    def centre(p):
        return 0.2 * (p[:, 0] - 2) + 0.3 * p[:, 1]

    def target(p):
        return log_normal(p[:, AZIMUTH], centre(p), 0.2)

    points[:, AZIMUTH] = centre(points) + 0.3 * generator.standard_normal(count)
    log_prob = log_normal(points[:, AZIMUTH], centre(points), 0.3) - math.log(8.0)
    samples = Samples(points, log_prob, target(points), space)
    both = at_condition(samples, {"x_m": 3.0, "y_m": -0.5}, target, 10_000, generator)
    mean, error = estimate(both, both.points[:, AZIMUTH])
    assert abs(mean - (0.2 - 0.15)) < 4 * error
    assert both.space.conditioned == ()
    first = at_condition(samples, {"x_m": 3.0}, target, count, generator)
    assert [both.space.free, first.space.conditioned] == [(AZIMUTH,), (1,)]
    then = at_condition(first, {"y_m": -0.5}, target, 10_000, generator)
    mean, error = estimate(then, then.points[:, AZIMUTH])
    assert abs(mean - 0.05) < 4 * error
    weights = np.exp(then.log_weights)
    assert abs(weights.mean() - 1) < 4 * weights.std() / 100


def test_without_a_condition_nothing_changes():
    assert at_condition(SAMPLES, {}, log_target, 10, np.random.default_rng(0)) is SAMPLES


FIXED = replace(SAMPLES, space=DesignSpace(AISLE.low, AISLE.high))
WORTH = r"x_m=1 the 1000 nearest samples count as only [0-3]\n(.|\n)*at least 50"


@pytest.mark.parametrize(
    ("samples", "condition", "target", "error", "words"),
    [
        (SAMPLES, {"x_m": 4.2}, log_target, ConfigError, "0 to 4"),
        (SAMPLES, {"x_m": math.nan}, log_target, ConfigError, "0 to 4"),
        (SAMPLES, {"y_m": 0.0}, log_target, ConfigError, "x_m"),
        (SAMPLES, {"speed": 1.0}, log_target, ConfigError, "x_m"),
        (FIXED, {"x_m": 1.0}, log_target, ConfigError, "no conditions"),
        (SAMPLES, {"x_m": 1.0}, lambda p: np.full(len(p), -np.inf), DataError, WORTH),
        (SAMPLES, {"x_m": 1.0}, lambda p: np.where(np.arange(len(p)) < 3, 0.0, -np.inf), DataError, WORTH),
        (SAMPLES, {"x_m": 1.0}, lambda p: np.full(len(p), np.nan), NumericalError, "x_m=1"),
        (SAMPLES, {"x_m": 1.0}, lambda p: np.zeros(3), NumericalError, "x_m=1"),
    ],
)
def test_what_cannot_be_moved_to_a_value_is_refused_in_words(samples, condition, target, error, words):
    with pytest.raises(error, match=words):
        at_condition(samples, condition, target, 1000, np.random.default_rng(0))
