r"""The M-step of origins: means in boxes, bounded covariances, and intervals that keep out of excluded boxes.

An interval x -+ z sigma along every axis keeps out of all excluded boxes exactly where it lies in one of the boxes
between them (see `origins`). Where the best parameters without this bound keep it, they are the best. Else every
component moves to the best place in one of a few of these boxes, or goes on from where it was, and keeps its old
parameters where it cannot gain, so that the likelihood never falls.

With S the scatter of a component's samples about their mean m, the best mean x and covariance C minimise
$f = \log |C| + \mathrm{tr}(C^{-1} (S + (m - x)(m - x)^T))$ with x -+ z sigma in the box [L, H] along every axis. Two
steps alternate, each exact, so that they end where nothing can be gained:

- With the correlations given, $1/C = D^{-1} Q D^{-1}$ with D = diag(sigma). In $p = 1/\sigma$ and
  $e = p\,(m - x)$ the objective $-2 \sum \log p_i + \sum Q_{ij} (p_i p_j S_{ij} + e_i e_j)$ is convex and the bounds
  $p\,(m - L) - e \ge z$ and $p\,(H - m) + e \ge z$ are linear: axis by axis, each in closed form.
- With the mean given, the covariance follows from Lagrange multipliers of its bounded variances.

They start from the samples' own moments with one axis after the other moved to its best, which is the best of all
where one axis alone is bounded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidardesign.numerics import SLACK, SQUARABLE, box_quadratic_minimum, clipped_eigenvalues

# Alternations of both steps: an iteration of the mixture starts where the one before ended, so the rest follows.
BOX_ALTERNATIONS = 2
# Updates of the Lagrange multipliers of bounded variances: the first is exact where one is bounded.
FORCE_ROUNDS = 6
# What rounding may leave of a narrow box counts as this wide, so that its inverse has a finite square [m].
SMALLEST_WIDTH_M = SQUARABLE
# Alternations between mean and covariance; each is exact, three reach rounding where both bind.
ALTERNATIONS = 3
# So many boxes are tried for each component, those in which the axes lose least one by one; of so many that a rough
# measure leaves.
BOXES_TRIED = 2
BOXES_SCORED = 8


class OriginLimits(NamedTuple):
    """Bounds on N origins along n free axes.

    Arguments:
        low, high: The box of the mean [m], shape (N, n).
        free_low, free_high: Boxes one of which holds the interval [m], may be infinite, shape (N, M, n); of limits
            `inside` given boxes the one that does, shape (N, n).
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

    @property
    def sides(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Low and high corners of the interval's box, then of the mean's."""
        return self.free_low, self.free_high, self.low, self.high

    def take(self, rows: np.ndarray) -> OriginLimits:
        """The limits of some origins."""
        return OriginLimits(*(value if isinstance(value, float) else value[rows] for value in self))

    def inside(self, boxes: np.ndarray) -> OriginLimits:
        """The limits inside each of the boxes (N, B) of an origin, one row per origin and box."""
        rows = np.repeat(np.arange(len(boxes)), boxes.shape[1])
        free_low, free_high = (side[rows, boxes.ravel()] for side in (self.free_low, self.free_high))
        low = np.maximum(self.low[rows], free_low)
        high = np.maximum(np.minimum(self.high[rows], free_high), low)
        bounds = self.least[rows], self.most[rows], self.thinnest[rows]
        return OriginLimits(low, high, free_low, free_high, self.interval, *bounds)


def moments_about(mean: np.ndarray, scatter: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Second moments about points (J, n) instead of the means, (J, n, n)."""
    away = mean - point
    return scatter + away[:, :, None] * away[:, None, :]


def objective(mean: np.ndarray, scatter: np.ndarray, point: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """log |C| + tr(C^-1 T) with T the moments about the point, (J,): minus twice the log-likelihood per sample."""
    about = moments_about(mean, scatter, point)
    return np.linalg.slogdet(covariance)[1] + np.einsum("kij,kji->k", np.linalg.inv(covariance), about)


def variances(covariance: np.ndarray) -> np.ndarray:
    """The diagonals, (J, n, n) to (J, n)."""
    return np.einsum("kii->ki", covariance)


def improve_in_boxes(
    mean: np.ndarray, scatter: np.ndarray, box: OriginLimits, point: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means (J, n) and covariances (J, n, n) whose intervals lie in their boxes, better than those they start from.

    Arguments:
        mean, scatter: Of the samples; the scatter is positive definite.
        box: Admitted parameters.
        point, covariance: The start; it need not keep the bounds.
    """
    bounds = box.least, box.most, box.thinnest
    for _ in range(BOX_ALTERNATIONS):
        point, scaled = _scaled(mean, scatter, box, point, covariance)
        about = moments_about(mean, scatter, point)
        most = np.square(np.minimum(point - box.free_low, box.free_high - point) / box.interval)
        tried = np.stack([scaled, _bounded(about, most)])
        many = [np.concatenate([one] * len(tried)) for one in (mean, scatter, point, most, *bounds)]
        flat = tried.reshape(-1, *covariance.shape[1:])
        flat = _narrowed(clipped_eigenvalues(flat, *many[4:]), many[3])
        best = objective(*many[:3], flat).reshape(len(tried), -1).argmin(axis=0)
        covariance = flat.reshape(tried.shape)[best, np.arange(len(mean))]
    return point, covariance


def project_into_boxes(mean: np.ndarray, scatter: np.ndarray, box: OriginLimits) -> tuple[np.ndarray, np.ndarray]:
    """The samples' moments with one axis after the other moved to its optimum inside the box, the worst first.

    The regressions of the other axes on it are kept.
    """
    point, covariance, rows = mean.copy(), scatter.copy(), np.arange(len(mean))
    for _ in range(mean.shape[1]):
        variance = variances(covariance)
        precision, shift = independent_axes(point, variance, box)
        axis = axis_losses(precision, shift, variance).argmax(axis=1)
        precision, shift = precision[rows, axis], shift[rows, axis]
        column, own = covariance[rows, :, axis], variance[rows, axis]
        point = point - column * (shift / precision / own)[:, None]
        excess = (own - 1 / np.square(precision)) / np.square(own)
        covariance = covariance - excess[:, None, None] * column[:, :, None] * column[:, None, :]
    return point, covariance


def independent_axes(mean: np.ndarray, variance: np.ndarray, box: OriginLimits) -> tuple[np.ndarray, np.ndarray]:
    """Inverse standard deviations p, and p times the shift from the mean, of axes as if independent, (J, n) each."""
    zero, one = np.zeros_like(variance), np.ones_like(variance)
    return _best_axis((variance, one, zero, zero), mean, box.sides, box)


def axis_losses(precision: np.ndarray, shift: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Increase of `objective` by the bounds of each axis, axes taken as independent, any shape; 0 where unbounded."""
    scale = np.square(precision) * variance
    return scale - np.log(scale) - 1 + np.square(shift)


def _bounded(about: np.ndarray, most: np.ndarray) -> np.ndarray:
    r"""The best covariances for moments T about given points, with variances of at most `most` (J, n).

    With Lagrange multipliers $\lambda_i \ge 0$ it solves $T = C + C \Lambda C$, so
    $C = 2\, T^{1/2} (1 + (1 + 4\, T^{1/2} \Lambda T^{1/2})^{1/2})^{-1} T^{1/2}$; along one axis
    $\lambda = (T - C) / C^2$, which is what is iterated.
    """
    values, vectors = np.linalg.eigh(about)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    force, covariance = np.zeros_like(most), about
    for _ in range(FORCE_ROUNDS):
        variance = variances(covariance)
        force = np.maximum(variance + force * np.square(variance) - most, 0.0) / np.square(most)
        stretch, axes = np.linalg.eigh((root * force[:, None]) @ root)
        spread = root @ (axes * np.sqrt(2 / (1 + np.sqrt(1 + 4 * np.maximum(stretch, 0.0))))[:, None])
        covariance = spread @ np.swapaxes(spread, 1, 2)
    return covariance


def _narrowed(covariance: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Covariances with variances of at most `most` (J, n), the other axes' regressions kept: nowhere larger."""
    for axis in range(covariance.shape[1]):
        column, variance = covariance[:, :, axis], covariance[:, axis, axis]
        excess = np.maximum(variance - most[:, axis], 0.0) / np.square(variance)
        covariance = covariance - excess[:, None, None] * column[:, :, None] * column[:, None, :]
    return covariance


def _scaled(
    mean: np.ndarray, scatter: np.ndarray, box: OriginLimits, point: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The best means and standard deviations inside the box, with the correlations of a covariance."""
    deviations = np.sqrt(variances(covariance))
    inverse = np.linalg.inv(covariance / (deviations[:, :, None] * deviations[:, None, :]))
    precision, shift = 1 / deviations, (mean - point) / deviations
    for axis in range(mean.shape[1]):
        others = inverse[:, axis].copy()
        others[:, axis] = 0.0
        own = inverse[:, axis, axis]
        linear = (others * precision * scatter[:, axis]).sum(axis=1)
        tilt = (others * shift).sum(axis=1)
        sides = tuple(side[:, axis] for side in box.sides)
        form = own * scatter[:, axis, axis], own, linear, tilt
        precision[:, axis], shift[:, axis] = _best_axis(form, mean[:, axis], sides, box)
    moved = np.clip(mean - shift / precision, box.low, box.high)
    ratio = 1 / precision / deviations
    return moved, covariance * ratio[:, :, None] * ratio[:, None, :]


def _best_axis(
    form: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    mean: np.ndarray,
    sides: tuple[np.ndarray, ...],
    box: OriginLimits,
) -> tuple[np.ndarray, np.ndarray]:
    r"""The p and e that minimise $-2 \log p + a p^2 + 2 b p + q e^2 + 2 c e$ inside the bounds, of one shape.

    For a given p the best e is -c / q clipped between lines in p, so what is left is convex in p: its minimum is
    that without bounds, that along one of the lines, or a corner between two; all are tried.

    Arguments:
        form: a, q, b and c.
        mean: Of the samples.
        sides: Ends of what the interval mean - e / p -+ z / p keeps to, then those of mean - e / p.
        box: For z and the largest variance.
    """
    square, shift_square, linear, shift_linear = form
    low, high, mean_low, mean_high = sides
    # lines e <= s p + t from below the mean, twice, and -e <= s p + t from above it, twice
    slopes = np.stack([mean - low, mean - mean_low, high - mean, mean_high - mean])
    shape = (4, *[1] * mean.ndim)
    offsets, signs = box.interval * np.reshape([-1.0, 0.0, -1.0, 0.0], shape), np.reshape([1.0, 1.0, -1.0, -1.0], shape)
    # The smallest p that the largest variance admits and at which the lower lines lie below the upper ones
    widths = np.maximum(slopes[[0, 0, 1]] + slopes[[2, 3, 2]], SMALLEST_WIDTH_M)
    factors = box.interval * np.reshape([2.0, 1.0, 1.0], (3, *[1] * (slopes.ndim - 1)))
    narrowest = 1 / np.sqrt(box.most).reshape(-1, *[1] * (slopes.ndim - 2))
    least = np.maximum((factors / widths).max(axis=0), narrowest)
    # a line that is nowhere near bends nothing
    bent = signs * np.where(np.isfinite(slopes), slopes, 0.0)
    first = np.concatenate([square[None], square + shift_square * np.square(bent)])
    second = np.concatenate([linear[None], linear + (shift_square * signs * offsets + shift_linear) * bent])
    # the positive root of first p^2 + second p = 1, without cancellation
    root = np.sqrt(np.square(second) + 4 * first)
    roots = np.where(second > 0, 2 / (root + np.abs(second)), (root - second) / (2 * first))
    steep, flat = slopes[::2], slopes[1::2]
    crossing = np.isfinite(steep) & (steep > flat)
    corners = np.where(crossing, box.interval / np.where(crossing, steep - flat, 1.0), roots[0])
    precision = np.maximum(np.concatenate([roots, corners, np.where(least > 0, least, roots[0])[None]]), least)
    ends = slopes[:, None] * precision + offsets[:, None]
    bottom = -ends[2:].min(axis=0)
    shift = np.minimum(np.maximum(-shift_linear / shift_square, bottom), np.maximum(ends[:2].min(axis=0), bottom))
    value = -2 * np.log(precision) + precision * (square * precision + 2 * linear)
    value += shift * (shift_square * shift + 2 * shift_linear)
    best = value.argmin(axis=0)[None]
    return np.take_along_axis(precision, best, axis=0)[0], np.take_along_axis(shift, best, axis=0)[0]


def best_origins(
    mean: np.ndarray,
    scatter: np.ndarray,
    limits: OriginLimits,
    old_mean: np.ndarray,
    old_covariance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Means (N, n) [m] and covariances (N, n, n) [m^2] at a likelihood that is the largest, or above the old one's.

    Arguments:
        mean, scatter: Of the samples, shape (N, n) and (N, n, n).
        limits: Admitted parameters.
        old_mean, old_covariance: Kept where they are admitted and nothing better is found.
    """
    point, covariance = _best_unconstrained(mean, scatter, limits)
    if not (np.isfinite(limits.free_low).any() or np.isfinite(limits.free_high).any()):
        return point, covariance
    rows = np.flatnonzero(~_holding(point, covariance, limits).any(axis=1))
    if len(rows):
        old = old_mean[rows], old_covariance[rows]
        point[rows], covariance[rows] = _between_boxes(mean[rows], scatter[rows], limits.take(rows), *old)
    return point, covariance


def _best_unconstrained(mean: np.ndarray, scatter: np.ndarray, limits: OriginLimits) -> tuple[np.ndarray, np.ndarray]:
    """The best mean in its box and covariance within its bounds, without excluded boxes."""
    bounds = limits.least, limits.most, limits.thinnest
    covariance = clipped_eigenvalues(scatter, *bounds)
    point = np.clip(mean, limits.low, limits.high)
    for _ in range(ALTERNATIONS):
        if np.array_equal(point, mean):
            break
        point = box_quadratic_minimum(np.linalg.inv(covariance), mean, limits.low, limits.high)
        covariance = clipped_eigenvalues(moments_about(mean, scatter, point), *bounds)
    return point, covariance


def _holding(point: np.ndarray, covariance: np.ndarray, limits: OriginLimits) -> np.ndarray:
    """Mask of the boxes that hold each interval, shape (N, M) bool."""
    reach = limits.interval * np.sqrt(np.maximum(variances(covariance), 0.0))
    low, high = (point - reach)[:, None], (point + reach)[:, None]
    slack = SLACK * reach[:, None]
    return ((low >= limits.free_low - slack) & (high <= limits.free_high + slack)).all(axis=2)


def _between_boxes(
    mean: np.ndarray, scatter: np.ndarray, limits: OriginLimits, old_mean: np.ndarray, old_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The best parameters of each origin in a few boxes, in the box of its old ones, or the old ones themselves."""
    floored = clipped_eigenvalues(scatter, limits.least)
    usable, held = _usable(old_mean, old_covariance, limits)
    boxes = np.concatenate([_candidate_boxes(mean, floored, limits), held[:, None]], axis=1)
    count, tried = boxes.shape
    many, rows = limits.inside(boxes), np.repeat(np.arange(count), tried)
    start, spread = project_into_boxes(mean[rows], floored[rows], many)
    again = np.flatnonzero(usable) * tried + tried - 1
    start[again], spread[again] = old_mean[usable], old_covariance[usable]
    point, covariance = improve_in_boxes(mean[rows], floored[rows], many, start, spread)
    value = objective(mean[rows], scatter[rows], point, covariance).reshape(count, tried)
    best = np.arange(count) * tried + value.argmin(axis=1)
    point, covariance = point[best], covariance[best]
    before = objective(mean[usable], scatter[usable], old_mean[usable], old_covariance[usable])
    kept = np.flatnonzero(usable)[before < value.min(axis=1)[usable]]
    point[kept], covariance[kept] = old_mean[kept], old_covariance[kept]
    return point, covariance


def _usable(point: np.ndarray, covariance: np.ndarray, limits: OriginLimits) -> tuple[np.ndarray, np.ndarray]:
    """Mask of the parameters within all bounds, and the first box that holds each (0 where none does), (N,) each."""
    holding = _holding(point, covariance, limits)
    values = np.linalg.eigvalsh(covariance)
    kept = (values[:, 0] > 0) & (values[:, -1] <= limits.most * (1 + SLACK))
    kept &= (values[:, 0] <= limits.thinnest * (1 + SLACK)) & holding.any(axis=1)
    slack = SLACK * np.sqrt(np.maximum(variances(covariance), 0.0))
    kept &= ((point >= limits.low - slack) & (point <= limits.high + slack)).all(axis=1)
    return kept, holding.argmax(axis=1)


def _candidate_boxes(mean: np.ndarray, scatter: np.ndarray, limits: OriginLimits) -> np.ndarray:
    """The few boxes of each origin with the smallest sum of `axis_losses`, shape (N, B)."""
    count, many = limits.free_low.shape[:2]
    boxes = np.broadcast_to(np.arange(many), (count, many))
    if many > BOXES_SCORED:
        # a rough cost of each box: the shift of the mean for a spread that fits
        centre, own = mean[:, None], variances(scatter)[:, None]
        widest = (limits.free_high - limits.free_low) / (2 * limits.interval)
        reach = limits.interval * np.minimum(np.sqrt(own), widest)
        lowest = np.maximum(limits.free_low + reach, limits.low[:, None])
        highest = np.minimum(limits.free_high - reach, limits.high[:, None])
        shifted = own + np.square(np.maximum(np.maximum(lowest - centre, centre - highest), 0.0))
        taken = np.minimum(shifted, np.square(widest))
        boxes = _lowest((np.log(taken / own) + shifted / taken).sum(axis=2), BOXES_SCORED)
    scored = boxes.shape[1]
    if scored <= BOXES_TRIED:
        return boxes
    rows = np.repeat(np.arange(count), scored)
    variance = variances(scatter)[rows]
    losses = axis_losses(*independent_axes(mean[rows], variance, limits.inside(boxes)), variance).sum(axis=1)
    return np.take_along_axis(boxes, _lowest(losses.reshape(count, scored), BOXES_TRIED), axis=1)


def _lowest(losses: np.ndarray, wanted: int) -> np.ndarray:
    """The columns of the smallest entries in each row, (N, M) to (N, wanted), the first where they tie."""
    return np.argsort(losses, axis=1, kind="stable")[:, :wanted]
