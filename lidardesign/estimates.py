"""Estimates: figures with their errors.

Standard errors follow from the influence of single samples (delta method; Owen 2013, "Monte Carlo theory, methods and
examples", ch. 9.2): the change of the figure is the mean of the influences. They hold for samples whose weights have a
finite variance; for weights with heavy tails they are too small, as the ESS is then too large.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

# Kinds of errors in `Estimate.kind`.
STANDARD_ERROR = "standard error"
HALF_INTERVAL = "half of the 95 % interval"
ROUNDING = "rounding"
# Most digits of a printed figure.
MOST_DIGITS = 4
# Added to both counts of a share (Agresti and Coull), so that 0 of a few has an error.
ADDED = 2


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
