"""Returns of a list of rays in a scene: exact first hits, or detected returns where effects are simulated.

Rays are traced from the sensor, not from the start of the gate, so a surface between the sensor and the gate hides
everything behind it.

With effects, light is followed in the order in which it travels: beams leave (`footprint`), hit static or moving bodies
(`motion`), come back from them directly and by detours (`specular`, `multipath`), to a receiver that may be elsewhere
(`shadowing`), attenuated by the air (`atmosphere`); then photons are counted and timed (`detection`). Each effect is
one module of `simulate.effects`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.scenes.casting import SceneCaster, checked_rays, first_hits
from lidardesign.scenes.rays import Hits, Outcome, Rays, Returns, gate_outcomes, path_windows, range_of_path
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import Background, Beams, Echoes, direct_echoes
from lidardesign.simulate.detector.physics import Physics, check_windows, chunks
from lidardesign.simulate.effects.ambient import add_ambient
from lidardesign.simulate.effects.atmosphere import through_air
from lidardesign.simulate.effects.footprint import split_beams
from lidardesign.simulate.effects.motion import moving_tracer, still_tracer
from lidardesign.simulate.effects.multipath import interreflections
from lidardesign.simulate.effects.shadowing import visible_echoes
from lidardesign.simulate.effects.specular import detours


def simulate(
    scene: Scene, rays: Rays, *, casters: Sequence[SceneCaster] | None = None, physics: Physics | None = None
) -> list[Returns]:
    """Simulate the returns of rays in every time frame of a scene.

    Arguments:
        scene: The scene; targets and occluders both stop rays.
        rays: The rays, fired anew in each frame, N of them.
        casters: One caster per frame, as `build_casters` makes them; None builds them here.
        physics: A detector and the effects that are on; None, or none on: geometry alone.

    Returns:
        One `Returns` per frame, each with N outcomes.

    Raises:
        ConfigError: The number of casters is not the scene's number of frames.
    """
    return simulate_many(scene, [rays], casters=casters, physics=physics)[0]


@phase("tracing")
def simulate_many(
    scene: Scene,
    lists: Sequence[Rays],
    *,
    casters: Sequence[SceneCaster] | None = None,
    physics: Physics | None = None,
    repeats: Sequence[int] | None = None,
) -> list[list[Returns]]:
    """Simulate the returns of several lists of rays in every time frame of a scene, each as in `simulate`.

    All lists are traced together: over many frames, most of the time of short lists goes into the calls.

    Arguments:
        scene: The scene; targets and occluders both stop rays.
        lists: Lists of rays, each fired anew in each frame.
        casters: One caster per frame; None builds them here.
        physics: A detector and the effects that are on; the rays of each sensor in a list share its
            emitter's energy.
        repeats: `Physics.repeat` of each list; None: the same for all lists.

    Returns:
        For each list, one `Returns` per frame.

    Raises:
        ConfigError: The number of casters is not the scene's number of frames.
    """
    casters = build_casters(scene) if casters is None else casters
    if len(casters) != scene.frames:
        raise ConfigError(f"{len(casters)} casters", where=f"scene {scene.name}", allowed=f"{scene.frames}")
    if not lists:
        return []
    if physics is not None and physics.effects:
        each = [physics if repeats is None else replace(physics, repeat=repeats[i]) for i in range(len(lists))]
        return [
            [measure(scene, frame, rays, caster, chance) for frame, caster in enumerate(casters)]
            for rays, chance in zip(lists, each, strict=True)
        ]
    ends = np.cumsum([len(rays) for rays in lists])
    origins, directions, gate_m = (
        np.concatenate([getattr(rays, name) for rays in lists]) for name in ("origin_m", "direction", "gate_m")
    )
    found: list[list[Returns]] = [[] for _ in lists]
    origins, directions = checked_rays(origins, directions)
    for frame, hits in enumerate(first_hits(casters, origins, directions)):
        outcome = gate_outcomes(hits.range_m, gate_m)
        returned = outcome == Outcome.RETURN
        columns = (outcome, np.where(returned, hits.range_m, np.nan), np.where(returned, hits.body, -1))
        for mine, rays, end in zip(found, lists, ends, strict=True):
            rows = slice(end - len(rays), end)
            # copies: a view would keep all the lists' returns alive with it
            mine.append(Returns(rays, *(column[rows].copy() for column in columns), frame=frame))
    return found


@phase("casters")
def build_casters(scene: Scene) -> list[SceneCaster]:
    """One caster per time frame of a scene, to be shared by all designs that are simulated in it."""
    return [SceneCaster(scene, frame) for frame in range(scene.frames)]


def measure(scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics) -> Returns:
    """Returns of rays in a frame of a scene, as a detector reports them.

    Arguments:
        scene: The scene.
        frame: The time frame.
        rays: The rays, N of them; those of a sensor share its emitter's energy.
        caster: Caster of this frame.
        physics: The detector and at least one effect.
    """
    # it loads compiled loops, which geometry alone does without
    from lidardesign.simulate.detection import detect

    light = followed_light(scene, frame, rays, caster, physics)
    path_m, body = detect(scene, frame, rays, light.windows_m, light.echoes, light.background, physics)
    # rays without a return keep the outcome of their geometry, or were not detected
    first = np.full(len(rays), np.inf)
    np.minimum.at(first, light.beams.ray, light.hits.range_m)
    outcome = gate_outcomes(first, rays.gate_m)
    outcome[outcome == Outcome.RETURN] = Outcome.NOT_DETECTED
    range_m = range_of_path(rays, scene.receiver, path_m)
    detected = np.isfinite(range_m)
    outcome[detected] = Outcome.RETURN
    return Returns(rays, outcome, range_m, np.where(detected, body, -1), frame=frame)


class FollowedLight(NamedTuple):
    """Light of rays that arrives at the receiver, before detection."""

    beams: Beams
    hits: Hits
    windows_m: np.ndarray
    echoes: Echoes
    background: Background


def followed_light(scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics) -> FollowedLight:
    """Beams, first hits, echoes and background of rays under the simulated effects; arguments as in `measure`."""
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
    """Photon histograms of N rays.

    Arguments:
        start_m: Start of each ray's first bin in half path, shape (N,) [m]. The first and the last bin
            hold only what lies within the ray's gate.
        width_m: Width of a bin in half path [m].
        number: Number of bins of each ray, shape (N,).
        counts: Photons counted per bin, zero beyond a ray's own bins, shape (N, most bins).
        pulses: Number of pulses of each ray, shape (N,).
    """

    start_m: np.ndarray
    width_m: float
    number: np.ndarray
    counts: np.ndarray
    pulses: np.ndarray


def photon_histograms(scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics) -> PhotonHistograms:
    """Photon histograms in which `simulate` detects the returns of rays, with the same random numbers.

    Arguments:
        scene: The scene.
        frame: The time frame.
        rays: The rays, N of them; those of a sensor share its emitter's energy.
        caster: Caster of this frame.
        physics: A detector that counts photons, and the simulated effects.

    Raises:
        ConfigError: The detector counts no photons, or its histogram does not cover a gate.
    """
    # it loads compiled loops, which geometry alone does without
    from lidardesign.simulate.detection import ArrivingLight, count_photons

    detector = physics.detector
    if detector.photons is None:
        raise ConfigError(
            f"the detector {detector.name!r} counts no photons",
            where="--detector",
            allowed="one with a light budget, as single-photon",
        )
    light = followed_light(scene, frame, rays, caster, physics)
    check_windows(light.windows_m, detector)
    whole = ArrivingLight.of(rays, light.windows_m, light.echoes, light.background, physics)
    number = np.diff(whole.bins.offset)
    counts = np.zeros((len(rays), number.max(initial=0)), np.int64)
    for begin, end in chunks(whole.bins.offset):
        filled = np.arange(counts.shape[1]) < number[begin:end, None]
        counts[begin:end][filled] = count_photons(scene, frame, whole.part(begin, end), physics)
    return PhotonHistograms(whole.bins.first_m, whole.bins.width_m, number, counts, whole.pulses)
