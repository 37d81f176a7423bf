"""Timing jitter of diode and converter: an independent normal error of every photon.

Bound of its effect (`bound`): without photons each return has one normal error, (c / 2) sigma_j rms. With n photons
the matched filter averages them: (c / 2) sigma_j / sqrt(n), where bins are as fine; each photon may also change bins
by itself, which adds a bin times (c / 2) sigma_j to the variance of one, and a wider pulse is located elsewhere
between bins. The highest bin does not average; with timing errors its error is `Counts.error_m` of pulse and timing
together, and without them that of the pulse alone, so that the two differ by at most sqrt(e(sigma_p, sigma_j)^2 +
e(sigma_p)^2). A wider echo is also lower: returns are lost where it falls below the detection threshold, or below
background as photons leave their bins, and surfaces outside a gate spill more photons into it. Of several photons in a
pulse a detector with dead time times the first, which is the earlier the larger the timing errors.

The pulse is taken as Gaussian and n as its expectation: an estimate where n is small.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.physics import Detector, metres
from lidardesign.simulate.effects.expected_counts import Blindness, Counts, Echo
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits


def add_timing_errors(
    path_m: np.ndarray, ray: np.ndarray, order: np.ndarray, detector: Detector, key: int
) -> np.ndarray:
    """Half paths with timing errors, of photons by ray and order or of whole returns, shape (K,) [m]."""
    # compiled on import, which bounds do not need
    from lidardesign.simulate.detector.streams import normals

    return path_m + metres(detector.jitter_sigma_s) * normals(key, ray, order)


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why jitter changes nothing, or None."""
    return None if detector.jitter_sigma_s > 0 else "the detector times without error"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of a timing error per return, or per photon."""
    detector = first_hits.detector
    sigma_s, timed = detector.jitter_sigma_s, f"timed to {1e12 * detector.jitter_sigma_s:.3g} ps"
    if detector.photons is None:
        error = np.full(len(first_hits), metres(sigma_s))
        return EffectBound(error**2, np.zeros(len(first_hits)), f"a return is {timed}")
    blind = Blindness.of(counts)
    signal, pulse_m, both_m = blind.left, first_hits.sigma_m(jitter=False), first_hits.sigma_m()
    if detector.estimator == "matched":
        # a wider pulse is located elsewhere between bins
        moved_m = np.minimum(2 * (both_m - pulse_m), first_hits.step_m)
        # and every photon with an error may change bins by itself
        strayed_m2 = metres(sigma_s) * (metres(sigma_s) + (detector.bin_m or 0.0))
        squared = counts.error_m(signal, np.sqrt(strayed_m2)) ** 2 + moved_m**2
    else:
        squared = counts.error_m(signal, both_m) ** 2 + counts.error_m(signal, pulse_m) ** 2
    squared = squared + ((both_m - pulse_m) * blind.early) ** 2
    lost = counts.more_missed(Echo(signal, pulse_m), Echo(signal, both_m))
    # photons that change bins make background win, or not any more
    lost = lost + np.minimum(signal * metres(sigma_s) / counts.bin_m, 1.0) * counts.false_return_probability(
        blind, both_m
    )
    spilled = -np.expm1(-np.maximum(counts.leaked(both_m) - counts.leaked(pulse_m), 0.0))
    return EffectBound(
        squared,
        np.where(first_hits.returned, lost, spilled),
        f"a photon is {timed}; a return has about {counts.typical} of them",
    )
