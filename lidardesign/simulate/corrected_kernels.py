"""Compiled loops that find the return in a histogram and know that the detector is blind after a count.

A pulse can only be counted in while it is alive. With the counts so far, the share a_b of pulses that are alive in bin
b is known, and the counts expected there are a_b (b + s g) per alive pulse (Coates 1968, for any dead time). So a level
of background is a level per alive share, and the log-matched filter (see `estimate_kernels`) becomes

    L(k) = sum_j h_{k+j} log(1 + s g_j / b) - s sum_j a_{k+j} g_j,

with h the photons that arrived in alive pulses, of which only one per pulse and bin was counted.
What pile-up has taken away is not brought back: a pulse in a bin with few alive pulses has few counts.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.simulate.estimate_kernels import FEW_PHOTONS, LEAST_BINS, at_least, pulse_shape, vertex

# How often the place of the pulse is used to tell it from the background that it is then found in
PASSES = 3


@njit(cache=True, nogil=True)
def alive_shares(counts, pulses, dead, period):  # noqa: ANN001, ANN201
    """The share of pulses that are alive in each bin, given all counts of a frame; times in bins.

    Blind are the pulses with a count less than a dead time ago, in the same pulse or in one before.
    """
    size = len(counts)
    running = np.zeros(size + 1)
    for b in range(size):
        running[b + 1] = running[b] + counts[b]
    alive = np.empty(size)
    for b in range(size):
        blind = running[b] - running[min(max(math.floor(b - dead) + 1, 0), b)]
        # pulses back so far that any count of theirs still blinds, then those of which only the late ones do
        back = max(math.ceil((dead - b) / period) - 1, 0)
        blind += back * running[size]
        since = b + (back + 1) * period - dead
        while since < size:
            blind += running[size] - running[min(max(math.floor(since) + 1, 0), size)]
            back += 1
            since = b + (back + 1) * period - dead
        alive[b] = max(1.0 - blind / pulses, 1.0 / pulses)
    return alive


@njit(cache=True, nogil=True)
def arrived(counted, pulses):  # noqa: ANN001, ANN201
    """How many photons fell into so many alive pulses of which `counted` had at least one, as far as that tells."""
    return -pulses * math.log1p(-min(counted / pulses, 1.0 - 1.0 / (pulses + 1.0)))


@njit(cache=True, nogil=True)
def _running(values):  # noqa: ANN001, ANN202
    sums = np.zeros(len(values) + 1)
    for b in range(len(values)):
        sums[b + 1] = sums[b] + values[b]
    return sums


@njit(cache=True, nogil=True)
def _around(sums, middle, half):  # noqa: ANN001, ANN202
    """The sum of bins middle - half to middle + half, as far as there are any."""
    return sums[min(middle + half + 1, len(sums) - 1)] - sums[max(middle - half, 0)]


@njit(cache=True, nogil=True)
def _stands_out(counted, room, level, half):  # noqa: ANN001, ANN202
    """The middle of the bins that hold the most beyond their level, by running sums."""
    best, most = 0, -np.inf
    for b in range(len(counted) - 1):
        excess = _around(counted, b, half) - level * _around(room, b, half)
        if excess > most:
            best, most = b, excess
    return best


@njit(cache=True, nogil=True)
def _heard(alive, shape, middle):  # noqa: ANN001, ANN202
    """The share of a pulse in a bin's middle that falls into alive pulses."""
    reach, total = len(shape) // 2, 0.0
    for b in range(max(middle - reach, 0), min(middle + reach, len(alive) - 1) + 1):
        total += alive[b] * shape[b - middle + reach]
    return total


@njit(cache=True, nogil=True)
def _matched(counts, alive, shape, signal, level, score):  # noqa: ANN001, ANN202
    """The bin of the largest log-likelihood, and by how much of a bin its vertex lies off the bin's middle.

    Only bins that a photon speaks for are considered.
    """
    size, reach = len(counts), len(shape) // 2
    weight = np.log1p(signal / level * shape)
    score[:size] = 0.0
    for b in range(size):
        if counts[b] > 0:
            for j in range(max(-reach, b - size + 1), min(reach, b) + 1):
                score[b - j] += counts[b] * weight[j + reach]
    best, most = 0, -np.inf
    for b in range(size):
        spoken_for = score[b] > 0
        score[b] = score[b] - signal * _heard(alive, shape, b) if spoken_for else -np.inf
        if score[b] > most:
            best, most = b, score[b]
    return best, vertex(score[:size], best)


@njit(cache=True, nogil=True)
def find_corrected(  # noqa: ANN201
    counts,  # noqa: ANN001
    offset,  # noqa: ANN001
    ends,  # noqa: ANN001
    width,  # noqa: ANN001
    sigma,  # noqa: ANN001
    half,  # noqa: ANN001
    known_level,  # noqa: ANN001
    false_alarm,  # noqa: ANN001
    matched,  # noqa: ANN001
    pulses,  # noqa: ANN001
    dead,  # noqa: ANN001
    period,  # noqa: ANN001
):
    """As `find_returns`, with the pulses of a frame, and dead time and time between pulses in bins."""
    found = np.full(len(offset) - 1, np.nan)
    longest = 0
    for i in range(len(offset) - 1):
        longest = max(longest, offset[i + 1] - offset[i])
    score = np.empty(longest)
    for i in range(len(offset) - 1):
        mine = counts[offset[i] : offset[i + 1]]
        size, total = len(mine), mine.sum()
        if total == 0:
            continue
        shape = pulse_shape(width, sigma, size)
        reach = len(shape) // 2
        alive = alive_shares(mine, pulses, dead, period)
        photons = np.empty(size)
        for b in range(size):
            photons[b] = arrived(mine[b], alive[b] * pulses)
        alive[0] *= ends[i, 0]
        alive[-1] *= ends[i, 1]
        counted, room, light = _running(mine), _running(alive), _running(photons)
        level, within = total / room[size], 0.0
        best = _stands_out(counted, room, level, half)
        for _ in range(PASSES):
            before = best
            pulse, own = _around(counted, best, reach), _around(room, best, reach)
            others = room[size] - own
            level = (total - pulse) / others if others > LEAST_BINS else known_level[i]
            if total - pulse < FEW_PHOTONS:
                level = max(level, known_level[i])
            if matched:
                ambient = max(arrived(level, pulses), 1.0 / size)
                signal = max(_around(light, best, reach) - ambient * own, 1.0) / _heard(alive, shape, best)
                best, within = _matched(photons, alive, shape, signal, ambient, score)
            else:
                best = _stands_out(counted, room, level, 0)
            if best == before:
                break
        if size * at_least(_around(counted, best, half), level * _around(room, best, half)) <= false_alarm:
            found[i] = best + 0.5 + within
    return found
