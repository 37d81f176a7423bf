"""Laws of the log-space and safe primitives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.numerics import (
    box_quadratic_minimum,
    circular_mean,
    clipped_eigenvalues,
    effective_count,
    effective_sample_size,
    log1mexp,
    logsumexp,
    nearest_positive_definite,
    normalised_weights,
    safe_divide,
    systematic_draw,
    wrap_angle,
)

finite = st.floats(-700, 700)


@given(st.lists(finite, min_size=1, max_size=8))
def test_logsumexp_is_the_logarithm_of_the_sum(values):
    exact = math.log(math.fsum(math.exp(v - max(values)) for v in values)) + max(values)
    assert logsumexp(values) == pytest.approx(exact, rel=1e-12, abs=1e-12)


def test_logsumexp_of_nothing_possible_is_minus_infinity_without_a_warning():
    rows = np.array([[-np.inf, -np.inf], [0.0, -np.inf]])
    np.testing.assert_array_equal(logsumexp(rows, axis=1), [-np.inf, 0.0])
    assert logsumexp([np.inf, 0.0]) == np.inf


def test_logsumexp_survives_magnitudes_that_overflow():
    assert logsumexp([5000.0, 5000.0]) == pytest.approx(5000 + math.log(2))
    assert logsumexp([-5000.0, -5000.0]) == pytest.approx(-5000 + math.log(2))


def test_logsumexp_weights_are_factors():
    assert logsumexp([0.0, 1.0], weights=[2.0, 0.0]) == pytest.approx(math.log(2))


@pytest.mark.parametrize("value", [-1e-300, -1e-12, -0.5, -math.log(2), -1.0, -40.0, -800.0])
def test_log1mexp_keeps_its_digits_at_both_ends(value):
    import mpmath

    with mpmath.workdps(400):
        exact = float(mpmath.log(-mpmath.expm1(mpmath.mpf(value))))
    assert float(log1mexp(value)) == pytest.approx(exact, rel=1e-14)


def test_log1mexp_of_zero_is_minus_infinity():
    assert log1mexp(0.0) == -np.inf


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_are_the_same_direction_in_half_open_turn(angle):
    wrapped = float(wrap_angle(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_wrapping_a_tiny_negative_angle_stays_inside():
    assert -math.pi <= float(wrap_angle(-math.pi - 1e-18)) < math.pi


@given(st.floats(0, 6.28), st.floats(0.01, 1.0))
def test_the_circular_mean_of_a_symmetric_pair_is_its_middle_also_across_zero(middle, offset):
    mean = circular_mean([middle - offset, middle + offset])
    assert 0 <= mean < 2 * math.pi
    assert abs(float(wrap_angle(mean - middle))) < 1e-9


def test_division_by_zero_gives_the_stated_value():
    np.testing.assert_array_equal(safe_divide([1.0, 2.0], [0.0, 4.0], otherwise=7.0), [7.0, 0.5])


def test_weights_are_normalised_and_refused_without_mass():
    np.testing.assert_allclose(normalised_weights([1000.0, 1000.0, -np.inf]), [0.5, 0.5, 0.0])
    with pytest.raises(ValueError, match="normalised"):
        normalised_weights([-np.inf, -np.inf])


def test_effective_sizes_count_equal_weights():
    assert effective_sample_size(np.zeros(50)) == pytest.approx(1.0)
    assert effective_sample_size(np.r_[0.0, np.full(9, -np.inf)]) == pytest.approx(0.1)
    assert effective_sample_size(np.full(3, -np.inf)) == 0.0
    assert effective_count(np.full(7, 1e-300)) == pytest.approx(7)
    assert effective_count(np.zeros(3)) == 0.0


def test_clipped_eigenvalues_lie_within_their_bounds():
    generator = np.random.default_rng(0)
    root = generator.standard_normal((20, 3, 3))
    fixed = clipped_eigenvalues(root @ np.swapaxes(root, 1, 2), 0.1, 0.5)
    values = np.linalg.eigvalsh(fixed)
    assert values.min() >= 0.1 - 1e-12
    assert values.max() <= 0.5 + 1e-12


def test_positive_definite_matrices_are_left_as_they_are():
    matrix = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_allclose(nearest_positive_definite(matrix, 0.5), matrix, atol=1e-15)
    repaired = nearest_positive_definite(np.diag([1.0, -1.0]), 0.5)
    np.testing.assert_allclose(repaired, np.diag([1.0, 0.5]))


def test_the_box_minimum_beats_every_other_point_of_the_box():
    generator = np.random.default_rng(1)
    root = generator.standard_normal((30, 3, 3))
    precision = root @ np.swapaxes(root, 1, 2) + 0.05 * np.eye(3)
    centre = 2 * generator.standard_normal((30, 3))
    low, high = -np.ones((30, 3)), np.ones((30, 3))
    best = box_quadratic_minimum(precision, centre, low, high, sweeps=400)
    assert (np.abs(best) <= 1).all()

    def cost(point):
        return np.einsum("ki,kij,kj->k", point - centre, precision, point - centre)

    for _ in range(300):
        other = np.clip(best + 0.2 * generator.standard_normal((30, 3)), -1, 1)
        assert (cost(best) <= cost(other) + 1e-9).all()


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_a_systematic_draw_takes_every_index_as_often_as_its_weight_says_rounded(count):
    generator = np.random.default_rng(count)
    weights = generator.exponential(size=50) * (generator.random(50) < 0.7)
    chosen = systematic_draw(weights, count, generator)
    times, expected = np.bincount(chosen, minlength=50), count * weights / weights.sum()
    assert len(chosen) == count
    assert (np.abs(times - expected) < 1).all()
    assert (times[weights == 0] == 0).all()
    assert (np.diff(chosen) >= 0).all()
