r"""A detector that is blind after a count: echoes shifted towards their start, thinned, or hidden by what came before.

What is left of the echo (see `Blindness`) strays, and is missed or mistaken, as fewer photons do: bounds grow by the
difference. Nothing of this can be where no pulse has two counts: lost is at most the expected number of counts that are
not there. Echoes are those that the air leaves, and haze is part of what they are mistaken for. Without an echo,
background that is uneven is taken for one more often than is allowed, and haze less often than without.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.blindness import Blindness, missed_behind, unevenness, variance_of_missing
from lidardesign.simulate.bounds.counts import Counts, counted
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why it is never blind, if so."""
    if detector.photons is None:
        return "the detector does not count photons"
    return None if detector.photons.dead_s > 0 else "the detector has no dead time"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of counts that blind it."""
    sigma_m = sight.sigma_m()
    blind = Blindness.of(counts)
    squared = (sigma_m * blind.early) ** 2 + variance_of_missing(counts, counts.in_air, blind.left, sigma_m)
    lost = np.where(sight.returned, _beaten(counts, blind, sigma_m), _invented(counts, blind))
    typical = float(np.median(blind.per_pulse[sight.returned] if sight.returned.any() else blind.per_pulse))
    dead_ns = 1e9 * sight.detector.photons.dead_s
    return Stake(squared, lost, f"{counted(typical)} counts a pulse, {dead_ns:.3g} ns blind after each")


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
