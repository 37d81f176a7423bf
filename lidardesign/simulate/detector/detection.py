"""From echoes to what a detector reports: the strongest echo, or the return that it finds among counted photons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.detector.detector import FWHM_PER_SIGMA, metres
from lidardesign.simulate.detector.histogram import Bins, check_windows, resolution_m
from lidardesign.simulate.detector.light import Background, Echoes
from lidardesign.simulate.physics import COUNTED, Physics

if TYPE_CHECKING:
    from lidardesign.simulate.detector.counting import Light

# Bins that are filled at once: 32 MB of counts, whatever the number of rays
BINS_AT_ONCE = 1 << 22
# Rays that are counted at once: of the photons that are followed one by one, some 100 MB at most
RAYS_AT_ONCE = 4096
# A range further than this many standard deviations (and half a bin) from every echo was found in noise
EXPLAINED_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class Detections:
    """What a detector reports of N rays.

    Arguments:
        path_m: Half the whole path, NaN without a return, shape (N,) [m].
        body: The body whose echo it is, -1 where noise was taken for one and without a return, shape (N,).
    """

    path_m: np.ndarray
    body: np.ndarray


def detect(
    scene: Scene, frame: int, windows_m: np.ndarray, echoes: Echoes, background: Background, physics: Physics
) -> Detections:
    """What a detector reports of all rays of a frame, which share the emitter's light.

    Arguments:
        scene, frame: They name the random streams.
        windows_m: The half paths that each ray listens to, closed at the start and open at the end, shape (N, 2) [m].
        echoes: The light that comes back.
        background: Counts that no surface sent back.
        physics: The detector and the effects that are on.

    Raises:
        ConfigError: A window that the detector's histogram does not cover.
    """
    check_windows(windows_m, physics.detector)
    if physics.detector.photons is None or not physics.effects & COUNTED:
        return _strongest(scene, frame, windows_m, echoes, physics)
    path_m = np.full(len(windows_m), np.nan)
    from lidardesign.simulate.detector.counting import Light

    light = Light.of(windows_m, echoes, background, physics)
    for begin, end in chunks(light.bins):
        path_m[begin:end] = _from_photons(scene, frame, light.part(begin, end), physics)
    return Detections(path_m, _explained(path_m, windows_m, echoes, light.bins.width_m, physics))


def chunks(bins: Bins) -> Iterator[tuple[int, int]]:
    """Rays that are counted together, as begin and end, so that their bins fit into memory."""
    begin = 0
    while begin < len(bins):
        end = int(np.searchsorted(bins.offset, bins.offset[begin] + BINS_AT_ONCE, side="right")) - 1
        end = min(max(end, begin + 1), begin + RAYS_AT_ONCE)
        yield begin, end
        begin = end


def _from_photons(scene: Scene, frame: int, light: Light, physics: Physics) -> np.ndarray:
    """The half paths that are read from a chunk's histograms, NaN without a return [m]."""
    from lidardesign.simulate.detector.counting import histogram

    detector, bins = physics.detector, light.bins
    counts = histogram(scene, frame, light, physics)
    sigma_m = metres(detector.timing_sigma_s)
    half = int(FWHM_PER_SIGMA * sigma_m / (2 * bins.width_m))
    known = _known_level(light, physics)
    matched = detector.estimator == "matched"
    judged = (counts, bins.offset, bins.heard_ends, bins.width_m, sigma_m, half, known, detector.false_alarm, matched)
    if detector.correction == "coates" and "pile_up" in physics.effects and detector.photons.dead_s > 0:
        from lidardesign.simulate.detector.estimate_kernels import find_corrected

        times_m = metres(detector.photons.dead_s), metres(1 / detector.photons.repetition_hz)
        place = find_corrected(*judged, max(light.pulses, 1.0), *(time_m / bins.width_m for time_m in times_m))
    else:
        from lidardesign.simulate.detector.estimate_kernels import find_returns

        place = find_returns(*judged)
    low, high = bins.windows_m[:, 0], bins.windows_m[:, 1]
    return np.clip(bins.first_m + place * bins.width_m, low, np.nextafter(high, low))


def _known_level(light: Light, physics: Physics) -> np.ndarray:
    """Background counts per bin that a detector measures between its pulses, shape (N,): blind after each, or not.

    With a correction, they are those of pulses that are all alive; at most one per pulse and bin.
    """
    detector, width_m = physics.detector, light.bins.width_m
    arriving = light.per_metre * width_m
    if "pile_up" not in physics.effects:
        return light.pulses * arriving
    if detector.correction == "coates" and detector.photons.dead_s > 0:
        return light.pulses * -np.expm1(-arriving)
    return light.pulses * arriving / (1 + light.per_metre * metres(detector.photons.dead_s))


def _strongest(scene: Scene, frame: int, windows_m: np.ndarray, echoes: Echoes, physics: Physics) -> Detections:
    """The strongest echo in each window; those that the detector cannot tell from it, as their mean by gain."""
    count, detector = len(windows_m), physics.detector
    inside = (echoes.path_m >= windows_m[echoes.ray, 0]) & (echoes.path_m < windows_m[echoes.ray, 1])
    echoes = echoes.kept(inside & (echoes.gain > 0))
    rising = np.argsort(echoes.gain, kind="stable")
    best = np.full(count, -1)
    best[echoes.ray[rising]] = rising
    found = best >= 0
    path_m, body = np.full(count, np.nan), np.full(count, -1)
    path_m[found], body[found] = echoes.path_m[best[found]], echoes.body[best[found]]
    path_m += _merging(path_m, best, echoes, resolution_m(detector))
    if "jitter" in physics.effects:
        from lidardesign.simulate.effects.jitter import displaced

        key = physics.stream("jitter", scene, frame)
        path_m = displaced(path_m, np.arange(count), np.zeros(count, int), detector, key)
        path_m = np.clip(path_m, windows_m[:, 0], np.nextafter(windows_m[:, 1], windows_m[:, 0]))
    if "quantisation" in physics.effects:
        from lidardesign.simulate.effects.quantisation import rounded

        path_m = rounded(path_m, windows_m, detector)
    return Detections(path_m, body)


def _merging(path_m: np.ndarray, best: np.ndarray, echoes: Echoes, resolution: float) -> np.ndarray:
    """How far echoes near the strongest one (index `best`, -1: none) move each ray's range [m]."""
    away = echoes.path_m - path_m[echoes.ray]
    near = np.abs(away) <= resolution
    ray = echoes.ray[near]
    weight = echoes.gain[near] / echoes.gain[best[ray]]
    moved = np.bincount(ray, weights=weight * away[near], minlength=len(path_m))
    total = np.bincount(ray, weights=weight, minlength=len(path_m))
    return moved / np.where(total > 0, total, 1.0)


def _explained(
    path_m: np.ndarray, windows_m: np.ndarray, echoes: Echoes, width_m: float, physics: Physics
) -> np.ndarray:
    """The body of the strongest echo near each detected half path, -1 where there is none."""
    tolerance = EXPLAINED_SIGMAS * metres(physics.detector.timing_sigma_s) + width_m / 2
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero((np.abs(echoes.path_m - path_m[echoes.ray]) <= tolerance) & (echoes.gain > 0))
    rising = near[np.argsort(echoes.gain[near], kind="stable")]
    body = np.full(len(windows_m), -1)
    body[echoes.ray[rising]] = echoes.body[rising]
    return body
