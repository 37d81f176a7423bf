"""Laws of the distance fields that densities are learned from: finite, the right sign, unit slope, as rays see."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from lidardesign.density.fields.distance import Field, build_field
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.scene import Mesh, Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction
from lidardesign.testing.law import BrokenLawError, Law, LawHolds, Subject
from lidardesign.testing.probing import rays_that_meet

# So many rays are tried in each round, until so many have met a target.
RAYS, ENOUGH, ROUNDS = 300, 150, 10
# Of a scene that moves, the frame is looked at in which targets are seen best, out of so many.
FRAMES, TRIAL_RAYS = 8, 60
# How far grids reach beyond meshes: further than the points that are looked at lie from them.
PADDING_SIGMAS = 4.0
SEED = 20_252
# Grids interpolate between points: a field of meshes may be off by so many of their steps.
STEPS_OFF = 1.5
# What is computed exactly is off by rounding, as a share of the distances that occur; Embree computes in float32.
ROUNDING = 1e-4
# At creases and half way between surfaces a distance has no gradient: so many of the points must have one.
SMOOTH_SHARE = 0.8
SLOPE_WITHIN = 0.15
# Thin bodies end before a point below their surface does: so many of the points must lie inside.
INSIDE_SHARE = 0.5


class RaysAtTargets(NamedTuple):
    """Rays of a scene that meet a target first, N of them.

    Arguments:
        number: The scene's number, its column in the field.
        origin_m, direction, normal: Shape (N, 3); normals face the origins.
        range_m: Of the first hits [m], shape (N,).
        solid: Whether what was hit has an inside, shape (N,).
        tried: How many rays towards targets these are of.
    """

    number: int
    origin_m: np.ndarray
    direction: np.ndarray
    normal: np.ndarray
    range_m: np.ndarray
    solid: np.ndarray
    tried: int

    def at(self, range_m: np.ndarray) -> np.ndarray:
        """Points along the rays, shape (N, 3) [m]."""
        return self.origin_m + range_m[:, None] * self.direction


class TargetFields:
    """The targets' fields of the scenes that are looked at, in one frame each, and rays that meet them.

    Arguments:
        subject: Whose scenes.
    """

    def __init__(self, subject: Subject) -> None:
        settings = subject.config.density
        self.scenes = [_at_rest(subject, scene) for scene in subject.looked_at]
        self.sigma_m = settings.sigma_m
        padding_m = PADDING_SIGMAS * settings.sigma_m
        self.field: Field = build_field(
            self.scenes, lambda body: body.is_target, resolution=settings.field_resolution, padding_m=padding_m
        )
        self.step_m = _step_m(self.scenes, settings.field_resolution, padding_m)
        self.seen = [_seen(subject, number, scene) for number, scene in enumerate(self.scenes)]

    def distance(self, seen: RaysAtTargets, points: np.ndarray) -> np.ndarray:
        """Distances to the targets of the rays' scene at points (N, 3), shape (N,) [m]."""
        return self.field.distances(points)[:, seen.number]

    def slope(self, seen: RaysAtTargets, points: np.ndarray) -> np.ndarray:
        """Lengths of the gradients there, shape (N,)."""
        weights = np.zeros((len(points), self.field.columns))
        weights[:, seen.number] = 1.0
        return np.linalg.norm(self.field.gradient(points, weights), axis=1)

    def tolerance_m(self, seen: RaysAtTargets) -> np.ndarray:
        """What distances near the rays may be off by, shape (N,) [m]."""
        return STEPS_OFF * self.step_m + ROUNDING * seen.range_m


_GROUNDS: WeakKeyDictionary[Subject, TargetFields] = WeakKeyDictionary()


def target_fields(subject: Subject) -> TargetFields:
    """The fields and rays of a subject, made once."""
    if subject not in _GROUNDS:
        _GROUNDS[subject] = TargetFields(subject)
    return _GROUNDS[subject]


def _at_rest(subject: Subject, scene: Scene) -> Scene:
    """A scene as it is in the frame in which most rays meet targets."""
    frames = np.unique(np.linspace(0, scene.frames - 1, min(scene.frames, FRAMES)).astype(int))
    stills = [
        replace(scene, bodies=tuple(replace(body, poses=body.pose(frame)) for body in scene.bodies)) for frame in frames
    ]
    if len(stills) == 1:
        return stills[0]
    seen = [
        len(_tried(subject, still, SceneCaster(still), TRIAL_RAYS, np.random.default_rng(SEED))) for still in stills
    ]
    return stills[int(np.argmax(seen))]


def _tried(
    subject: Subject, scene: Scene, caster: SceneCaster, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Design points, body and normal in columns, shape (K, 10), of rays at all condition values that meet targets."""
    per = -(-count // len(subject.conditions))
    found = [
        rays_that_meet(scene, subject.config.space.at(condition), caster, 0, per, generator)
        for condition in subject.conditions
    ]
    return np.concatenate([np.column_stack([points, hits.body, hits.normal]) for points, hits in found])


def _step_m(scenes: list[Scene], resolution: int, padding_m: float) -> float:
    """The step of the grid that targets' meshes are interpolated on; 0 where there are none [m]."""
    bodies = [body for scene in scenes for body in scene.bodies if body.is_target and isinstance(body.shape, Mesh)]
    if not bodies:
        return 0.0
    corners = np.concatenate([body.shape.transformed(body.pose()).bounds_m for body in bodies])  # type: ignore[union-attr]
    return (float(np.ptp(corners, axis=0).max()) + 2 * padding_m) / (resolution - 1)


def _seen(subject: Subject, number: int, scene: Scene) -> RaysAtTargets:
    """Rays from the design space towards points of a scene's targets, those that meet a target first."""
    generator, caster = np.random.default_rng([SEED, number]), SceneCaster(scene)
    rounds: list[np.ndarray] = []
    while len(rounds) < ROUNDS and sum(map(len, rounds)) < ENOUGH:
        rounds.append(_tried(subject, scene, caster, RAYS, generator))
    design = np.concatenate(rounds)
    has_inside = [not isinstance(body.shape, Mesh) or body.shape.sign != "unsigned" for body in scene.bodies]
    solid = np.array(has_inside, dtype=bool)[design[:, 6].astype(int)]
    looking = direction(design[:, AZIMUTH], design[:, ELEVATION])
    return RaysAtTargets(number, design[:, :3], looking, design[:, 7:], design[:, RANGE], solid, RAYS * len(rounds))


def check_reach(subject: Subject) -> LawHolds:
    """Rays of the design space meet targets in every scene that is looked at."""
    counts = [len(seen.range_m) for seen in target_fields(subject).seen]
    if not min(counts):
        name = subject.looked_at[counts.index(0)].name
        raise BrokenLawError(
            f"none of {RAYS * ROUNDS} rays from the design space to the targets of scene {name!r} meets one",
            hint="widen the angles or the range, move the origin, or check the units: all lengths are metres",
        )
    share = sum(counts) / sum(seen.tried for seen in target_fields(subject).seen)
    return LawHolds(f"{share:.0%} of the rays towards targets meet one inside the design space", {"share": share})


def check_finite(subject: Subject) -> LawHolds:
    """Distances and their gradients are finite everywhere between sensors and targets."""
    ground, generator, count = target_fields(subject), np.random.default_rng(SEED), 0
    for seen in ground.seen:
        points = seen.at(seen.range_m * generator.uniform(0.0, 1.2, len(seen.range_m)))
        bad = ~(np.isfinite(ground.distance(seen, points)) & np.isfinite(ground.slope(seen, points)))
        if bad.any():
            raise BrokenLawError(f"{bad.sum()} of {len(bad)} distances or gradients are NaN or infinite")
        count += len(points)
    return LawHolds(f"at {count} points", {"points": count})


def check_sign(subject: Subject) -> LawHolds:
    """Distances are positive at sensors and in front of targets, and negative inside those that are solid."""
    ground, generator = target_fields(subject), np.random.default_rng(SEED)
    inside: list[np.ndarray] = []
    for seen in ground.seen:
        tolerance, name = ground.tolerance_m(seen), ground.scenes[seen.number].name
        at_sensor = ground.distance(seen, seen.origin_m)
        if (at_sensor < -tolerance).any():
            raise BrokenLawError(
                f"scene {name!r}: a sensor's place is {-at_sensor.min():.3g} m inside a target",
                hint="move the design space's origins out of the targets",
            )
        in_front = ground.distance(seen, seen.at(seen.range_m * generator.uniform(0.0, 1.0, len(seen.range_m))))
        if (in_front < -tolerance).any():
            raise BrokenLawError(f"scene {name!r}: {-in_front.min():.3g} m inside a target before any ray meets it")
        below = seen.at(seen.range_m) - (2 * tolerance)[:, None] * seen.normal
        inside.append(ground.distance(seen, below)[seen.solid] < 0)
    found = np.concatenate(inside)
    share = float(found.mean()) if len(found) else 1.0
    if share < INSIDE_SHARE:
        raise BrokenLawError(f"only {share:.0%} of the points just below solid surfaces are inside")
    if not len(found):
        return LawHolds("nothing is in front of sensors or targets that should not be; no target has an inside")
    return LawHolds(f"{share:.0%} of {len(found)} points just below solid surfaces are inside", {"inside": share})


def check_slope(subject: Subject) -> LawHolds:
    """Gradients of distances have length 1 in front of targets."""
    ground, generator = target_fields(subject), np.random.default_rng(SEED)
    slopes = []
    for seen in ground.seen:
        near = max(2 * ground.step_m, ground.sigma_m / 2)
        offset = np.minimum(generator.uniform(near, 2 * near + ground.sigma_m, len(seen.range_m)), seen.range_m)
        slopes.append(ground.slope(seen, seen.at(seen.range_m) + offset[:, None] * seen.normal))
    off = np.abs(np.concatenate(slopes) - 1)
    share = float((off <= SLOPE_WITHIN).mean())
    if share < SMOOTH_SHARE:
        raise BrokenLawError(
            f"only {share:.0%} of {len(off)} gradients are within {SLOPE_WITHIN} of length 1",
            hint="a mesh of separate sheets or in other units than metres? density.field_resolution refines grids",
        )
    median = float(np.median(off))
    return LawHolds(
        f"{share:.0%} of {len(off)} within {SLOPE_WITHIN}, half within {median:.1g}",
        {"share": share, "median_off": median},
    )


def check_agreement(subject: Subject) -> LawHolds:
    """Distances are 0 where rays meet targets, and on the way there never more than what is left of it."""
    ground, generator, worst_m = target_fields(subject), np.random.default_rng(SEED), 0.0
    for seen in ground.seen:
        shares = generator.uniform(0.0, 1.0, len(seen.range_m))
        at_hit = np.abs(ground.distance(seen, seen.at(seen.range_m)))
        beyond = ground.distance(seen, seen.at(shares * seen.range_m)) - (1 - shares) * seen.range_m
        off_m = np.maximum(at_hit, beyond)
        worst = int((off_m - ground.tolerance_m(seen)).argmax())
        if off_m[worst] > ground.tolerance_m(seen)[worst]:
            raise BrokenLawError(
                f"scene {ground.scenes[seen.number].name!r}: field and ray differ by {off_m[worst]:.3g} m at a hit "
                f"{seen.range_m[worst]:.3g} m away",
                allowed=f"{ground.tolerance_m(seen)[worst]:.3g} m",
                hint="a finer density.field_resolution, or meshes whose sheets are not closer than a grid step",
            )
        worst_m = max(worst_m, float(off_m.max()))
    count = sum(len(seen.range_m) for seen in ground.seen)
    return LawHolds(f"{count} hits, at most {worst_m:.1g} m off", {"rays": count, "difference_m": worst_m})


LAWS = (
    Law(
        "targets are in reach",
        "geometry",
        "rays of the design space meet targets",
        check_reach,
        needs=("scenes are made", "conditions lie in the space"),
    ),
    Law("fields are finite", "geometry", "distances and gradients are finite", check_finite, ("targets are in reach",)),
    Law(
        "fields have the right sign",
        "geometry",
        "distances are positive outside and negative inside",
        check_sign,
        ("fields are finite",),
    ),
    Law(
        "gradients have length 1",
        "geometry",
        "distances change by a metre per metre",
        check_slope,
        ("fields are finite",),
    ),
    Law(
        "fields and rays agree",
        "geometry",
        "distances are 0 where rays meet targets",
        check_agreement,
        ("fields are finite",),
    ),
)
