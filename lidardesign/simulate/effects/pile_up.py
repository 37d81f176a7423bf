"""A detector is blind after a count: within a pulse the first photon hides later ones, and those of further pulses.

Every photon falls into one of a ray's P pulses, each as likely as the others. A pulse in which nothing was counted
within the dead time before is alive; in it, the photon is counted. Light that is not synchronous with the pulses, and
counts before the window opens, blind nobody: the detector is armed at the window's start.

What it could change (`bound`), as echoes are shifted towards their start, thinned, or hidden by what came before: what
is left of the echo (see `Blindness`) strays, and is missed or mistaken, as fewer photons do: bounds grow by the
difference. Nothing of this can be where no pulse has two counts: lost is at most the expected number of counts that are
not there. Echoes are those that the air leaves, and haze is part of what they are mistaken for. Without an echo,
background that is uneven is taken for one more often than is allowed, and haze less often than without.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from lidardesign.geometry.rays import Rays
from lidardesign.scene import Scene
from lidardesign.simulate.detector.detector import Bins, Detector, Photons, metres
from lidardesign.simulate.effects.expected_counts import (
    Blindness,
    Counts,
    count_text,
    missed_behind,
    unevenness,
    variance_of_missing,
)
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits
from lidardesign.simulate.streams import normal, uniform

# More photons in one bin than this are counted together, by mean and variance of how many pulses they fall into
ONE_BY_ONE = 32
# Expected hits of alive pulses below which a rounded normal would be wrong on average
FEW_PULSES = 8.0
# More photons per pulse in one bin than this are no more: they leave a pulse without any with the probability exp(-32)
MOST_PER_PULSE = 32
# A ray with more photons than this, where dead times reach across pulses, is followed in a share of its pulses only
MOST_PHOTONS = 1 << 21
# draws of a ray: one per photon by its bin and its place among the bin's photons, so that a photon more or less changes
# nothing in other bins; and far beyond one per bin
DRAWS_PER_BIN = 1 << 32
FIRST_BIN = 1 << 62


def survive_dead_time(
    counts: np.ndarray, bins: Bins, photons: Photons, rays: int, key: int, first_ray: int
) -> np.ndarray:
    """The photons that are counted among those that arrive, flat as `bins` says.

    Arguments:
        counts: Arriving photons per bin, over all pulses of a frame.
        bins: Of N rays.
        photons: Its dead time and its pulses.
        rays: How many rays share the pulses.
        key: Of this effect's random numbers.
        first_ray: Index of the first of the N rays.
    """
    if photons.dead_s == 0:
        return counts
    pulses = max(round(photons.pulses(rays)), 1)
    dead_bins = metres(photons.dead_s) / bins.width_m
    period_bins = metres(1 / photons.repetition_hz) / bins.width_m
    return _counted(counts, bins.offset, pulses, dead_bins, period_bins, np.uint64(key), first_ray)


@njit(cache=True, nogil=True)
def _counted(counts, offset, pulses, dead, period, key, first_ray):  # noqa: ANN001, ANN202
    found = np.zeros_like(counts)
    for i in range(len(offset) - 1):
        arrived, mine = counts[offset[i] : offset[i + 1]], found[offset[i] : offset[i + 1]]
        if len(arrived) - 1 + dead < period:
            _within_pulses(arrived, mine, pulses, dead, key, first_ray + i)
        else:
            _across_pulses(arrived, mine, pulses, dead, period, key, first_ray + i)
    return found


@njit(cache=True, nogil=True)
def _within_pulses(arrived, mine, pulses, dead, key, ray):  # noqa: ANN001, ANN202
    """Bin after bin: a photon finds its pulse alive with the share of pulses without a count in the dead time."""
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
    """How many of the alive pulses get at least one of so many photons: a rounded normal of its mean and variance.

    Where it is few, the binomial quantile of the normal number z, as if pulses got photons independently.
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
    """The least number of successes whose distribution function reaches a share."""
    count = 0
    probability = math.exp(trials * math.log(failure))
    total = probability
    while total < share and count < trials:
        probability *= (trials - count) / (count + 1.0) * (1 - failure) / failure
        count += 1
        total += probability
    return count


@njit(cache=True, nogil=True)
def _one_of(arrived, shares):  # noqa: ANN001, ANN202
    """One of so many equal shares of photons, evenly over time."""
    total, before = 0, 0
    found = np.empty_like(arrived)
    for b in range(len(arrived)):
        total += arrived[b]
        found[b] = total // shares - before
        before += found[b]
    return found


@njit(cache=True, nogil=True)
def _across_pulses(arrived, mine, pulses, dead, period, key, ray):  # noqa: ANN001, ANN202
    """Photon after photon in the order of time, where a count may blind the pulses after its own."""
    arrived = np.minimum(arrived, MOST_PER_PULSE * pulses)
    total = arrived.sum()
    if total > MOST_PHOTONS and pulses > 1:
        shares = min(total // MOST_PHOTONS + 1, pulses)
        _across_pulses(_one_of(arrived, shares), mine, pulses // shares, dead, period, key, ray)
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
    """Times pulse * size + bin that are in the order of bins, in the order of pulses and then bins (counting sort)."""
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


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why it is never blind, if so."""
    if detector.photons is None:
        return "the detector does not count photons"
    return None if detector.photons.dead_s > 0 else "the detector has no dead time"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Of counts that blind it."""
    sigma_m = first_hits.sigma_m()
    blind = Blindness.of(counts)
    squared = (sigma_m * blind.early) ** 2 + variance_of_missing(counts, counts.in_air, blind.left, sigma_m)
    lost = np.where(first_hits.returned, _beaten(counts, blind, sigma_m), _invented(counts, blind))
    typical = float(np.median(blind.per_pulse[first_hits.returned] if first_hits.returned.any() else blind.per_pulse))
    dead_ns = 1e9 * first_hits.detector.photons.dead_s
    return EffectBound(squared, lost, f"{count_text(typical)} counts a pulse, {dead_ns:.3g} ns blind after each")


def _beaten(counts: Counts, blind: Blindness, sigma_m: np.ndarray) -> np.ndarray:
    """How much more often what is left of an echo is missed or mistaken.

    With Y Poisson of mean m and f(Y) the probability that Y counts are beaten, which falls with Y,
    |d/dm E f(Y)| = E[f(Y) - f(Y + 1)] <= E f(Y): what is gone makes at most its number times that more mistakes.
    """
    per_bin, haze = counts.per_bin, [counts.pulses * part for part in counts.haze_per_pulse]
    gone = counts.in_air - blind.left + counts.pulse_bins * per_bin * (1 - blind.under)
    in_light = missed_behind(counts, blind, sigma_m) - counts.missed(counts.in_air, per_bin, sigma_m)
    in_the_dark = counts.missed(blind.left, 0.0, sigma_m) - counts.missed(counts.in_air, 0.0, sigma_m)
    missed = np.maximum(np.maximum(in_light, in_the_dark), 0.0)
    any_count = -np.expm1(-counts.bins * per_bin - haze[0])
    mistaken = counts.mistaken(blind.left, per_bin + haze[1], per_bin * blind.under, sigma_m)
    return np.minimum(missed + np.clip(gone, 0.0, 1.0) * np.minimum(mistaken, any_count), 1.0)


def _invented(counts: Counts, blind: Blindness) -> np.ndarray:
    """How much more or less often background is taken for a return; not at all where none of it is gone, (N,)."""
    haze = counts.pulses * counts.haze_per_pulse[0]
    gone = (counts.per_bin * counts.bins + haze) * (1 - blind.level)
    return np.minimum(unevenness(counts, blind) - np.expm1(-haze), np.minimum(gone, 1.0))
