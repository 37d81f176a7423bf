r"""How much light may come back by way of other surfaces, and how far it may move a range, without simulating it.

From a matt point P some directions lead to other surfaces Q: F is their share of P's view, weighted with the cosine.
All that a flood sends to P from there, relative to what it sends P directly, is

    share = mean over directions of rho_Q E(Q) / E(P), and for all later surfaces at most
    rho F (rho F_max E_max / E(P)) / (1 - rho F_max),

E = cosine / distance^2 to the emitter, 0 in its shadow, rho the largest reflectance: a geometric series, since no point
gets more than rho F_max of what the brightest has. With the receiver in the emitter's place the same holds for a beam
whose detours a fixed receiver hears, by reciprocity. A pixel that is lit through itself alone gets back

    share = mean over directions of rho_P rho_Q (form factor of the pixel's spot from Q), at most rho_P rho_Q,
    and for all later surfaces at most the same times rho F_max / (1 - rho F_max), late by as much more as there are.

Light that is late by d moves a range by at most its share times d; what is late by more than a detector tells apart
makes a peak of its own, which may be taken for the echo where all of it outweighs that. Directions are laid out evenly
(Lambert's equal-area disc), not drawn: shares are measured by casting them, to within a few hundredths. A surface that
fills less than a hundredth of a view may be missed by a point, and is met by others as often as it should.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.hits import Hits
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.simulate.receiver_view import in_view
from lidardesign.simulate.returns import Rays

# Points whose view is measured, and directions from each: some thousand rays.
MOST_POINTS, DIRECTIONS = 64, 96
# A surface that a pixel grazes more flatly than this counts as met at it: a spot is then 50 times as long as wide.
FLATTEST_COSINE = 0.02
GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
# Rays start this share of their distance above a surface, so as not to hit it again.
CLEARANCE = 1e-6
# A series of bounces between perfect mirrors of matt white never ends; a share this close to 1 stands for it.
WHITEST = 0.999


@dataclass(frozen=True, eq=False)
class Detours:
    """Bounds for a sample of rays.

    Arguments:
        chosen: Which rays, shape (K,).
        share: Light by detours over direct light, at most, shape (K,).
        apart: The part of it that is late by more than a detector's resolution, at most, shape (K,).
        shift_m: How far the rest may move a range, at most, shape (K,) [m].
        seen: Share of the view that other surfaces fill, shape (K,).
    """

    chosen: np.ndarray
    share: np.ndarray
    apart: np.ndarray
    shift_m: np.ndarray
    seen: np.ndarray


def later_share(reflectance: float, seen: np.ndarray, most_seen: float, brightest: np.ndarray) -> np.ndarray:
    """Light that met three surfaces or more, over direct light, at most.

    Arguments:
        reflectance: The largest of a scene.
        seen: Share of each point's view that other surfaces fill, shape (K,).
        most_seen: The largest of all such shares.
        brightest: What the brightest point gets, over what each gets, directly, shape (K,).
    """
    once = min(reflectance * most_seen, WHITEST)
    return reflectance * seen * once * brightest / (1 - once)


def lamp_bound(
    scene: Scene, rays: Rays, hits: Hits, caster: SceneCaster, lamp_m: np.ndarray | None, resolution_m: float
) -> Detours:
    """Detours of a flood at the rays' origins, or of beams that a fixed receiver hears in all of its field of view.

    A flood shines everywhere as it does along each ray.

    Arguments:
        scene: What light meets, and its receiver.
        rays: N of them.
        hits: What they meet.
        caster: Of this frame.
        lamp_m: Where light comes from, or is heard, shape (3,) [m]; None: at each ray's origin.
        resolution_m: Half paths that a detector does not tell apart [m].
    """
    view = _View.of(scene, rays, hits, caster)
    lamp = view.origin_m if lamp_m is None else np.broadcast_to(np.asarray(lamp_m, dtype=float), view.point_m.shape)
    toward = lamp - view.point_m
    direct_m = np.linalg.norm(toward, axis=1)
    own = np.maximum(np.einsum("kj,kj->k", view.normal, toward), 0.0) / direct_m**3
    lit, lit_m = view.lit_from(lamp, caster, None if lamp_m is None else scene)
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.where(own[:, None] > 0, view.reflectance * lit / own[:, None], 0.0) / DIRECTIONS
        brightest = np.where(own > 0, max(own.max(initial=0.0), lit.max(initial=0.0)) / own, 0.0)
    late_m = (lit_m + view.away_m - direct_m[:, None]) / 2
    most = max((body.reflectance for body in scene.bodies), default=0.0)
    later = later_share(most, view.seen, view.seen.max(initial=0.0), brightest)
    return view.detours(each, late_m, later, later * resolution_m, resolution_m)


def pixel_bound(
    scene: Scene, rays: Rays, hits: Hits, caster: SceneCaster, pixel_sr: float, resolution_m: float
) -> Detours:
    """Detours of scanned beams that only the pixel around each beam hears; arguments as in `lamp_bound`."""
    view = _View.of(scene, rays, hits, caster)
    back = view.origin_m - view.point_m
    distance_m = np.linalg.norm(back, axis=1)
    cosine = np.einsum("kj,kj->k", view.normal, back) / distance_m
    spot_m2 = pixel_sr * distance_m**2 / np.maximum(cosine, FLATTEST_COSINE)
    facing = np.maximum(np.einsum("kdj,kdj->kd", view.found_normal, -view.direction), 0.0)
    leaving = np.einsum("kdj,kj->kd", view.direction, view.normal)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factor = np.minimum(facing * leaving * spot_m2[:, None] / (math.pi * view.away_m**2), 1.0)
    own = np.array([body.reflectance for body in scene.bodies])[hits.body[view.chosen]]
    each = np.where(np.isfinite(view.away_m), own[:, None] * view.reflectance * factor, 0.0) / DIRECTIONS
    most = max((body.reflectance for body in scene.bodies), default=0.0)
    once = min(most * view.seen.max(initial=0.0), WHITEST)
    # the k-th bounce more comes from k times as far: sum k once^(k - 1) = 1 / (1 - once)^2
    moved_m = view.moved_m(each, view.away_m, resolution_m) * (1 / (1 - once) ** 2 - 1)
    return view.detours(each, view.away_m, each.sum(axis=1) * once / (1 - once), moved_m, resolution_m)


@dataclass(frozen=True, eq=False)
class _View:
    """What K points on surfaces see in D directions: arrays (K, ...) and (K, D, ...)."""

    chosen: np.ndarray
    origin_m: np.ndarray
    point_m: np.ndarray
    normal: np.ndarray
    direction: np.ndarray
    away_m: np.ndarray
    found_normal: np.ndarray
    reflectance: np.ndarray

    @classmethod
    def of(cls, scene: Scene, rays: Rays, hits: Hits, caster: SceneCaster) -> _View:
        met = np.flatnonzero(hits.body >= 0)
        chosen = met[np.unique(np.linspace(0, len(met) - 1, min(MOST_POINTS, len(met))).astype(int))]
        origin_m, normal = rays.origin_m[chosen], hits.normal[chosen]
        lift_m = CLEARANCE * (1 + hits.range_m[chosen])
        point_m = origin_m + hits.range_m[chosen, None] * rays.direction[chosen] + lift_m[:, None] * normal
        direction = _hemispheres(normal)
        starts = np.repeat(point_m, DIRECTIONS, axis=0)
        found = caster.first_hit(starts, direction.reshape(-1, 3))
        shape = (len(chosen), DIRECTIONS)
        reflectance = np.array([*(body.reflectance for body in scene.bodies), 0.0])[found.body]
        return cls(
            chosen,
            origin_m,
            point_m,
            normal,
            direction,
            found.range_m.reshape(shape),
            found.normal.reshape(*shape, 3),
            reflectance.reshape(shape),
        )

    @property
    def seen(self) -> np.ndarray:
        return np.isfinite(self.away_m).mean(axis=1)

    def lit_from(self, lamp_m: np.ndarray, caster: SceneCaster, viewed: Scene | None) -> tuple[np.ndarray, np.ndarray]:
        """What the surfaces seen get from a lamp, cosine / distance^2, and how far it is, both (K, D)."""
        away_m = np.where(np.isfinite(self.away_m), self.away_m, 0.0)
        lift_m = CLEARANCE * (1 + away_m)
        places = self.point_m[:, None] + away_m[..., None] * self.direction + lift_m[..., None] * self.found_normal
        toward = lamp_m[:, None] - places
        distance_m = np.linalg.norm(toward, axis=-1)
        toward = toward / distance_m[..., None]
        cosine = np.maximum(np.einsum("kdj,kdj->kd", toward, self.found_normal), 0.0)
        asked = np.isfinite(self.away_m) & (cosine > 0)
        if viewed is not None and viewed.receiver is not None:
            asked &= in_view(viewed.receiver, places)
        free = np.zeros(asked.shape, dtype=bool)
        free[asked] = caster.first_hit(places[asked], toward[asked]).range_m >= distance_m[asked]
        return np.where(free, cosine / distance_m**2, 0.0), distance_m

    def moved_m(self, each: np.ndarray, late_m: np.ndarray, resolution_m: float) -> np.ndarray:
        """Shares (K, D) of light times their delays (K, D), of what is late by less than a resolution, shape (K,)."""
        near = (each > 0) & (late_m < resolution_m)
        return (each * np.where(near, np.maximum(late_m, 0.0), 0.0)).sum(axis=1)

    def detours(
        self,
        each: np.ndarray,
        late_m: np.ndarray,
        later: np.ndarray,
        later_moved_m: np.ndarray,
        resolution_m: float,
    ) -> Detours:
        moved_m = self.moved_m(each, late_m, resolution_m) + np.minimum(later_moved_m, later * resolution_m)
        # a mean of the echo and what is near to it lies no further off than its share of the furthest
        beside = np.where(late_m < resolution_m, each, 0.0).sum(axis=1) + later
        shift_m = np.minimum(moved_m, resolution_m * beside / (1 + beside))
        apart = np.where(late_m < resolution_m, 0.0, each).sum(axis=1) + later
        return Detours(self.chosen, each.sum(axis=1) + later, apart, shift_m, self.seen)


def _hemispheres(normal: np.ndarray) -> np.ndarray:
    """Directions above surfaces with normals (K, 3), as dense as the cosine, turned from point to point, (K, D, 3)."""
    number = np.arange(DIRECTIONS)
    radius = np.sqrt((number + 0.5) / DIRECTIONS)
    angle = GOLDEN_ANGLE_RAD * number + GOLDEN_ANGLE_RAD * DIRECTIONS * np.arange(len(normal))[:, None]
    other = np.eye(3)[np.abs(normal).argmin(axis=1)]
    left = np.cross(other, normal)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(normal, left)
    height = np.sqrt(1 - radius**2)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return x[..., None] * left[:, None] + y[..., None] * up[:, None] + height[:, None] * normal[:, None]
