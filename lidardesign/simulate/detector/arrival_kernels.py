"""Compiled loops that sort arriving photons into bins.

Bins of ray i are offset[i] to offset[i + 1] of a flat array; they start at first[i], are `width` wide, and count only
what lies in the ray's window, closed at its start and open at its end.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.simulate.streams import poisson_quantile, uniform

# Beyond so many standard deviations a Gaussian pulse holds less than one photon in 10^15
REACH = 8.0
# Draws of even light: one per cell for its photons, then one per photon, and far beyond one per bin
FIRST_PHOTON, DRAWS_PER_CELL = 1, 1 << 40
FIRST_BIN = 1 << 39
# Cells with fewer photons than this are always drawn one by one
FEW_PHOTONS = 64.0


@njit(cache=True, nogil=True)
def echo_of(ray, share, echo_offset, expected):  # noqa: ANN001, ANN201
    """For photons of rays (K,) at shares (K,) of their light: the echo they are of, and the share within it."""
    echo = np.empty(len(ray), np.int64)
    rest = np.empty(len(ray))
    for k in range(len(ray)):
        begin, end = echo_offset[ray[k]], echo_offset[ray[k] + 1]
        total = 0.0
        for e in range(begin, end):
            total += expected[e]
        left = share[k] * total
        e = begin
        while e < end - 1 and left >= expected[e]:
            left -= expected[e]
            e += 1
        echo[k] = e
        rest[k] = left / expected[e]
    return echo, rest


@njit(cache=True, nogil=True)
def add_photons(counts, offset, first, width, windows, ray, path):  # noqa: ANN001, ANN201
    """Count photons of rays (K,) at half paths (K,)."""
    for k in range(len(ray)):
        i = ray[k]
        if windows[i, 0] <= path[k] < windows[i, 1]:
            place = offset[i] + int((path[k] - first[i]) / width)
            counts[min(place, offset[i + 1] - 1)] += 1


@njit(cache=True, nogil=True)
def expected_in_bins(chosen, offset, first, width, windows, echo_offset, path, expected, sigma):  # noqa: ANN001, ANN201
    """Expected counts of echoes that are Gaussian in time, in the bins of chosen rays, one ray after the other."""
    total = 0
    for i in chosen:
        total += offset[i + 1] - offset[i]
    found = np.zeros(total)
    place = 0
    for i in chosen:
        size = offset[i + 1] - offset[i]
        for e in range(echo_offset[i], echo_offset[i + 1]):
            low = max(math.floor((path[e] - REACH * sigma - first[i]) / width), 0)
            high = min(math.floor((path[e] + REACH * sigma - first[i]) / width), size - 1)
            for b in range(low, high + 1):
                left = max(first[i] + b * width, windows[i, 0])
                right = min(first[i] + (b + 1) * width, windows[i, 1])
                found[place + b] += expected[e] * _share_between(left - path[e], right - path[e], sigma)
        place += size
    return found


@njit(cache=True, nogil=True)
def _share_between(left, right, sigma):  # noqa: ANN001, ANN202
    """Share of a normal distribution around 0 between two places; without width, all of it is in [left, right)."""
    if sigma == 0:
        return 1.0 if left <= 0 < right else 0.0
    scale = 1 / (math.sqrt(2.0) * sigma)
    if left > 0:
        return 0.5 * (math.erfc(left * scale) - math.erfc(right * scale))
    return 0.5 * (math.erfc(-right * scale) - math.erfc(-left * scale))


@njit(cache=True, nogil=True)
def even_counts(expected, offset):  # noqa: ANN001, ANN201
    """Whole counts whose running sums are the rounded running sums of expected ones, in each of R groups of bins."""
    found = np.empty(len(expected), np.int64)
    for i in range(len(offset) - 1):
        total, before = 0.0, 0
        for k in range(offset[i], offset[i + 1]):
            total += expected[k]
            now = math.floor(total + 0.5)
            found[k] = now - before
            before = now
    return found


@njit(cache=True, nogil=True)
def poisson_of_bins(expected, offset, rays, key, first_draw):  # noqa: ANN001, ANN201
    """Poisson counts of expected ones in the bins of rays (R,), whose bins are offset[i] to offset[i + 1]."""
    found = np.zeros(len(expected), np.int64)
    for i in range(len(rays)):
        for k in range(offset[i], offset[i + 1]):
            if expected[k] > 0:
                found[k] = poisson_quantile(expected[k], uniform(key, rays[i], first_draw + k - offset[i]))
    return found


@njit(cache=True, nogil=True)
def add_bins(counts, offset, chosen, found):  # noqa: ANN001, ANN201
    """Add counts of chosen rays' bins, one ray after the other."""
    place = 0
    for i in chosen:
        for b in range(offset[i], offset[i + 1]):
            counts[b] += found[place]
            place += 1


@njit(cache=True, nogil=True)
def add_even_light(counts, offset, first, width, windows, edges, expected, key, first_ray):  # noqa: ANN001, ANN201
    """Count Poisson photons that are spread evenly over cells (N, C + 1) with expected counts (N, C)."""
    for i in range(len(offset) - 1):
        for c in range(expected.shape[1]):
            low, high = max(edges[i, c], windows[i, 0]), min(edges[i, c + 1], windows[i, 1])
            if not (high > low and expected[i, c] > 0):
                continue
            mean = expected[i, c] * (high - low) / (edges[i, c + 1] - edges[i, c])
            size = offset[i + 1] - offset[i]
            begin = min(int((low - first[i]) / width), size - 1)
            end = min(int((high - first[i]) / width), size - 1)
            draws = c * DRAWS_PER_CELL
            if mean <= max(FEW_PHOTONS, end - begin + 1.0):
                number = poisson_quantile(mean, uniform(key, first_ray + i, draws))
                for k in range(number):
                    share = uniform(key, first_ray + i, draws + FIRST_PHOTON + k)
                    b = int((low + share * (high - low) - first[i]) / width)
                    counts[offset[i] + min(b, size - 1)] += 1
                continue
            for b in range(begin, end + 1):
                left, right = max(first[i] + b * width, low), min(first[i] + (b + 1) * width, high)
                part = mean * max(right - left, 0.0) / (high - low)
                if part > 0:
                    counts[offset[i] + b] += poisson_quantile(part, uniform(key, first_ray + i, draws + FIRST_BIN + b))
