"""Means over scenes with their intervals, paired differences, and ratios of means.

Scenes of one group share random draws, as the poses of one mesh: the spread of a mean is that of leaving out one group
after the other (jackknife; Efron and Tibshirani 1993, ch. 11). Intervals are Student's t; as scores are skewed, the end
towards which their mean is skewed is where Hall (1992, "On the removal of skewness by transformation") has it, if that
is further out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from lidardesign.errors import NumericalError

LEVEL = 0.95
FEW_GROUPS = 10  # with fewer of them intervals are wide, and of skewed scores they hold less than their level
UNLIMITED = (-math.inf, math.inf)
PERCENT = 100.0


class Interval(NamedTuple):
    """A mean with the ends of its interval; the ends are None for a single group."""

    mean: float
    low: float | None
    high: float | None


def mean_interval(
    values: Any, groups: Any = None, *, limits: tuple[float, float] = UNLIMITED, level: float = LEVEL
) -> Interval:
    """The mean over scenes with its interval over groups.

    Values that are all equal in two groups or more give an interval without width. Of groups of unequal sizes as many
    count as groups of one size would be worth.

    Arguments:
        values: One per scene, shape (S,).
        groups: The number of each scene's group, from 0, shape (S,); None: every scene is its own.
        limits: The least and the largest value that there can be; no end lies beyond.
        level: The share of intervals that hold the mean over all scenes that there could be.

    Raises:
        NumericalError: No values, or one that is not finite, or groups of other scenes.
    """
    values = np.asarray(values, dtype=np.float64)
    groups = np.arange(values.size) if groups is None else np.asarray(groups)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all() or groups.shape != values.shape:
        raise NumericalError(
            f"an interval needs finite values and a group, one per scene; found shapes {values.shape}, {groups.shape}",
            where="statistics",
        )
    counts, mean = np.bincount(groups), float(values.mean())
    if len(counts) == 1:
        return Interval(mean, None, None)
    if (values == values[0]).all():
        return Interval(*[float(values[0])] * 3)
    # by how much the mean moves without a group, times the number of the others
    moved = (np.bincount(groups, values) - mean * counts) / (len(values) - counts) * (len(counts) - 1)
    error = math.sqrt(np.square(moved).sum() / (len(moved) * (len(moved) - 1)))
    degrees = max(len(values) ** 2 / np.square(counts).sum() - 1, 1.0)
    return student_interval(mean, error, degrees, skewness_of_mean(moved), limits=limits, level=level)


def skewness_of_mean(values: np.ndarray) -> float:
    """The skewness of the mean of values with mean 0, (N,), as other draws would have it; 0 of two."""
    squares, count = float(np.square(values).sum()), len(values)
    if count == 2 or squares == 0:
        return 0.0
    return float((values**3).sum()) / squares**1.5 * math.sqrt(count * (count - 1)) / (count - 2)


def student_interval(
    mean: float,
    error: float,
    degrees: float,
    skewness: float = 0.0,
    *,
    limits: tuple[float, float] = UNLIMITED,
    level: float = LEVEL,
) -> Interval:
    """Student's t interval of a mean, with the end towards which the mean is skewed further out.

    Arguments:
        mean: The mean.
        error: Its standard error.
        degrees: Degrees of freedom, which may be fractional.
        skewness: Of the mean.
        limits: The least and the largest value that there can be; no end lies beyond, except for the mean's sake.
        level: The share that the interval holds.
    """
    reach = float(stdtrit(degrees, (1 + level) / 2))
    low, high = (max(reach, -sign * _straightened(-sign * reach, skewness / 3)) for sign in (-1.0, 1.0))
    return Interval(mean, min(max(mean - error * low, limits[0]), mean), max(min(mean + error * high, limits[1]), mean))


def _straightened(quantile: float, bend: float) -> float:
    """The t statistic at which Hall's transform, a cubic without the bend, has a quantile."""
    return quantile if bend == 0 else float(np.cbrt(1 + 3 * bend * (quantile - bend / 2)) - 1) / bend


def paired_difference(
    first: Any, second: Any, groups: Any = None, *, limits: tuple[float, float] = UNLIMITED, level: float = LEVEL
) -> Interval:
    """The mean of first - second over the same scenes, shapes (S,), with its interval as `mean_interval` has it.

    `limits` are those of the values; a difference is at most their span.

    Raises:
        NumericalError: The two are not of the same scenes, or hold values that are not finite.
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if first.shape != second.shape:
        raise NumericalError(f"{first.shape} and {second.shape} values do not pair", where="statistics")
    return mean_interval(first - second, groups, limits=spanned(limits), level=level)


def worst_tenth(values: np.ndarray, better: str) -> float:
    """The mean of the worst tenth of values, (N,), and of the worst one at least; `better` is lower or higher."""
    ordered = np.sort(values)[:: -1 if better == "lower" else 1]
    return float(ordered[: math.ceil(len(ordered) / 10)].mean())


def spanned(limits: tuple[float, float]) -> tuple[float, float]:
    """The limits of differences of values within limits."""
    return limits[0] - limits[1], limits[1] - limits[0]


def log_ratios(first: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """Values, (...), whose mean is the logarithm of mean(first) / mean(second), and which spread as it does.

    They are the logarithm with the influence of every value on it (delta method). None where a mean is not above 0.
    """
    over, under = float(np.mean(first)), float(np.mean(second))
    return np.log(over / under) + first / over - second / under if min(over, under) > 0 else None


def relative_difference(first: Any, second: Any, groups: Any = None) -> Interval | None:
    """By how much the mean of first is above that of second [%], by logarithms; None where a mean is not above 0."""
    logs = log_ratios(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    return None if logs is None else as_percent(mean_interval(logs, groups))


def as_percent(interval: Interval) -> Interval:
    """The interval of a ratio less 1 [%] from that of its logarithm."""
    return Interval._make(None if one is None else PERCENT * math.expm1(one) for one in interval)
