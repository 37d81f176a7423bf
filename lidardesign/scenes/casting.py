"""First hits and all crossings of rays with a scene: Embree for meshes, closed forms for primitives.

Meshes at rest share one Embree scene; a moving mesh has one in its own frame, built once, and rays that pass its
bounding ball are transformed into that frame. Rays that may have slipped through a mesh are cast twice (see
`triangles`), and the hits found that way are counted. `trace` and `trace_each`, which learning calls with many more
rays, cast once: rays exactly at vertices have probability 0 in a density.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import replace
from typing import Literal
from weakref import WeakKeyDictionary, WeakValueDictionary

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK, SQUARABLE, unit_vectors
from lidardesign.scenes.rays import Crossings, Hits
from lidardesign.scenes.scene import Body, Mesh, Scene, inverse_rigid
from lidardesign.scenes.surface import KINDS, SIZES, bounding_radius_m
from lidardesign.scenes.triangles import FARTHEST_M, SecondCasts, Triangles, advances_m, mesh_caster

# Step behind a triangle before the next cast, as a share of the scene's reach.
STEP_SHARE = COARSE_SLACK
MAXIMUM_LAYERS = 16
CROSSINGS_PER_RAY = 2  # of primitives, allocated at first
RAYS_AT_ONCE = 100_000  # over frames that are traced together

Only = Literal["all", "targets", "occluders", "resting"]


class SceneCaster:
    """Casts rays into one frame of a scene.

    Arguments:
        scene: The scene.
        frame: The time frame.
        only: The bodies that rays can hit.
    """

    def __init__(self, scene: Scene, frame: int = 0, *, only: Only = "all") -> None:
        chosen = _chosen(scene, only)
        self.second_casts = SecondCasts()
        meshes = [(i, body) for i, body in chosen if isinstance(body.shape, Mesh)]
        resting = [(i, body) for i, body in meshes if body.poses.ndim == 2]
        moving = [(i, body) for i, body in meshes if body.poses.ndim == 3]
        self.at_rest = _shared_at_rest(resting) if resting else None
        self.moving = _Moving(moving, frame) if moving else None
        primitives = [(i, body) for i, body in chosen if not isinstance(body.shape, Mesh)]
        self.primitives = Primitives(primitives, frame) if primitives else None

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First hits of rays, origins and directions of shape (N, 3); directions are normalised here.

        A ray that starts inside a solid hits its surface from inside.

        Raises:
            ConfigError: An origin or direction that is not finite, or a direction of zero length.
        """
        return next(first_hits([self], *checked_rays(origins, directions)))

    def trace(self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> Hits:
        """First hits of finite float64 rays of unit length, cast once; hits at or beyond limits (N,) [m] are misses."""
        return _traced([self], origins, directions, limit_m, None)[0]

    def crossings(
        self, origins: np.ndarray, directions: np.ndarray, start_m: np.ndarray, limit_m: np.ndarray
    ) -> Crossings:
        """All surfaces that rays cross from starts (N,) up to limits (N,) [m], hidden ones too; rays as in `trace`.

        Up to `MAXIMUM_LAYERS` triangles per ray are found; triangles closer than the step between them count once.
        """
        parts = [Crossings(np.empty(0, int), np.empty(0), np.empty(0))]
        meshes = [part for part in (self.at_rest, self.moving) if part]
        if meshes:
            reach_m = float(limit_m[np.isfinite(limit_m)].max(initial=0.0))
            step_m = STEP_SHARE * max(reach_m, *(part.radius_m for part in meshes))
            alive, start = np.arange(len(origins)), start_m.copy()
            for _ in range(MAXIMUM_LAYERS):
                ahead, toward = start[alive], directions[alive]
                places, left_m = origins[alive] + ahead[:, None] * toward, limit_m[alive] - ahead
                (hits,) = _traced_meshes([self], places, toward, left_m, None)
                hit = hits.body >= 0
                alive = alive[hit]
                if not len(alive):
                    break
                reached = ahead[hit] + hits.range_m[hit]
                cosine = np.abs(np.einsum("nk,nk->n", hits.normal[hit], toward[hit]))
                parts.append(Crossings(alive, reached, cosine))
                start[alive] = reached + step_m
        if self.primitives:
            parts.append(self.primitives.crossings(origins, directions, start_m, limit_m))
        return Crossings(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def first_hits(casters: Sequence[SceneCaster], origins: np.ndarray, directions: np.ndarray) -> Iterator[Hits]:
    """First hits of the same rays in each of several frames of a scene.

    Arguments:
        casters: One per frame, with the same bodies.
        origins, directions: Rays from `checked_rays`, shapes (N, 3).
    """
    at_once = max(RAYS_AT_ONCE // max(len(origins), 1), 1)
    for start in range(0, len(casters), at_once):
        some = casters[start : start + at_once]
        for caster in some:
            caster.second_casts.rays += len(origins)
        yield from _traced(some, origins, directions, np.full(len(origins), np.inf), some[0].second_casts)


def _traced(
    casters: Sequence[SceneCaster],
    origins: np.ndarray,
    directions: np.ndarray,
    limit_m: np.ndarray,
    twice: SecondCasts | None,
) -> list[Hits]:
    found = _traced_meshes(casters, origins, directions, limit_m, twice)
    for caster, hits in zip(casters, found, strict=True):
        if caster.primitives:
            caster.primitives.keep_nearer(hits, origins, directions, limit_m)
        rows = np.flatnonzero(hits.body >= 0)
        hits.normal[rows] = _facing(hits.normal[rows], directions[rows])
    return found


def _traced_meshes(
    casters: Sequence[SceneCaster],
    origins: np.ndarray,
    directions: np.ndarray,
    limit_m: np.ndarray,
    twice: SecondCasts | None,
) -> list[Hits]:
    found = [
        caster.at_rest.trace(origins, directions, limit_m, twice) if caster.at_rest else Hits.none(len(origins))
        for caster in casters
    ]
    moving = [caster.moving for caster in casters if caster.moving]
    if moving:
        _keep_nearer(moving, found, origins, directions, limit_m, twice)
    return found


def trace_each(
    casters: Sequence[SceneCaster],
    starts: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    limit_m: np.ndarray,
) -> Hits:
    """First hits of many casters' rays at once: caster c traces the rays from starts[c] to starts[c + 1].

    Rays and hits are as in `SceneCaster.trace`. Casters of meshes at rest alone, which are many in learning, run only
    Embree's calls one by one.
    """
    resting = [None if caster.primitives or caster.moving else caster.at_rest for caster in casters]
    if any(meshes is None for meshes in resting):
        return Hits.joined(
            [
                caster.trace(origins[begin:end], directions[begin:end], limit_m[begin:end])
                for caster, begin, end in zip(casters, starts[:-1], starts[1:], strict=True)
            ]
        )
    # for meshes at rest everything except Embree's calls is done for all rays together
    counts = np.diff(starts)
    local = origins - np.repeat([meshes.triangles.centre_m for meshes in resting], counts, axis=0)
    advance_m = advances_m(local, directions, np.repeat([meshes.radius_m for meshes in resting], counts))
    local = (local + advance_m[:, None] * directions).astype(np.float32)
    toward, limit = directions.astype(np.float32), np.clip(limit_m - advance_m, 0.0, FARTHEST_M).astype(np.float32)
    hits = Hits.none(len(origins))
    rows, ranges, normals = [], [], []
    for meshes, begin, end in zip(resting, starts[:-1], starts[1:], strict=True):
        if begin == end:
            continue
        found = meshes.triangles.run(local[begin:end], toward[begin:end], limit[begin:end])
        hit = np.flatnonzero(found["primID"] >= 0)
        rows.append(begin + hit)
        ranges.append(found["tfar"][hit])
        normals.append(found["Ng"][hit])
        hits.body[begin + hit] = meshes.body_of_geometry[found["geomID"][hit]]
    if rows:
        hit = np.concatenate(rows)
        hits.range_m[hit] = np.concatenate(ranges) + advance_m[hit]
        hits.normal[hit] = _facing(unit_vectors(np.concatenate(normals).astype(np.float64)), directions[hit])
    beyond = hits.range_m >= limit_m
    hits.range_m[beyond], hits.body[beyond], hits.normal[beyond] = np.inf, -1, 0.0
    return hits


def _chosen(scene: Scene, only: Only) -> list[tuple[int, Body]]:
    attribute = {"targets": "is_target", "occluders": "is_occluder", "resting": "is_resting"}.get(only)
    return [(i, body) for i, body in enumerate(scene.bodies) if attribute is None or getattr(body, attribute)]


_casters: WeakKeyDictionary[Scene, dict[tuple[int, ...], SceneCaster]] = WeakKeyDictionary()


def shared_caster(scene: Scene, frame: int = 0, *, only: Only = "all") -> SceneCaster:
    """Shared caster of a scene's frame and bodies, built at first use and kept as long as the scene."""
    known = _casters.setdefault(scene, {})
    key = (frame, *(i for i, _ in _chosen(scene, only)))
    if key not in known:
        known[key] = SceneCaster(scene, frame, only=only)
    return known[key]


def checked_rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of unit length, float64, shape (N, 3) each.

    Raises:
        ConfigError: One that is not finite, or a direction of zero length.
    """
    directions = np.asarray(directions, dtype=np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ConfigError(f"directions have shape {directions.shape}", where="rays", allowed="(N, 3)")
    origins = np.ascontiguousarray(np.broadcast_to(origins, directions.shape), dtype=np.float64)
    largest = np.abs(directions).max(axis=1, initial=0.0)
    if not (np.isfinite(origins).all() and np.isfinite(largest).all()) or (len(largest) and largest.min() == 0):
        raise ConfigError("an origin or direction is not finite, or a direction has zero length", where="rays")
    extreme = (largest < SQUARABLE) | (largest > 1 / SQUARABLE)
    if extreme.any():
        directions = np.where(extreme[:, None], directions / largest[:, None], directions)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


class Primitives:
    """Ray casting against the primitives of a frame.

    Arguments:
        members: Indices among all bodies, and the bodies; at least one.
        frame: The time frame.
    """

    def __init__(self, members: Sequence[tuple[int, Body]], frame: int) -> None:
        shapes, poses = [body.shape for _, body in members], np.stack([body.pose(frame) for _, body in members])
        radii_m = np.array([bounding_radius_m(shape) for shape in shapes])
        self.radius_m = float(radii_m.max())  # of a ball around a member's origin that holds any of them
        self._shapes = (
            np.array([KINDS[type(shape)] for shape in shapes]),
            np.array([SIZES[type(shape)](shape) for shape in shapes], dtype=np.float64),
            np.ascontiguousarray(inverse_rigid(poses)[:, :3]),
            np.ascontiguousarray(poses[:, :3, 3]),
            radii_m,
            np.array([number for number, _ in members]),
        )

    def keep_nearer(self, hits: Hits, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> None:
        """Replace the entries of `hits` by nearer hits on primitives, with outward normals."""
        from lidardesign.scenes import primitive_kernels

        primitive_kernels.keep_nearer(self._shapes, origins, directions, limit_m, hits.range_m, hits.body, hits.normal)

    def crossings(
        self, origins: np.ndarray, directions: np.ndarray, start_m: np.ndarray, limit_m: np.ndarray
    ) -> Crossings:
        """Crossings with the primitives, as in `SceneCaster.crossings`."""
        from lidardesign.scenes import primitive_kernels

        room = CROSSINGS_PER_RAY * len(origins)
        while True:
            found = np.empty(room, dtype=np.int64), np.empty(room), np.empty(room)
            count = primitive_kernels.crossings(self._shapes, origins, directions, start_m, limit_m, *found)
            if count <= room:
                return Crossings(*(column[:count] for column in found))
            room = count


class _AtRest:
    def __init__(self, bodies: Sequence[tuple[int, Body]]) -> None:
        self.body_of_geometry = np.array([index for index, _ in bodies], dtype=np.int64)
        self._meshes = [body.shape for _, body in bodies]  # kept alive, so that their ids stay unique
        self.triangles = Triangles([body.shape.transformed(body.poses) for _, body in bodies])
        self.radius_m = self.triangles.radius_m

    def trace(
        self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray, twice: SecondCasts | None
    ) -> Hits:
        hits = self.triangles.trace(origins, directions, limit_m, twice)
        return replace(hits, body=np.append(self.body_of_geometry, -1)[hits.body])


# Cached Embree scenes, by the first of their bodies and by geometry.
_at_rest: WeakKeyDictionary[Body, dict[Hashable, _AtRest]] = WeakKeyDictionary()
_by_geometry: WeakValueDictionary[Hashable, _AtRest] = WeakValueDictionary()


def _shared_at_rest(bodies: Sequence[tuple[int, Body]]) -> _AtRest:
    """Embree scene of bodies at rest, shared by all frames and by scenes with the same meshes at the same poses."""
    geometry = tuple((index, id(body.shape), body.poses.tobytes()) for index, body in bodies)
    known = _at_rest.setdefault(bodies[0][1], {})
    if geometry not in known:
        known[geometry] = _by_geometry.get(geometry) or _AtRest(bodies)
        _by_geometry[geometry] = known[geometry]
    return known[geometry]


class _Moving:
    def __init__(self, bodies: Sequence[tuple[int, Body]], frame: int) -> None:
        self._body = [index for index, _ in bodies]
        self.casters = [mesh_caster(body.shape) for _, body in bodies]
        self._poses = np.stack([body.pose(frame) for _, body in bodies])
        centres = np.stack([caster.centre_m for caster in self.casters])
        self._centres = np.einsum("bij,bj->bi", self._poses[:, :3, :3], centres) + self._poses[:, :3, 3]
        self._radii_m = np.array([caster.radius_m for caster in self.casters])
        self.radius_m = float(self._radii_m.max())

    def passing(
        self, number: int, origins: np.ndarray, directions: np.ndarray, bound_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows (K,) of rays that pass a mesh's ball before bounds (N,) [m], and the rays in its frame, (K, 3) each."""
        from lidardesign.scenes import primitive_kernels

        rows, local, toward = np.empty(len(origins), np.intp), np.empty(origins.shape), np.empty(origins.shape)
        ball = (self._centres[number], self._radii_m[number])
        found = primitive_kernels.passing(*ball, self._poses[number], origins, directions, bound_m, rows, local, toward)
        return rows[:found], local[:found], toward[:found]

    def enter(self, number: int, hits: Hits, rows: np.ndarray, met: Hits) -> None:
        """Write the hits of rays (K,) on a mesh, met in the mesh's frame, into `hits`."""
        hit = met.body >= 0
        won = rows[hit]
        hits.range_m[won], hits.body[won] = met.range_m[hit], self._body[number]
        hits.normal[won] = _turned(met.normal[hit], self._poses[number, :3, :3])


def _keep_nearer(
    moving: Sequence[_Moving],
    found: Sequence[Hits],
    origins: np.ndarray,
    directions: np.ndarray,
    limit_m: np.ndarray,
    twice: SecondCasts | None,
) -> None:
    """Replace hits in several frames by nearer ones on moving meshes, the same in all frames.

    Each mesh is cast once with the rays of all frames: most of the time of few rays goes into the calls.
    """
    for number, caster in enumerate(moving[0].casters):
        bounds = [np.minimum(hits.range_m, limit_m) for hits in found]
        asked = [part.passing(number, origins, directions, bound) for part, bound in zip(moving, bounds, strict=True)]
        rows, local, toward = zip(*asked, strict=True)
        bound = np.concatenate([bound[some] for bound, some in zip(bounds, rows, strict=True)])
        met = caster.trace(np.concatenate(local), np.concatenate(toward), bound, twice)
        ends = np.cumsum([len(some) for some in rows])
        for part, hits, some, end in zip(moving, found, rows, ends, strict=True):
            part.enter(number, hits, some, met.subset(slice(end - len(some), end)))


def _turned(vectors: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rotated vectors (N, 3); unlike a matrix product, bit-identical for any batch size."""
    x, y, z = (vectors[:, [axis]] * rotation[:, axis] for axis in range(3))
    return x + y + z


def _facing(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Normals (N, 3) flipped to face the origins of rays with directions (N, 3)."""
    return np.where((np.einsum("nk,nk->n", normals, directions) > 0)[:, None], -normals, normals)
