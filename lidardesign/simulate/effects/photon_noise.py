"""Light comes in photons: how many are counted is Poisson, and when within the pulse is chance.

A ray's photons are drawn with one number for how many there are and two for each of them, so that a little more or
less light changes a few photons and leaves the others.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidardesign.simulate.arrival_kernels import poisson_of_bins
from lidardesign.simulate.streams import normals, poisson_quantile, uniform, uniforms

# draws of a ray: 0 for the number of photons, from here on two per photon, and far beyond one per bin
FIRST_PHOTON = 1
FIRST_BIN = 1 << 40


@njit(cache=True, nogil=True)
def _numbers(expected, rays, key):  # noqa: ANN001, ANN202
    found = np.empty(len(expected), np.int64)
    for i in range(len(expected)):
        found[i] = poisson_quantile(expected[i], uniform(key, rays[i], 0))
    return found


def numbers(expected: np.ndarray, rays: np.ndarray, key: int) -> np.ndarray:
    """Poisson counts of expected ones of rays, shapes (R,)."""
    return _numbers(expected, rays, np.uint64(key))


def places(ray: np.ndarray, order: np.ndarray, key: int) -> tuple[np.ndarray, np.ndarray]:
    """For photons, by ray and order in it: a number in (0, 1) that chooses an echo, and a normal one for the pulse."""
    draw = FIRST_PHOTON + 2 * order
    return uniforms(key, ray, draw), normals(key, ray, draw + 1)


def of_bins(expected: np.ndarray, offset: np.ndarray, rays: np.ndarray, key: int) -> np.ndarray:
    """Poisson counts of expected ones in the bins of rays (R,), whose bins are offset[i] to offset[i + 1]."""
    return poisson_of_bins(expected, offset, rays, np.uint64(key), FIRST_BIN)
