"""Random plans of effects, `make soak-promise`: nothing that is skipped changes more than is tolerated.

What a plan skips changes ranges by no more than its tolerance, rms over returns, and no more than its share of returns:
ray by ray, with the same random numbers, against all effects but multipath, which needs another program.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from support.planning import CONSUMER, SINGLE, TIMED, grid, random_shapes

from benchmarks.soak.long_runs import amount
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Ambient, Body, Box, Medium, Mesh, Receiver, Scene, rigid
from lidardesign.simulate.detector.physics import EFFECTS, Detector, Physics
from lidardesign.simulate.effects.first_hits import FirstHits
from lidardesign.simulate.plan import Planner, Tolerance
from lidardesign.simulate.returns import build_casters, simulate

BLOCK = 50
SIMULATED = frozenset(EFFECTS) - {"multipath"}
# Each is measured so many times with other chance, and compared within so many standard errors.
REPEATS = 4
STANDARD_ERRORS = 4.0
# A return that is further off than this many tolerances, or than the detector tells apart, comes from elsewhere.
ELSEWHERE = 5.0
ROUNDING_M = 1e-3
KINDS = ("bodies", "wall", "wall on an edge", "slanted wall", "mesh", "turning body")


@dataclass(frozen=True)
class Case:
    """A random scene with rays, what measures, and what a plan may skip."""

    kind: str
    scene: Scene
    rays: Rays
    detector: Detector
    tolerance: Tolerance


@dataclass(frozen=True)
class Kept:
    """What became of a promise: changes in units of the tolerance, and what was skipped."""

    case: Case
    skipped: tuple[str, ...]
    range_m: float = 0.0
    lost: float = 0.0
    broken: bool = False

    def __str__(self) -> str:
        tolerance = self.case.tolerance
        return (
            f"{self.case.kind}, {self.case.detector.name}, without {', '.join(self.skipped)}: ranges changed by "
            f"{self.range_m / tolerance.range_m:.2g} and returns by {self.lost / tolerance.lost:.2g} of the tolerance"
        )


def random_case(seed: int) -> Case:
    """The case of a number, always the same."""
    generator = np.random.default_rng(seed)
    detector = _detector(generator)
    kind = str(generator.choice(KINDS))
    scene, near_m = _scene(generator, kind, detector.bin_m)
    width_m = generator.uniform(0.5, 3) if generator.uniform() < 0.7 else _power(generator, -1.3, 0)
    start_m = float(generator.choice([0.1, 0.5, 1.0]))
    if width_m < 0.5:
        # narrow gates around the surface, which may lie before or behind them
        start_m = max(near_m - width_m * generator.uniform(-0.1, 1.1), 0.01)
    if kind == "wall on an edge" and detector.bin_m is not None and detector.histogram_start == "gate":
        start_m = max(round(start_m / detector.bin_m), 1) * detector.bin_m
    half_rad = _power(generator, -4, -0.4) if "wall" in kind else 0.4
    rays = grid(int(generator.choice([5, 20])), half_rad, (start_m, start_m + width_m), scene.frame_rate_hz)
    usual = Tolerance.of(detector)
    tolerance = Tolerance(usual.range_m * _power(generator, -1.5, 1), _power(generator, -3, -1))
    return Case(kind, scene, rays, detector, tolerance)


def _power(generator: np.random.Generator, low: float, high: float) -> float:
    return float(10 ** generator.uniform(low, high))


def _detector(generator: np.random.Generator) -> Detector:
    chosen = (SINGLE, CONSUMER, TIMED, TIMED)[generator.integers(4)]
    is_wide = generator.uniform() < 0.8
    common = {"footprint_rays": 19, "histogram_start": str(generator.choice(["gate", "pulse"]))}
    if chosen is TIMED:
        bin_s = None if generator.uniform() < 0.3 else _power(generator, -11, -8.5)
        jitter_s = (bin_s or 1e-10) * _power(generator, -3.5, 0.5) * (generator.uniform() < 0.9)
        pulse_s = float(generator.choice([0.0, 1e-10]))
        width = _power(generator, -4, -1) * is_wide
        return replace(
            TIMED, bin_s=bin_s, jitter_sigma_s=jitter_s, pulse_sigma_s=pulse_s, divergence_rad=width, **common
        )
    photons = replace(
        chosen.photons,
        pulse_energy_j=chosen.photons.pulse_energy_j * _power(generator, -1.5, 3),
        dead_s=_power(generator, -9.5, -6.5) * (generator.uniform() < 0.8),
        dark_hz=_power(generator, 1, 6),
    )
    return replace(
        chosen,
        estimator=str(generator.choice(["peak", "matched"])),
        correction=str(generator.choice(["none", "coates"])),
        false_alarm=_power(generator, -4, -1),
        bin_s=_bin_s(generator, chosen.bin_s),
        bins=None,
        jitter_sigma_s=chosen.jitter_sigma_s * _power(generator, -2, 0.5),
        pulse_sigma_s=chosen.pulse_sigma_s * _power(generator, -1, 0.3),
        divergence_rad=chosen.divergence_rad * generator.uniform(0.05, 1) * is_wide,
        photons=photons,
        **common,
    )


def _bin_s(generator: np.random.Generator, usual_s: float) -> float | None:
    kind = generator.uniform()
    return None if kind < 0.1 else usual_s if kind < 0.5 else usual_s * _power(generator, -1, 1)


def _scene(generator: np.random.Generator, kind: str, bin_m: float | None) -> tuple[Scene, float]:
    """A scene, and about how far its nearest surface is [m]."""
    near_m = generator.uniform(0.6, 2.5)
    if kind == "wall on an edge" and bin_m:
        near_m = round(near_m / bin_m) * bin_m + generator.choice([0.0, 1e-6, -1e-6, 0.02 * bin_m * generator.normal()])
    speed = _power(generator, -4, 0.5) * (generator.uniform() < 0.3)
    surface = {"reflectance": generator.uniform(0.05, 0.7), "velocity_m_s": tuple(speed * generator.normal(size=3))}
    surface["specular"] = 0.3 * (generator.uniform() < 0.05)
    behind = [Body(Box((0.05, 3, 3)), "behind", poses=rigid(translation_m=(4, 0, 0)))]
    bodies = behind[: int(generator.uniform() < 0.7)]
    if "wall" in kind:
        tilt_rad = generator.uniform(0, 1.45) if kind == "slanted wall" else 0.0
        place = rigid(_turn(tilt_rad), (near_m + 0.05 / math.cos(tilt_rad), 0, 0))
        bodies.append(Body(Box((0.05, 9, 9)), "wall", poses=place, **surface))
    elif kind == "mesh":
        ball = trimesh.creation.icosphere(subdivisions=2, radius=generator.uniform(0.1, 0.5))
        place = rigid(translation_m=(near_m, *generator.uniform(-0.2, 0.2, 2)))
        bodies.append(Body(Mesh(np.array(ball.vertices), np.array(ball.faces)), "ball", poses=place, **surface))
    elif kind == "turning body":
        step = rigid(_turn(_power(generator, -4, -0.5)), tuple(_power(generator, -4, -1) * generator.normal(size=3)))
        place = rigid(translation_m=(near_m, 0, 0))
        poses = np.stack([place, place @ step, place @ step @ step])
        bodies.append(Body(Box(tuple(generator.uniform(0.1, 0.5, 3))), "turning", poses=poses))
    else:
        bodies += [_body(generator, number, surface) for number in range(generator.integers(1, 4))]
    return Scene(tuple(bodies), f"scene {generator.integers(1 << 30)}", **_air(generator)), near_m


def _turn(angle_rad: float) -> np.ndarray:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _body(generator: np.random.Generator, number: int, surface: dict) -> Body:
    shapes, place = random_shapes(generator)
    return Body(shapes[generator.integers(3)], f"body {number}", poses=place, **surface)


def _air(generator: np.random.Generator) -> dict:
    air = {}
    if generator.uniform() < 0.6:
        air["ambient"] = Ambient(_power(generator, 1, 5), str(generator.choice(["sun", "indoor"])))
    if generator.uniform() < 0.4:
        fog = _power(generator, -3, -0.3)
        air["medium"] = Medium(fog, fog / 20 * _power(generator, -1, 0.5))
    if generator.uniform() < 0.1:
        beside_m = float(generator.choice([0.0, 0.05, 0.4]))
        air["receiver"] = Receiver((0, beside_m, 0), 0, 0, 3.1, 3.1, (0, 20))
    return air


def kept_promise(case: Case) -> Kept:
    """What a plan of the case skips changes, and whether it is more than it may be."""
    casters = build_casters(case.scene)
    plan = Planner(case.detector, tolerance=case.tolerance).plan(case.scene, [case.rays], casters)
    chosen = plan.effects & SIMULATED
    skipped = {one.name for one in plan.decisions if not one.on and (one.bound.range_m or one.bound.lost)} & SIMULATED
    if not skipped:
        return Kept(case, ())

    def measured(effects: frozenset[str], seed: int) -> list[Returns]:
        physics = Physics(case.detector, effects, seed) if effects else None
        return simulate(case.scene, case.rays, casters=casters, physics=physics)

    resolved_m = FirstHits.of(case.scene, 0, case.detector, [case.rays], casters[0]).resolution_m
    far_m = max(ELSEWHERE * case.tolerance.range_m, (1 + ROUNDING_M) * resolved_m, ROUNDING_M)
    truth, squares, lost = measured(frozenset(), 0), [np.zeros(0)], 0
    for seed in range(REPEATS):
        both = zip(truth, measured(chosen, seed), measured(chosen | skipped, seed), strict=True)
        for geometry, planned, every in both:
            moved_m = np.where(planned.returned & every.returned, planned.range_m - every.range_m, 0.0)
            near = np.abs(moved_m) <= far_m
            lost += int(((planned.returned != every.returned) | ~near).sum())
            squares.append(moved_m[near & geometry.returned & planned.returned & every.returned] ** 2)
    squared, returns = np.concatenate(squares), max(sum(int(one.returned.sum()) for one in truth), 1)
    share, allowed = lost / (REPEATS * returns), case.tolerance.lost
    # the highest that chance makes of what is promised
    allowed += STANDARD_ERRORS * math.sqrt(max(allowed, 1 / returns) / (REPEATS * returns))
    mean = float(squared.mean()) if len(squared) else 0.0
    error = STANDARD_ERRORS * math.sqrt(float(np.mean(squared**2)) / len(squared)) if len(squared) else 0.0
    # ranges of meshes are exact to float32
    most_m2 = (case.tolerance.range_m + 1e-6) ** 2
    return Kept(case, tuple(sorted(skipped)), math.sqrt(mean), share, mean - error > most_m2 or share > allowed)


def pytest_generate_tests(metafunc):
    plans = amount(metafunc.config)
    metafunc.parametrize(("first", "end"), [(at, min(at + BLOCK, plans)) for at in range(0, plans, BLOCK)])


@pytest.mark.long
@pytest.mark.filterwarnings("default")
def test_what_is_skipped_changes_no_more_than_is_tolerated(piece, first, end):
    def work():
        found = {seed: kept_promise(random_case(seed)) for seed in range(first, end)}
        faults = [f"seed {seed}: {kept}" for seed, kept in found.items() if kept.broken]
        skipping = sum(bool(kept.skipped) for kept in found.values())
        return {"counts": {"plans": len(found), "skipping something": skipping}, "faults": faults}

    piece(work)
