"""Compiled loops of detectors with dead time: counted photons, and returns corrected for dead time.

The return is located in the counted photons: a photon is counted only while its pulse is alive. With the counts
so far, the share a_b of pulses that are alive in bin b is known, and the counts expected there are a_b (b + s g) per
alive pulse (Coates 1968, for any dead time). So a level of background is a level per alive share, and the log-matched
filter becomes

    L(k) = sum_j h_{k+j} log(1 + s g_j / b) - s sum_j a_{k+j} g_j,

with h the photons that arrived in alive pulses, of which only one per pulse and bin was counted.
The correction does not restore lost photons: a pulse in a bin with few alive pulses has few counts.
"""

import math

import numpy as np
from numba import njit

from lidardesign.simulate.detector.kernels import (
    FEW_BACKGROUND_PHOTONS,
    LEAST_BINS,
    at_least,
    pulse_shape,
    vertex,
)
from lidardesign.simulate.detector.streams import normal, uniform

# More photons in one bin than this are counted together, by mean and variance of the number of pulses that they hit
ONE_BY_ONE = 32
# Expected hits of alive pulses below which a rounded normal would be wrong on average
FEW_PULSES = 8.0
# Upper limit of photons per pulse in a bin: at it, a pulse is without any with the probability exp(-32)
MOST_PER_PULSE = 32
# A ray with more photons than this, where dead times reach across pulses, is followed in a share of its pulses only
MOST_PHOTONS = 1 << 21
# draws of a ray: one per photon by its bin and its place among the bin's photons, so that a photon more or less changes
# nothing in other bins; and far beyond one per bin
DRAWS_PER_BIN = 1 << 32
FIRST_BIN = 1 << 62


@njit(cache=True, nogil=True)
def count_alive(counts, offset, pulses, dead, period, key, first_ray):  # noqa: ANN001, ANN201
    """Counted photons per bin among those that arrive, flat; pulses per ray, dead time and pulse period in bins."""
    found = np.zeros_like(counts)
    for i in range(len(offset) - 1):
        arrived, mine = counts[offset[i] : offset[i + 1]], found[offset[i] : offset[i + 1]]
        if len(arrived) - 1 + dead < period:
            _within_pulses(arrived, mine, pulses[i], dead, key, first_ray + i)
        else:
            _across_pulses(arrived, mine, pulses[i], dead, period, key, first_ray + i)
    return found


@njit(cache=True, nogil=True)
def _within_pulses(arrived, mine, pulses, dead, key, ray):  # noqa: ANN001, ANN202
    """Count photons bin by bin: each is counted with the share of pulses without a count within the dead time."""
    blind, oldest = 0, 0
    for b in range(len(arrived)):
        while oldest < b and b - oldest >= dead:
            blind -= mine[oldest]
            oldest += 1
        number = arrived[b]
        if number == 0:
            continue
        if number <= ONE_BY_ONE:
            for k in range(number):
                if uniform(key, ray, b * DRAWS_PER_BIN + k) * pulses < pulses - blind - mine[b]:
                    mine[b] += 1
        else:
            mine[b] = _hit_pulses(number, pulses - blind, pulses, normal(key, ray, FIRST_BIN + b))
        blind += mine[b]


@njit(cache=True, nogil=True)
def _hit_pulses(number, alive, pulses, z):  # noqa: ANN001, ANN202
    """Number of alive pulses hit by at least one of `number` photons: a rounded normal of its mean and variance.

    Where it is small, the binomial quantile of the normal number z, as if pulses got photons independently.
    """
    empty = math.exp(number * math.log1p(-1.0 / pulses)) if pulses > 1 else 0.0
    two_empty = math.exp(number * math.log1p(-2.0 / pulses)) if pulses > 2 else 0.0
    mean = alive * (1 - empty)
    if mean < FEW_PULSES and empty > 0:
        return min(_binomial_quantile(alive, empty, 0.5 * math.erfc(-z / math.sqrt(2.0))), number)
    variance = alive * empty + alive * (alive - 1.0) * two_empty - (alive * empty) ** 2
    return min(max(math.floor(mean + math.sqrt(max(variance, 0.0)) * z + 0.5), 0), min(alive, number))


@njit(cache=True, nogil=True)
def _binomial_quantile(trials, failure, share):  # noqa: ANN001, ANN202
    """The least number of successes whose binomial distribution function reaches a share."""
    count = 0
    probability = math.exp(trials * math.log(failure))
    total = probability
    while total < share and count < trials:
        probability *= (trials - count) / (count + 1.0) * (1 - failure) / failure
        count += 1
        total += probability
    return count


@njit(cache=True, nogil=True)
def _share_of_counts(arrived, shares):  # noqa: ANN001, ANN202
    """One of `shares` equal parts of photons, evenly over time."""
    total, before = 0, 0
    found = np.empty_like(arrived)
    for b in range(len(arrived)):
        total += arrived[b]
        found[b] = total // shares - before
        before += found[b]
    return found


@njit(cache=True, nogil=True)
def _across_pulses(arrived, mine, pulses, dead, period, key, ray):  # noqa: ANN001, ANN202
    """Count photons one by one in order of time, with dead time that may reach into later pulses."""
    arrived = np.minimum(arrived, MOST_PER_PULSE * pulses)
    total = arrived.sum()
    if total > MOST_PHOTONS and pulses > 1:
        shares = min(total // MOST_PHOTONS + 1, pulses)
        _across_pulses(_share_of_counts(arrived, shares), mine, pulses // shares, dead, period, key, ray)
        mine *= shares
        return
    size = len(arrived)
    times = np.empty(total, np.int64)
    photon = 0
    for b in range(size):
        for k in range(arrived[b]):
            share = uniform(key, ray, b * DRAWS_PER_BIN + k)
            times[photon] = min(int(share * pulses), pulses - 1) * size + b
            photon += 1
    ordered = np.sort(times) if pulses > total else _by_pulse(times, size, pulses)
    alive_at = -1.0
    for time in ordered:
        pulse, b = time // size, time % size
        if pulse * period + b >= alive_at:
            mine[b] += 1
            # a pulse's photons in one bin are counted once, however short the dead time
            alive_at = pulse * period + b + max(dead, 1.0)


@njit(cache=True, nogil=True)
def _by_pulse(times, size, pulses):  # noqa: ANN001, ANN202
    """Sort times pulse * size + bin, given in order of bins, by pulse and then bin (counting sort)."""
    place = np.zeros(pulses + 1, np.int64)
    for time in times:
        place[time // size + 1] += 1
    for pulse in range(pulses):
        place[pulse + 1] += place[pulse]
    ordered = np.empty_like(times)
    for time in times:
        ordered[place[time // size]] = time
        place[time // size] += 1
    return ordered


# Iterations of locating the pulse and estimating the background outside of it
PASSES = 3


@njit(cache=True, nogil=True)
def alive_shares(counts, pulses, dead, period):  # noqa: ANN001, ANN201
    """The share of pulses that are alive in each bin, given all counts of a frame; times in bins.

    Blind are the pulses with a count less than a dead time ago, in the same pulse or in one before.
    """
    size, running = len(counts), _running(counts)
    alive = np.empty(size)
    for b in range(size):
        blind = running[b] - running[min(max(math.floor(b - dead) + 1, 0), b)]
        # earlier pulses whose counts all reach here by dead time, then those of which only the late ones do
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
def arrived_photons(counted, pulses):  # noqa: ANN001, ANN201
    """Estimated number of photons in alive pulses of which `counted` have at least one."""
    return -pulses * math.log1p(-min(counted / pulses, 1.0 - 1.0 / (pulses + 1.0)))


@njit(cache=True, nogil=True)
def _running(values):  # noqa: ANN001, ANN202
    return np.append(0.0, np.cumsum(values.astype(np.float64)))


@njit(cache=True, nogil=True)
def _around(sums, middle, half):  # noqa: ANN001, ANN202
    """Sum of the bins middle - half to middle + half from running sums, cut to the histogram."""
    return sums[min(middle + half + 1, len(sums) - 1)] - sums[max(middle - half, 0)]


@njit(cache=True, nogil=True)
def _stands_out(counted, room, level, half):  # noqa: ANN001, ANN202
    """Middle of the bins with the most counts above their background level, from running sums."""
    best, most = 0, -np.inf
    for b in range(len(counted) - 1):
        excess = _around(counted, b, half) - level * _around(room, b, half)
        if excess > most:
            best, most = b, excess
    return best


@njit(cache=True, nogil=True)
def _alive_part(alive, shape, middle):  # noqa: ANN001, ANN202
    """Share of an echo centred in a bin that falls into alive pulses."""
    reach, total = len(shape) // 2, 0.0
    for b in range(max(middle - reach, 0), min(middle + reach, len(alive) - 1) + 1):
        total += alive[b] * shape[b - middle + reach]
    return total


@njit(cache=True, nogil=True)
def _corrected_matched(counts, alive, shape, signal, level, score):  # noqa: ANN001, ANN202
    """The bin of the largest log-likelihood, and by how much of a bin its vertex lies off the bin's middle.

    Only bins within reach of a photon are considered.
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
        score[b] = score[b] - signal * _alive_part(alive, shape, b) if spoken_for else -np.inf
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
    """Find returns as `find_returns`, corrected for dead time, given pulses of each ray, dead time, period in bins."""
    found = np.full(len(offset) - 1, np.nan)
    score = np.empty(np.append(np.diff(offset), 0).max())
    for i in range(len(offset) - 1):
        mine = counts[offset[i] : offset[i + 1]]
        size, total = len(mine), mine.sum()
        if total == 0:
            continue
        shape = pulse_shape(width, sigma, size)
        reach = len(shape) // 2
        alive = alive_shares(mine, pulses[i], dead, period)
        photons = np.empty(size)
        for b in range(size):
            photons[b] = arrived_photons(mine[b], alive[b] * pulses[i])
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
            if total - pulse < FEW_BACKGROUND_PHOTONS:
                level = max(level, known_level[i])
            if matched:
                ambient = max(arrived_photons(level, pulses[i]), 1.0 / size)
                signal = max(_around(light, best, reach) - ambient * own, 1.0) / _alive_part(alive, shape, best)
                best, within = _corrected_matched(photons, alive, shape, signal, ambient, score)
            else:
                best = _stands_out(counted, room, level, 0)
            if best == before:
                break
        if size * at_least(_around(counted, best, half), level * _around(room, best, half)) <= false_alarm:
            found[i] = best + 0.5 + within
    return found
