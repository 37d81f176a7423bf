"""Times are rounded to bins, which start with the gate or with the pulse: an error spread evenly over a bin.

What it could change (`bound`): its rms is bin / sqrt(12), as ranges lie anywhere in a bin, or what rounding does to the
ranges of first hits where that is more: where all of them lie at one place of their bin it may be half a bin. The
highest bin of other bins is another one, and background makes other peaks in them, or none.
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
    """Half paths (N,) at the centre of the part of their bin that lies in their window (N, 2) [m], NaN kept."""
    if detector.bin_m is None:
        return path_m
    low, high = ends_of_bins(path_m, windows_m, detector)
    return (low + high) / 2


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why nothing is rounded, if so."""
    return None if detector.bin_m else "the detector has no bins"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """bin^2 / 12 for every ray, or what rounding does to the first hits of its list."""
    bin_m, row = first_hits.detector.bin_m, first_hits.row
    rounded_m2 = np.bincount(row, first_hits.rounding_m**2 * first_hits.returned)
    squared = np.maximum(bin_m**2 / 12, safe_divide(rounded_m2, np.bincount(row, first_hits.returned)))[row]
    lost = np.zeros(len(first_hits))
    if first_hits.detector.photons is not None:
        sigma_m, blind = first_hits.sigma_m(), Blindness.of(counts)
        if first_hits.detector.estimator == "peak":
            squared = squared + 2 * counts.error_m(blind.left, sigma_m) ** 2
        lost = np.minimum(2 * counts.by_chance(blind, sigma_m) + counts.missed_on_edges(blind.left, sigma_m), 1.0)
    return EffectBound(squared, lost, f"bins are {1000 * bin_m:.3g} mm wide")
