"""Occlusion between lit points and a bistatic receiver.

The receiver sees lit points in its field of view along an unobstructed line of sight, or one obstructed only by glass.

Bound of its effect (`bound`): occlusion of a point is not known without casting a ray from the receiver, so every
return may be lost. A ray that starts at the receiver has the same line of sight both ways: it loses exactly the points
outside the receiver's field of view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from lidardesign.numerics import COARSE_SLACK
from lidardesign.scenes.rays import Hits, Rays, in_view
from lidardesign.scenes.scene import Mesh, Scene
from lidardesign.simulate.detector.light import Beams, Echoes, Tracer
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits

# Closed forms round at about 1e-15 of a distance; this clears a surface and is far below the thickness of any pane.
CLEARANCE_SHARE = 1e-5
# Hits on meshes are exact to float32, up to 1e-6 of the mesh radius; this is twice that.
MESH_CLEARANCE_SHARE = 2 * COARSE_SLACK
# A line of sight through more surfaces than this counts as blocked.
MAXIMUM_SURFACES = 8


_mesh_radii_m: WeakKeyDictionary[Scene, float] = WeakKeyDictionary()


def clearance_m(scene: Scene, distance_m: np.ndarray) -> np.ndarray:
    """Distance from a surface at which rays start or end, so that rounding causes no second hit, shape (N,) [m].

    Arguments:
        scene: Its largest mesh sets the rounding error of hits.
        distance_m: Length of the ray so far, shape (N,) [m].
    """
    if scene not in _mesh_radii_m:
        # Half the diagonal around what is traced as one: each moving mesh, or all that rest [m]
        radii_m, resting = [0.0], []
        for body in scene.bodies:
            if isinstance(body.shape, Mesh):
                low, high = body.shape.bounds_m
                radii_m.append(float(np.linalg.norm(high - low)) / 2)
                if body.poses.ndim == 2:
                    middle = body.poses[:3, :3] @ (low + high) / 2 + body.poses[:3, 3]
                    resting += [middle - radii_m[-1], middle + radii_m[-1]]
        if resting:
            radii_m.append(float(np.linalg.norm(np.ptp(resting, axis=0))) / 2)
        _mesh_radii_m[scene] = max(radii_m)
    return CLEARANCE_SHARE * distance_m + MESH_CLEARANCE_SHARE * _mesh_radii_m[scene]


def sight_shares(
    scene: Scene, points: np.ndarray, normal: np.ndarray, time_s: np.ndarray, tracer: Tracer
) -> np.ndarray:
    """Transmittance of the line of sight from surface points (N, 3) to the receiver, shape (N,).

    0 outside its field of view or range and behind opaque surfaces; transparent ones multiply it by their transmission.
    The line ends a clearance above the surface, so that surfaces that touch the lit one do not hide it.

    Arguments:
        scene: Its receiver and its bodies' transmissions.
        points: Lit points [m].
        normal: Unit normals towards the light, shape (N, 3).
        time_s: When they are lit within the frame [s], shape (N,).
        tracer: First hits of any rays at any time within the frame.
    """
    receiver = scene.receiver
    passing = np.array([body.transmission for body in scene.bodies])
    start = np.asarray(receiver.origin_m)
    ends = points + clearance_m(scene, np.linalg.norm(points - start, axis=1))[:, None] * normal
    length_m = np.linalg.norm(ends - start, axis=1)
    lit_side = np.einsum("nk,nk->n", normal, start - points) > 0
    share = (in_view(receiver, points) & (lit_side | (length_m == 0))).astype(np.float64)
    rows, travelled_m = np.flatnonzero(share * length_m > 0), np.zeros(len(points))
    for _ in range(MAXIMUM_SURFACES):
        direction = (ends[rows] - start) / length_m[rows, None]
        found = tracer(start + travelled_m[rows, None] * direction, direction, time_s[rows])
        met_m = travelled_m[rows] + found.range_m
        blocked = (found.body >= 0) & (met_m < length_m[rows])
        rows, met_m, body = rows[blocked], met_m[blocked], found.body[blocked]
        share[rows] *= passing[body]
        travelled_m[rows] = met_m + clearance_m(scene, met_m)
        rows = rows[(share[rows] > 0) & (travelled_m[rows] < length_m[rows])]
        if not len(rows):
            return share
    share[rows] = 0.0
    return share


def visible_echoes(scene: Scene, beams: Beams, hits: Hits, echoes: Echoes, tracer: Tracer) -> Echoes:
    """The direct echoes that reach the scene's receiver, attenuated by glass.

    Arguments:
        scene: Its receiver and its bodies' transmissions.
        beams: Beams of light, B of them.
        hits: First hits of the beams.
        echoes: One echo for each of these hits, in their order.
        tracer: First hits of any rays at any time within the frame.
    """
    seen = np.flatnonzero(hits.body >= 0)
    points = beams.origin_m[seen] + hits.range_m[seen, None] * beams.direction[seen]
    share = in_view(scene.receiver, points).astype(np.float64)
    # a ray that starts at the receiver returns along its own unobstructed path
    apart = (beams.origin_m[seen] != np.asarray(scene.receiver.origin_m)).any(axis=1)
    rows = seen[apart]
    share[apart] = sight_shares(scene, points[apart], hits.normal[rows], beams.time_s[rows], tracer)
    return replace(echoes, gain=echoes.gain * share).subset(share > 0)


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why the receiver sees all lit points, or None."""
    return None if scene.receiver is not None else "every ray is received where it starts"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of occlusion between lit points and the receiver."""
    receiver, rays = first_hits.scene.receiver, first_hits.rays
    together = (rays.origin_m == np.asarray(receiver.origin_m)).all(axis=1)
    points = rays.origin_m + first_hits.range_m[:, None] * rays.direction
    lost = np.where(together, ~in_view(receiver, points), True) & first_hits.returned
    away, hidden = (f"{100 * share.mean():.3g} %" for share in (~together, lost))
    return EffectBound(
        np.zeros(len(first_hits)),
        lost.astype(float),
        f"{away} of rays start away from the receiver, {hidden} may not be seen by it",
    )
