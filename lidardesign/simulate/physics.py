"""What a detector measures of a list of rays when optional effects are on.

Light is followed in the order in which it travels: beams leave (`footprint`), meet what stands or moves there
(`motion`), come back from it directly and by detours (`specular`, `multipath`), to a receiver that may stand elsewhere
(`shadowing`), weakened by the air (`atmosphere`); then photons are counted and timed (`detection`). Each effect is one
module of `simulate.effects`, imported when it is on and never otherwise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Hits, Outcome, Rays, Returns
from lidardesign.geometry.receiver import path_windows, range_of_path
from lidardesign.run.validation import suggest
from lidardesign.scene import Scene
from lidardesign.simulate.detector.detector import IDEAL, Detector
from lidardesign.simulate.detector.light import Background, Beams, Echoes

EFFECTS = {
    "footprint": "beams have a width: mixed pixels, several returns",
    "motion": "things move within a frame",
    "specular": "mirrors and glass lead light elsewhere",
    "multipath": "light comes back by way of other surfaces",
    "shadowing": "the receiver may not see what the emitter lights",
    "atmosphere": "the air weakens light and sends some of it back",
    "photon_noise": "light comes in photons",
    "jitter": "photons are timed with an error",
    "ambient": "light of the surroundings and dark counts",
    "pile_up": "a detector is blind after a count",
    "quantisation": "times are rounded to bins",
}
# Where one of these is on, photons are counted; without them a detector reports the strongest echo.
COUNTED = frozenset({"photon_noise", "jitter", "ambient", "pile_up", "quantisation", "atmosphere"})

# First hits of rays (N, 3), (N, 3) that are sent at times (N,) [s] within the frame.
Tracer = Callable[[np.ndarray, np.ndarray, np.ndarray], Hits]


@dataclass(frozen=True)
class Physics:
    """A detector and the effects that are simulated.

    Arguments:
        detector: How returns are measured.
        effects: Names out of `EFFECTS`.
        seed: Root of every effect's own random stream.
        repeat: Which time the scene is measured: rays that are fired again from elsewhere meet other chance.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """

    detector: Detector = IDEAL
    effects: frozenset[str] = frozenset()
    seed: int = 0
    repeat: int = 0

    def __post_init__(self) -> None:
        check_effects(self.effects)

    def stream(self, effect: str, scene: Scene, frame: int) -> int:
        """The key of an effect's random numbers in a frame of a scene; no other effect changes them."""
        again = (str(self.repeat),) if self.repeat else ()
        label = "\0".join((str(self.seed), effect, scene.name, str(frame), *again))
        return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8], "little")


def check_effects(names: Iterable[str]) -> None:
    """Refuse names that are no effects.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """
    for name in sorted(set(names) - EFFECTS.keys()):
        hint = suggest(name.lower(), EFFECTS)
        raise ConfigError(f"unknown effect {name!r}", where="effects", allowed=", ".join(EFFECTS), hint=hint)


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
    from lidardesign.simulate.detector.detection import detect

    found = detect(scene, frame, light.windows_m, light.echoes, light.background, physics)
    return _returns(scene, frame, rays, light.beams, light.hits, found.path_m, found.body)


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
    tracer = _tracer(scene, frame, caster, effects)
    beams = Beams.of(rays)
    if "footprint" in effects:
        from lidardesign.simulate.effects.footprint import split

        beams = split(beams, detector)
    hits = tracer(beams.origin_m, beams.direction, beams.time_s)
    echoes = direct_echoes(scene, beams, hits)
    echoes = _with_detours(scene, frame, rays, beams, hits, echoes, tracer, physics)
    windows_m = path_windows(rays, scene.receiver)
    background = Background(np.zeros(len(rays)))
    if "atmosphere" in effects:
        from lidardesign.simulate.effects.atmosphere import through_air

        echoes, background = through_air(scene, rays, beams, hits, windows_m, echoes, detector, background)
    if "ambient" in effects:
        from lidardesign.simulate.effects.ambient import lit

        background = lit(scene, rays, beams, hits, detector, background)
    return FollowedLight(beams, hits, windows_m, echoes, background)


def direct_echoes(scene: Scene, beams: Beams, hits: Hits) -> Echoes:
    """The echo of every beam's first hit, wherever it is heard: share * reflectance * cosine / (pi * distance^2)."""
    seen = np.flatnonzero(hits.body >= 0)
    points = beams.origin_m[seen] + hits.range_m[seen, None] * beams.direction[seen]
    origins = beams.origin_m[seen]
    home = origins if scene.receiver is None else np.broadcast_to(np.asarray(scene.receiver.origin_m), origins.shape)
    back = home - points
    # what starts at the receiver comes back by the way that it took, to the last bit
    back_m = np.where((origins == home).all(axis=1), hits.range_m[seen], np.linalg.norm(back, axis=1))
    reflectance = np.array([body.reflectance for body in scene.bodies])[hits.body[seen]]
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.maximum(np.einsum("nk,nk->n", hits.normal[seen], back) / back_m, 0.0)
        gain = beams.share[seen] * reflectance * cosine / (np.pi * back_m**2)
    # a surface that touches the receiver blinds it, unless it is black: finite, and stronger than anything else
    gain = np.nan_to_num(gain, nan=np.finfo(float).max, posinf=np.finfo(float).max) * (reflectance > 0)
    return Echoes(beams.ray[seen], (hits.range_m[seen] + back_m) / 2, gain, hits.body[seen])


def _tracer(scene: Scene, frame: int, caster: SceneCaster, effects: frozenset[str]) -> Tracer:
    if "motion" in effects:
        from lidardesign.simulate.effects.motion import moving_tracer

        return moving_tracer(scene, frame)
    return lambda origins, directions, time_s: caster.first_hit(origins, directions)


def _with_detours(
    scene: Scene,
    frame: int,
    rays: Rays,
    beams: Beams,
    hits: Hits,
    echoes: Echoes,
    tracer: Tracer,
    physics: Physics,
) -> Echoes:
    """The direct echoes with what comes back by other ways, and without what the receiver cannot see."""
    if "shadowing" in physics.effects and scene.receiver is not None:
        from lidardesign.simulate.effects.shadowing import heard

        echoes = heard(scene, beams, hits, echoes, tracer)
    if "specular" in physics.effects:
        from lidardesign.simulate.effects.specular import detours

        echoes = Echoes.joined([echoes, detours(scene, beams, hits, tracer)])
    if "multipath" in physics.effects:
        from lidardesign.simulate.effects.multipath import interreflections

        echoes = Echoes.joined([echoes, interreflections(scene, frame, rays, physics)])
    return echoes


def _returns(
    scene: Scene, frame: int, rays: Rays, beams: Beams, hits: Hits, path_m: np.ndarray, body: np.ndarray
) -> Returns:
    """Measured paths as returns; rays without one keep the outcome of their geometry, or were not detected."""
    from lidardesign.simulate.simulate import gate_outcomes

    first = np.full(len(rays), np.inf)
    np.minimum.at(first, beams.ray, hits.range_m)
    outcome = gate_outcomes(first, rays.gate_m)
    outcome[outcome == Outcome.RETURN] = Outcome.NOT_DETECTED
    range_m = range_of_path(rays, scene.receiver, path_m)
    detected = np.isfinite(range_m)
    outcome[detected] = Outcome.RETURN
    return Returns(rays, outcome, range_m, np.where(detected, body, -1), frame=frame)
