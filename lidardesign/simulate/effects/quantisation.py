"""Times are rounded to bins, which start with the gate or with the pulse; uniform error: bin / sqrt(12) rms."""

from __future__ import annotations

import numpy as np

from lidardesign.simulate.detector import Detector


def bins_start(windows_m: np.ndarray, detector: Detector) -> np.ndarray:
    """Where the bin that a window (N, 2) [m] starts in starts, shape (N,) [m]."""
    starts = windows_m[:, 0]
    return starts if detector.histogram_start == "gate" else np.floor(starts / detector.bin_m) * detector.bin_m


def rounded(path_m: np.ndarray, windows_m: np.ndarray, detector: Detector) -> np.ndarray:
    """Half paths (N,) at the centre of the part of their bin that lies in their window (N, 2) [m], NaN kept."""
    if detector.bin_m is None:
        return path_m
    first = bins_start(windows_m, detector)
    low = first + np.floor((path_m - first) / detector.bin_m) * detector.bin_m
    return (np.maximum(low, windows_m[:, 0]) + np.minimum(low + detector.bin_m, windows_m[:, 1])) / 2
