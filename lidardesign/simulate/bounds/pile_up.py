r"""A detector that is blind after a count: echoes shifted towards their start, thinned, or hidden by what came before.

Per pulse s counts of the echo and m counts before it are expected. The echo's first photon is the one that counts, with
the probability exp(-m) (1 - exp(-s)) instead of s counts; every count also blinds the pulses that its dead time covers,
which leaves the share 1 / (1 + c r) of them, c pulses covered, r counts per pulse. Of K photons, normal with sigma, the
first is early by at most sigma min(sqrt(2 ln K), (K - 1) / sqrt(pi)), in the mean over K >= 1 as well (both bounds are
concave in K or linear; Jensen), with E K = s / (1 - exp(-s)).

What is left of the echo strays, and is missed or mistaken, as fewer photons do: bounds grow by the difference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scene import Scene
from lidardesign.simulate.bounds.counts import Counts, Echo, changed_share
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector, metres
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why it is never blind, if so."""
    if detector.photons is None:
        return "the detector does not count photons"
    return None if detector.photons.dead_s > 0 else "the detector has no dead time"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of counts that blind it."""
    sigma_m = sight.sigma_m()
    echo = safe_divide(counts.in_air, counts.pulses)
    haze = counts.haze_per_pulse[0]
    before = counts.background_per_metre * sight.before_m + haze
    whole = counts.background_per_metre * sight.width_m + haze + echo
    first = -np.expm1(-echo)
    photons = sight.detector.photons
    covered = np.floor((photons.dead_s + sight.width_m / metres(1)) * photons.repetition_hz)
    awake = 1 / (1 + covered * -np.expm1(-whole))
    left = counts.pulses * awake * np.exp(-before) * first
    gone = counts.in_air - left
    several = np.maximum(safe_divide(echo, first, 1.0), 1.0)
    early = np.minimum(np.sqrt(2 * np.log(several)), (several - 1) / math.sqrt(math.pi))
    squared = (sigma_m * early) ** 2 + _strayed(counts, left, sigma_m)
    lost = _beaten(counts, left, np.clip(gone, 0.0, 1.0), sigma_m)
    reason = f"{_typical(sight, whole):.2g} counts a pulse, {1e9 * photons.dead_s:.3g} ns blind after each"
    return Stake(squared, np.where(sight.returned, lost, 0.0), reason)


def _strayed(counts: Counts, left: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """Variance by what is not there: all of the error where many photons are gone, its share where few are."""
    gone = changed_share(counts.in_air, left)
    error = counts.error_m(left, sigma_m) ** 2
    if counts.sight.detector.estimator == "matched":
        return error * gone
    return error * np.minimum(2 * np.sqrt(gone), 1.0)


def _beaten(counts: Counts, left: np.ndarray, gone: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """How much more often fewer photons are missed or mistaken.

    With Y Poisson of mean m and f(Y) the probability that Y counts are beaten, which falls with Y,
    |d/dm E f(Y)| = E[f(Y) - f(Y + 1)] <= E f(Y): what is gone makes at most its number times that more mistakes.
    """
    per_bin = counts.per_bin
    fullest = per_bin + counts.pulses * counts.haze_per_pulse[1]
    missed = counts.more_missed(Echo(counts.in_air, sigma_m), Echo(left, sigma_m))
    any_count = -np.expm1(-counts.bins * per_bin - counts.pulses * counts.haze_per_pulse[0])
    mistaken = np.minimum(counts.mistaken(left, fullest, per_bin, sigma_m), any_count)
    return np.clip(missed + gone * mistaken, 0.0, 1.0)


def _typical(sight: Sight, whole: np.ndarray) -> float:
    return float(np.median(whole[sight.returned])) if sight.returned.any() else float(np.median(whole))
