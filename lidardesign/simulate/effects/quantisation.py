"""Times are rounded to bins, which start with the gate or with the pulse: an error spread evenly over a bin.

What it could change (`bound`): its rms is bin / sqrt(12), as ranges lie anywhere in a bin: an estimate where all of
them lie at one place of their bin, which may be half a bin off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.geometry.rays import Rays
from lidardesign.scene import Scene
from lidardesign.simulate.detector.detector import Detector, bins_start
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits


def round_to_bins(path_m: np.ndarray, windows_m: np.ndarray, detector: Detector) -> np.ndarray:
    """Half paths (N,) at the centre of the part of their bin that lies in their window (N, 2) [m], NaN kept."""
    if detector.bin_m is None:
        return path_m
    first = bins_start(windows_m, detector)
    low = first + np.floor((path_m - first) / detector.bin_m) * detector.bin_m
    return (np.maximum(low, windows_m[:, 0]) + np.minimum(low + detector.bin_m, windows_m[:, 1])) / 2


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why nothing is rounded, if so."""
    return None if detector.bin_m else "the detector has no bins"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """bin^2 / 12 for every ray."""
    bin_m = first_hits.detector.bin_m
    return EffectBound(
        np.full(len(first_hits), (bin_m / math.sqrt(12)) ** 2),
        np.zeros(len(first_hits)),
        f"bins are {1000 * bin_m:.3g} mm wide",
    )
