"""What simulating an effect takes, predicted from its work: sub-rays, rays at their own time, photons.

Seconds on one core of the machine that this was written on (2.5 GHz): elsewhere the relation between effects holds.
"""

from __future__ import annotations

from lidardesign.simulate.detector import Detector

# Casting a ray and following its echo [s].
RAY_SECONDS = 1.5e-6
# Per ray [s]: body by body at its own time; a few mirrors and panes; a second ray to the receiver; cells of air.
PER_RAY_SECONDS = {"motion": 1e-5, "specular": 1e-5, "shadowing": 5e-6, "atmosphere": 2e-5, "multipath": 3e-4}
# Per ray [s], where photons are counted into histograms, and where a time is only rounded or moved.
COUNTED_SECONDS, TIMED_SECONDS = 2e-5, 2e-7


def predicted_seconds(effect: str, detector: Detector, rays: int) -> float:
    """Of an effect for so many rays over all frames [s]."""
    if effect == "footprint":
        return rays * (detector.footprint_rays - 1) * RAY_SECONDS
    if effect in PER_RAY_SECONDS:
        return rays * PER_RAY_SECONDS[effect]
    return rays * (TIMED_SECONDS if detector.photons is None else COUNTED_SECONDS)
