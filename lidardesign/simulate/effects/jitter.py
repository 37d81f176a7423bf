"""The timing of a photon strays: by diode and converter, as a normal error that every photon has anew."""

from __future__ import annotations

import numpy as np

from lidardesign.simulate.arrival_kernels import poisson_of_bins
from lidardesign.simulate.detector import Detector, metres
from lidardesign.simulate.streams import normals

# draws of a ray: one per photon, and far beyond one per bin
FIRST_BIN = 1 << 40


def displaced(path_m: np.ndarray, ray: np.ndarray, order: np.ndarray, detector: Detector, key: int) -> np.ndarray:
    """Half paths as they are timed [m], shape (K,): of photons by ray and order in it, or of whole returns."""
    if detector.jitter_sigma_s == 0:
        return path_m
    return path_m + metres(detector.jitter_sigma_s) * normals(key, ray, order)


def of_bins(expected: np.ndarray, offset: np.ndarray, rays: np.ndarray, key: int) -> np.ndarray:
    """Counts in the bins of rays (R,) whose many photons stray, where their number is not chance: Poisson in each."""
    return poisson_of_bins(expected, offset, rays, np.uint64(key), FIRST_BIN)
