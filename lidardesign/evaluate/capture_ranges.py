"""Ranges from captured histograms, cut to the bins that each ray hears.

They are found as `lidardesign.simulate.estimate_kernels` finds them in simulated histograms. Where a gate holds too few
photons to tell the background, its threshold takes the level that is usual in the whole capture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidardesign.errors import DataError
from lidardesign.evaluate.capture import Capture
from lidardesign.simulate.detector import FWHM_PER_SIGMA, Estimator

# Histograms are worked on so many bins at a time, which bounds memory at some 150 MB.
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
    """Ranges [m], NaN without a return, and counts of pixels (K,) between bins (K,) and (K,), each of shape (K,).

    Raises:
        DataError: The matched filter is asked for, and the capture does not say how wide its pulse is.
    """
    from lidardesign.simulate.estimate_kernels import find_returns

    matched = estimation.estimator == "matched"
    if matched and capture.pulse_fwhm_ps is None:
        raise DataError(
            "the matched filter needs the width of the pulse, and the capture has no pulse_fwhm_ps",
            where="--estimator matched",
            hint="add pulse_fwhm_ps to the capture, or take --estimator peak",
        )
    pulse_ps = capture.pulse_fwhm_ps or 0.0
    half = int(pulse_ps / (2 * capture.bin_ps))
    place, photons = np.full(len(pixel), np.nan), np.zeros(len(pixel))
    for begin, end in _chunks(last - first):
        counts, offset = _cut(capture, pixel[begin:end], first[begin:end], last[begin:end])
        photons[begin:end] = np.diff(np.concatenate([[0], np.cumsum(counts)])[offset])
        known = np.full(end - begin, capture.background_per_bin)
        sigma_ps = pulse_ps / FWHM_PER_SIGMA
        place[begin:end] = find_returns(
            counts,
            offset,
            np.ones((end - begin, 2)),
            capture.bin_ps,
            sigma_ps,
            half,
            known,
            estimation.false_alarm,
            matched,
        )
    return capture.start_m[pixel] + (first + place) * capture.bin_m, photons


def _chunks(lengths: np.ndarray) -> Iterator[tuple[int, int]]:
    """Rays whose bins are worked on together, as begin and end."""
    ends = np.cumsum(lengths)
    begin = 0
    while begin < len(lengths):
        before = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, before + CHUNK_BINS, side="right")), begin + 1)
        yield begin, end
        begin = end


def _cut(capture: Capture, pixel: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The counts that rays hear one after the other, and where each begins in them, (K + 1,)."""
    lengths = np.maximum(last - first, 0)
    offset = np.concatenate([[0], np.cumsum(lengths)])
    at = np.arange(offset[-1]) - np.repeat(offset[:-1] - first, lengths)
    return capture.counts[np.repeat(pixel, lengths), at].astype(np.int64), offset
