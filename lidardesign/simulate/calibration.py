"""Light of real parts: a detector's emitter, scaled until a part reaches as far as its data sheet says.

Of the ranges that sources state at some illuminance, the one in the brightest light counts, the first of equal ones: it
is what sunlight asks of a part. A bench simulates a plate there that fills the beams, in sunlight, and the least light
is sought with which the stated share of the rays (or `USUAL_SHARE`) reports it. Reflectances that no source states are
those of a white target, as makers use. In darkness a part may then reach further than stated; its gate ends before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.parts.catalogue import parts_of
from lidardesign.parts.part import Part
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Ambient, Body, Box, Scene, rigid
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import Detector, Physics, bin_width_m, metres
from lidardesign.simulate.returns import simulate

USUAL_SHARE, WHITE = 0.5, 0.9
FULL_SUN_KLUX = 100.0
LUX_PER_KLUX = 1000.0
BENCH_EFFECTS = frozenset({"photon_noise", "jitter", "ambient", "pile_up", "quantisation"})
# Rays on the bench, fewer where each has many pulses, in which photons are followed one by one.
BENCH_RAYS, FEWEST_BENCH_RAYS, BENCH_PULSES = 256, 32, 1 << 24
# Light is sought in steps of this factor, as many as these up or down, and then by halving ratios.
STEP, MOST_STEPS, HALVINGS = 10.0, 6, 8
NEAREST_SHARE = 1e-3
# Beyond a surface on the bench, in standard deviations of a photon's time.
BEHIND_SIGMAS = 4.0
# The shipped detector for parts of a kind; nothing shipped is like the others.
STAND_INS = {"multi-zone": "consumer-8x8"}


@dataclass(frozen=True)
class Claim:
    """A range that a source states for a part in some light.

    Arguments:
        range_m: The range [m].
        near_m, far_m: Ends of the part's gate [m].
        reflectance: Reflectance of the target.
        klux: Its illuminance [klux].
        share: Share of rays that detect it.
    """

    range_m: float
    near_m: float
    far_m: float
    reflectance: float
    klux: float
    share: float

    @classmethod
    def of(cls, part: Part) -> Claim | None:
        """A part's claim in the brightest light; None where no source states an illuminance."""
        lit = [one for one in part.figures["far_m"] if one.illuminance_klux is not None]
        if not lit:
            return None
        best = max(lit, key=lambda one: one.illuminance_klux)
        reflectance = WHITE if best.reflectance_percent is None else best.reflectance_percent / 100
        share = USUAL_SHARE if best.detection_percent is None else best.detection_percent / 100
        near, far = part.range_m
        return cls(best.value, near, max(far, best.value), reflectance, best.illuminance_klux, share)

    def detected(self, detector: Detector, rays: int, light: float) -> float:
        """Share of the rays that report a plate at the range, where so many share an emitter.

        Raises:
            ConfigError: The detector cannot cover the gate.
        """
        photons = detector.photons
        count = round(np.clip(BENCH_PULSES / photons.pulses(rays), FEWEST_BENCH_RAYS, BENCH_RAYS))
        scale = count / rays
        photons = replace(
            photons,
            pulse_energy_j=photons.pulse_energy_j * light * (scale if detector.is_flood else 1.0),
            pulses_per_frame=photons.pulses_per_frame * (1.0 if detector.is_flood else scale),
        )
        bench = replace(detector, photons=photons, emitters="shared", bins=None)
        plate = Body(
            Box((self.range_m / 2, self.far_m, self.far_m)),
            poses=rigid(translation_m=(1.5 * self.range_m, 0.0, 0.0)),
            reflectance=self.reflectance,
        )
        scene = Scene((plate,), ambient=Ambient(self.klux * LUX_PER_KLUX) if self.klux else None)
        behind_m = BEHIND_SIGMAS * metres(detector.timing_sigma_s) + bin_width_m(detector)
        looking, none = np.tile([1.0, 0.0, 0.0], (count, 1)), np.zeros(count)
        fired = Rays(0 * looking, looking, np.tile([self.near_m, self.far_m + behind_m], (count, 1)), none, none)
        (returns,) = simulate(scene, fired, physics=Physics(bench, BENCH_EFFECTS))
        return float((returns.body == 0).mean())


@lru_cache(maxsize=256)
def least_light(claim: Claim, detector: Detector, rays: int) -> float | None:
    """The least light, as a multiple of the detector's, with which so many rays of an emitter keep a claim; None: none.

    None too where the detector cannot cover the part's gate.
    """

    def keeps(light: float) -> bool:
        return claim.detected(detector, rays, light) >= claim.share

    try:
        enough = keeps(1.0)
    except ConfigError:
        return None
    # more light until it is enough, or less until it is not
    light, factor = 1.0, 1 / STEP if enough else STEP
    for _ in range(MOST_STEPS):
        light *= factor
        if keeps(light) != enough:
            return _edge(keeps, light / factor, light) if enough else _edge(keeps, light, light / factor)
    return None


def _edge(holds: Callable[[float], bool], inside: float, outside: float) -> float:
    """The end of an interval in which something holds, by halving ratios, on the side where it does."""
    for _ in range(HALVINGS):
        middle = float(np.sqrt(inside * outside))
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside


def part_light(part: Part, detector: Detector, rays: int) -> float | None:
    """The light of a part of which so many rays are fired, as a multiple of a detector's; None where it is unknown."""
    claim = Claim.of(part)
    return None if claim is None or detector.photons is None else least_light(claim, detector, rays)


def with_part_light(rays: Rays, design: DesignSpec, detector: Detector) -> Rays:
    """A design's rays with the light of its parts, as their data sheets have it; others keep the detector's own."""
    parts = parts_of(design)
    if detector.photons is None or not any(parts):
        return rays
    fired = np.bincount(rays.sensor, minlength=len(parts)).tolist()
    known = [
        part_light(part, detector, count) if part and count else None for part, count in zip(parts, fired, strict=True)
    ]
    light = np.array([1.0 if one is None else one for one in known])
    return replace(rays, light=light[rays.sensor]) if any(known) else rays


def light_notes(design: DesignSpec, detector: Detector) -> list[str]:
    """Lines on the light of a design's parts under a detector."""
    kinds = {part.name: part for part in parts_of(design) if part is not None}
    if detector.photons is None or detector.emitters == "shared" or not kinds:
        return []
    known = [name for name, part in kinds.items() if part_light(part, detector, part.rays) is not None]
    unknown = [name for name in kinds if name not in known]
    lines = {
        f"light as data sheets imply: {', '.join(known)}": known,
        f"no stated range sets the light of {', '.join(unknown)}: that of {detector.name} is used": unknown,
    }
    return [line for line, names in lines.items() if names]


@dataclass(frozen=True)
class Reach:
    """The range that a sensor's part reaches on the target that its data sheet states; None where it is unknown.

    Arguments:
        dark_m: In darkness, as stated [m].
        sunny_m: In full sun, as stated or as follows from what is stated in less light [m].
    """

    dark_m: float | None = None
    sunny_m: float | None = None

    def as_text(self) -> dict[str, str]:
        """The cell of a table for people, by heading."""
        ranges = ("unknown" if range_m is None else f"{range_m:.2g}" for range_m in (self.dark_m, self.sunny_m))
        return {f"reaches in the dark / at {FULL_SUN_KLUX:g} klux [m]": " / ".join(ranges)}


def reach_of(part: Part) -> Reach:
    """How far a part reaches in darkness and in full sun."""
    return Reach(_stated_m(part, 0.0), _stated_m(part, FULL_SUN_KLUX) or _reckoned_m(part))


def _stated_m(part: Part, klux: float) -> float | None:
    try:
        return part.under(illuminance_klux=klux).range_m[1]
    except ConfigError:
        return None


def _reckoned_m(part: Part) -> float | None:
    """The range in full sun by the calibrated detector that stands in for a part's kind."""
    claim = Claim.of(part)
    if claim is None or part.kind not in STAND_INS:
        return None
    detector = load_detector(STAND_INS[part.kind])
    light = part_light(part, detector, part.rays)
    if light is None:
        return None

    def reaches(range_m: float) -> bool:
        sunny = replace(claim, klux=FULL_SUN_KLUX, range_m=range_m)
        return sunny.detected(detector, part.rays, light) >= claim.share

    found = _edge(reaches, max(claim.near_m, NEAREST_SHARE * claim.range_m), claim.range_m)
    return found if reaches(found) else None


def reaches_of(design: DesignSpec) -> list[Reach]:
    """How far each sensor of a design of parts reaches; empty where none is a part."""
    kinds = {part.name: part for part in parts_of(design) if part is not None}
    reach = {name: reach_of(part) for name, part in kinds.items()}
    if not any(sensor.part for sensor in design.sensors):
        return []
    return [reach.get(sensor.part or "", Reach()) for sensor in design.sensors]


def reach_notes(design: DesignSpec) -> list[str]:
    """Lines on gates that end beyond what a source states of a part in any light."""
    return [
        f"{sensor.name} listens to {sensor.gate_m[1]:.4g} m, and {sensor.part} reaches {reach.dark_m:.4g} m in the dark"
        for sensor, reach in zip(design.sensors, reaches_of(design), strict=False)
        if reach.dark_m is not None and sensor.gate_m[1] > reach.dark_m
    ]
