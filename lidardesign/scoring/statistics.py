"""Means over scenes with their intervals, and paired differences (Efron and Tibshirani 1993, ch. 13).

Scenes of one group share random draws, as the poses of one mesh: groups are resampled. Fewer than 10 give bootstrap
intervals that are too narrow; they have Student's t interval.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from lidardesign.errors import NumericalError
from lidardesign.task import random_generator

RESAMPLES = 4000  # the ends of a 95 % interval are then known to a hundredth of its width
LEVEL = 0.95
FEWEST_RESAMPLED = 10
LARGEST_TABLE = 2_000_000  # resampled indices held at once; bounds memory at 16 MB


class Interval(NamedTuple):
    """A mean with the ends of its interval; the ends are None for a single group."""

    mean: float
    low: float | None
    high: float | None


def mean_interval(
    values: Any, seed: int, groups: Any = None, *, resamples: int = RESAMPLES, level: float = LEVEL
) -> Interval:
    """The mean over scenes with its interval over groups: a percentile bootstrap, below 10 groups Student's t.

    Values that are all equal in two groups or more give an interval without width. The seed alone decides which groups
    are drawn, so rows over the same scenes share their resamples.

    Arguments:
        values: One per scene, shape (S,).
        seed: Root of the resampling.
        groups: The number of each scene's group, from 0, shape (S,); None: every scene is its own.
        resamples: Number of bootstrap samples.
        level: The share of the resampled means inside the interval.

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
    counts = np.bincount(groups)
    mean, sums = float(values.mean()), np.bincount(groups, values)
    if len(counts) == 1:
        return Interval(mean, None, None)
    if (values == values[0]).all():
        return Interval(float(values[0]), float(values[0]), float(values[0]))
    if len(counts) < FEWEST_RESAMPLED:
        # contributions of groups to the mean: deviations of their means where all have equally many scenes
        moved = (sums - mean * counts) / counts.mean()
        error = math.sqrt(np.square(moved).sum() / (len(moved) * (len(moved) - 1)))
        return student_interval(mean, error, len(moved) - 1, level)
    means = _resampled_means(sums, counts, resamples, random_generator(seed, "bootstrap", len(counts)))
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def student_interval(mean: float, error: float, degrees: float, level: float = LEVEL) -> Interval:
    """Student's t interval of a mean with a standard error of `degrees` degrees of freedom, which may be fractional."""
    half = error * float(stdtrit(degrees, (1 + level) / 2))
    return Interval(mean, mean - half, mean + half)


def paired_difference(
    first: Any, second: Any, seed: int, groups: Any = None, *, resamples: int = RESAMPLES, level: float = LEVEL
) -> Interval:
    """The mean of first - second over the same scenes, shapes (S,), with its interval as `mean_interval` has it.

    Raises:
        NumericalError: The two are not of the same scenes, or hold values that are not finite.
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if first.shape != second.shape:
        raise NumericalError(f"{first.shape} and {second.shape} values do not pair", where="statistics")
    return mean_interval(first - second, seed, groups, resamples=resamples, level=level)


def _resampled_means(
    sums: np.ndarray, counts: np.ndarray, resamples: int, generator: np.random.Generator
) -> np.ndarray:
    """Means over the scenes of groups drawn with replacement, shape (resamples,), in pieces of bounded size."""
    piece = max(1, LARGEST_TABLE // len(sums))
    means = []
    for start in range(0, resamples, piece):
        drawn = generator.integers(0, len(sums), (min(piece, resamples - start), len(sums)))
        means.append(sums[drawn].mean(axis=1) / counts[drawn].mean(axis=1))
    return np.concatenate(means)


def worst_tenth(values: np.ndarray, better: str) -> float:
    """The mean of the worst tenth of values, (N,), and of the worst one at least; `better` is lower or higher."""
    ordered = np.sort(values)[:: -1 if better == "lower" else 1]
    return float(ordered[: math.ceil(len(ordered) / 10)].mean())
