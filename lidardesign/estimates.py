"""Estimates: figures with their errors, means over scenes with their intervals, and ratios of means.

Standard errors follow from the influence of single samples (delta method; Owen 2013, "Monte Carlo theory, methods and
examples", ch. 9.2): the change of the figure is the mean of the influences. They hold for samples whose weights have a
finite variance; for weights with heavy tails they are too small, as the ESS is then too large.

Scenes of one group share random draws, as the poses of one mesh: the spread of a mean is that of leaving out one group
after the other (jackknife; Efron and Tibshirani 1993, ch. 11). Intervals are Student's t; as scores are skewed, the end
towards which their mean is skewed is where Hall (1992, "On the removal of skewness by transformation") has it, if that
is further out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from lidardesign.errors import NumericalError
from lidardesign.numerics import SLACK

# Kinds of errors in `Estimate.kind`.
STANDARD_ERROR = "standard error"
HALF_INTERVAL = "half of the 95 % interval"
ROUNDING = "rounding"
# Most digits of a printed figure.
MOST_DIGITS = 4
# Added to both counts of a share (Agresti and Coull), so that 0 of a few has an error.
ADDED = 2
LEVEL = 0.95
FEW_GROUPS = 10  # with fewer of them intervals are wide, and of skewed scores they hold less than their level
UNLIMITED = (-math.inf, math.inf)
PERCENT = 100.0


@dataclass(frozen=True)
class Estimate:
    """A figure and its error.

    Arguments:
        value: The figure, in `unit`; None where the error is the largest of many figures.
        error: Its error, in `unit`; None where it is unknown.
        unit: Unit, "" for shares and counts.
        kind: Kind of the error: a standard error, half an interval, or the largest rounding error.
    """

    value: float | None
    error: float | None
    unit: str = ""
    kind: str = STANDARD_ERROR

    def as_dict(self) -> dict[str, Any]:
        """JSON form of the estimate."""
        return asdict(self)


def as_documents(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """JSON form of named estimates, as in `error_estimates` of commands."""
    return {name: estimate.as_dict() for name, estimate in estimates.items()}


def figure_and_interval(value: float, low: float | None, high: float | None, *, sign: str = "") -> tuple[str, str, str]:
    """A figure and the ends of its interval as text: two digits of the half width, at most four of the largest.

    Arguments:
        value: The figure.
        low: The lower end; None where there is no interval, and the figure has three digits.
        high: The upper end.
        sign: `+` to print the sign of positive figures too.

    Returns:
        The figure, and both ends; dashes where there are none.
    """
    if low is None or high is None or not high > low:
        end = "-" if low is None else f"{low:.3g}"
        return f"{value:{sign}.3g}", end, end
    fine, largest = 1 - math.floor(math.log10((high - low) / 2)), max(abs(value), abs(low), abs(high))
    decimals = max(0, min(fine, MOST_DIGITS - 1 - math.floor(math.log10(largest))))
    # adding zero removes the sign of a rounded -0
    figure, *ends = (round(one, decimals) + 0.0 for one in (value, low, high))
    return f"{figure:{sign}.{decimals}f}", f"{ends[0]:.{decimals}f}", f"{ends[1]:.{decimals}f}"


def comparison(difference: Interval, other: str, better: str, unit: str) -> str:
    """What a design is beside another one: better or worse by how much, or not significantly different.

    Arguments:
        difference: Its score minus that of the other.
        other: The other's name.
        better: Of the metric, `lower` or `higher`.
        unit: The metric's.
    """
    sign = 1.0 if difference.mean > 0 else -1.0
    word = "better" if (sign < 0) == (better == "lower") else "worse"
    ends = [None if end is None else sign * end for end in difference[1:]]
    low, high = ends if None in ends else sorted(ends)
    if difference.mean == low == high == 0:
        return f"the same as {other} in every scene"
    unit = "percentage points" if unit == "%" else unit
    size, low_text, high_text = figure_and_interval(abs(difference.mean), low, high)
    by = f"{size} {unit}".rstrip()
    if low is None:
        return f"not significantly different from {other} ({by} {word})"
    if low > 0:
        return f"{word} than {other} by {by} ({low_text} to {high_text})"
    return f"not significantly different from {other} ({by} {word}, {low_text} to {high_text})"


def standard_error(influence: np.ndarray) -> float:
    """Standard error of a figure from the influences of its samples, shape (N,): sqrt(mean of squares / N)."""
    return float(np.sqrt(np.square(influence).mean() / len(influence))) if len(influence) else 0.0


def effective_share_error(weights: np.ndarray) -> float:
    """Standard error of the ESS (sum w)^2 / (N sum w^2) of N independent weights, shape (N,), not all 0.

    Its influence is ESS (2 w / mean(w) - w^2 / mean(w^2) - 1).
    """
    # only ratios of weights matter
    scaled = np.asarray(weights, dtype=np.float64) / np.max(weights)
    mean, square = scaled.mean(), np.square(scaled).mean()
    ess = mean**2 / square
    return standard_error(ess * (2 * scaled / mean - np.square(scaled) / square - 1))


def log_mean_error(weights: np.ndarray) -> float:
    """Standard error of log mean(w) of N independent weights, shape (N,), not all 0; influence w / mean(w) - 1."""
    scaled = np.asarray(weights, dtype=np.float64) / np.max(weights)
    return standard_error(scaled / scaled.mean() - 1)


def weighted_mean_error(values: np.ndarray, weights: np.ndarray) -> float:
    """Standard error of sum(w v) / sum(w), shapes (N,); influence N w (v - mean) / sum(w)."""
    share = np.asarray(weights, dtype=np.float64) / np.sum(weights)
    return standard_error(len(share) * share * (values - share @ values))


def share_error(count: int, total: int) -> float:
    """Standard error of a share count / total, above 0 for shares of 0 and 1 too (Agresti and Coull 1998)."""
    size = total + 2 * ADDED
    share = (count + ADDED) / size
    return float(np.sqrt(share * (1 - share) / size))


def median_error(values: np.ndarray) -> float:
    """Standard error of the median of values (N,), N >= 1: half the interval between the ranks n / 2 -+ sqrt(n) / 2."""
    half = np.sqrt(len(values)) / 2
    ranks = np.array([-half, half]) + (len(values) - 1) / 2
    low, high = np.interp(ranks, np.arange(len(values)), np.sort(values))
    return float(high - low) / 2


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
    from scipy.special import stdtrit

    reach = float(stdtrit(degrees, (1 + level) / 2))
    low, high = (max(reach, -sign * _straightened(-sign * reach, skewness / 3)) for sign in (-1.0, 1.0))
    return Interval(mean, min(max(mean - error * low, limits[0]), mean), max(min(mean + error * high, limits[1]), mean))


def _straightened(quantile: float, bend: float) -> float:
    """The t statistic at which Hall's transform, a cubic, has a quantile: (cbrt(1 + 3 b (q - b / 2)) - 1) / b."""
    moved = quantile - bend / 2
    root = float(np.cbrt(1 + 3 * bend * moved))
    return 3 * moved / (root**2 + root + 1)  # the same without the difference of two near numbers


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
    apart = first - second
    # what rounding leaves of no difference is none
    apart[np.abs(apart) <= SLACK * np.maximum(np.abs(first), np.abs(second))] = 0.0
    return mean_interval(apart, groups, limits=spanned(limits), level=level)


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
