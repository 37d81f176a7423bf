r"""What moves while the rays of a frame are fired one after another.

A ray fired at the time t meets a body that has moved by v t, v the velocity of the point it meets: its range changes by
at most |v| t / cos(theta) on a plane met at the angle theta, which may lead it into or out of its gate, and at the
body's edges it meets something else, with the probability that an edge lies within |v| t; see `edge_probability` (an
estimate). What a body moves into that it was not in front of is met by moving the ray back by v t, v where the ray
passes the body, and casting it (exact for bodies that do not turn, and for one that moves alone). A detector without
any error or width, `ideal`, takes the whole frame at one instant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.scene import Body, Box, Mesh, Plane, Scene, inverse_rigid
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.neighbours import edge_probability
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import IDEAL, Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why all rays of a frame see one moment, if so."""
    if is_instant(detector):
        return "the detector takes a frame at one instant"
    if not any(_moves(body) for body in scene.bodies):
        return "nothing moves"
    return None if any(rays.time_s.any() for rays in lists) else "all rays are fired at once"


def is_instant(detector: Detector) -> bool:
    """Whether a detector is `ideal` but for its name: its rays take no time."""
    return replace(detector, name=IDEAL.name) == IDEAL


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of moving bodies."""
    velocity = point_velocities(sight)
    step_m = np.linalg.norm(velocity, axis=1) * sight.rays.time_s
    moved_m = step_m / sight.cosine
    edge = edge_probability(sight, step_m)
    squared = np.minimum(moved_m, sight.width_m) ** 2 + edge * sight.resolution_m**2
    entered = entered_rays(sight)
    lost = np.maximum(edge, ((sight.gate_edge_m <= moved_m) & (moved_m > 0)) | entered)
    reason = f"surfaces move by up to {1000 * step_m.max(initial=0.0):.3g} mm within a frame"
    if entered.any():
        reason += f", and into {100 * entered.mean():.3g} % of rays"
    return Stake(squared, lost, reason)


def entered_rays(sight: Sight) -> np.ndarray:
    """Which rays meet, at their own time, a moving body that they do not meet when the frame begins, shape (N,)."""
    entered = np.zeros(len(sight), dtype=bool)
    rays, range_m = sight.rays, sight.hits.range_m
    for index, body in enumerate(sight.scene.bodies):
        if not _moves(body):
            continue
        rows = np.flatnonzero((sight.hits.body != index) & (rays.time_s > 0))
        middle, radius_m = _ball(body, sight.frame)
        drift = _velocity(sight.scene, body, sight.frame, middle[None])[0]
        offset = middle + rays.time_s[rows, None] * drift - rays.origin_m[rows]
        along = np.einsum("nk,nk->n", offset, rays.direction[rows])
        aside_m = np.sqrt(np.maximum(np.einsum("nk,nk->n", offset, offset) - along**2, 0.0))
        passing = (aside_m <= radius_m) & (along >= -radius_m) & (along - radius_m <= range_m[rows])
        rows, along = rows[passing], along[passing]
        place = rays.origin_m[rows] + along[:, None] * rays.direction[rows]
        back = rays.time_s[rows, None] * _velocity(sight.scene, body, sight.frame, place)
        found = sight.caster.first_hit(rays.origin_m[rows] - back, rays.direction[rows])
        entered[rows] |= (found.body == index) & (found.range_m < range_m[rows])
    return entered


def _ball(body: Body, frame: int) -> tuple[np.ndarray, float]:
    """The middle (3,) and radius of a ball that holds a body at the start of a frame [m]."""
    shape, pose = body.shape, body.pose(frame)
    if isinstance(shape, Mesh):
        low, high = shape.bounds_m
        return pose[:3, :3] @ (low + high) / 2 + pose[:3, 3], float(np.linalg.norm(high - low)) / 2
    if isinstance(shape, Plane):
        return pose[:3, 3], math.inf
    if isinstance(shape, Box):
        return pose[:3, 3], float(np.linalg.norm(shape.half_extents_m))
    return pose[:3, 3], shape.radius_m + getattr(shape, "half_length_m", 0.0)


def point_velocities(sight: Sight) -> np.ndarray:
    """How the points that rays meet move with their bodies, shape (N, 3) [m/s]; 0 on a miss."""
    points = sight.rays.origin_m + sight.range_m[:, None] * sight.rays.direction
    velocity = np.zeros((len(sight), 3))
    for index, body in enumerate(sight.scene.bodies):
        met = np.flatnonzero(sight.hits.body == index)
        if len(met) and _moves(body):
            velocity[met] = _velocity(sight.scene, body, sight.frame, points[met])
    return velocity


def _velocity(scene: Scene, body: Body, frame: int, points: np.ndarray) -> np.ndarray:
    """Of points fixed to a body that goes on to its next pose, or, in the last frame, on from the one before."""
    if body.poses.ndim == 2:
        return np.broadcast_to(np.asarray(body.velocity_m_s), points.shape)
    last = len(body.poses) - 1
    first, then = (frame, frame + 1) if frame < last else (last - 1, last)
    step = body.poses[then] @ inverse_rigid(body.poses[first])
    return (points @ step[:3, :3].T + step[:3, 3] - points) * scene.frame_rate_hz


def _moves(body: Body) -> bool:
    if body.poses.ndim == 2:
        return any(body.velocity_m_s)
    return len(body.poses) > 1 and bool((body.poses != body.poses[0]).any())
