"""Ranges from captured histograms, cut to the bins that each ray hears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.evaluate.capture import Capture
from lidardesign.simulate.detector import Estimator

# Histograms are worked on so many bins at a time, which bounds memory at a few of these in float64.
CHUNK_BINS = 1 << 22


@dataclass(frozen=True)
class Estimation:
    """How a range follows from a histogram.

    Arguments:
        estimator: Its highest bin, or the log-matched filter with the pulse.
        false_alarm: Probability that background alone is taken for a return, over all bins that a ray hears.
    """

    estimator: Estimator = "peak"
    false_alarm: float = 0.01


def measured(
    capture: Capture, pixel: np.ndarray, first: np.ndarray, last: np.ndarray, estimation: Estimation
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges [m], NaN without a return, and counts of pixels (K,) between bins (K,) and (K,), each of shape (K,)."""
    range_m, photons = np.full(len(pixel), np.nan), np.zeros(len(pixel))
    for ray in range(len(pixel)):
        histogram = capture.counts[pixel[ray], first[ray] : last[ray]].astype(np.float64)
        photons[ray] = histogram.sum()
        if photons[ray]:
            range_m[ray] = capture.start_m + (first[ray] + histogram.argmax() + 0.5) * capture.bin_m
    return range_m, photons
