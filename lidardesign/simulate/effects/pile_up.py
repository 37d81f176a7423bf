"""Pile-up: dead time after a count hides later photons of the same pulse and of further pulses.

Every photon falls into one of a ray's P pulses, each as likely as the others. A pulse in which nothing was counted
within the dead time before is alive; in it, the photon is counted. Light that is not synchronous with the pulses, and
counts before the window opens, blind nobody: the detector is armed at the window's start.

Bound of its effect (`bound`), as echoes are shifted towards their start, thinned, or hidden by earlier counts: the
rest of the echo (see `Blindness`) is missed or mistaken, and its range errs, as with fewer photons; the bound is the
difference. Only pulses with two counts lose any: the lost share is at most the expected number of missing counts.
Echoes are attenuated by the air, and may be mistaken for haze. Without an echo, uneven background is taken for one more
often than the false-alarm rate, and haze less often than without dead time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.physics import Bins, Detector, Photons, metres
from lidardesign.simulate.effects.expected_counts import (
    Blindness,
    Counts,
    count_text,
    missed_behind,
    unevenness,
    variance_of_missing,
)
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits


def survive_dead_time(
    counts: np.ndarray, bins: Bins, photons: Photons, pulses: np.ndarray, key: int, first_ray: int
) -> np.ndarray:
    """Counted photons per bin among those that arrive, flat with the offsets of `bins`.

    Arguments:
        counts: Arriving photons per bin, over all pulses of a frame.
        bins: Bins of N rays.
        photons: The detector's dead time and time between pulses.
        pulses: Pulses of each ray, shape (N,).
        key: Key of this effect's random numbers.
        first_ray: Index of the first of the N rays.
    """
    if photons.dead_s == 0:
        return counts
    whole = np.maximum(np.round(pulses), 1).astype(np.int64)
    dead_bins = metres(photons.dead_s) / bins.width_m
    period_bins = metres(1 / photons.repetition_hz) / bins.width_m
    # compiled on import, which bounds do not need
    from lidardesign.simulate.detector.dead_time import count_alive

    return count_alive(counts, bins.offset, whole, dead_bins, period_bins, np.uint64(key), first_ray)


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why pile-up changes nothing, or None."""
    if detector.photons is None:
        return "the detector does not count photons"
    return None if detector.photons.dead_s > 0 else "the detector has no dead time"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of dead time."""
    sigma_m, blind = first_hits.sigma_m(), Blindness.of(counts)
    squared = (sigma_m * blind.early) ** 2 + variance_of_missing(counts, counts.in_air, blind.left, sigma_m)
    # Increase of the probability that the rest of an echo is missed or mistaken
    per_bin, haze = counts.per_bin, [counts.pulses * part for part in counts.haze_per_pulse]
    gone = counts.in_air - blind.left + counts.pulse_bins * per_bin * (1 - blind.under)
    squared += np.clip(gone, 0.0, 1.0) * counts.level_m2
    in_light = missed_behind(counts, blind, sigma_m) - counts.missed(counts.in_air, per_bin, sigma_m)
    in_the_dark = counts.missed(blind.left, 0.0, sigma_m) - counts.missed(counts.in_air, 0.0, sigma_m)
    missed = np.maximum(np.maximum(in_light, in_the_dark), 0.0)
    any_count = -np.expm1(-counts.bins * per_bin - haze[0])
    mistaken = counts.mistaken(blind.left, per_bin + haze[1], per_bin * blind.under, sigma_m)
    lost = np.minimum(missed + np.clip(gone, 0.0, 1.0) * np.minimum(mistaken, any_count), 1.0)
    # where there is no return, background is taken for one
    stray = haze[0] + counts.leaked(sigma_m)
    fewer = (per_bin * counts.bins + stray) * (1 - blind.level)
    invented = np.minimum(unevenness(counts, blind) - np.expm1(-stray), np.minimum(fewer, 1.0))
    typical = float(np.median(blind.per_pulse[first_hits.returned] if first_hits.returned.any() else blind.per_pulse))
    dead_ns = 1e9 * first_hits.detector.photons.dead_s
    lost = np.where(first_hits.returned, lost, invented)
    return EffectBound(squared, lost, f"{count_text(typical)} counts per pulse, {dead_ns:.3g} ns blind after each")
