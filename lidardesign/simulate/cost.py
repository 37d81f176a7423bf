"""What simulating an effect takes, predicted per ray and frame.

Measured on one core (2.5 GHz) with a face of 20,000 triangles, some hundred photons per ray and a gate of 1 m, each
effect added to photon noise alone. Elsewhere the relation between effects holds roughly; full sunlight and wide gates
take several times as much.
"""

from __future__ import annotations

from lidardesign.simulate.detector import Detector

# Per further sub-ray of a beam [s].
SUB_RAY_SECONDS = 3e-7
# Per ray, whatever detects [s]; detours are rendered by another program.
LIGHT_SECONDS = {"motion": 4e-7, "specular": 1.8e-6, "shadowing": 1e-6, "multipath": 3e-3}
# Per ray, where photons are counted [s].
PHOTON_SECONDS = {"photon_noise": 2e-6, "jitter": 3e-7, "ambient": 4e-7, "pile_up": 5e-6, "atmosphere": 3.5e-6}
ROUNDING_SECONDS = 1e-7


def predicted_seconds(effect: str, detector: Detector, rays: int) -> float:
    """Of an effect for so many rays over all frames [s]."""
    if effect == "footprint":
        return rays * (detector.footprint_rays - 1) * SUB_RAY_SECONDS
    if effect in LIGHT_SECONDS:
        return rays * LIGHT_SECONDS[effect]
    if effect in PHOTON_SECONDS and detector.photons is not None:
        return rays * PHOTON_SECONDS[effect]
    return rays * ROUNDING_SECONDS
