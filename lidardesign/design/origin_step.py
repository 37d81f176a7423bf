r"""The M-step of origins: means in boxes, bounded covariances, and intervals that keep out of excluded boxes.

An interval x -+ z sigma along every axis keeps out of all excluded boxes just where it lies in one of the boxes
between them (see `origins`). Where the best parameters without this bound keep it, they are the best. Else every
component moves to the best place in one of a few of these boxes, or goes on from where it was, and keeps its old
parameters where it cannot gain, so that the likelihood never falls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidardesign.design.box_step import (
    Box,
    axis_losses,
    improved,
    independent_axes,
    moments_about,
    objective,
    projected,
    variances,
)
from lidardesign.numerics import SLACK, box_quadratic_minimum, clipped_eigenvalues

# Alternations between mean and covariance; each is exact, three reach rounding where both bind.
ALTERNATIONS = 3
# So many boxes are tried for each component, those in which the axes lose least one by one; of so many that a rough
# measure leaves.
BOXES_TRIED = 2
BOXES_SCORED = 8
# Parameters keep bounds up to this share of a standard deviation, by rounding.


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
        return Limits(*(value if isinstance(value, float) else value[rows] for value in self))

    def inside(self, boxes: np.ndarray) -> Box:
        """One row per origin and box of `boxes` (N, B), origin by origin."""
        rows = np.repeat(np.arange(len(boxes)), boxes.shape[1])
        free_low, free_high = (side[rows, boxes.ravel()] for side in (self.free_low, self.free_high))
        low = np.maximum(self.low[rows], free_low)
        high = np.maximum(np.minimum(self.high[rows], free_high), low)
        bounds = self.least[rows], self.most[rows], self.thinnest[rows]
        return Box(low, high, free_low, free_high, self.interval, *bounds)


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
    point, covariance = _anywhere(mean, scatter, limits)
    if not (np.isfinite(limits.free_low).any() or np.isfinite(limits.free_high).any()):
        return point, covariance
    rows = np.flatnonzero(~_holding(point, covariance, limits).any(axis=1))
    if len(rows):
        old = old_mean[rows], old_covariance[rows]
        point[rows], covariance[rows] = _between_boxes(mean[rows], scatter[rows], limits.take(rows), *old)
    return point, covariance


def _anywhere(mean: np.ndarray, scatter: np.ndarray, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """The best mean in its box and covariance between its bounds, wherever its interval lies."""
    bounds = limits.least, limits.most, limits.thinnest
    covariance = clipped_eigenvalues(scatter, *bounds)
    point = np.clip(mean, limits.low, limits.high)
    for _ in range(ALTERNATIONS):
        if np.array_equal(point, mean):
            break
        point = box_quadratic_minimum(np.linalg.inv(covariance), mean, limits.low, limits.high)
        covariance = clipped_eigenvalues(moments_about(mean, scatter, point), *bounds)
    return point, covariance


def _holding(point: np.ndarray, covariance: np.ndarray, limits: Limits) -> np.ndarray:
    """Which boxes hold which intervals, shape (N, M) bool."""
    reach = limits.interval * np.sqrt(np.maximum(variances(covariance), 0.0))
    low, high = (point - reach)[:, None], (point + reach)[:, None]
    slack = SLACK * reach[:, None]
    return ((low >= limits.free_low - slack) & (high <= limits.free_high + slack)).all(axis=2)


def _between_boxes(
    mean: np.ndarray, scatter: np.ndarray, limits: Limits, old_mean: np.ndarray, old_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters in the best of a few boxes for each origin, or better ones in the box of the old ones, or these."""
    floored = clipped_eigenvalues(scatter, limits.least)
    usable, held = _usable(old_mean, old_covariance, limits)
    boxes = np.concatenate([_promising(mean, floored, limits), held[:, None]], axis=1)
    count, tried = boxes.shape
    many, rows = limits.inside(boxes), np.repeat(np.arange(count), tried)
    start, spread = projected(mean[rows], floored[rows], many)
    again = np.flatnonzero(usable) * tried + tried - 1
    start[again], spread[again] = old_mean[usable], old_covariance[usable]
    point, covariance = improved(mean[rows], floored[rows], many, start, spread)
    value = objective(mean[rows], scatter[rows], point, covariance).reshape(count, tried)
    best = np.arange(count) * tried + value.argmin(axis=1)
    point, covariance = point[best], covariance[best]
    before = objective(mean[usable], scatter[usable], old_mean[usable], old_covariance[usable])
    kept = np.flatnonzero(usable)[before < value.min(axis=1)[usable]]
    point[kept], covariance[kept] = old_mean[kept], old_covariance[kept]
    return point, covariance


def _usable(point: np.ndarray, covariance: np.ndarray, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """Which parameters keep all bounds, shape (N,) bool, and the first box that holds them, or any, shape (N,)."""
    holding = _holding(point, covariance, limits)
    values = np.linalg.eigvalsh(covariance)
    kept = (values[:, 0] > 0) & (values[:, -1] <= limits.most * (1 + SLACK))
    kept &= (values[:, 0] <= limits.thinnest * (1 + SLACK)) & holding.any(axis=1)
    slack = SLACK * np.sqrt(np.maximum(variances(covariance), 0.0))
    kept &= ((point >= limits.low - slack) & (point <= limits.high + slack)).all(axis=1)
    return kept, holding.argmax(axis=1)


def _promising(mean: np.ndarray, scatter: np.ndarray, limits: Limits) -> np.ndarray:
    """A few boxes for each origin, those in which its axes lose least, one by one: shape (N, B)."""
    count, many = limits.free_low.shape[:2]
    boxes = np.broadcast_to(np.arange(many), (count, many))
    if many > BOXES_SCORED:
        boxes = _lowest(_rough_losses(mean, variances(scatter), limits), BOXES_SCORED)
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


def _rough_losses(mean: np.ndarray, variance: np.ndarray, limits: Limits) -> np.ndarray:
    """About what each box costs: the shift that makes room for a spread that fits, (N, n) to (N, M)."""
    centre, own = mean[:, None], variance[:, None]
    widest = (limits.free_high - limits.free_low) / (2 * limits.interval)
    reach = limits.interval * np.minimum(np.sqrt(own), widest)
    lowest = np.maximum(limits.free_low + reach, limits.low[:, None])
    highest = np.minimum(limits.free_high - reach, limits.high[:, None])
    shifted = own + np.square(np.maximum(np.maximum(lowest - centre, centre - highest), 0.0))
    taken = np.minimum(shifted, np.square(widest))
    return (np.log(taken / own) + shifted / taken).sum(axis=2)
