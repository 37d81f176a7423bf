"""The photon histograms that a detector would hand out, one per ray: what captures consist of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.scene import Scene
from lidardesign.simulate.counting import Light, histogram
from lidardesign.simulate.detection import chunks
from lidardesign.simulate.histogram import check_windows
from lidardesign.simulate.physics import Physics, followed_light
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.simulate.returns import Rays


@dataclass(frozen=True, eq=False)
class PhotonHistograms:
    """Counts over time of N rays.

    Arguments:
        start_m: Where each ray's first bin starts, as half the whole path, shape (N,) [m]. The first and the last bin
            hold only what lies within the ray's gate.
        width_m: Of a bin, in half paths [m].
        number: How many bins each ray has, shape (N,).
        counts: Photons counted per bin, zero beyond a ray's own bins, shape (N, most bins).
        pulses: How many pulses each ray got.
    """

    start_m: np.ndarray
    width_m: float
    number: np.ndarray
    counts: np.ndarray
    pulses: float


def photon_histograms(
    scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics
) -> PhotonHistograms:
    """The histograms that `simulate` finds the returns of rays in, with the same random numbers.

    Arguments:
        scene: What the rays meet.
        frame: The time frame.
        rays: The rays that share the emitter's energy, N of them.
        caster: Of this frame.
        physics: A detector that counts photons, and the effects that are on.

    Raises:
        ConfigError: The detector counts no photons, or its histogram does not cover a gate.
    """
    detector = physics.detector
    if detector.photons is None:
        raise ConfigError(
            f"the detector {detector.name!r} counts no photons",
            where="--detector",
            allowed="one with a light budget, as single-photon",
        )
    light = followed_light(scene, frame, rays, caster, physics)
    check_windows(light.windows_m, detector)
    whole = Light.of(light.windows_m, light.echoes, light.background, physics)
    number = np.diff(whole.bins.offset)
    counts = np.zeros((len(rays), number.max(initial=0)), np.int64)
    for begin, end in chunks(whole.bins):
        filled = np.arange(counts.shape[1]) < number[begin:end, None]
        counts[begin:end][filled] = histogram(scene, frame, whole.part(begin, end), physics)
    return PhotonHistograms(whole.bins.first_m, whole.bins.width_m, number, counts, whole.pulses)


def coates(counts: np.ndarray, pulses: float) -> np.ndarray:
    """Photons per pulse that arrived in each bin, from those that a detector counted which is blind after the first.

    A bin's photons can only be counted in pulses that were not over: log((P - C_before) / (P - C_to_here)), with C the
    running count (Coates 1968). In bins after the last pulse was used up nothing is known: NaN.

    Arguments:
        counts: Photons counted per bin, from the time on at which the detector was armed, shape (..., B).
        pulses: How many pulses there were.

    Raises:
        ConfigError: More photons were counted than there were pulses.
    """
    counts = np.asarray(counts, dtype=np.float64)
    used = np.cumsum(counts, axis=-1)
    if (used[..., -1:] > pulses).any() or (counts < 0).any():
        raise ConfigError(
            f"{used[..., -1:].max():g} photons in {pulses:g} pulses",
            where="Coates' correction",
            allowed="at most one photon per pulse, and no negative counts",
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        arrived = np.log((pulses - used + counts) / (pulses - used))
    return np.where(pulses - used > 0, arrived, np.nan)
