"""What a detector measures of a list of rays when optional effects are on.

Light is followed in the order in which it travels: beams leave (`footprint`), meet what stands or moves there
(`motion`), come back from it directly and by detours (`specular`, `multipath`), to a receiver that may stand elsewhere
(`shadowing`), weakened by the air (`atmosphere`); then photons are counted and timed (`detection`). Each effect is one
module of `simulate.effects`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Hits, Outcome, Rays, Returns, gate_outcomes
from lidardesign.geometry.receiver import path_windows, range_of_path
from lidardesign.scene import Scene
from lidardesign.simulate.detector.detection import ArrivingLight, count_photons, detect
from lidardesign.simulate.detector.detector import check_windows
from lidardesign.simulate.effects.ambient import add_ambient
from lidardesign.simulate.effects.atmosphere import through_air
from lidardesign.simulate.effects.footprint import split_beams
from lidardesign.simulate.effects.motion import moving_tracer, still_tracer
from lidardesign.simulate.effects.multipath import interreflections
from lidardesign.simulate.effects.shadowing import visible_echoes
from lidardesign.simulate.effects.specular import detours
from lidardesign.simulate.light import Background, Beams, Echoes, direct_echoes
from lidardesign.simulate.physics import Physics


def measure(scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics) -> Returns:
    """What a detector reports of rays in a frame of a scene.

    Arguments:
        scene: What the rays meet.
        frame: The time frame.
        rays: The rays that share the emitter's energy, N of them.
        caster: Of this frame.
        physics: The detector and at least one effect.
    """
    light = followed_light(scene, frame, rays, caster, physics)
    found = detect(scene, frame, light.windows_m, light.echoes, light.background, physics)
    # rays without a return keep the outcome of their geometry, or were not detected
    first = np.full(len(rays), np.inf)
    np.minimum.at(first, light.beams.ray, light.hits.range_m)
    outcome = gate_outcomes(first, rays.gate_m)
    outcome[outcome == Outcome.RETURN] = Outcome.NOT_DETECTED
    range_m = range_of_path(rays, scene.receiver, found.path_m)
    detected = np.isfinite(range_m)
    outcome[detected] = Outcome.RETURN
    return Returns(rays, outcome, range_m, np.where(detected, found.body, -1), frame=frame)


class FollowedLight(NamedTuple):
    """What arrives of rays' light, before anything is detected."""

    beams: Beams
    hits: Hits
    windows_m: np.ndarray
    echoes: Echoes
    background: Background


def followed_light(scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics) -> FollowedLight:
    """The light of rays on its way out and back, as far as the effects that are on lead it; see `measure`."""
    effects, detector = physics.effects, physics.detector
    tracer = moving_tracer(scene, frame) if "motion" in effects else still_tracer(caster)
    beams = Beams.of(rays)
    if "footprint" in effects:
        beams = split_beams(beams, detector)
    hits = tracer(beams.origin_m, beams.direction, beams.time_s)
    echoes = direct_echoes(scene, beams, hits)
    if "shadowing" in effects and scene.receiver is not None:
        echoes = visible_echoes(scene, beams, hits, echoes, tracer)
    if "specular" in effects:
        echoes = Echoes.joined([echoes, detours(scene, beams, hits, tracer)])
    if "multipath" in effects:
        echoes = Echoes.joined([echoes, interreflections(scene, frame, rays, physics)])
    windows_m = path_windows(rays, scene.receiver)
    background = Background(np.zeros(len(rays)))
    if "atmosphere" in effects:
        echoes, background = through_air(scene, rays, beams, hits, windows_m, echoes, detector, background)
    if "ambient" in effects:
        background = add_ambient(scene, rays, beams, hits, detector, background)
    return FollowedLight(beams, hits, windows_m, echoes, background)


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
    whole = ArrivingLight.of(light.windows_m, light.echoes, light.background, physics)
    number = np.diff(whole.bins.offset)
    counts = np.zeros((len(rays), number.max(initial=0)), np.int64)
    for begin, end in whole.bins.chunks():
        filled = np.arange(counts.shape[1]) < number[begin:end, None]
        counts[begin:end][filled] = count_photons(scene, frame, whole.part(begin, end), physics)
    return PhotonHistograms(whole.bins.first_m, whole.bins.width_m, number, counts, whole.pulses)
