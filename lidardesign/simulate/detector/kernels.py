"""Compiled loops that sort arriving photons into bins, and locate and accept returns in histograms.

Bins of ray i are offset[i] to offset[i + 1] of a flat array; they start at first[i], are `width` wide, and count only
photons in the ray's window, closed at its start and open at its end.

The range is the middle of the highest bin, or the maximum of the log-matched filter: the likelihood of a pulse of the
known shape g at a bin k in an even background b,

    L(k) = sum_j h_{k+j} log(1 + s g_j / b) - s sum_j g_j,

over the bins k + j in the window, with s the signal photons above background (Rapp and Goyal 2017; the second term
matters only for pulses that the window cuts off), refined by a parabola through its neighbours.

It is reported if the photons within one full width at half maximum around it are more than the background alone
brings anywhere in the window with the allowed probability: bins * P(Poisson(b m) >= n) <= false_alarm, m bins wide.
"""

import math

import numpy as np
from numba import njit

from lidardesign.numerics import ROUNDING
from lidardesign.simulate.detector.streams import poisson_quantile, uniform

# Beyond so many standard deviations a Gaussian pulse holds less than one photon in 10^15
REACH = 8.0
# Draws of even light: one per cell for its photons, then one per photon, and far beyond one per bin
FIRST_PHOTON, DRAWS_PER_CELL = 1, 1 << 40
FIRST_BIN = 1 << 39
# Cells with fewer photons than this are always drawn one by one
DRAWN_ONE_BY_ONE = 64.0


@njit(cache=True, nogil=True)
def echo_of(ray, share, echo_offset, expected):  # noqa: ANN001, ANN201
    """Index of the echo of each photon, by rays (K,) and shares (K,) of their light, and the share within the echo."""
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
    """Share of a normal distribution around 0 between two places; with sigma 0, all or none by [left, right)."""
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
    """Poisson counts of the bins offset[i] to offset[i + 1] of rays (R,) with these expected counts."""
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
            if mean <= max(DRAWN_ONE_BY_ONE, end - begin + 1.0):
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


# Outside of this many standard deviations around a pulse, photons are background
PULSE_REACH = 4.0
# With fewer photons outside of the pulse than this, the level is at least the known one
FEW_BACKGROUND_PHOTONS = 10
# Fewest bins from which a background level is measured
LEAST_BINS = 0.5
# Above this mean, Poisson's tail is taken as a normal one
NORMAL_MEAN = 1e5
# Terms of a tail's sum that are smaller than this share of it do not change it
TAIL_PRECISION = ROUNDING


@njit(cache=True, nogil=True)
def at_least(number, mean):  # noqa: ANN001, ANN201
    """P(Poisson(mean) >= number); 1 where the number is not above the mean."""
    if number <= mean or number <= 0:
        return 1.0
    if mean <= 0:
        return 0.0
    if mean > NORMAL_MEAN:
        return 0.5 * math.erfc((number - 0.5 - mean) / math.sqrt(2.0 * mean))
    term = math.exp(number * math.log(mean) - mean - math.lgamma(number + 1.0))
    total, k = term, number
    while term > TAIL_PRECISION * total:
        k += 1
        term *= mean / k
        total += term
    return total


@njit(cache=True, nogil=True)
def pulse_shape(width, sigma, longest):  # noqa: ANN001, ANN201
    """Share of a pulse in each bin around its central one, at most as wide as the longest histogram."""
    reach = min(math.ceil(PULSE_REACH * sigma / width), max(longest - 1, 0))
    shape = np.ones(2 * reach + 1)
    if sigma > 0:
        scale = width / (math.sqrt(2.0) * sigma)
        for j in range(-reach, reach + 1):
            shape[j + reach] = 0.5 * (math.erf((j + 0.5) * scale) - math.erf((j - 0.5) * scale))
    return shape


@njit(cache=True, nogil=True)
def _fullest(counts, half):  # noqa: ANN001, ANN202
    """Middle b of the bins b - half to b + half with the most counts, the first of equals."""
    size = len(counts)
    total = 0
    for b in range(min(half, size)):
        total += counts[b]
    best, most = 0, -1
    for b in range(size):
        if b + half < size:
            total += counts[b + half]
        if b - half - 1 >= 0:
            total -= counts[b - half - 1]
        if total > most:
            best, most = b, total
    return best


@njit(cache=True, nogil=True)
def _sum_around(counts, middle, half):  # noqa: ANN001, ANN202
    return counts[max(middle - half, 0) : middle + half + 1].sum()


@njit(cache=True, nogil=True)
def vertex(score, best):  # noqa: ANN001, ANN201
    """Offset of the vertex of the parabola through a maximum and its neighbours, in bins."""
    if best == 0 or best == len(score) - 1:
        return 0.0
    left, middle, right = score[best - 1], score[best], score[best + 1]
    if not (math.isfinite(left) and math.isfinite(right)):
        return 0.0
    bend = left - 2 * middle + right
    return 0.5 * (left - right) / bend if bend < 0 else 0.0


@njit(cache=True, nogil=True)
def _matched(counts, shape, below, signal, level, score):  # noqa: ANN001, ANN202
    """The bin of the largest log-likelihood, and the vertex's offset from the bin's middle in bins.

    `below` are the running sums of the pulse's shape, from 0 on.
    """
    size, reach = len(counts), len(shape) // 2
    weight = np.log1p(signal / level * shape)
    score[:size] = -signal
    for edge in range(min(reach, size)):
        for b in (edge, size - 1 - edge):
            inside = below[min(reach, size - 1 - b) + reach + 1] - below[max(-reach, -b) + reach]
            score[b] = -signal * inside
    for b in range(size):
        if counts[b] > 0:
            for j in range(max(-reach, b - size + 1), min(reach, b) + 1):
                score[b - j] += counts[b] * weight[j + reach]
    best = np.argmax(score[:size])
    return best, vertex(score[:size], best)


@njit(cache=True, nogil=True)
def _listened_bins(first, last, size, ends):  # noqa: ANN001, ANN202
    """Number of bins between two, both included, with the first and last bin counted by their shares in the window."""
    count = last - first + 1.0
    if first == 0:
        count -= 1.0 - ends[0]
    if last == size - 1:
        count -= 1.0 - ends[1]
    return count


@njit(cache=True, nogil=True)
def find_returns(counts, offset, ends, width, sigma, half, known_level, false_alarm, matched):  # noqa: ANN001, ANN201
    """Position of each ray's return in bins from its first bin's start, NaN without one, shape (N,).

    Arguments are the flat counts and where rays begin in them, the shares of a ray's first and last bin that lie in its
    window (N, 2), a bin's width and a photon's timing error in the same unit, the half width of a pulse in bins, the
    known background per bin (N,), the allowed probability of a false alarm, and whether to take the matched filter's
    maximum or the highest bin.
    """
    found = np.full(len(offset) - 1, np.nan)
    longest = np.append(np.diff(offset), 0).max()
    shape = pulse_shape(width, sigma, longest)
    below = np.concatenate((np.zeros(1), np.cumsum(shape)))
    reach = len(shape) // 2
    score = np.empty(longest)
    for i in range(len(offset) - 1):
        mine = counts[offset[i] : offset[i + 1]]
        size, total = len(mine), mine.sum()
        if total == 0:
            continue
        middle = _fullest(mine, half)
        pulse = _sum_around(mine, middle, reach)
        own = _listened_bins(max(middle - reach, 0), min(middle + reach, size - 1), size, ends[i])
        others = _listened_bins(0, size - 1, size, ends[i]) - own
        level = (total - pulse) / others if others > LEAST_BINS else known_level[i]
        if total - pulse < FEW_BACKGROUND_PHOTONS:
            level = max(level, known_level[i])
        within = 0.0
        if matched:
            signal = max(pulse - level * own, 1.0)
            # the lowest background is one photon in the whole window
            best, within = _matched(mine, shape, below, signal, max(level, 1.0 / size), score)
        else:
            best = mine.argmax()
        around = _listened_bins(max(best - half, 0), min(best + half, size - 1), size, ends[i])
        if size * at_least(_sum_around(mine, best, half), level * around) <= false_alarm:
            found[i] = best + 0.5 + within
    return found
