"""First hits of rays in a scene: Embree for meshes, closed forms for primitives, nearest of both.

Meshes are recentred in float64 before they become Embree's float32, which keeps sub-micrometre accuracy far from
the origin; Embree runs in its robust mode, without which a quarter of the rays aimed at vertices slip through.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.scene import Body, Box, Capsule, Mesh, Plane, Scene, Sphere, inverse_rigid

FARTHEST_M = 1e30  # what Embree takes for an unlimited ray

Only = Literal["all", "targets", "occluders"]


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays.

    Arguments:
        range_m: Distance along the ray [m], infinite on a miss, shape (N,).
        body: Index into the scene's bodies, -1 on a miss, shape (N,).
        normal: Unit surface normal facing the ray's origin, zero on a miss, shape (N, 3).
    """

    range_m: np.ndarray
    body: np.ndarray
    normal: np.ndarray


class SceneCaster:
    """Casts rays into one frame of a scene.

    Arguments:
        scene: The scene; meshes are moved to their pose at `frame` once.
        frame: The time frame.
        only: Which bodies rays can hit.
    """

    def __init__(self, scene: Scene, frame: int = 0, *, only: Only = "all") -> None:
        keep = {"all": lambda body: True, "targets": lambda body: body.is_target, "occluders": lambda b: b.is_occluder}
        chosen = [(i, body) for i, body in enumerate(scene.bodies) if keep[only](body)]
        self._meshes = _MeshCaster([(i, body) for i, body in chosen if isinstance(body.shape, Mesh)], frame)
        self._primitives = [(i, body, body.pose(frame)) for i, body in chosen if not isinstance(body.shape, Mesh)]

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """The nearest hit of every ray, shapes (N, 3) and (N, 3); directions are normalised here.

        Raises:
            ConfigError: An origin or direction that is not finite, or a direction of zero length.
        """
        origins, directions = _checked_rays(origins, directions)
        return self.trace(origins, directions, np.full(len(origins), np.inf))

    def trace(self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> Hits:
        """`first_hit` of rays known to be finite, float64 and of unit length; from its limit (N,) on, a hit is a miss."""
        hits = self._meshes.trace(origins, directions, limit_m)
        for index, body, pose in self._primitives:
            _keep_nearer(hits, index, limit_m, *_primitive_hit(body, pose, origins, directions))
        rows = np.flatnonzero(hits.body >= 0)
        facing = np.einsum("nk,nk->n", hits.normal[rows], directions[rows]) > 0
        hits.normal[rows[facing]] *= -1
        return hits


def _checked_rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    origins = np.ascontiguousarray(np.broadcast_to(origins, np.shape(directions)), dtype=np.float64)
    directions = np.asarray(directions, dtype=np.float64)
    lengths = np.linalg.norm(directions, axis=-1)
    if not (np.isfinite(origins).all() and np.isfinite(lengths).all()) or (len(lengths) and lengths.min() == 0):
        raise ConfigError("a ray has an origin or direction that is not finite, or a direction of zero length", where="rays")
    return origins, directions / lengths[:, None]


def _keep_nearer(hits: Hits, index: int, limit_m: np.ndarray, range_m: np.ndarray, normal: np.ndarray) -> None:
    nearer = (range_m < hits.range_m) & (range_m < limit_m)
    hits.range_m[nearer], hits.body[nearer], hits.normal[nearer] = range_m[nearer], index, normal[nearer]


class _MeshCaster:
    """All meshes of a frame in one Embree scene, recentred."""

    def __init__(self, bodies: list[tuple[int, Body]], frame: int) -> None:
        self._body_of_geometry = np.array([index for index, _ in bodies], dtype=np.int64)
        if not bodies:
            return
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        world = [body.shape.transformed(body.pose(frame)) for _, body in bodies]
        corners = np.concatenate([mesh.bounds_m for mesh in world])
        self._centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        self._scene = EmbreeScene()
        self._geometries = [
            TriangleMesh(self._scene, (mesh.vertices - self._centre).astype(np.float32), mesh.faces) for mesh in world
        ]

    def trace(self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> Hits:
        count = len(origins)
        hits = Hits(np.full(count, np.inf), np.full(count, -1, dtype=np.int64), np.zeros((count, 3)))
        if not len(self._body_of_geometry) or not count:
            return hits
        found = self._scene.run(
            (origins - self._centre).astype(np.float32),
            directions.astype(np.float32),
            dists=np.clip(limit_m, 0.0, FARTHEST_M).astype(np.float32),
            output=True,
        )
        rows = np.flatnonzero((found["primID"] >= 0) & (found["tfar"] < limit_m))
        hits.range_m[rows] = found["tfar"][rows]
        hits.body[rows] = self._body_of_geometry[found["geomID"][rows]]
        hits.normal[rows] = _unit(found["Ng"][rows].astype(np.float64))
        return hits


def _primitive_hit(
    body: Body, pose: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Range and world normal of the first hit with one primitive, by its closed form in the body's frame."""
    to_body = inverse_rigid(pose)
    local_origins = origins @ to_body[:3, :3].T + to_body[:3, 3]
    local_directions = directions @ to_body[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m, normal = _CLOSED_FORMS[type(body.shape)](body.shape, local_origins, local_directions)
    missed = ~(range_m >= 0)
    return np.where(missed, np.inf, range_m), np.where(missed[:, None], 0.0, normal) @ pose[:3, :3].T


def _nearest_non_negative(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """The smaller root that lies ahead; from inside a body that is the way out."""
    return np.where(near >= 0, near, np.where(far >= 0, far, np.inf))


def _ball(origins: np.ndarray, directions: np.ndarray, radius_m: float) -> np.ndarray:
    along = np.einsum("nk,nk->n", origins, directions)
    perpendicular = origins - along[:, None] * directions
    # the distance of the line from the centre directly: b^2 - c cancels for far origins
    half_chord = np.sqrt(radius_m**2 - np.einsum("nk,nk->n", perpendicular, perpendicular))
    range_m = _nearest_non_negative(-along - half_chord, -along + half_chord)
    return np.where(np.isnan(half_chord), np.inf, range_m)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)


def _points(origins: np.ndarray, directions: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    return origins + np.where(np.isfinite(range_m), range_m, 0.0)[:, None] * directions


def _sphere(shape: Sphere, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    range_m = _ball(origins, directions, shape.radius_m)
    return range_m, _unit(_points(origins, directions, range_m))


def _box(shape: Box, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    half = np.asarray(shape.half_extents_m)
    entry, leave = (-half - origins) / directions, (half - origins) / directions
    low, high = np.fmin(entry, leave), np.fmax(entry, leave)
    parallel = directions == 0
    inside_slab = np.abs(origins) <= half
    low = np.where(parallel, np.where(inside_slab, -np.inf, np.inf), low)
    high = np.where(parallel, np.where(inside_slab, np.inf, -np.inf), high)
    near, far = low.max(axis=1), high.min(axis=1)
    range_m = np.where(near <= far, _nearest_non_negative(near, far), np.inf)
    points = _points(origins, directions, range_m)
    axis = np.argmax(np.abs(points) / half, axis=1)
    normal = np.zeros_like(points)
    rows = np.arange(len(points))
    normal[rows, axis] = np.sign(points[rows, axis])
    return range_m, normal


def _capsule(shape: Capsule, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    radius, half_length = shape.radius_m, shape.half_length_m
    across = np.einsum("nk,nk->n", directions[:, :2], directions[:, :2])
    along = np.einsum("nk,nk->n", origins[:, :2], directions[:, :2]) / across
    perpendicular = origins[:, :2] - along[:, None] * directions[:, :2]
    half_chord = np.sqrt((radius**2 - np.einsum("nk,nk->n", perpendicular, perpendicular)) / across)
    candidates = [-along - half_chord, -along + half_chord]
    side = [
        np.where((t >= 0) & (np.abs(origins[:, 2] + t * directions[:, 2]) <= half_length), t, np.inf) for t in candidates
    ]
    for end in (-half_length, half_length):
        side += _cap(origins - np.array([0.0, 0.0, end]), directions, radius, np.sign(end) if end else 0.0)
    range_m = np.fmin.reduce(side)
    points = _points(origins, directions, range_m)
    axis_point = np.zeros_like(points)
    axis_point[:, 2] = np.clip(points[:, 2], -half_length, half_length)
    return range_m, _unit(points - axis_point)


def _cap(origins: np.ndarray, directions: np.ndarray, radius_m: float, outward: float) -> list[np.ndarray]:
    """Hits with the half of an end ball that is not inside the capsule's cylinder."""
    along = np.einsum("nk,nk->n", origins, directions)
    perpendicular = origins - along[:, None] * directions
    half_chord = np.sqrt(radius_m**2 - np.einsum("nk,nk->n", perpendicular, perpendicular))
    hits = []
    for range_m in (-along - half_chord, -along + half_chord):
        height = origins[:, 2] + range_m * directions[:, 2]
        hits.append(np.where((range_m >= 0) & (height * outward >= 0), range_m, np.inf))
    return hits


def _plane(shape: Plane, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    range_m = -origins[:, 2] / directions[:, 2]
    range_m = np.where(np.isfinite(range_m) & (range_m >= 0), range_m, np.inf)
    return range_m, np.tile([0.0, 0.0, 1.0], (len(origins), 1))


_CLOSED_FORMS: dict[type, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    Sphere: _sphere,
    Box: _box,
    Capsule: _capsule,
    Plane: _plane,
}
