"""Log-space and safe primitives, and all guards against rounding, each with its reason.

Functions take and return numpy arrays or torch tensors, and keep float32 and float64; everything else becomes float64.
Where one selects between two formulas, each gets only input in its domain: the derivative of the other formula would
otherwise be NaN times zero.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device, is_torch_array

FULL_TURN = 2 * math.pi

# Series in the square of a small angle t, or of its sine s: there the plain quotients are 0 / 0, and their derivatives
# differences of large numbers.
ANGLE_OVER_SINE = (1.0, 1 / 6, 7 / 360, 31 / 15120)
ARCSINE_OVER_SINE = (1.0, 1 / 6, 3 / 40, 5 / 112)
SINE_OVER_ANGLE = (1.0, -1 / 6, 1 / 120, -1 / 5040)
COSINE = (1.0, -1 / 2, 1 / 24, -1 / 720)

# Guards, from the finest to the coarsest. Modules rename them where another name is clearer.
# The smallest normal float64: a quotient by at least this is finite for numerators of up to about 1.
TINY = float(np.finfo(np.float64).tiny)
# Squares of numbers below this underflow.
SQUARABLE = 1e-150
# Relative spacing of float64 and of float32 near 1, and an upper bound of rounding to float32, which is half of that.
EPSILON = float(np.finfo(np.float64).eps)
EPSILON_FLOAT32 = float(np.finfo(np.float32).eps)
FLOAT32_ROUNDING = 1e-7
# Relative difference of two float64 results by different sequences of about a hundred operations.
ROUNDING = 1e-12
# Relative slack of conditions that hold by construction: sums, differences and conversions cost a few digits.
SLACK = 1e-9
# Half of the digits, as of a difference of squares or of an angle from its cosine near 1.
HALF_DIGITS = 1e-8
# Curvature below what the rounding of a product of three matrices can add or take, relative to that of the same axis.
CURVATURE = 8 * EPSILON
# Relative slack of values from float32 or from handwritten decimals.
COARSE_SLACK = 1e-6


def logsumexp(values: Any, axis: int | None = None, weights: Any | None = None) -> Any:
    r"""Logarithm of a sum of exponentials, $\log \sum_i w_i e^{a_i}$.

    Rows that are all -inf give -inf without a warning and have derivative 0; a +inf gives +inf, likewise.

    Arguments:
        values: Exponents a, any shape.
        axis: Axis of the sum; None sums all.
        weights: Factors w >= 0 that broadcast with `values`.
    """
    xp, values = _floats(values)
    if axis is None:
        weights = None if weights is None else xp.reshape(xp.broadcast_to(_as(weights, values), values.shape), (-1,))
        values, axis = xp.reshape(values, (-1,)), 0
    if not values.shape[axis]:
        return _scalar(xp.sum(values, axis=axis) - math.inf)
    peak = _constant(xp.max(values, axis=axis, keepdims=True))
    finite = xp.isfinite(peak)
    if not bool(xp.all(finite)):
        values = xp.where(finite, values, xp.zeros_like(values))
    shift = xp.where(finite, peak, xp.zeros_like(peak))
    terms = xp.exp(values - shift)
    if weights is not None:
        terms = terms * _as(weights, values)
    total = xp.sum(terms, axis=axis, keepdims=True)
    some = finite & (total > 0)
    logarithm = xp.log(xp.where(some, total, xp.ones_like(total))) + shift
    otherwise = xp.where(finite, xp.full_like(peak, -math.inf), peak)
    return _scalar(xp.squeeze(xp.where(some, logarithm, otherwise), axis=axis))


def safe_divide(numerator: Any, denominator: Any, otherwise: float = 0.0) -> Any:
    """Quotient, with `otherwise` (and derivative 0) where the denominator is zero."""
    xp, numerator, denominator = _floats(numerator, denominator)
    zero = denominator == 0
    quotient = numerator / xp.where(zero, xp.ones_like(denominator), denominator)
    return xp.where(zero, xp.full_like(quotient, otherwise), quotient)


def safe_sqrt(values: Any) -> Any:
    """Square root, 0 (and derivative 0) where the value is not positive: at 0 the derivative would be infinite."""
    xp, values = _floats(values)
    none = values <= 0
    root = xp.sqrt(xp.where(none, xp.ones_like(values), values))
    return _scalar(xp.where(none, xp.zeros_like(values), root))


def safe_norm(vectors: Any, axis: int = -1) -> Any:
    """Euclidean lengths that neither overflow nor lose small vectors; derivative 0 at the zero vector."""
    xp, vectors = _floats(vectors)
    with np.errstate(over="ignore"):
        squared = xp.sum(vectors * vectors, axis=axis)
    information = xp.finfo(vectors.dtype)
    # squares this large keep their digits
    kept = (squared > information.smallest_normal / information.eps) & xp.isfinite(squared)
    if bool(xp.all(kept)):
        return xp.sqrt(squared)
    largest = _constant(xp.max(xp.abs(vectors), axis=axis, keepdims=True))
    scalable = (largest > 0) & xp.isfinite(largest)
    scale = xp.where(scalable, largest, xp.ones_like(largest))
    scaled = vectors / scale
    length = safe_sqrt(xp.sum(scaled * scaled, axis=axis, keepdims=True))
    return xp.squeeze(length * scale, axis=axis)


def unit_vectors(vectors: Any, axis: int = -1) -> Any:
    """Vectors of length 1 along `axis`; the zero vector stays zero."""
    xp, vectors = _floats(vectors)
    return safe_divide(vectors, xp.expand_dims(safe_norm(vectors, axis), axis=axis))


def wrap_angle(angle_rad: Any) -> Any:
    """Equivalent angle in [-pi, pi) [rad]; an angle in the interval is not changed."""
    return wrap_turn(angle_rad, -math.pi)


def wrap_turn(angle_rad: Any, start_rad: float = 0.0) -> Any:
    """Equivalent angle in [start, start + 2 pi) [rad]; an angle in the interval is not changed."""
    xp, angle = _floats(angle_rad)
    past = angle - start_rad
    turned = xp.remainder(past, FULL_TURN)
    # the remainder of a tiny negative number rounds to the full turn, that of what is inside is itself
    wrapped = start_rad + xp.where(turned >= FULL_TURN, turned - FULL_TURN, turned)
    return _scalar(xp.where(turned == past, angle, wrapped))


def circular_difference(first_rad: Any, second_rad: Any) -> Any:
    """Signed difference from the second angle to the first one, in [-pi, pi) [rad]."""
    _, first, second = _floats(first_rad, second_rad)
    return wrap_angle(first - second)


def sphere_log(local: Any) -> Any:
    """Tangent coordinates at the pole (1, 0, 0) of unit vectors: (..., 3) to (..., 2) [rad].

    Their length is the angle from the pole: a plain arc cosine loses half of its digits there. Near it the ratio of
    angle and sine comes from its series. The antipode has no direction: it is put at (pi, 0), derivative 0.
    """
    xp, local = _floats(local)
    forward, sideways = local[..., 0], local[..., 1:]
    squared = xp.sum(sideways * sideways, axis=-1)
    near = (squared < _series_limit(squared)) & (forward > 0)
    lost = xp.all(sideways == 0, axis=-1) & ~near
    sine = safe_norm(xp.where((near | lost)[..., None], xp.ones_like(sideways), sideways))
    ratio = xp.where(near, _series(squared, ARCSINE_OVER_SINE), xp.atan2(sine, forward) / sine)
    antipode = xp.stack([xp.full_like(forward, math.pi), xp.zeros_like(forward)], axis=-1)
    return xp.where(lost[..., None], antipode, sideways * ratio[..., None])


def sphere_exp(tangent: Any) -> Any:
    """Unit vectors from tangent coordinates at the pole (1, 0, 0), (..., 2) [rad] to (..., 3); inverts `sphere_log`."""
    xp, tangent = _floats(tangent)
    squared = xp.sum(tangent * tangent, axis=-1)
    near = squared < _series_limit(squared)
    angle = xp.sqrt(xp.where(near, xp.ones_like(squared), squared))
    ratio = xp.where(near, _series(squared, SINE_OVER_ANGLE), xp.sin(angle) / angle)
    cosine = xp.where(near, _series(squared, COSINE), xp.cos(angle))
    return xp.concat([cosine[..., None], tangent * ratio[..., None]], axis=-1)


def angle_over_sine(angle_rad: Any) -> Any:
    """t / sin t for 0 <= t <= pi: the area factor of the sphere's exponential map; 1 at 0, large and finite at pi."""
    xp, angle = _floats(angle_rad)
    squared = angle * angle
    near = squared < _series_limit(squared)
    # the sine of t, not of pi - t with a rounded pi, is exact up to the antipode
    sine = xp.sin(xp.where(near, xp.ones_like(angle), angle))
    far = angle / xp.maximum(sine, xp.full_like(sine, xp.finfo(angle.dtype).eps))
    return _scalar(xp.where(near, _series(squared, ANGLE_OVER_SINE), far))


def normalised_weights(log_weights: Any) -> np.ndarray:
    """Weights exp(a) scaled to sum to 1, shape (N,).

    Raises:
        ValueError: No log-weight is finite, or one is NaN or +inf.
    """
    log_weights = np.asarray(log_weights, dtype=np.float64)
    peak = log_weights.max(initial=-np.inf)
    if not np.isfinite(peak):
        raise ValueError("weights cannot be normalised: no finite largest log-weight")
    weights = np.exp(log_weights - peak)
    return weights / weights.sum()


def effective_count(weights: Any) -> float:
    r"""Effective number of weights, $(\sum w)^2 / \sum w^2$; 0 where all are 0."""
    weights = np.asarray(weights, dtype=np.float64)
    if not weights.any():
        return 0.0
    scaled = weights / weights.max()
    return float(scaled.sum() ** 2 / np.square(scaled).sum())


def effective_sample_size(log_weights: Any) -> float:
    r"""ESS $= (\sum w)^2 / (N \sum w^2)$ as a share of N, between 0 and 1."""
    log_weights = np.asarray(log_weights, dtype=np.float64)
    if not len(log_weights) or not np.isfinite(log_weights.max()):
        return 0.0
    return effective_count(np.exp(log_weights - log_weights.max())) / len(log_weights)


def systematic_draw(weights: Any, count: int, generator: np.random.Generator) -> np.ndarray:
    """Ascending indices of `count` draws in proportion to weights (N,), one in each of equal shares of their sum.

    Every index is drawn its expected number of times, rounded up or down (systematic resampling; Kitagawa 1996).
    """
    cumulated = np.cumsum(weights)
    places = (np.arange(count) + generator.uniform()) / count * cumulated[-1]
    return np.minimum(np.searchsorted(cumulated, places, side="right"), len(cumulated) - 1)


def clipped_eigenvalues(matrices: np.ndarray, low: Any, high: Any = np.inf, smallest: Any = np.inf) -> np.ndarray:
    """Symmetric matrices (..., n, n) with their eigenvalues clipped to [low, high], each (...).

    The least eigenvalue is also lowered to at most `smallest` (...). The result maximises the Gaussian log-likelihood
    under these bounds, as lowering the least eigenvalue costs least.
    """
    symmetric = (matrices + np.swapaxes(matrices, -1, -2)) / 2
    values, vectors = np.linalg.eigh(symmetric)
    values = np.clip(values, np.asarray(low)[..., None], np.asarray(high)[..., None])
    values[..., 0] = np.minimum(values[..., 0], smallest)
    rebuilt = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return (rebuilt + np.swapaxes(rebuilt, -1, -2)) / 2


def box_quadratic_minimum(precision: np.ndarray, centre: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    r"""Minimisers of $(x - c)^T P (x - c)$ in boxes, which may be open: (K, n, n), (K, n) to (K, n).

    The minimum is that of one face of the box without its edges, of which there are 3^n with the inside: all are tried.
    """
    point = np.clip(centre, low, high)
    if np.array_equal(point, centre):
        return point
    free = np.full_like(centre, np.inf)
    faces = itertools.product(*np.stack([low.T, free.T, high.T], axis=1))
    edge = np.stack([np.stack(face, axis=1) for face in faces])
    held = np.isfinite(edge)
    # some roundings more of curvature: what is flat in float64 has a minimum too
    curved = precision + CURVATURE * np.einsum("kii,ij->kij", precision, np.eye(len(centre.T)))
    slopes = np.where(held[..., None], np.eye(len(centre.T)), curved)
    away = np.linalg.solve(slopes, np.where(held, edge - centre, 0.0)[..., None]).squeeze(-1)
    points = np.where(held, edge, np.clip(centre + away, low, high))
    cost = np.einsum("fki,kij,fkj->fk", points - centre, precision, points - centre)
    return points[cost.argmin(axis=0), np.arange(len(centre))]


def _floats(*values: Any) -> tuple[Any, ...]:
    """The namespace of the arrays, and the values as floating arrays of one dtype on one device."""
    tensors = [value for value in values if is_torch_array(value)]
    if tensors:
        xp = array_namespace(*tensors)
        dtype = functools.reduce(xp.result_type, [tensor.dtype for tensor in tensors])
        dtype = dtype if xp.isdtype(dtype, "real floating") else xp.float64
        like = xp.zeros((), dtype=dtype, device=device(tensors[0]))
        return xp, *(_as(value, like) for value in values)
    arrays = [value for value in values if isinstance(value, np.ndarray | np.generic)]
    single = bool(arrays) and all(value.dtype == np.float32 for value in arrays)
    dtype = np.float32 if single else np.float64
    converted = [np.asarray(value, dtype=dtype) for value in values]
    return _namespace(converted[0]), *converted


def _namespace(array: Any) -> Any:
    """Array API namespace of an array, for numpy from version 2 on numpy itself."""
    if isinstance(array, np.ndarray) and hasattr(np, "__array_namespace_info__"):
        return np  # its twin in array_api_compat imports all parts of numpy, and their tests
    return array_namespace(array)


def _as(value: Any, like: Any) -> Any:
    """A value as an array of the dtype and on the device of another."""
    if is_torch_array(value):
        return value.to(like)
    return _namespace(like).asarray(value, dtype=like.dtype, device=device(like))


def _constant(values: Any) -> Any:
    """The values without derivatives."""
    return values.detach() if is_torch_array(values) else values


def _scalar(values: Any) -> Any:
    """A numpy scalar for an array without axes; everything else unchanged."""
    return values[()] if isinstance(values, np.ndarray) else values


def _series_limit(values: Any) -> float:
    """Squared angle below which four terms of a series in the square, and their derivative, are exact."""
    return float(_namespace(values).finfo(values.dtype).eps) ** 0.25


def _series(squared: Any, coefficients: tuple[float, ...]) -> Any:
    """A polynomial in the square of an angle, by Horner's rule."""
    return functools.reduce(lambda total, coefficient: coefficient + squared * total, reversed(coefficients))
