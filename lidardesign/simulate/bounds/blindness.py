r"""What a detector that is blind after each count leaves of echoes and of background: pile-up, for all bounds.

Per pulse s counts of the echo, m counts before it and w in the whole gate are expected. Of the echo the first photon
counts, with the probability exp(-m) (1 - exp(-s)); every count also blinds the c pulses that its dead time reaches
into, which leaves the share 1 / (1 + c (1 - exp(-w))) of them. Of K photons, normal with sigma, the first is early by
at most sigma min(sqrt(2 ln K), (K - 1) / sqrt(pi)), in the mean over K >= 1 as well (both bounds are concave in K or
linear; Jensen), with E K = s / (1 - exp(-s)).

Background is thinned alike: from all of it at the gate's start to exp(-m) under the echo. Its mean level, which returns
are judged by, lies below its start, so that the start itself may be taken for a return.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.simulate.bounds.counts import Counts, changed_share, share_in_bins
from lidardesign.simulate.detector import metres


@dataclass(frozen=True, eq=False)
class Blindness:
    """What is counted of the light of N rays.

    Arguments:
        left: Counts of the echo, shape (N,).
        awake: The share of the background at the gate's start that is counted, shape (N,).
        under: That of the background under the echo, shape (N,).
        level: That of all background, shape (N,).
        early: How early the first of an echo's photons is, in standard deviations, at most, shape (N,).
        per_pulse: Counts per pulse that arrive, shape (N,).
    """

    left: np.ndarray
    awake: np.ndarray
    under: np.ndarray
    level: np.ndarray
    early: np.ndarray
    per_pulse: np.ndarray

    @classmethod
    def of(cls, counts: Counts, *, ambient: bool = True, haze: bool = True) -> Blindness:
        """With ambient light and dark counts, and with what the air sends back, or as if there were none."""
        sight, photons = counts.sight, counts.sight.detector.photons
        echo = safe_divide(counts.in_air, counts.pulses)
        from_air = counts.haze_per_pulse[0] * haze
        per_metre = counts.background_per_metre * ambient
        whole = per_metre * sight.width_m + from_air + echo
        if photons.dead_s == 0:
            every = np.ones(len(sight))
            return cls(counts.in_air, every, every, every, np.zeros(len(sight)), whole)
        first = -np.expm1(-echo)
        covered = np.floor((photons.dead_s + sight.width_m / metres(1)) * photons.repetition_hz)
        awake = 1 / (1 + covered * -np.expm1(-whole))
        under = awake * np.exp(-(per_metre * sight.before_m + from_air))
        level = awake * safe_divide(-np.expm1(-whole), whole, 1.0)
        several = np.maximum(safe_divide(echo, first, 1.0), 1.0)
        early = np.minimum(np.sqrt(2 * np.log(several)), (several - 1) / math.sqrt(math.pi))
        return cls(counts.pulses * under * first, awake, under, level, early, whole)


def missed_behind(counts: Counts, blind: Blindness, sigma_m: np.ndarray) -> np.ndarray:
    """Probability that what is left of an echo falls below what its gate's mean background asks for, shape (N,)."""
    from scipy.special import pdtr

    width = counts.pulse_bins
    expected = blind.left * share_in_bins(width, counts.bin_m, sigma_m) + width * counts.per_bin * blind.under
    return pdtr(counts.needed(counts.per_bin * blind.level) - 1, expected)


def unevenness(counts: Counts, blind: Blindness) -> np.ndarray:
    """How much more often background is taken for a return because there is more of it where gates start, (N,).

    The union over all bins of what the start's level makes, less what the mean level does.
    """
    from scipy.special import pdtrc

    needed = counts.needed(counts.per_bin * blind.level)
    mean, start = (counts.pulse_bins * counts.per_bin * share for share in (blind.level, blind.awake))
    return np.clip(counts.bins * (pdtrc(needed - 1, start) - pdtrc(needed - 1, mean)), 0.0, 1.0)


def variance_of_missing(counts: Counts, before: np.ndarray, left: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """Variance by what is not there: all of the error where many photons are gone, its share where few are, (N,)."""
    gone = changed_share(before, left)
    error = counts.error_m(left, sigma_m) ** 2
    if counts.sight.detector.estimator == "matched":
        return error * gone
    return error * np.minimum(2 * np.sqrt(gone), 1.0)
