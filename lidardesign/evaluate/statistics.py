"""Means over scenes with bootstrap intervals, and paired differences (Efron and Tibshirani 1993, ch. 13)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lidardesign.errors import NumericalError
from lidardesign.task import random_generator

RESAMPLES = 4000  # the ends of a 95 % interval are then known to a hundredth of its width
LEVEL = 0.95
LARGEST_TABLE = 2_000_000  # resampled indices held at once; bounds memory at 16 MB


class Interval(NamedTuple):
    """A mean with the ends of its interval."""

    mean: float
    low: float
    high: float


def bootstrap_interval(values: Any, seed: int, *, resamples: int = RESAMPLES, level: float = LEVEL) -> Interval:
    """The mean over scenes with its percentile bootstrap interval.

    Values that are all equal, a single scene among them, give an interval without width: the bootstrap knows
    nothing of scenes that it has not seen. The seed alone decides which scenes are drawn, so rows over the
    same scenes share their resamples.

    Arguments:
        values: One per scene, shape (S,).
        seed: Root of the resampling.
        resamples: Number of bootstrap samples.
        level: The share of the resampled means inside the interval.

    Raises:
        NumericalError: No values, or one that is not finite.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise NumericalError(
            f"a bootstrap needs finite values, one per scene; found shape {values.shape}", where="statistics"
        )
    if (values == values[0]).all():
        return Interval(float(values[0]), float(values[0]), float(values[0]))
    means = _resampled_means(values, resamples, random_generator(seed, "bootstrap", len(values)))
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    mean = float(values.mean())
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def paired_difference(
    first: Any, second: Any, seed: int, *, resamples: int = RESAMPLES, level: float = LEVEL
) -> Interval:
    """The mean of first - second over the same scenes, shapes (S,), with its bootstrap interval.

    Raises:
        NumericalError: The two are not of the same scenes, or hold values that are not finite.
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if first.shape != second.shape:
        raise NumericalError(f"{first.shape} and {second.shape} values do not pair", where="statistics")
    return bootstrap_interval(first - second, seed, resamples=resamples, level=level)


def _resampled_means(values: np.ndarray, resamples: int, generator: np.random.Generator) -> np.ndarray:
    """Means of resamples with replacement, shape (resamples,), drawn in pieces of bounded size."""
    piece = max(1, LARGEST_TABLE // len(values))
    means = [
        values[generator.integers(0, len(values), (min(piece, resamples - start), len(values)))].mean(axis=1)
        for start in range(0, resamples, piece)
    ]
    return np.concatenate(means)
