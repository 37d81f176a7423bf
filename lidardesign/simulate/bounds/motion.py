r"""What moves while the rays of a frame are fired one after another.

A ray fired at the time t meets a body that has moved by v t, v the velocity of the point it meets: its range changes by
at most |v| t / cos(theta) on a plane met at the angle theta, which may lead it into or out of its gate, and at the
body's edges it meets something else, with the probability that an edge lies within |v| t; see `edge_probability` (an
estimate). A detector without any error or width,
`ideal`, takes the whole frame at one instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.scene import Body, Scene, inverse_rigid
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
    lost = np.maximum(edge, (sight.gate_edge_m <= moved_m) & (moved_m > 0))
    reason = f"surfaces move by up to {1000 * step_m.max(initial=0.0):.3g} mm within a frame"
    return Stake(squared, lost, reason)


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
