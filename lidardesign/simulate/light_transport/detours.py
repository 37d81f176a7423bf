r"""Upper bound of multipath light, for `effects.multipath`, from a few cast rays without simulation.

From a matt point P some directions lead to other surfaces Q: F is their share of P's view, weighted with the cosine.
The light of a flood that reaches P by way of them, relative to its direct light on P, is

    share = mean over Q of rho_Q E(Q) / E(P)  +  mean over Q and what Q sees, R, of rho_Q rho_R E(R) / E(P)  + ...

with E = cosine / distance^2 to the emitter, 0 in its shadow. The first two sums are measured by casting rays; all the
others are at most mean(rho_Q rho_R) once E_max / E(P) / (1 - once), once = rho F_max for the largest reflectance: a
geometric series, since no point gets more than that part of the brightest one's light. With the receiver in the
emitter's place the same holds for a beam with a fixed receiver, by reciprocity. A pixel that sees only its own spot
gets back

    share = mean over Q of rho_P rho_Q (form factor of the pixel's spot from Q), at most rho_P rho_Q,
    and by all later surfaces at most the same times once / (1 - once), late by as much more as there are.

Light that is late by d moves a range by at most its share times d; light that is late by more than the detector's
resolution makes a peak of its own, which may be taken for the echo where all of it outweighs that. Directions are
evenly spread (Lambert's equal-area disc), not random: shares are measured to within a few hundredths. A surface that
fills less than a hundredth of a view may be missed from one point, but is hit in proportion over all points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.numerics import COARSE_SLACK, safe_divide
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Hits, Rays, in_view
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import reflectances

# Points whose view is measured, directions from each, and directions from their hits: up to forty thousand rays.
MOST_POINTS, DIRECTIONS, FURTHER_DIRECTIONS = 64, 64, 4
# Lower limit of the cosine of incidence: a spot is then 50 times as long as wide.
FLATTEST_COSINE = 0.02
GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
# Rays start this share of their distance above a surface, so as not to hit it again.
CLEARANCE = COARSE_SLACK
# Upper limit of the share that a bounce keeps: between white walls all around the series would not converge.
WHITEST = 0.999


@dataclass(frozen=True, eq=False)
class Detours:
    """Upper bounds of multipath light for a sample of rays.

    Arguments:
        chosen: Indices of the rays, shape (K,).
        share: Multipath light over direct light, shape (K,).
        apart: The part of it that is late by more than a detector's resolution, shape (K,).
        shift_m: Range shift by the rest, shape (K,) [m].
        seen: Share of the view that other surfaces fill, shape (K,).
    """

    chosen: np.ndarray
    share: np.ndarray
    apart: np.ndarray
    shift_m: np.ndarray
    seen: np.ndarray


def series(once: float) -> float:
    """Sum of the geometric series of bounces that each keep the share `once`, once / (1 - once), kept finite."""
    kept = min(once, WHITEST)
    return kept / (1 - kept)


def lamp_bound(
    scene: Scene, rays: Rays, hits: Hits, caster: SceneCaster, lamp_m: np.ndarray | None, resolution_m: float
) -> Detours:
    """Multipath bound of a flood at the rays' origins, or of beams received in a fixed receiver's field of view.

    A flood shines as strongly in all directions as along each ray.

    Arguments:
        scene: The scene and its receiver.
        rays: N rays.
        hits: Their first hits.
        caster: Caster of this frame.
        lamp_m: Position of the emitter, or of the receiver, shape (3,) [m]; None: each ray's origin.
        resolution_m: The detector's resolution in half path [m].
    """
    chosen = _sample(hits)
    lamp = rays.origin_m[chosen] if lamp_m is None else np.tile(np.asarray(lamp_m, dtype=float), (len(chosen), 1))
    place = rays.origin_m[chosen] + hits.range_m[chosen, None] * rays.direction[chosen]
    start = _Ends(np.arange(len(chosen)), np.ones(len(chosen)), place, hits.normal[chosen], np.zeros(len(chosen)))
    direct_m = np.linalg.norm(lamp - place, axis=1)
    # light that falls on a spot at the lamp itself is late by nothing
    own = safe_divide(np.maximum(np.einsum("kj,kj->k", start.normal, lamp - place), 0.0), direct_m**3)
    first = _next(scene, caster, start, DIRECTIONS)
    second = _next(scene, caster, first, FURTHER_DIRECTIONS)
    # a flood's pixels see spots anywhere; a fixed receiver only those in its view
    viewed = scene if lamp_m is not None else None
    lit = [_lit(ends, lamp[ends.point], caster, viewed) for ends in (first, second)]
    brightest = max([own.max(initial=0.0), *(light.max(initial=0.0) for light, _ in lit)])
    seen = first.seen(len(chosen))
    most = max(body.reflectance for body in scene.bodies)
    with np.errstate(divide="ignore"):
        over_own = np.where(own > 0, 1 / own, 0.0)
    late = _Late(len(chosen), resolution_m)
    for ends, (light, away_m) in zip((first, second), lit, strict=True):
        late.add(
            ends.point, ends.weight * light * over_own[ends.point], (ends.path_m + away_m - direct_m[ends.point]) / 2
        )
    twice = np.bincount(second.point, second.weight, len(chosen))
    rest = twice * series(most * seen.max(initial=0.0)) * brightest * over_own
    return late.detours(chosen, rest, rest * resolution_m, seen)


def pixel_bound(
    scene: Scene, rays: Rays, hits: Hits, caster: SceneCaster, pixel_sr: float, resolution_m: float
) -> Detours:
    """Multipath bound of scanned beams received by the pixel around each beam; arguments as in `lamp_bound`."""
    chosen = _sample(hits)
    distance_m, normal = hits.range_m[chosen], hits.normal[chosen]
    place = rays.origin_m[chosen] + distance_m[:, None] * rays.direction[chosen]
    own = reflectances(scene, hits)[chosen]
    start = _Ends(np.arange(len(chosen)), own, place, normal, np.zeros(len(chosen)))
    cosine = np.abs(np.einsum("kj,kj->k", normal, rays.direction[chosen]))
    spot_m2 = pixel_sr * distance_m**2 / np.maximum(cosine, FLATTEST_COSINE)
    ends = _next(scene, caster, start, DIRECTIONS)
    back = place[ends.point] - ends.place
    facing = np.maximum(np.einsum("mj,mj->m", ends.normal, back), 0.0)
    leaving = np.maximum(-np.einsum("mj,mj->m", normal[ends.point], back), 0.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factor = np.fmin(facing * leaving * spot_m2[ends.point] / (math.pi * ends.path_m**4), 1.0)
    late = _Late(len(chosen), resolution_m)
    late.add(ends.point, ends.weight * factor, ends.path_m)
    seen = ends.seen(len(chosen))
    further = series(max(body.reflectance for body in scene.bodies) * seen.max(initial=0.0))
    # the k-th bounce more comes from k times as far: sum over k of k once^(k - 1) = 1 / (1 - once)^2
    return late.detours(chosen, late.share * further, late.moved_m * ((1 + further) ** 2 - 1), seen)


@dataclass(frozen=True, eq=False)
class _Ends:
    """Ends of paths that started at sampled points, as flat lists.

    Arguments:
        point: Index of the point that each path started at.
        weight: Share of the point's view that each path represents, times the reflectances on it.
        place, normal: Position [m] and surface normal of its end, shape (M, 3).
        path_m: Length of the path [m].
    """

    point: np.ndarray
    weight: np.ndarray
    place: np.ndarray
    normal: np.ndarray
    path_m: np.ndarray

    def seen(self, points: int) -> np.ndarray:
        """Share of the directions from each point that hit a surface, after one step."""
        return np.bincount(self.point, minlength=points) / DIRECTIONS


class _Late:
    """Shares of late light within and beyond the detector's resolution, summed by point."""

    def __init__(self, points: int, resolution_m: float) -> None:
        self._resolution_m = resolution_m
        self.near, self.apart, self.moved_m = np.zeros(points), np.zeros(points), np.zeros(points)

    @property
    def share(self) -> np.ndarray:
        return self.near + self.apart

    def add(self, point: np.ndarray, share: np.ndarray, late_m: np.ndarray) -> None:
        near, points = late_m < self._resolution_m, len(self.near)
        self.near += np.bincount(point, share * near, points)
        self.apart += np.bincount(point, share * ~near, points)
        self.moved_m += np.bincount(point, share * near * np.maximum(late_m, 0.0), points)

    def detours(self, chosen: np.ndarray, rest: np.ndarray, rest_moved_m: np.ndarray, seen: np.ndarray) -> Detours:
        """The bounds with the rest of the light, of any delay, added."""
        moved_m = self.moved_m + np.minimum(rest_moved_m, rest * self._resolution_m)
        # the mean of an echo and near late light is off by at most their share times the resolution
        beside = self.near + rest
        shift_m = np.minimum(moved_m, self._resolution_m * beside / (1 + beside))
        return Detours(chosen, self.share + rest, self.apart + rest, shift_m, seen)


def _sample(hits: Hits) -> np.ndarray:
    """Indices of up to `MOST_POINTS` rays with a hit, evenly out of all of them."""
    met = np.flatnonzero(hits.body >= 0)
    return met[np.unique(np.linspace(0, len(met) - 1, min(MOST_POINTS, len(met))).astype(int))]


def _next(scene: Scene, caster: SceneCaster, ends: _Ends, directions: int) -> _Ends:
    """Extend paths from their ends in `directions` directions each to the next hits."""
    # Directions above surfaces with normals (M, 3), dense as the cosine, turned from each to the next, (M D, 3)
    number = np.arange(directions)
    radius = np.sqrt((number + 0.5) / directions)
    angle = GOLDEN_ANGLE_RAD * (number + directions * np.arange(len(ends.normal))[:, None])
    left = np.cross(np.eye(3)[np.abs(ends.normal).argmin(axis=1)], ends.normal)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(ends.normal, left)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    height = np.sqrt(1 - radius**2)[:, None]
    spread = x[..., None] * left[:, None] + y[..., None] * up[:, None] + height * ends.normal[:, None]
    direction = spread.reshape(-1, 3)
    source = np.repeat(np.arange(len(ends.point)), directions)
    start = _lifted(ends.place, ends.normal)[source]
    found = caster.first_hit(start, direction)
    met = np.flatnonzero(found.body >= 0)
    source, reached = source[met], found.range_m[met]
    return _Ends(
        ends.point[source],
        ends.weight[source] * reflectances(scene, found)[met] / directions,
        start[met] + reached[:, None] * direction[met],
        found.normal[met],
        ends.path_m[source] + reached,
    )


def _lit(ends: _Ends, lamp_m: np.ndarray, caster: SceneCaster, viewed: Scene | None) -> tuple[np.ndarray, np.ndarray]:
    """Unshadowed light from lamps (M, 3) on places, cosine / distance^2, and the distances of lamps [m], both (M,)."""
    places = _lifted(ends.place, ends.normal)
    toward = lamp_m - places
    away_m = np.linalg.norm(toward, axis=1)
    cosine = np.einsum("mj,mj->m", toward, ends.normal) / away_m
    asked = cosine > 0
    if viewed is not None and viewed.receiver is not None:
        asked &= in_view(viewed.receiver, places)
    asked = np.flatnonzero(asked)
    free = caster.first_hit(places[asked], toward[asked]).range_m >= away_m[asked]
    light = np.zeros(len(places))
    light[asked] = np.where(free, cosine[asked] / away_m[asked] ** 2, 0.0)
    return light, away_m


def _lifted(places: np.ndarray, normal: np.ndarray) -> np.ndarray:
    if not len(places):
        return places
    return places + CLEARANCE * (1 + np.ptp(places, axis=0).max()) * normal
