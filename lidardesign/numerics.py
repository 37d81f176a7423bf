"""Log-space and safe primitives: every guard against rounding lives here, with its reason."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

LOG_HALF = -math.log(2.0)


def logsumexp(values: Any, axis: int | None = None, weights: Any | None = None) -> Any:
    r"""Logarithm of a sum of exponentials, $\log \sum_i w_i e^{a_i}$.

    Rows that are all -inf give -inf without a warning; a +inf gives +inf.

    Arguments:
        values: Exponents a, any shape.
        axis: The axis that is summed; None sums all.
        weights: Factors w >= 0 that broadcast with `values`.
    """
    values = np.asarray(values, dtype=np.float64)
    peak = np.max(values, axis=axis, keepdims=True, initial=-np.inf)
    shift = np.where(np.isfinite(peak), peak, 0.0)
    with np.errstate(over="ignore", divide="ignore"):
        terms = np.exp(values - shift)
        total = np.sum(terms if weights is None else terms * weights, axis=axis, keepdims=True)
        result = np.log(total) + shift
    return result.reshape(())[()] if axis is None else np.squeeze(result, axis=axis)


def log1mexp(values: Any) -> np.ndarray:
    r"""$\log(1 - e^{a})$ for a <= 0, accurate at both ends (M. Maechler, 2012): -inf at a = 0."""
    values = np.asarray(values, dtype=np.float64)
    near = values > LOG_HALF
    with np.errstate(divide="ignore"):
        close = np.log(-np.expm1(np.where(near, values, -1.0)))
        far = np.log1p(-np.exp(np.where(near, -1.0, values)))
    return np.where(near, close, far)


def safe_divide(numerator: Any, denominator: Any, otherwise: float = 0.0) -> np.ndarray:
    """Quotient, with `otherwise` where the denominator is zero."""
    numerator, denominator = np.broadcast_arrays(np.asarray(numerator, float), np.asarray(denominator, float))
    zero = denominator == 0
    return np.where(zero, otherwise, numerator / np.where(zero, 1.0, denominator))


def wrap_angle(angle_rad: Any) -> np.ndarray:
    """The same angle in [-pi, pi) [rad]."""
    wrapped = np.mod(np.asarray(angle_rad, dtype=np.float64) + math.pi, 2 * math.pi) - math.pi
    # the remainder of a tiny negative number rounds to the full turn
    return np.where(wrapped >= math.pi, -math.pi, wrapped)


def circular_mean(angle_rad: Any, weights: Any | None = None) -> float:
    """Direction of the weighted mean of unit vectors, in [0, 2 pi) [rad]; 0 where they cancel."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    share = np.ones_like(angle) if weights is None else np.asarray(weights, dtype=np.float64)
    mean = math.atan2(float(np.sum(share * np.sin(angle))), float(np.sum(share * np.cos(angle)))) % (2 * math.pi)
    return 0.0 if mean >= 2 * math.pi else mean


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
    r"""The number of equal weights that are worth as much: $(\sum w)^2 / \sum w^2$; 0 where all are 0."""
    weights = np.asarray(weights, dtype=np.float64)
    largest = weights.max(initial=0.0)
    if largest <= 0:
        return 0.0
    scaled = weights / largest
    return float(scaled.sum() ** 2 / np.square(scaled).sum())


def effective_sample_size(log_weights: Any) -> float:
    r"""ESS $= (\sum w)^2 / (N \sum w^2)$ as a share of N, between 0 and 1."""
    log_weights = np.asarray(log_weights, dtype=np.float64)
    if not len(log_weights) or not np.isfinite(log_weights.max()):
        return 0.0
    return effective_count(np.exp(log_weights - log_weights.max())) / len(log_weights)


def systematic_draw(weights: Any, count: int, generator: np.random.Generator) -> np.ndarray:
    """Indices of `count` draws in proportion to weights (N,), ascending: one in each of equal shares of their sum.

    Every index is drawn its expected number of times, rounded up or down (systematic resampling; Kitagawa 1996).
    """
    cumulated = np.cumsum(weights)
    places = (np.arange(count) + generator.uniform()) / count * cumulated[-1]
    return np.minimum(np.searchsorted(cumulated, places, side="right"), len(cumulated) - 1)


def clipped_eigenvalues(matrices: np.ndarray, low: Any, high: Any = np.inf, smallest: Any = np.inf) -> np.ndarray:
    """Symmetric matrices (..., n, n) with their eigenvalues moved into [low, high], each (...).

    The least eigenvalue is lowered to at most `smallest` (...) besides. It is the maximiser of the Gaussian
    log-likelihood under these bounds, not a mere repair: lowering the least eigenvalue costs least.
    """
    symmetric = (matrices + np.swapaxes(matrices, -1, -2)) / 2
    values, vectors = np.linalg.eigh(symmetric)
    values = np.clip(values, np.asarray(low)[..., None], np.asarray(high)[..., None])
    values[..., 0] = np.minimum(values[..., 0], smallest)
    rebuilt = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return (rebuilt + np.swapaxes(rebuilt, -1, -2)) / 2


def nearest_positive_definite(covariance: np.ndarray, floor: float) -> np.ndarray:
    """The nearest symmetric matrix (Frobenius norm) whose eigenvalues are at least `floor`, (..., n, n)."""
    return clipped_eigenvalues(covariance, floor)


def box_quadratic_minimum(
    precision: np.ndarray, centre: np.ndarray, low: np.ndarray, high: np.ndarray, sweeps: int = 60
) -> np.ndarray:
    r"""Minimisers of $(x - c)^T P (x - c)$ in boxes, by exact coordinate descent: (K, n, n), (K, n) to (K, n).

    Convex, so coordinate descent converges to the one minimum; boxes that hold their centre are exact at once.
    """
    point = np.clip(centre, low, high)
    if np.array_equal(point, centre):
        return point
    diagonal = np.einsum("kii->ki", precision)
    for _ in range(sweeps):
        before = point.copy()
        for i in range(point.shape[1]):
            gradient = np.einsum("kj,kj->k", precision[:, i], point - centre)
            point[:, i] = np.clip(point[:, i] - gradient / diagonal[:, i], low[:, i], high[:, i])
        if np.array_equal(before, point):
            break
    return point
