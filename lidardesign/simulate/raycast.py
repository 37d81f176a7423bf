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
GROUP_CHUNK = 200_000  # ray-primitive pairs at a time: the temporaries stay below some 50 MB

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
        kinds = {type(body.shape) for _, body in chosen} - {Mesh}
        self._groups = [
            _PrimitiveGroup([(i, body) for i, body in chosen if isinstance(body.shape, kind)], frame)
            for kind in sorted(kinds, key=lambda kind: kind.__name__)
        ]

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """The nearest hit of every ray, shapes (N, 3) and (N, 3); directions are normalised here.

        Raises:
            ConfigError: An origin or direction that is not finite, or a direction of zero length.
        """
        origins, directions = _checked_rays(origins, directions)
        return self.trace(origins, directions, np.full(len(origins), np.inf))

    def trace(self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> Hits:
        """`first_hit` of finite float64 rays of unit length; from its limit (N,) on, a hit counts as a miss."""
        hits = self._meshes.trace(origins, directions, limit_m)
        for group in self._groups:
            group.keep_nearer(hits, origins, directions, limit_m)
        rows = np.flatnonzero(hits.body >= 0)
        facing = np.einsum("nk,nk->n", hits.normal[rows], directions[rows]) > 0
        hits.normal[rows[facing]] *= -1
        return hits


def _checked_rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    origins = np.ascontiguousarray(np.broadcast_to(origins, np.shape(directions)), dtype=np.float64)
    directions = np.asarray(directions, dtype=np.float64)
    lengths = np.linalg.norm(directions, axis=-1)
    if not (np.isfinite(origins).all() and np.isfinite(lengths).all()) or (len(lengths) and lengths.min() == 0):
        raise ConfigError("an origin or direction is not finite, or a direction has zero length", where="rays")
    return origins, directions / lengths[:, None]


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


class _PrimitiveGroup:
    """All primitives of one kind in a frame, each hit in closed form in its own frame."""

    def __init__(self, members: list[tuple[int, Body]], frame: int) -> None:
        kind = type(members[0][1].shape)
        self._closed_form = _CLOSED_FORMS[kind]
        self._body = np.array([index for index, _ in members], dtype=np.int64)
        self._sizes = np.array([_SIZES[kind](body.shape) for _, body in members])[:, None]
        poses = np.stack([body.pose(frame) for _, body in members])
        self._rotation = poses[:, :3, :3]
        self._to_body = inverse_rigid(poses)

    def keep_nearer(self, hits: Hits, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> None:
        """Enter the hits that are nearer than what `hits` holds, in chunks that bound the memory."""
        size = max(1, GROUP_CHUNK // len(self._body))
        for start in range(0, len(origins), size):
            rows = slice(start, start + size)
            range_m, body, normal = self._nearest(origins[rows], directions[rows])
            nearer = np.flatnonzero((range_m < hits.range_m[rows]) & (range_m < limit_m[rows]))
            hits.range_m[rows][nearer] = range_m[nearer]
            hits.body[rows][nearer] = body[nearer]
            hits.normal[rows][nearer] = normal[nearer]

    def _nearest(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range, body and world normal of the nearest member per ray: (N,), (N,), (N, 3)."""
        turn = np.swapaxes(self._to_body[:, :3, :3], -1, -2)
        local_origins = origins @ turn + self._to_body[:, None, :3, 3]
        local_directions = directions @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = self._closed_form(self._sizes, local_origins, local_directions)
        range_m = np.where(range_m >= 0, range_m, np.inf)
        chosen = np.argmin(range_m, axis=0)
        rows = np.arange(len(origins))
        nearest = range_m[chosen, rows]
        reached = np.where(np.isfinite(nearest), nearest, 0.0)[:, None]
        points = local_origins[chosen, rows] + reached * local_directions[chosen, rows]
        normal = _NORMALS[self._closed_form](self._sizes[chosen, 0], points)
        return nearest, self._body[chosen], np.einsum("nij,nj->ni", self._rotation[chosen], normal)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(float).tiny)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)


def _nearest_non_negative(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """The smaller root that lies ahead; from inside a body that is the way out."""
    return np.where(near >= 0, near, np.where(far >= 0, far, np.inf))


def _ball_roots(origins: np.ndarray, directions: np.ndarray, radius_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both roots, NaN where the line passes by; the line's distance from the centre does not cancel as b^2 - c does."""
    along = _dot(origins, directions)
    perpendicular = origins - along[..., None] * directions
    half_chord = np.sqrt(radius_m**2 - _dot(perpendicular, perpendicular))
    return -along - half_chord, -along + half_chord


def _sphere(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return _nearest_non_negative(*_ball_roots(origins, directions, sizes[..., 0]))


def _sphere_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return _unit(points)


def _box(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    entry, leave = (-sizes - origins) / directions, (sizes - origins) / directions
    low, high = np.fmin(entry, leave), np.fmax(entry, leave)
    parallel = directions == 0
    inside_slab = np.abs(origins) <= sizes
    low = np.where(parallel, np.where(inside_slab, -np.inf, np.inf), low)
    high = np.where(parallel, np.where(inside_slab, np.inf, -np.inf), high)
    near, far = low.max(axis=-1), high.min(axis=-1)
    return np.where(near <= far, _nearest_non_negative(near, far), np.inf)


def _box_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    axis = np.argmax(np.abs(points) / sizes, axis=1)
    normal = np.zeros_like(points)
    rows = np.arange(len(points))
    normal[rows, axis] = np.sign(points[rows, axis])
    return normal


def _capsule(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    radius, half_length = sizes[..., 0], sizes[..., 1]
    across = _dot(directions[..., :2], directions[..., :2])
    along = _dot(origins[..., :2], directions[..., :2]) / across
    perpendicular = origins[..., :2] - along[..., None] * directions[..., :2]
    half_chord = np.sqrt((radius**2 - _dot(perpendicular, perpendicular)) / across)
    nearest = np.full(origins.shape[:-1], np.inf)
    for range_m in (-along - half_chord, -along + half_chord):
        on_side = np.abs(origins[..., 2] + range_m * directions[..., 2]) <= half_length
        nearest = np.where((range_m >= 0) & on_side, np.fmin(nearest, range_m), nearest)
    for outward in (-1.0, 1.0):
        centred = origins.copy()
        centred[..., 2] -= outward * half_length
        for range_m in _ball_roots(centred, directions, radius):
            on_cap = (centred[..., 2] + range_m * directions[..., 2]) * outward >= 0
            nearest = np.where((range_m >= 0) & on_cap, np.fmin(nearest, range_m), nearest)
    return nearest


def _capsule_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    axis_point = np.zeros_like(points)
    axis_point[:, 2] = np.clip(points[:, 2], -sizes[:, 1], sizes[:, 1])
    return _unit(points - axis_point)


def _plane(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    range_m = -origins[..., 2] / directions[..., 2]
    return np.where(np.isfinite(range_m) & (range_m >= 0), range_m, np.inf)


def _plane_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.tile([0.0, 0.0, 1.0], (len(points), 1))


_CLOSED_FORMS: dict[type, Callable[..., np.ndarray]] = {Sphere: _sphere, Box: _box, Capsule: _capsule, Plane: _plane}
_NORMALS = {_sphere: _sphere_normal, _box: _box_normal, _capsule: _capsule_normal, _plane: _plane_normal}
_SIZES: dict[type, Callable[..., tuple[float, float, float]]] = {
    Sphere: lambda shape: (shape.radius_m, 0.0, 0.0),
    Box: lambda shape: shape.half_extents_m,
    Capsule: lambda shape: (shape.radius_m, shape.half_length_m, 0.0),
    Plane: lambda shape: (0.0, 0.0, 0.0),
}
