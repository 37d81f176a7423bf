"""Quantisation: times are rounded to bins that start with the gate or with the pulse, a uniform error over a bin.

Bound of its effect (`bound`): its rms is bin / sqrt(12), as ranges lie anywhere in a bin, or the rounding error of the
first hits where that is larger: half a bin where all of them lie at the same place in their bins. Other bins also
change which bin is the highest and which peaks background makes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.physics import Detector, ends_of_bins
from lidardesign.simulate.effects.expected_counts import Blindness, Counts
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits


def round_to_bins(path_m: np.ndarray, windows_m: np.ndarray, detector: Detector) -> np.ndarray:
    """Half paths (N,) rounded to the centre of the part of their bin in their window (N, 2) [m]; NaN is kept."""
    if detector.bin_m is None:
        return path_m
    low, high = ends_of_bins(path_m, windows_m, detector)
    return (low + high) / 2


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why nothing is rounded, or None."""
    return None if detector.bin_m else "the detector has no bins"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of rounding: bin^2 / 12, or the mean over first hits of the ray's list if larger."""
    bin_m, row = first_hits.detector.bin_m, first_hits.row
    rounded_m2 = np.bincount(row, first_hits.rounding_m**2 * first_hits.returned)
    squared = np.maximum(bin_m**2 / 12, safe_divide(rounded_m2, np.bincount(row, first_hits.returned)))[row]
    lost = np.zeros(len(first_hits))
    if first_hits.detector.photons is not None:
        sigma_m, blind = first_hits.sigma_m(), Blindness.of(counts)
        if first_hits.detector.estimator == "peak":
            squared = squared + 2 * counts.error_m(blind.left, sigma_m) ** 2
        lost = np.minimum(
            2 * counts.false_return_probability(blind, sigma_m) + counts.missed_on_edges(blind.left, sigma_m), 1.0
        )
    return EffectBound(squared, lost, f"bins are {1000 * bin_m:.3g} mm wide")
