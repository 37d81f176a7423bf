r"""The M-step of origins: means in boxes, bounded covariances, and intervals that keep out of excluded boxes.

With S the scatter of a component's samples about their mean m, the best mean x and covariance C minimise
$f = \log |C| + \mathrm{tr}(C^{-1} (S + (m - x)(m - x)^T))$. An interval x -+ z sigma along every axis keeps out of
all excluded boxes just where it lies in one of the boxes between them (see `origins`). Where the best parameters
without this bound keep it, they are the best. Else every component moves to the best of a few of these boxes, and
keeps its old parameters where it cannot gain, so that the likelihood never falls.

Inside a box [L, H], two steps alternate:

- With the correlations given, $1/C = D^{-1} Q D^{-1}$ with D = diag(sigma). In $p = 1/\sigma$ and
  $e = p\,(m - x)$ the objective $-2 \sum \log p_i + \sum Q_{ij} (p_i p_j S_{ij} + e_i e_j)$ is convex and the bounds
  $p\,(m - L) - e \ge z$ and $p\,(H - m) + e \ge z$ are linear: axis by axis, each in closed form.
- With the mean given, the covariance is that of the samples about it; an axis i whose variance d bounds is scaled
  while the others keep their regressions on it, $C - (1 - d / C_{ii})\, C_i C_i^T / C_{ii}$: the best where one
  axis is bounded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidardesign.numerics import box_quadratic_minimum, clipped_eigenvalues

# Alternations between mean and covariance; each is exact, three reach rounding where both bind.
ALTERNATIONS = 3
# The same inside one of the boxes between excluded ones, and rounds over the axes in each: the next iteration of the
# mixture starts from where this one ended.
BOX_ALTERNATIONS = 2
AXIS_ROUNDS = 3
# So many boxes are tried for each component, those in which the axes lose least one by one.
BOXES_TRIED = 3
# Parameters keep bounds up to this share of the bound, by rounding.
ROUNDING = 1e-9


class Limits(NamedTuple):
    """Bounds on N origins along n free axes.

    Arguments:
        low, high: The box of the mean [m], shape (N, n).
        free_low, free_high: Boxes one of which holds the interval [m], shape (N, M, n).
        interval: Standard deviations on each side of the mean.
        least, most: Bounds on the variance along every direction [m^2], shape (N,).
        thinnest: The largest admitted variance along the thinnest direction [m^2], shape (N,).
    """

    low: np.ndarray
    high: np.ndarray
    free_low: np.ndarray
    free_high: np.ndarray
    interval: float
    least: np.ndarray
    most: np.ndarray
    thinnest: np.ndarray

    def take(self, rows: np.ndarray) -> Limits:
        """The limits of some origins."""
        arrays = [value if isinstance(value, float) else value[rows] for value in self]
        return Limits(*arrays)

    def inside(self, boxes: np.ndarray) -> Limits:
        """One row per origin and box of `boxes` (N, B), each with that box alone."""
        count, tried = boxes.shape
        rows = np.repeat(np.arange(count), tried)
        free_low, free_high = (side[rows, boxes.ravel()] for side in (self.free_low, self.free_high))
        low = np.maximum(self.low[rows], free_low)
        high = np.maximum(np.minimum(self.high[rows], free_high), low)
        return self.take(rows)._replace(low=low, high=high, free_low=free_low[:, None], free_high=free_high[:, None])


def best_origins(
    mean: np.ndarray,
    scatter: np.ndarray,
    limits: Limits,
    old_mean: np.ndarray,
    old_covariance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Means (N, n) [m] and covariances (N, n, n) [m^2] at a likelihood that is the largest, or above the old one's.

    Arguments:
        mean, scatter: Of the samples, shape (N, n) and (N, n, n).
        limits: Admitted parameters.
        old_mean, old_covariance: Kept where they are admitted and nothing better is found.
    """
    point, covariance = _in_the_box(mean, scatter, limits)
    if not (np.isfinite(limits.free_low).any() or np.isfinite(limits.free_high).any()):
        return point, covariance
    rows = np.flatnonzero(~_kept(point, covariance, limits))
    if len(rows):
        part = limits.take(rows)
        found = _in_some_box(mean[rows], scatter[rows], part)
        old = old_mean[rows], old_covariance[rows]
        point[rows], covariance[rows] = _better(mean[rows], scatter[rows], part, found, old)
    return point, covariance


def _in_the_box(mean: np.ndarray, scatter: np.ndarray, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """The best mean in its box and covariance between its bounds, wherever its interval lies."""
    bounds = limits.least, limits.most, limits.thinnest
    covariance = clipped_eigenvalues(scatter, *bounds)
    point = np.clip(mean, limits.low, limits.high)
    for _ in range(ALTERNATIONS):
        if np.array_equal(point, mean):
            break
        point = box_quadratic_minimum(np.linalg.inv(covariance), mean, limits.low, limits.high)
        covariance = clipped_eigenvalues(_about(mean, scatter, point), *bounds)
    return point, covariance


def _about(mean: np.ndarray, scatter: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Second moments about points (N, n) instead of the means."""
    away = mean - point
    return scatter + away[:, :, None] * away[:, None, :]


def _deviations(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("kii->ki", covariance))


def _kept(point: np.ndarray, covariance: np.ndarray, limits: Limits) -> np.ndarray:
    """Which intervals lie in one of their boxes, shape (N,) bool."""
    reach = limits.interval * _deviations(covariance)
    low, high = (point - reach)[:, None], (point + reach)[:, None]
    slack = ROUNDING * reach[:, None]
    return ((low >= limits.free_low - slack) & (high <= limits.free_high + slack)).all(axis=2).any(axis=1)


def _in_some_box(mean: np.ndarray, scatter: np.ndarray, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """Parameters inside the best of a few boxes for each origin."""
    count, many = limits.free_low.shape[:2]
    everywhere = limits.inside(np.tile(np.arange(many), (count, 1)))
    loss = _axis_losses(np.repeat(mean, many, axis=0), np.repeat(scatter, many, axis=0), everywhere)
    tried = min(BOXES_TRIED, many)
    boxes = np.argsort(loss.reshape(count, many), axis=1, kind="stable")[:, :tried]
    means, scatters = np.repeat(mean, tried, axis=0), np.repeat(scatter, tried, axis=0)
    point, covariance = _in_one_box(means, scatters, limits.inside(boxes))
    value = _objective(means, scatters, point, covariance).reshape(count, tried)
    best = np.arange(count) * tried + value.argmin(axis=1)
    return point[best], covariance[best]


def _axis_losses(mean: np.ndarray, scatter: np.ndarray, limits: Limits) -> np.ndarray:
    """What each box costs along its axes, as if these were independent, shape (N,)."""
    variance = np.maximum(np.einsum("kii->ki", scatter), limits.least[:, None])
    zero, one = np.zeros_like(variance), np.ones_like(variance)
    precision, shift = _best_axis(variance, one, zero, zero, mean, *_sides(limits), limits)
    return (-2 * np.log(precision) + np.square(precision) * variance + np.square(shift)).sum(axis=1)


def _sides(limits: Limits) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners of the only box and of the mean's, (N, n) each."""
    return limits.free_low[:, 0], limits.free_high[:, 0], limits.low, limits.high


def _in_one_box(mean: np.ndarray, scatter: np.ndarray, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """Parameters whose intervals lie in the only box of each origin."""
    bounds = limits.least, limits.most, limits.thinnest
    floored = clipped_eigenvalues(scatter, limits.least)
    point, covariance = _in_the_box(mean, scatter, limits)
    for _ in range(BOX_ALTERNATIONS):
        point, scaled = _scaled(mean, floored, point, covariance, limits)
        most = np.square(_room(point, limits))
        scaled = _narrowed(clipped_eigenvalues(scaled, 0.0, *bounds[1:]), most)
        fresh = _narrowed(clipped_eigenvalues(_about(mean, floored, point), *bounds), most)
        values = [_objective(mean, floored, point, one) for one in (scaled, fresh)]
        covariance = np.where((values[0] <= values[1])[:, None, None], scaled, fresh)
    return point, covariance


def _room(point: np.ndarray, limits: Limits) -> np.ndarray:
    """The largest standard deviation along each axis whose interval lies in the only box, (N, n)."""
    low, high, _, _ = _sides(limits)
    return np.minimum(point - low, high - point) / limits.interval


def _narrowed(covariance: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Covariances with variances of at most `most` (N, n), the other axes' regressions kept: nowhere larger."""
    for axis in range(covariance.shape[1]):
        column, variance = covariance[:, :, axis], covariance[:, axis, axis]
        excess = np.maximum(variance - most[:, axis], 0.0) / np.square(variance)
        covariance = covariance - excess[:, None, None] * column[:, :, None] * column[:, None, :]
    return covariance


def _scaled(
    mean: np.ndarray, scatter: np.ndarray, point: np.ndarray, covariance: np.ndarray, limits: Limits
) -> tuple[np.ndarray, np.ndarray]:
    """The best means and standard deviations inside the only box, with the correlations of a covariance."""
    deviations = _deviations(covariance)
    products = deviations[:, :, None] * deviations[:, None, :]
    inverse = np.linalg.inv(covariance / products)
    precision, shift = 1 / deviations, (mean - point) / deviations
    axes = range(mean.shape[1])
    for _ in range(AXIS_ROUNDS):
        for axis in axes:
            others = inverse[:, axis].copy()
            own = others[:, axis].copy()
            others[:, axis] = 0.0
            linear = (others * precision * scatter[:, axis]).sum(axis=1)
            tilt = (others * shift).sum(axis=1)
            one = [value[:, axis] for value in (mean, *_sides(limits))]
            best = _best_axis(own * scatter[:, axis, axis], own, linear, tilt, *one, limits)
            precision[:, axis], shift[:, axis] = best
    moved = np.clip(mean - shift / precision, limits.low, limits.high)
    ratio = 1 / precision / deviations
    return moved, covariance * ratio[:, :, None] * ratio[:, None, :]


def _best_axis(
    square: np.ndarray,
    shift_square: np.ndarray,
    linear: np.ndarray,
    shift_linear: np.ndarray,
    mean: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    mean_low: np.ndarray,
    mean_high: np.ndarray,
    limits: Limits,
) -> tuple[np.ndarray, np.ndarray]:
    r"""The p and e that minimise $-2 \log p + a p^2 + 2 b p + q e^2 + 2 c e$ inside the bounds.

    For a given p the best e is -c / q clipped between lines in p, so what is left is convex in p: its minimum is
    that without bounds, that along one of the lines, or a corner between two; all are tried.

    Arguments:
        square, shift_square, linear, shift_linear: a, q, b and c, of one shape.
        mean: Of the samples.
        low, high: Ends of what the interval mean - e / p -+ z / p keeps to.
        mean_low, mean_high: Ends of what mean - e / p keeps to.
        limits: For z and the largest variance.
    """
    z, most = limits.interval, limits.most
    # lines e <= s p + t from below the mean, and -e <= s p + t from above it
    below, above = ((mean - low, -z), (mean - mean_low, 0.0)), ((high - mean, -z), (mean_high - mean, 0.0))
    least = np.broadcast_to((1 / np.sqrt(most)).reshape(-1, *[1] * (mean.ndim - 1)), mean.shape)
    for slope, offset in below:
        for other, other_offset in above:
            width, needed = slope + other, -(offset + other_offset)
            if needed:
                # along a fixed width of zero nothing fits; rounding alone makes it so
                least = np.maximum(least, needed / np.maximum(width, np.finfo(np.float64).tiny))
    free = _stationary(square, linear)
    tried = [free, np.where(least > 0, least, free)]
    for side, sign in ((below, 1.0), (above, -1.0)):
        for slope, offset in side:
            used = np.isfinite(slope)
            s, t = sign * np.where(used, slope, 0.0), sign * offset
            first = square + shift_square * np.square(s)
            second = linear + shift_square * s * t + shift_linear * s
            tried.append(np.where(used, _stationary(first, second), free))
        steep, flat = side[0][0], side[1][0]
        crossing = np.isfinite(steep) & (steep > flat)
        tried.append(np.where(crossing, z / np.where(crossing, steep - flat, 1.0), free))
    precision = np.maximum(np.stack(tried), least)
    top = np.minimum(*(slope * precision + offset for slope, offset in below))
    bottom = np.maximum(*(-slope * precision - offset for slope, offset in above))
    shift = np.minimum(np.maximum(-shift_linear / shift_square, bottom), np.maximum(top, bottom))
    value = -2 * np.log(precision) + square * np.square(precision) + 2 * linear * precision
    value += shift_square * np.square(shift) + 2 * shift_linear * shift
    best = value.argmin(axis=0)[None]
    return np.take_along_axis(precision, best, axis=0)[0], np.take_along_axis(shift, best, axis=0)[0]


def _stationary(square: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """The positive root of a p^2 + b p = 1, without cancellation."""
    root = np.sqrt(np.square(linear) + 4 * square)
    return np.where(linear > 0, 2 / (root + np.abs(linear)), (root - linear) / (2 * square))


def _objective(mean: np.ndarray, scatter: np.ndarray, point: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """log |C| + tr(C^-1 T) with T the moments about the point, (N,): minus twice the log-likelihood per sample."""
    about = _about(mean, scatter, point)
    return np.linalg.slogdet(covariance)[1] + np.einsum("kij,kji->k", np.linalg.inv(covariance), about)


def _better(
    mean: np.ndarray,
    scatter: np.ndarray,
    limits: Limits,
    found: tuple[np.ndarray, np.ndarray],
    old: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """The found parameters, or the old ones where these are admitted and better."""
    point, covariance = old
    values = np.linalg.eigvalsh(covariance)
    usable = (values[:, 0] > 0) & (values[:, -1] <= limits.most * (1 + ROUNDING))
    usable &= (values[:, 0] <= limits.thinnest * (1 + ROUNDING)) & _kept(point, covariance, limits)
    slack = ROUNDING * _deviations(covariance)
    usable &= ((point >= limits.low - slack) & (point <= limits.high + slack)).all(axis=1)
    if usable.any():
        before = _objective(mean[usable], scatter[usable], point[usable], covariance[usable])
        after = _objective(mean[usable], scatter[usable], found[0][usable], found[1][usable])
        usable[usable] = before < after
    keep = usable[:, None]
    return np.where(keep, point, found[0]), np.where(keep[:, None], covariance, found[1])
