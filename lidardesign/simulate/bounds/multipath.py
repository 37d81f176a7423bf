"""Light that comes back by way of other surfaces: later, and weaker by each bounce.

From points that rays meet, other surfaces are looked for, and what they send there is bounded (`multipath_bound`): of
a flood or for one receiver that hears all, what they get of the light; where one spot at a time is lit and seen,
what falls on it again. What is late by less than a detector tells apart moves the echo by its delay times its share;
what is late by more makes its own peak, taken for the echo at most where all of it outweighs that. Where a receiver
that stands elsewhere does not hear the echo at all, whatever comes by detours may be taken for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Body, Box, Capsule, Mesh, Plane, Scene, Sphere
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.bounds.spots import moved_by_spots_m
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.hits import Hits
from lidardesign.simulate.multipath_bound import Detours, lamp_bound, pixel_bound
from lidardesign.simulate.receiver_view import in_view
from lidardesign.simulate.returns import Rays

# What lies in the way by less than this share of it is the surface itself: rays are traced to float32.
CLEARANCE_SHARE = 1e-4
# Shares of late light below this are not told apart [%].
TINY_PERCENT = 0.01


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why no light can go from one surface to another, if so."""
    if len(scene.bodies) == 1 and _convex_from(scene.bodies[0], lists):
        return "one convex body lights nothing else"
    if not detector.bin_s and not detector.pulse_sigma_s:
        return "later light is told apart from the first echo"
    if max(body.reflectance for body in scene.bodies) == 0:
        return "nothing reflects"
    return None


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of light that is late, the same for all rays: as its rms over points."""
    rows = np.flatnonzero(sight.returned)
    if not len(rows):
        return sight.nothing("no ray returns")
    found = _detours(sight, rows)
    moved_m = np.minimum(found.shift_m, sight.width_m[rows][found.chosen])
    squared_m2 = np.mean(moved_m**2)
    by_spots_m2 = np.mean(moved_by_spots_m(sight) ** 2) if _is_flood(sight) else 0.0
    alone = _hidden(sight, rows[found.chosen]) & (found.seen > 0)
    outweighed = np.mean((found.apart > 1) | alone)
    late = 100 * found.share.mean()
    reason = (
        f"other surfaces fill {100 * found.seen.mean():.2g} % of what a surface sees; "
        + (f"late light is at most {late:.2g} %" if late >= TINY_PERCENT else f"late light is below {TINY_PERCENT} %")
        + (f", and all there is of {100 * alone.mean():.3g} % of returns" if alone.any() else "")
    )
    if by_spots_m2 > squared_m2:
        reason = f"the spots of a flood light each other, {reason}"
    return Stake(np.full(len(sight), max(squared_m2, by_spots_m2)), np.where(sight.returned, outweighed, 0.0), reason)


def _hidden(sight: Sight, rows: np.ndarray) -> np.ndarray:
    """Whether the light of some rays that hit something does not come straight to a receiver elsewhere, (K,) bool."""
    receiver = sight.scene.receiver
    if receiver is None:
        return np.zeros(len(rows), dtype=bool)
    home, origin_m = np.asarray(receiver.origin_m), sight.rays.origin_m[rows]
    points = origin_m + sight.range_m[rows, None] * sight.rays.direction[rows]
    way, hidden = points - home, ~in_view(receiver, points)
    length_m = np.linalg.norm(way, axis=1)
    asked = ~hidden & (origin_m != home).any(axis=1) & (length_m > 0)
    met_m = sight.caster.first_hit(np.broadcast_to(home, way[asked].shape), way[asked]).range_m
    hidden[asked] = met_m < length_m[asked] * (1 - CLEARANCE_SHARE)
    return hidden


def _is_flood(sight: Sight) -> bool:
    """Whether all rays are lit at once, and each is heard where it starts."""
    photons = sight.detector.photons
    return sight.scene.receiver is None and photons is not None and photons.emission == "flood"


def _detours(sight: Sight, rows: np.ndarray) -> Detours:
    rays, hits = sight.rays.subset(rows), sight.hits
    hits = Hits(hits.range_m[rows], hits.body[rows], hits.normal[rows])
    photons, receiver = sight.detector.photons, sight.scene.receiver
    flood = photons is not None and photons.emission == "flood"
    if not flood and receiver is None:
        beam_sr = math.pi * (sight.detector.divergence_rad / 2) ** 2
        pixel_sr = beam_sr if photons is None else max(photons.field_of_view_sr, beam_sr)
        return pixel_bound(sight.scene, rays, hits, sight.caster, pixel_sr, sight.resolution_m)
    # a flood's pixels look at spots that its emitters light; a receiver alone hears what is sent anywhere in its view
    lamp_m = None if flood or receiver is None else np.asarray(receiver.origin_m)
    return lamp_bound(sight.scene, rays, hits, sight.caster, lamp_m, sight.resolution_m)


def _convex_from(body: Body, lists: Sequence[Rays]) -> bool:
    """Whether a body is convex as all rays see it: from outside."""
    if isinstance(body.shape, Mesh):
        return False
    poses = body.poses if body.poses.ndim == 3 else body.poses[None]
    return not any(_inside(body, rays.origin_m, pose).any() for rays in lists for pose in poses)


def _inside(body: Body, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Which points (N, 3) lie in a primitive, shape (N,); both sides of a plane are flat."""
    shape, local = body.shape, (points - pose[:3, 3]) @ pose[:3, :3]
    if isinstance(shape, Box):
        return (np.abs(local) < np.asarray(shape.half_extents_m)).all(axis=1)
    if isinstance(shape, Capsule):
        local[:, 2] -= np.clip(local[:, 2], -shape.half_length_m, shape.half_length_m)
    if isinstance(shape, Plane):
        return np.zeros(len(points), dtype=bool)
    assert isinstance(shape, Sphere | Capsule)
    return np.linalg.norm(local, axis=1) < shape.radius_m
