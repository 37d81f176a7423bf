"""Laws of the log-space and safe primitives: float32 and float64, forward and backward, against 50 digits."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lidardesign import numerics
from lidardesign.numerics import (
    angle_over_sine,
    box_quadratic_minimum,
    circular_difference,
    clipped_eigenvalues,
    effective_count,
    effective_sample_size,
    logsumexp,
    normalised_weights,
    safe_divide,
    safe_norm,
    safe_sqrt,
    sphere_exp,
    sphere_log,
    systematic_draw,
    unit_vectors,
    wrap_angle,
    wrap_turn,
)

DTYPES = [np.float32, np.float64]
TORCH = {np.float32: torch.float32, np.float64: torch.float64}
each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
# a handful of operations, each rounded to half a unit in the last place
ROUNDINGS = 8
finite = st.floats(-700, 700)


def digits(function, *values):
    """A function of 50 digits (and as many more as a tiny argument needs) at floats, as float."""
    with mpmath.workdps(400):
        return function(*(mpmath.mpf(float(value)) for value in values))


def close(found, exact, dtype, roundings=ROUNDINGS, least=0.0):
    """Whether a number is as near to the exact one as the format allows."""
    limit = roundings * float(np.finfo(dtype).eps) * max(abs(float(exact)), least) + float(np.finfo(dtype).tiny)
    return abs(float(found) - float(exact)) <= limit


def gradients(function, values, dtype):
    """The derivative of the summed function at values, by torch."""
    tensor = torch.tensor(np.asarray(values, dtype=dtype), requires_grad=True)
    function(tensor).sum().backward()
    return tensor.grad.numpy()


def half_turns(value):
    return value - 2 * mpmath.pi * mpmath.floor((value + mpmath.pi) / (2 * mpmath.pi))


def ratio(value):
    return value / mpmath.sin(value) if value else mpmath.mpf(1)


def of_ratio(value):
    sine, cosine = mpmath.sin(value), mpmath.cos(value)
    return (sine - value * cosine) / sine**2 if value else mpmath.mpf(0)


# function, what it is, its derivative, and arguments, ordinary and special
ELEMENTWISE = {
    "safe_sqrt": (
        safe_sqrt,
        mpmath.sqrt,
        lambda a: 1 / (2 * mpmath.sqrt(a)),
        [1e-37, 1e-12, 0.3, 1.0, 2.0, 1e30],
    ),
    "angle_over_sine": (
        angle_over_sine,
        ratio,
        of_ratio,
        [0.0, 1e-30, 1e-9, 1e-5, 0.01, 0.011, 0.012, 0.13, 0.14, 0.5, 1.5, 1.6, 2.5, 3.0, 3.1, 3.14, 3.141],
    ),
    "wrap_angle": (wrap_angle, half_turns, lambda a: mpmath.mpf(1), [-3.0, -1e-20, 0.0, 1.0, 3.0]),
    "wrap_turn": (
        wrap_turn,
        lambda a: a - 2 * mpmath.pi * mpmath.floor(a / (2 * mpmath.pi)),
        lambda a: mpmath.mpf(1),
        [0.0, 1e-20, 1.0, 6.0],
    ),
}


@each_dtype
@pytest.mark.parametrize("name", ELEMENTWISE)
def test_a_function_of_one_number_keeps_the_digits_of_its_format(name, dtype):
    function, exact, _, values = ELEMENTWISE[name]
    values = np.asarray(values, dtype=dtype)
    for found in (function(values), function(torch.tensor(values)).numpy()):
        assert found.dtype == dtype
        for value, number in zip(values, found, strict=True):
            assert close(number, digits(exact, value), dtype), (value, number)


@each_dtype
@pytest.mark.parametrize("name", ELEMENTWISE)
def test_the_derivative_of_a_function_of_one_number_keeps_them_too(name, dtype):
    function, _, derivative, values = ELEMENTWISE[name]
    for value, slope in zip(np.asarray(values, dtype=dtype), gradients(function, values, dtype), strict=True):
        exact = digits(derivative, value)
        # two terms of the ratio's derivative cancel near 0, where the value does not depend on them
        assert close(slope, exact, dtype, roundings=64, least=1.0 if name == "angle_over_sine" else 0.0), (value, slope)


@each_dtype
def test_values_at_the_edges_are_limits_and_derivatives_there_are_defined(dtype):
    values = np.asarray([0.0, -1.0, math.inf], dtype=dtype)
    np.testing.assert_array_equal(safe_sqrt(values), [0.0, 0.0, math.inf])
    np.testing.assert_array_equal(gradients(safe_sqrt, values, dtype), [0.0, 0.0, 0.0])


@each_dtype
@pytest.mark.parametrize("function", [safe_sqrt, wrap_angle, logsumexp, safe_norm])
def test_what_is_not_a_number_stays_none(function, dtype):
    assert np.isnan(np.asarray(function(np.asarray([math.nan], dtype=dtype)))).all()
    assert torch.isnan(function(torch.tensor([math.nan], dtype=TORCH[dtype]))).all()


def test_lists_and_whole_numbers_become_float64_and_float32_stays_beside_plain_numbers():
    assert logsumexp([1, 2]).dtype == np.float64
    assert safe_divide(np.array([1, 2]), 3).dtype == np.float64
    assert safe_divide(np.float32([1, 2]), 3.0).dtype == np.float32
    assert safe_divide(np.float32([1]), np.float64([3])).dtype == np.float64
    assert safe_divide(np.float32([1]), np.array([3])).dtype == np.float64
    assert safe_divide(torch.ones(2, dtype=torch.float32), 3.0).dtype == torch.float32
    assert safe_divide(torch.ones(2, dtype=torch.float32), torch.ones(2, dtype=torch.float64)).dtype == torch.float64
    assert safe_divide(torch.ones(2, dtype=torch.int64), 3).dtype == torch.float64
    assert isinstance(wrap_angle(7.0), np.float64)


@given(st.lists(finite, min_size=1, max_size=8))
def test_logsumexp_is_the_logarithm_of_the_sum(values):
    exact = math.log(math.fsum(math.exp(v - max(values)) for v in values)) + max(values)
    assert logsumexp(values) == pytest.approx(exact, rel=1e-12, abs=1e-12)


@each_dtype
@pytest.mark.parametrize("shift", [0.0, 5000.0, -5000.0, -1e5])
def test_logsumexp_and_its_derivative_survive_magnitudes_that_overflow(dtype, shift):
    values = np.asarray([0.0, 1.0, -2.0, -math.inf], dtype=dtype) + dtype(shift)
    exact = digits(lambda *a: mpmath.log(mpmath.fsum(mpmath.exp(v) for v in a)), *values[:3])
    assert close(logsumexp(values), exact, dtype)
    assert logsumexp(values).dtype == dtype
    shares = gradients(logsumexp, values, dtype)
    for value, share in zip(values[:3], shares, strict=False):
        assert close(share, digits(lambda v: mpmath.exp(v - exact), value), dtype)
    assert shares[3] == 0


@each_dtype
def test_logsumexp_of_nothing_possible_is_minus_infinity_and_has_derivative_0(dtype):
    rows = np.asarray([[-math.inf, -math.inf], [0.0, -math.inf], [math.inf, 0.0]], dtype=dtype)
    np.testing.assert_array_equal(logsumexp(rows, axis=1), [-math.inf, 0.0, math.inf])
    np.testing.assert_array_equal(
        gradients(lambda v: logsumexp(v, axis=1), rows, dtype), [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    )
    assert logsumexp(np.zeros((0,), dtype)) == -math.inf
    np.testing.assert_array_equal(logsumexp(np.zeros((2, 0), dtype), axis=1), [-math.inf, -math.inf])


@each_dtype
def test_logsumexp_weights_are_factors(dtype):
    values, weights = np.asarray([[0.0, 1.0], [3.0, 4.0]], dtype), np.asarray([2.0, 0.0], dtype)
    np.testing.assert_allclose(
        logsumexp(values, axis=1, weights=weights), np.array([0.0, 3.0]) + math.log(2), rtol=1e-6
    )
    np.testing.assert_allclose(logsumexp(values, weights=weights), math.log(2 + 2 * math.exp(3)), rtol=1e-6)
    assert logsumexp(values, weights=np.zeros(2, dtype)) == -math.inf
    np.testing.assert_array_equal(
        gradients(lambda v: logsumexp(v, axis=1, weights=weights), values, dtype), [[1.0, 0.0], [1.0, 0.0]]
    )
    shares = np.exp([[0.0, -math.inf], [3.0, -math.inf]]) / (1 + math.exp(3))
    np.testing.assert_allclose(gradients(lambda v: logsumexp(v, weights=weights), values, dtype), shares, rtol=1e-6)


def test_logsumexp_sums_the_axis_that_is_asked_for():
    values = np.arange(6.0).reshape(2, 3)
    for axis in (0, 1, -1):
        np.testing.assert_allclose(logsumexp(values, axis=axis), np.log(np.exp(values).sum(axis=axis)))
    assert logsumexp(values) == pytest.approx(math.log(np.exp(values).sum()))


@each_dtype
def test_division_by_zero_gives_the_stated_value_and_derivative_0(dtype):
    numerator, denominator = np.asarray([1.0, 2.0], dtype), np.asarray([0.0, 4.0], dtype)
    np.testing.assert_array_equal(safe_divide(numerator, denominator, otherwise=7.0), [7.0, 0.5])
    np.testing.assert_array_equal(safe_divide(numerator, denominator), [0.0, 0.5])
    np.testing.assert_array_equal(
        gradients(lambda v: safe_divide(torch.tensor(numerator), v), denominator, dtype), [0.0, -0.125]
    )
    np.testing.assert_array_equal(
        gradients(lambda v: safe_divide(v, torch.tensor(denominator)), numerator, dtype), [0.0, 0.25]
    )


@pytest.mark.parametrize(
    ("dtype", "exponent"),
    [*((np.float32, e) for e in (-30, -21, -18, 0, 18, 30)), *((np.float64, e) for e in (-200, -158, 0, 150, 200))],
)
def test_lengths_of_large_and_small_vectors_neither_overflow_nor_vanish(dtype, exponent):
    vector = np.asarray([[3.0, 4.0, 12.0], [0.0, 0.0, 1.0]], dtype) * dtype(10.0) ** dtype(exponent)
    exact = [digits(lambda *v: mpmath.sqrt(mpmath.fsum(c * c for c in v)), *row) for row in vector]
    for found in (safe_norm(vector), safe_norm(torch.tensor(vector)).numpy()):
        assert all(close(number, length, dtype) for number, length in zip(found, exact, strict=True))
    np.testing.assert_allclose(unit_vectors(vector), [[3 / 13, 4 / 13, 12 / 13], [0, 0, 1]], rtol=1e-6)
    np.testing.assert_allclose(gradients(safe_norm, vector, dtype)[0], [3 / 13, 4 / 13, 12 / 13], rtol=1e-6)


@each_dtype
def test_the_zero_vector_has_length_0_derivative_0_and_no_direction(dtype):
    vectors = np.asarray([[0.0, 0.0], [3.0, 4.0], [math.inf, 1.0]], dtype)
    np.testing.assert_array_equal(safe_norm(vectors), [0.0, 5.0, math.inf])
    np.testing.assert_allclose(gradients(safe_norm, vectors[:2], dtype), [[0.0, 0.0], [0.6, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(unit_vectors(vectors[:2]), [[0.0, 0.0], [0.6, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(unit_vectors(vectors[:2].T, axis=0), [[0.0, 0.6], [0.0, 0.8]], rtol=1e-6)


@given(st.floats(-1e4, 1e4), st.floats(-10, 10))
def test_wrapped_angles_are_the_same_direction_in_half_open_turns(angle, start):
    wrapped, turned = float(wrap_angle(angle)), float(wrap_turn(angle, start))
    assert -math.pi <= wrapped < math.pi
    assert start <= turned <= start + 2 * math.pi
    for same in (wrapped, turned):
        assert math.cos(same) == pytest.approx(math.cos(angle), abs=1e-9)
        assert math.sin(same) == pytest.approx(math.sin(angle), abs=1e-9)


@each_dtype
def test_wrapping_a_tiny_negative_angle_stays_inside(dtype):
    assert -math.pi <= float(wrap_angle(-math.pi - 1e-18)) < math.pi
    assert wrap_turn(dtype(-1e-30)) == 0
    assert wrap_angle(dtype(math.pi)) == -dtype(math.pi)
    assert wrap_angle(dtype(0)) == 0
    # a multiple of the turn in float is no multiple of it
    assert float(wrap_angle(1e6 * math.pi)) == pytest.approx(float(digits(half_turns, 1e6 * math.pi)), abs=1e-9)


@given(st.floats(-100, 100), st.floats(-3.1, 3.1))
def test_a_circular_difference_is_the_turn_that_leads_from_one_angle_to_the_other(angle, turn):
    assert float(circular_difference(angle + turn, angle)) == pytest.approx(turn, abs=1e-12)


def at_angle(angle, dtype, toward=0.3):
    """A unit vector at an angle from the pole (1, 0, 0), rounded, and its exact tangent coordinates."""
    sine = mpmath.sin(angle)
    vector = [mpmath.cos(angle), sine * mpmath.cos(toward), sine * mpmath.sin(toward)]
    return np.asarray([float(v) for v in vector], dtype)


def exact_log(vector):
    """Tangent coordinates of a rounded unit vector, by the plain formula in 400 digits."""

    def coordinates(forward, horizontal, vertical):
        sine = mpmath.sqrt(horizontal**2 + vertical**2)
        factor = mpmath.atan2(sine, forward) / sine
        return [horizontal * factor, vertical * factor]

    return digits(coordinates, *vector)


ANGLES = [1e-30, 1e-12, 1e-8, 1e-5, 0.01, 0.011, 0.12, 0.13, 0.14, 0.5, 1.5, 2.0, 3.0, 3.14, 3.1415926]


@each_dtype
@pytest.mark.parametrize("angle", ANGLES)
def test_the_maps_of_the_sphere_are_exact_near_the_pole_and_near_its_antipode(dtype, angle):
    vector = at_angle(angle, dtype)
    exact = exact_log(vector)
    for found in (sphere_log(vector), sphere_log(torch.tensor(vector)).numpy()):
        assert found.dtype == dtype
        assert all(close(number, value, dtype) for number, value in zip(found, exact, strict=True))
    # what is rounded by one unit in the tangent plane moves by as much on the sphere, not by its square root
    back = sphere_exp(sphere_log(vector))
    np.testing.assert_allclose(back, vector, atol=8 * np.finfo(dtype).eps)
    tangent = np.asarray([angle * 0.6, -angle * 0.8], dtype)
    length = digits(lambda a, b: mpmath.sqrt(a * a + b * b), *tangent)
    expected = [mpmath.cos(length), *(mpmath.mpf(float(t)) * mpmath.sin(length) / length for t in tangent)]
    found = sphere_exp(tangent)
    assert found.dtype == dtype
    assert all(
        close(number, value, dtype, least=angle if angle > 1 else 1e-3 * angle)
        for number, value in zip(found, expected, strict=True)
    )
    assert np.linalg.norm(found.astype(np.float64)) == pytest.approx(1, abs=8 * float(np.finfo(dtype).eps))


@each_dtype
@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-6, 0.01, 0.011, 0.12, 0.13, 0.14, 1.0, 2.5, 3.1])
def test_one_map_of_the_sphere_undoes_the_other_in_their_derivatives_too(dtype, angle):
    tangent = torch.tensor([0.6 * angle, 0.8 * angle], dtype=TORCH[dtype])
    there = torch.autograd.functional.jacobian(sphere_exp, tangent).numpy().astype(np.float64)
    back = torch.autograd.functional.jacobian(sphere_log, sphere_exp(tangent)).numpy().astype(np.float64)
    # near the antipode one of them stretches by t / sin t, which multiplies rounding
    allowed = 64 * float(np.finfo(dtype).eps) * float(angle_over_sine(angle)) ** 2
    np.testing.assert_allclose(back @ there, np.eye(2), atol=allowed)
    # along the tangent the sphere is met at unit speed, across it at sin t / t
    along = there @ np.array([0.6, 0.8])
    across = there @ np.array([-0.8, 0.6])
    assert np.linalg.norm(along) == pytest.approx(1, abs=allowed)
    assert np.linalg.norm(across) == pytest.approx(1 / float(angle_over_sine(angle)), abs=allowed)


@each_dtype
def test_the_antipode_is_at_the_angle_pi_and_the_pole_at_0_with_derivatives_that_are_numbers(dtype):
    poles = np.asarray([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype)
    np.testing.assert_array_equal(sphere_log(poles), np.asarray([[0, 0], [math.pi, 0], [math.pi, 0]], dtype))
    np.testing.assert_array_equal(sphere_exp(np.zeros((1, 2), dtype)), [[1, 0, 0]])
    np.testing.assert_array_equal(gradients(sphere_log, poles, dtype), [[0, 1, 1], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(gradients(sphere_exp, np.zeros((1, 2)), dtype), [[1, 1]])
    tiny = 1e-160 if dtype == np.float64 else 1e-30
    behind = np.asarray([-1.0, 0.6 * tiny, 0.8 * tiny], dtype)
    np.testing.assert_allclose(sphere_log(behind), [0.6 * math.pi, 0.8 * math.pi], rtol=1e-6)


@each_dtype
def test_the_area_factor_of_the_sphere_is_finite_at_the_antipode_and_beyond(dtype):
    factors = angle_over_sine(np.asarray([math.pi, np.nextafter(dtype(math.pi), dtype(4))], dtype))
    assert np.isfinite(factors).all()
    assert (factors > 1e6).all()
    assert np.isfinite(gradients(angle_over_sine, [math.pi], dtype)).all()


@pytest.mark.parametrize("flatness", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_at_the_minimum_in_a_box_each_slope_is_0_or_leads_out_of_it(count, flatness):
    generator = np.random.default_rng(1)
    turn = np.linalg.qr(generator.standard_normal((60, count, count)))[0]
    precision = turn @ (np.geomspace(1, flatness, count)[:, None] * np.swapaxes(turn, 1, 2))
    centre = 2 * generator.standard_normal((60, count))
    low, high = -np.ones((60, count)), np.ones((60, count))
    low[:20, 0], high[40:, -1] = -np.inf, np.inf
    best = box_quadratic_minimum(precision, centre, low, high)
    slope = np.einsum("kij,kj->ki", precision, best - centre)
    assert ((low <= best) & (best <= high)).all()
    assert (slope[best > low] <= 1e-12).all()
    assert (slope[best < high] >= -1e-12).all()
    held = ((low <= centre) & (centre <= high)).all(axis=1)
    assert held.any()
    np.testing.assert_array_equal(best[held], centre[held])


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


def test_the_series_are_those_of_their_functions():
    whole = [math.factorial(k) for k in range(8)]
    assert pytest.approx([(-1) ** k / whole[2 * k + 1] for k in range(4)], rel=1e-15) == numerics.SINE_OVER_ANGLE
    assert pytest.approx([(-1) ** k / whole[2 * k] for k in range(4)], rel=1e-15) == numerics.COSINE
    exact = [math.comb(2 * k, k) / (4**k * (2 * k + 1)) for k in range(4)]
    assert pytest.approx(exact, rel=1e-15) == numerics.ARCSINE_OVER_SINE
    # t / sin t times sin t / t is 1, in every power
    for power in range(4):
        terms = [numerics.ANGLE_OVER_SINE[k] * numerics.SINE_OVER_ANGLE[power - k] for k in range(power + 1)]
        assert math.fsum(terms) == pytest.approx(float(power == 0), abs=1e-17)


def test_guards_go_from_the_finest_to_the_coarsest():
    names = ["TINY", "SQUARABLE", "EPSILON", "ROUNDING", "SLACK", "HALF_DIGITS"]
    names += ["FLOAT32_ROUNDING", "EPSILON_FLOAT32", "COARSE_SLACK"]
    values = [getattr(numerics, name) for name in names]
    assert values == sorted(set(values))
    assert values[0] > 0
    assert values[-1] < 1e-5
    # what is squared, and the two roundings of a format
    assert numerics.SQUARABLE**2 > numerics.TINY
    assert 1 + numerics.EPSILON > 1
    assert 1 + numerics.EPSILON / 2 == 1
    assert pytest.approx(math.sqrt(numerics.EPSILON), rel=0.5) == numerics.HALF_DIGITS


def test_along_an_edge_of_the_box_the_minimum_is_the_best_there():
    precision = np.array([[[1.0, 0.99], [0.99, 1.0]]])
    centre, low, high = np.array([[3.0, -1.0]]), np.full((1, 2), -1.0), np.ones((1, 2))
    inside = np.array([[0.4, 0.2]])
    np.testing.assert_array_equal(box_quadratic_minimum(precision, inside, low, high), inside)
    # the first coordinate stands at its bound, the other at its best there
    np.testing.assert_allclose(box_quadratic_minimum(precision, centre, low, high), [[1.0, 0.98]], rtol=1e-12)
    # also of what depends on the sum of the coordinates alone
    np.testing.assert_allclose(box_quadratic_minimum(np.ones((1, 2, 2)), centre + 2, low, high), [[1.0, 1.0]])


def test_normalised_weights_know_no_scale_and_refuse_what_is_no_number():
    values = np.array([0.0, 1.0, -2.0, -np.inf])
    expected = np.exp(values) / np.exp(values).sum()
    for shift in (-1e5, 0.0, 1e5):
        np.testing.assert_allclose(normalised_weights(values + shift), expected, rtol=1e-9)
    for bad in ([math.nan, 0.0], [math.inf, 0.0], [-math.inf, -math.inf], []):
        with pytest.raises(ValueError, match="normalised"):
            normalised_weights(bad)


def test_effective_counts_are_the_square_of_the_sum_over_the_sum_of_squares():
    weights = np.array([3.0, 1.0, 0.0])
    assert effective_count(weights) == pytest.approx(16 / 10)
    assert effective_count(weights * 1e200) == pytest.approx(16 / 10)
    assert effective_sample_size(np.log([3.0, 1.0, 0.5])) == pytest.approx(4.5**2 / 10.25 / 3)
    assert effective_sample_size(np.log([3.0, 1.0]) + 1e5) == pytest.approx(16 / 10 / 2)
    assert effective_sample_size(np.r_[0.0, np.full(9, -np.inf)]) == pytest.approx(0.1)
    assert effective_count(np.full(7, 1e-300)) == pytest.approx(7)
    assert effective_sample_size([]) == effective_sample_size(np.full(3, -np.inf)) == 0.0
    assert effective_count([]) == effective_count(np.zeros(3)) == 0.0


def test_the_least_eigenvalue_is_lowered_besides_and_eigenvectors_stay():
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    matrix = turn @ np.diag([2.0, 5.0]) @ turn.T
    found = clipped_eigenvalues(matrix[None], np.array([0.5]), np.array([4.0]), np.array([1.5]))
    np.testing.assert_allclose(found[0], turn @ np.diag([1.5, 4.0]) @ turn.T, rtol=1e-12)
    np.testing.assert_array_equal(found, np.swapaxes(found, -1, -2))
    np.testing.assert_allclose(clipped_eigenvalues(matrix, 0.5), matrix, rtol=1e-12)
    skewed = matrix + np.array([[0.0, 0.3], [-0.3, 0.0]])
    np.testing.assert_allclose(clipped_eigenvalues(skewed, 0.5), matrix, rtol=1e-12)


def test_a_systematic_draw_of_whole_shares_is_exact_and_one_offset_moves_all():
    class Fixed:
        def __init__(self, value):
            self.value = value

        def uniform(self):
            return self.value

    weights = np.array([1.0, 0.0, 2.0, 1.0])
    for offset in (0.0, 0.5, 0.999):
        assert systematic_draw(weights, 4, Fixed(offset)).tolist() == [0, 2, 2, 3]
    assert systematic_draw(weights, 2, Fixed(0.0)).tolist() == [0, 2]
    assert systematic_draw(weights, 2, Fixed(0.6)).tolist() == [2, 3]
    # rounding of the last place never leads past the last index
    assert systematic_draw(weights, 1, Fixed(1.0)).tolist() == [3]


def test_an_angle_inside_its_turn_keeps_every_bit():
    angles = np.random.default_rng(5).uniform(0, 2 * math.pi, 1000)
    np.testing.assert_array_equal(wrap_turn(angles), angles)
    np.testing.assert_array_equal(wrap_angle(angles - math.pi), angles - math.pi)
    # added and taken away, half a radian would cost the last bits of small ones
    small = np.random.default_rng(7).uniform(-1.5, 1.5, 1000) / 3
    assert (small + 0.5 - 0.5 != small).any()
    np.testing.assert_array_equal(wrap_turn(small, -0.5), small)
    assert wrap_turn(5.0, 5.0) == 5.0
    assert float(wrap_turn(4.999, 5.0)) == pytest.approx(4.999 + 2 * math.pi)


def test_unit_vectors_are_along_the_last_axis_of_any_number():
    np.testing.assert_allclose(unit_vectors([3.0, 4.0]), [0.6, 0.8])
    np.testing.assert_allclose(unit_vectors(np.full((2, 2, 2, 1), -7.0)), -np.ones((2, 2, 2, 1)))


def test_clipped_matrices_of_any_batch_are_symmetric_to_the_last_bit_and_those_of_the_symmetric_part():
    generator = np.random.default_rng(6)
    root = generator.standard_normal((5, 20, 3, 3))
    matrices, skew = root @ np.swapaxes(root, -1, -2), generator.standard_normal((5, 20, 3, 3))
    found = clipped_eigenvalues(matrices + skew - np.swapaxes(skew, -1, -2), np.full((5, 20), 0.2), 2.0)
    np.testing.assert_array_equal(found, np.swapaxes(found, -1, -2))
    np.testing.assert_allclose(found, clipped_eigenvalues(matrices, 0.2, 2.0), atol=1e-12)
    values, expected = np.linalg.eigvalsh(found), np.clip(np.linalg.eigvalsh(matrices), 0.2, 2.0)
    np.testing.assert_allclose(values, expected, atol=1e-12)
