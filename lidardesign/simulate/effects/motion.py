"""Motion within a frame: every ray is cast at the poses of bodies at its own firing time.

A body with a pose per frame goes from each pose T_0 to the next T_1 on the one screw that joins them,
T(s) = exp(s log(T_1 T_0^{-1})) T_0 with s = time * frame rate: with a constant turn about a fixed axis and a constant
travel along it, which is how the links of a robot move when one joint turns (Murray, Li, Sastry 1994, chapter 2).
Rays that are fired later than a frame lasts hit it on its way to the pose after that. After its last pose a body
continues its last motion. A body with a single pose for all frames moves with its velocity.

Bound of its effect (`bound`): a ray fired at the time t hits a body that has moved by v t, v the velocity of the hit
point: its range changes by at most |v| t / cos(theta) on a plane met at the angle theta, which may lead it into or out
of its gate, and at the body's edges it hits something else, with the probability that an edge lies within |v| t; see
`edge_probability` (an estimate). Bodies that move into a ray are found by moving the ray back by v t, v where the ray
passes the body, and casting it (exact for bodies that do not turn, and for a single moving body). A detector without
any error or width, `ideal`, takes the whole frame at one instant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lidardesign.scenes.casting import Primitives, SceneCaster, shared_caster
from lidardesign.scenes.rays import Hits, Rays
from lidardesign.scenes.scene import Body, Mesh, Scene, Shape, inverse_rigid
from lidardesign.scenes.surface import BALL_SLACK, bounding_radius_m
from lidardesign.scenes.triangles import SecondCasts, mesh_caster
from lidardesign.simulate.detector.light import Tracer
from lidardesign.simulate.detector.physics import IDEAL, Detector
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits, edge_probability

# First hits of rays (N, 3), (N, 3) in a body's own frame before limits (N,).
LocalTracer = Callable[[np.ndarray, np.ndarray, np.ndarray], Hits]


@dataclass(frozen=True, eq=False)
class Screw:
    """Screw motion: a pose with constant angular velocity and translation.

    Arguments:
        pose: Body to world at time 0, shape (4, 4).
        turn_rad_s: Axis times angular speed, in the world [rad/s], shape (3,).
        drift_m_s: Velocity of the body's point at the world's origin [m/s], shape (3,).
    """

    pose: np.ndarray
    turn_rad_s: np.ndarray
    drift_m_s: np.ndarray

    @classmethod
    def between(cls, pose: np.ndarray, later: np.ndarray, rate_hz: float) -> Screw:
        """The screw that joins two poses, the shorter way round, the second 1 / rate after the first."""
        step = later @ inverse_rigid(pose)
        # slow to import
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
        drift = np.linalg.solve(_translations(turn, np.ones(1))[0], step[:3, 3])
        return cls(pose, turn * rate_hz, drift * rate_hz)

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (N, 3, 3) and translations (N, 3) of the body at times (N,) [s]."""
        # Rotations exp(t [w]) for a rate w (3,) and times (N,), shape (N, 3, 3) (Rodrigues 1840)
        speed = float(np.linalg.norm(self.turn_rad_s))
        axis = _cross_matrix(self.turn_rad_s / speed if speed else self.turn_rad_s)
        angle = (speed * time_s)[:, None, None]
        # 1 - cos written without its cancellation
        turned = np.eye(3) + np.sin(angle) * axis + 2 * np.sin(angle / 2) ** 2 * (axis @ axis)
        moved = _translations(self.turn_rad_s, time_s) @ self.drift_m_s
        return turned @ self.pose[:3, :3], turned @ self.pose[:3, 3] + moved

    def speed_m_s(self, point: np.ndarray) -> float:
        """Speed of a point (3,) in the body's frame, constant on a screw [m/s]."""
        place = self.pose[:3, :3] @ point + self.pose[:3, 3]
        return float(np.linalg.norm(np.cross(self.turn_rad_s, place) + self.drift_m_s))


def _cross_matrix(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _translations(turn: np.ndarray, time: np.ndarray) -> np.ndarray:
    """The integral of exp(s [w]) over s from 0 to t, for a rate w (3,) and times t (N,), shape (N, 3, 3)."""
    speed = float(np.linalg.norm(turn))
    axis = _cross_matrix(turn / speed if speed else turn)
    time = time[:, None, None]
    half = speed * time / 2
    # sinc(x) = sin(pi x) / (pi x) has no hole at 0
    versed = time * np.sin(half) * np.sinc(half / np.pi)
    return time * np.eye(3) + versed * axis + time * (1 - np.sinc(speed * time / np.pi)) * (axis @ axis)


def path_of(body: Body, frame: int, rate_hz: float) -> Screw:
    """Screw motion of a body during a frame."""
    if body.poses.ndim == 2:
        return Screw(body.poses, np.zeros(3), np.asarray(body.velocity_m_s))
    if len(body.poses) == 1:
        return Screw(body.poses[0], np.zeros(3), np.zeros(3))
    start = min(frame, len(body.poses) - 2)
    return replace(Screw.between(body.poses[start], body.poses[start + 1], rate_hz), pose=body.poses[frame])


class _MovingBody:
    """A body of a scene that rays meet at different times of a frame, traced in its own frame."""

    def __init__(self, scene: Scene, index: int, frame: int) -> None:
        self._index, self._body, self._frame, self._rate_hz = index, scene.bodies[index], frame, scene.frame_rate_hz
        self._trace, self._centre, self._radius_m = _local_tracer(self._body.shape)

    def keep_nearer(self, hits: Hits, origins: np.ndarray, directions: np.ndarray, time_s: np.ndarray) -> None:
        """Replace the entries of `hits` by nearer hits of this body."""
        for path, piece, elapsed_s in self._pieces(time_s):
            near = self._near(path, origins[piece], directions[piece], elapsed_s, hits.range_m[piece])
            if not len(near):
                continue
            rows = piece[near]
            rotation, translation = path.at(elapsed_s[near])
            local_origins = np.einsum("nji,nj->ni", rotation, origins[rows] - translation)
            local_directions = np.einsum("nji,nj->ni", rotation, directions[rows])
            found = self._trace(local_origins, local_directions, hits.range_m[rows])
            hit = np.flatnonzero(np.isfinite(found.range_m))
            won, turned = rows[hit], np.einsum("nij,nj->ni", rotation[hit], found.normal[hit])
            turned[np.einsum("nk,nk->n", turned, directions[won]) > 0] *= -1
            hits.range_m[won], hits.body[won], hits.normal[won] = found.range_m[hit], self._index, turned

    def _pieces(self, time_s: np.ndarray) -> Iterator[tuple[Screw, np.ndarray, np.ndarray]]:
        """Screws of the body's path, each with the rows of its rays and their times since its start [s]."""
        if self._body.poses.ndim == 2:
            yield path_of(self._body, self._frame, self._rate_hz), np.arange(len(time_s)), time_s
            return
        left = len(self._body.poses) - 1 - self._frame
        passed = np.clip(np.floor(time_s * self._rate_hz), 0, left).astype(np.int64)
        for frames in np.unique(passed).tolist():
            rows = np.flatnonzero(passed == frames)
            yield path_of(self._body, self._frame + frames, self._rate_hz), rows, time_s[rows] - frames / self._rate_hz

    def _near(
        self, path: Screw, origins: np.ndarray, directions: np.ndarray, time_s: np.ndarray, limit_m: np.ndarray
    ) -> np.ndarray:
        """Rows of rays that pass, before their limit, a ball around the body at all of their times."""
        if not np.isfinite(self._radius_m) or not len(origins):
            return np.arange(len(origins))
        earliest, latest = time_s.min(), time_s.max()
        rotation, translation = path.at(np.array([(earliest + latest) / 2]))
        offset = rotation[0] @ self._centre + translation[0] - origins
        radius_m = self._radius_m + path.speed_m_s(self._centre) * (latest - earliest) / 2
        along = np.einsum("nk,nk->n", offset, directions)
        squared = np.einsum("nk,nk->n", offset, offset)
        slack = BALL_SLACK * squared
        reach = radius_m + np.sqrt(slack)
        return np.flatnonzero(
            (squared - along**2 <= radius_m**2 + slack) & (along >= -reach) & (along - reach <= limit_m)
        )


def _local_tracer(shape: Shape) -> tuple[LocalTracer, np.ndarray, float]:
    """Tracer of a shape in its own frame, and the centre (3,) and radius of a ball around it [m]."""
    if isinstance(shape, Mesh):
        caster, counted = mesh_caster(shape), SecondCasts()
        return partial(caster.trace, twice=counted), caster.centre_m, caster.radius_m
    group = Primitives([(0, Body(shape))], 0)

    def trace(origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> Hits:
        hits = Hits.none(len(origins))
        group.keep_nearer(hits, origins, directions, limit_m)
        return hits

    return trace, np.zeros(3), group.radius_m


def still_tracer(caster: SceneCaster) -> Tracer:
    """Tracer of a scene that is static within a frame."""
    return lambda origins, directions, time_s: caster.first_hit(origins, directions)


def moving_tracer(scene: Scene, frame: int) -> Tracer:
    """Tracer of unit rays (N, 3), (N, 3) that are sent at times (N,) [s] within a frame, with bodies in motion."""
    caster = shared_caster(scene, only="resting")
    moving = [_MovingBody(scene, index, frame) for index, body in enumerate(scene.bodies) if not body.is_resting]

    def trace(origins: np.ndarray, directions: np.ndarray, time_s: np.ndarray) -> Hits:
        hits = caster.first_hit(origins, directions)
        for body in moving:
            body.keep_nearer(hits, origins, directions, time_s)
        return hits

    return trace


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why motion changes nothing, or None."""
    if is_instant(detector):
        return "the detector takes a frame at one instant"
    if not any(_moves(body) for body in scene.bodies):
        return "nothing moves"
    return None if any(rays.time_s.any() for rays in lists) else "all rays are fired at once"


def is_instant(detector: Detector) -> bool:
    """True if a detector equals `ideal` except for its name: it takes a frame at one instant."""
    return replace(detector, name=IDEAL.name) == IDEAL


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of moving bodies."""
    step_m = np.linalg.norm(point_velocities(first_hits), axis=1) * first_hits.rays.time_s
    moved_m = step_m / first_hits.cosine
    edge = edge_probability(first_hits, step_m)
    squared = np.minimum(moved_m, first_hits.width_m) ** 2 + edge * first_hits.resolution_m**2
    entered = entered_rays(first_hits)
    lost = np.maximum(edge, ((first_hits.gate_edge_m <= moved_m) & (moved_m > 0)) | entered)
    lost = np.maximum(lost, counts.spilled(moved_m))
    reason = f"surfaces move by up to {1000 * step_m.max(initial=0.0):.3g} mm within a frame"
    if entered.any():
        reason += f", and into {100 * entered.mean():.3g} % of rays"
    return EffectBound(squared, lost, reason)


def entered_rays(first_hits: FirstHits) -> np.ndarray:
    """Mask of rays that hit, at their own time, a moving body that they do not hit at the frame's start, shape (N,)."""
    entered = np.zeros(len(first_hits), dtype=bool)
    rays, range_m = first_hits.rays, first_hits.hits.range_m
    for index, body in enumerate(first_hits.scene.bodies):
        if not _moves(body):
            continue
        rows = np.flatnonzero((first_hits.hits.body != index) & (rays.time_s > 0))
        middle, radius_m = _ball(body, first_hits.frame)
        drift = _velocity(first_hits.scene, body, first_hits.frame, middle[None])[0]
        offset = middle + rays.time_s[rows, None] * drift - rays.origin_m[rows]
        along = np.einsum("nk,nk->n", offset, rays.direction[rows])
        aside_m = np.sqrt(np.maximum(np.einsum("nk,nk->n", offset, offset) - along**2, 0.0))
        passing = (aside_m <= radius_m) & (along >= -radius_m) & (along - radius_m <= range_m[rows])
        rows, along = rows[passing], along[passing]
        place = rays.origin_m[rows] + along[:, None] * rays.direction[rows]
        back = rays.time_s[rows, None] * _velocity(first_hits.scene, body, first_hits.frame, place)
        found = first_hits.caster.first_hit(rays.origin_m[rows] - back, rays.direction[rows])
        entered[rows] |= (found.body == index) & (found.range_m < range_m[rows])
    return entered


def _ball(body: Body, frame: int) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a ball around a body at the start of a frame [m]."""
    shape, pose = body.shape, body.pose(frame)
    if isinstance(shape, Mesh):
        low, high = shape.bounds_m
        return pose[:3, :3] @ (low + high) / 2 + pose[:3, 3], float(np.linalg.norm(high - low)) / 2
    return pose[:3, 3], bounding_radius_m(shape)


def point_velocities(first_hits: FirstHits) -> np.ndarray:
    """Velocities of the bodies at first hits, 0 on a miss, shape (N, 3) [m/s]."""
    points = first_hits.rays.origin_m + first_hits.range_m[:, None] * first_hits.rays.direction
    velocity = np.zeros((len(first_hits), 3))
    for index, body in enumerate(first_hits.scene.bodies):
        met = np.flatnonzero(first_hits.hits.body == index)
        if len(met) and _moves(body):
            velocity[met] = _velocity(first_hits.scene, body, first_hits.frame, points[met])
    return velocity


def _velocity(scene: Scene, body: Body, frame: int, points: np.ndarray) -> np.ndarray:
    """Mean velocities of points (N, 3) fixed to a body until its next pose, or before its last, (N, 3) [m/s]."""
    if body.poses.ndim == 2:
        return np.broadcast_to(np.asarray(body.velocity_m_s), points.shape)
    start = min(frame, len(body.poses) - 2)
    step = body.poses[start + 1] @ inverse_rigid(body.poses[start])
    return (points @ step[:3, :3].T + step[:3, 3] - points) * scene.frame_rate_hz


def _moves(body: Body) -> bool:
    if body.poses.ndim == 2:
        return any(body.velocity_m_s)
    return len(body.poses) > 1 and bool((body.poses != body.poses[0]).any())
