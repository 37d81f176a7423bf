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
    # compiled loops, which bounds do without
    from lidardesign.simulate.detector.dead_time import count_alive

    return count_alive(counts, bins.offset, pulses, dead_bins, period_bins, np.uint64(key), first_ray)


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why it is never blind, if so."""
    if detector.photons is None:
        return "the detector does not count photons"
    return None if detector.photons.dead_s > 0 else "the detector has no dead time"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Of counts that blind it."""
    sigma_m, blind = first_hits.sigma_m(), Blindness.of(counts)
    squared = (sigma_m * blind.early) ** 2 + variance_of_missing(counts, counts.in_air, blind.left, sigma_m)
    # How much more often what is left of an echo is missed or mistaken
    per_bin, haze = counts.per_bin, [counts.pulses * part for part in counts.haze_per_pulse]
    gone = counts.in_air - blind.left + counts.pulse_bins * per_bin * (1 - blind.under)
    squared += np.clip(gone, 0.0, 1.0) * counts.level_m2
    in_light = missed_behind(counts, blind, sigma_m) - counts.missed(counts.in_air, per_bin, sigma_m)
    in_the_dark = counts.missed(blind.left, 0.0, sigma_m) - counts.missed(counts.in_air, 0.0, sigma_m)
    missed = np.maximum(np.maximum(in_light, in_the_dark), 0.0)
    any_count = -np.expm1(-counts.bins * per_bin - haze[0])
    mistaken = counts.mistaken(blind.left, per_bin + haze[1], per_bin * blind.under, sigma_m)
    lost = np.where(
        first_hits.returned,
        np.minimum(missed + np.clip(gone, 0.0, 1.0) * np.minimum(mistaken, any_count), 1.0),
        _invented(counts, blind),
    )
    typical = float(np.median(blind.per_pulse[first_hits.returned] if first_hits.returned.any() else blind.per_pulse))
    dead_ns = 1e9 * first_hits.detector.photons.dead_s
    return EffectBound(squared, lost, f"{count_text(typical)} counts per pulse, {dead_ns:.3g} ns blind after each")


def _invented(counts: Counts, blind: Blindness) -> np.ndarray:
    """How much more or less often background is taken for a return; not at all where none of it is gone, (N,)."""
    stray = counts.pulses * counts.haze_per_pulse[0] + counts.leaked(counts.first_hits.sigma_m())
    gone = (counts.per_bin * counts.bins + stray) * (1 - blind.level)
    return np.minimum(unevenness(counts, blind) - np.expm1(-stray), np.minimum(gone, 1.0))
