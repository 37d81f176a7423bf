"""Rays against primitives in closed form, all of one kind at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from lidardesign.geometry.rays import Crossings, Hits
from lidardesign.numerics import ROUNDING, unit_vectors
from lidardesign.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Shape, Sphere, inverse_rigid

GROUP_CHUNK = 200_000  # ray-primitive pairs at a time: the temporaries stay below some 50 MB
# Relative rounding of squared distances, doubled many times over: bounding balls are never missed.
BALL_SLACK = ROUNDING


class _Pairs(NamedTuple):
    """Rays of a chunk with a primitive whose bounding ball they pass, as flat lists of K pairs.

    Arguments:
        rows: The chunk of rays.
        ray, member: The ray's number in the chunk and the primitive's in its group.
        origins, directions: The rays in the primitive's frame, shape (K, 3).
        near, far: Ranges where they enter and leave it, NaN where they do not [m].
    """

    rows: slice
    ray: np.ndarray
    member: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    near: np.ndarray
    far: np.ndarray


class PrimitiveGroup:
    """All primitives of one kind in a frame, each crossed in closed form in its own frame."""

    def __init__(self, members: list[tuple[int, Body]], frame: int) -> None:
        kind = type(members[0][1].shape)
        self._crossed, self._normal = _CROSSED[kind], _NORMALS[kind]
        self._body = np.array([index for index, _ in members], dtype=np.int64)
        self._sizes = np.array([SIZES[kind](body.shape) for _, body in members])
        self._radii_m = np.array([bounding_radius_m(body.shape) for _, body in members])
        poses = np.stack([body.pose(frame) for _, body in members])
        self._rotation = poses[:, :3, :3]
        self._middle = poses[:, :3, 3].mean(axis=0)
        self._offsets = poses[:, :3, 3] - self._middle
        self._to_body = inverse_rigid(poses)

    @property
    def radius_m(self) -> float:
        """The radius of a ball around a member's origin that holds any of them."""
        return float(self._radii_m.max())

    def keep_nearer(self, hits: Hits, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> None:
        """Enter the hits that are nearer than what `hits` holds."""
        for pairs in self._pairs(origins, directions, limit_m):
            rows = pairs.rows
            range_m = np.where(pairs.near >= 0, pairs.near, np.where(pairs.far >= 0, pairs.far, np.inf))
            bound = np.minimum(hits.range_m[rows], limit_m[rows])
            nearest = bound.copy()
            np.minimum.at(nearest, pairs.ray, range_m)
            won = np.flatnonzero((range_m == nearest[pairs.ray]) & (range_m < bound[pairs.ray]))
            ray = pairs.ray[won]
            hits.range_m[rows][ray] = range_m[won]
            hits.body[rows][ray] = self._body[pairs.member[won]]
            hits.normal[rows][ray] = self._normals(pairs, won, range_m[won])

    def _normals(self, pairs: _Pairs, chosen: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        """World normals where the chosen pairs cross at a range, outward."""
        points = pairs.origins[chosen] + range_m[:, None] * pairs.directions[chosen]
        member = pairs.member[chosen]
        return np.einsum("nij,nj->ni", self._rotation[member], self._normal(self._sizes[member], points))

    def crossings(
        self, origins: np.ndarray, directions: np.ndarray, start_m: np.ndarray, limit_m: np.ndarray
    ) -> Crossings:
        """See `SceneCaster.crossings`."""
        parts = [Crossings(np.empty(0, int), np.empty(0), np.empty(0))]
        for pairs in self._pairs(origins, directions, limit_m):
            start, limit = start_m[pairs.rows][pairs.ray], limit_m[pairs.rows][pairs.ray]
            for range_m in (pairs.near, pairs.far):
                within = np.flatnonzero((range_m >= start) & (range_m < limit))
                row = pairs.ray[within] + pairs.rows.start
                cosine = np.abs(_dot(self._normals(pairs, within, range_m[within]), directions[row]))
                parts.append(Crossings(row, range_m[within], cosine))
        return Crossings(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _pairs(self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> Iterator[_Pairs]:
        size = max(1, GROUP_CHUNK // len(self._body))
        for start in range(0, len(origins), size):
            rows = slice(start, min(start + size, len(origins)))
            ray, member = self._near_pairs(origins[rows], directions[rows], limit_m[rows])
            pose = self._to_body[member]
            local_origins = np.einsum("nij,nj->ni", pose[:, :3, :3], origins[rows][ray]) + pose[:, :3, 3]
            local_directions = np.einsum("nij,nj->ni", pose[:, :3, :3], directions[rows][ray])
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                near, far = self._crossed(self._sizes[member], local_origins, local_directions)
            yield _Pairs(rows, ray, member, local_origins, local_directions, near, far)

    def _near_pairs(
        self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rays and members whose bounding balls they pass within their limits."""
        start = origins - self._middle
        along = self._offsets @ directions.T
        along -= _dot(start, directions)
        # |c - o|^2 written out is two matrix products; what that cancels far away is below the slack
        lengths = _dot(start, start) + _dot(self._offsets, self._offsets)[:, None]
        aside = lengths - 2.0 * (self._offsets @ start.T) - along * along
        radii_m = self._radii_m[:, None]
        reach = radii_m + math.sqrt(BALL_SLACK * lengths.max(initial=0.0))
        passes = aside <= radii_m * radii_m + BALL_SLACK * lengths
        passes &= along >= -reach
        passes &= along - reach <= limit_m
        # flat indices are found ten times faster than pairs of them
        member, ray = np.divmod(np.flatnonzero(passes), max(len(origins), 1))
        return ray, member


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)


def _ball(origins: np.ndarray, directions: np.ndarray, radius_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both roots, NaN where the line passes by; the line's distance from the centre does not cancel as b^2 - c does."""
    along = _dot(origins, directions)
    perpendicular = origins - along[:, None] * directions
    half_chord = np.sqrt(radius_m**2 - _dot(perpendicular, perpendicular))
    return -along - half_chord, -along + half_chord


def _sphere(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return _ball(origins, directions, sizes[:, 0])


def _sphere_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return unit_vectors(points)


def _box(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    entry, leave = (-sizes - origins) / directions, (sizes - origins) / directions
    low, high = np.fmin(entry, leave), np.fmax(entry, leave)
    parallel = directions == 0
    inside_slab = np.abs(origins) <= sizes
    low = np.where(parallel, np.where(inside_slab, -np.inf, np.inf), low)
    high = np.where(parallel, np.where(inside_slab, np.inf, -np.inf), high)
    near, far = low.max(axis=1), high.min(axis=1)
    hit = near <= far
    return np.where(hit, near, np.nan), np.where(hit, far, np.nan)


def _box_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    axis = np.argmax(np.abs(points) / sizes, axis=1)
    normal, rows = np.zeros_like(points), np.arange(len(points))
    normal[rows, axis] = np.sign(points[rows, axis])
    return normal


def _capsule(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line enters the capsule through its side, or through the cap on whose side it enters the endless cylinder.

    Choosing the cap that way leaves no seam between side and cap for a ray to slip through.
    """
    radius_m, half_length_m = sizes[:, 0], sizes[:, 1]
    across = _dot(directions[:, :2], directions[:, :2])
    along = _dot(origins[:, :2], directions[:, :2]) / across
    perpendicular = origins[:, :2] - along[:, None] * directions[:, :2]
    half_chord = np.sqrt((radius_m**2 - _dot(perpendicular, perpendicular)) / across)
    roots = []
    for end, number in ((-1.0, 0), (1.0, 1)):
        side = -along + end * half_chord
        height = origins[:, 2] + side * directions[:, 2]
        # a ray along the axis never meets the side: it comes and goes through the caps
        height = np.where(across == 0, end * directions[:, 2] * np.inf, height)
        centred = origins.copy()
        centred[:, 2] -= np.sign(height) * half_length_m
        roots.append(np.where(np.abs(height) <= half_length_m, side, _ball(centred, directions, radius_m)[number]))
    return roots[0], roots[1]


def _capsule_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    axis_point = np.zeros_like(points)
    axis_point[:, 2] = np.clip(points[:, 2], -sizes[:, 1], sizes[:, 1])
    return unit_vectors(points - axis_point)


def _cylinder(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line is in the cylinder where it is both between the planes of its ends and in the endless cylinder."""
    radius_m, half_length_m = sizes[:, 0], sizes[:, 1]
    across = _dot(directions[:, :2], directions[:, :2])
    upright = across == 0
    along = np.where(upright, 0.0, _dot(origins[:, :2], directions[:, :2]) / across)
    perpendicular = origins[:, :2] - along[:, None] * directions[:, :2]
    half_chord = np.sqrt((radius_m**2 - _dot(perpendicular, perpendicular)) / across)
    height, climb = origins[:, 2], directions[:, 2]
    ends = (-half_length_m - height) / climb, (half_length_m - height) / climb
    level = (climb == 0) & (np.abs(height) <= half_length_m)
    near = np.maximum(-along - half_chord, np.where(level, -np.inf, np.minimum(*ends)))
    far = np.minimum(half_chord - along, np.where(level, np.inf, np.maximum(*ends)))
    hit = near <= far
    return np.where(hit, near, np.nan), np.where(hit, far, np.nan)


def _cylinder_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    radial = np.hypot(points[:, 0], points[:, 1])
    normal = points.copy()
    on_end = np.abs(points[:, 2]) * sizes[:, 0] > radial * sizes[:, 1]
    normal[on_end, :2], normal[~on_end, 2] = 0.0, 0.0
    return unit_vectors(normal)


def _ellipsoid(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stretched along its axes it is a ball of radius 1."""
    stretched = directions / sizes
    length = np.linalg.norm(stretched, axis=1)
    near, far = _ball(origins / sizes, stretched / length[:, None], np.ones(len(sizes)))
    return near / length, far / length


def _ellipsoid_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return unit_vectors(points / sizes**2)


def _plane(sizes: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One crossing, and no second one."""
    range_m = -origins[:, 2] / directions[:, 2]
    return np.where(np.isfinite(range_m), range_m, np.nan), np.full(len(range_m), np.nan)


def _plane_normal(sizes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.tile([0.0, 0.0, 1.0], (len(points), 1))


# Where a line enters and leaves each kind: NaN where it passes by.
_CROSSED: dict[type, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    Sphere: _sphere,
    Box: _box,
    Capsule: _capsule,
    Cylinder: _cylinder,
    Ellipsoid: _ellipsoid,
    Plane: _plane,
}
_NORMALS: dict[type, Callable[..., np.ndarray]] = {
    Sphere: _sphere_normal,
    Box: _box_normal,
    Capsule: _capsule_normal,
    Cylinder: _cylinder_normal,
    Ellipsoid: _ellipsoid_normal,
    Plane: _plane_normal,
}
# Their lengths, as closed forms and compiled loops take them; planes and meshes have none.
SIZES: dict[type, Callable[..., tuple[float, float, float]]] = {
    Sphere: lambda shape: (shape.radius_m, 0.0, 0.0),
    Box: lambda shape: shape.half_extents_m,
    Capsule: lambda shape: (shape.radius_m, shape.half_length_m, 0.0),
    Cylinder: lambda shape: (shape.radius_m, shape.half_length_m, 0.0),
    Ellipsoid: lambda shape: shape.semi_axes_m,
    Plane: lambda shape: (0.0, 0.0, 0.0),
    Mesh: lambda shape: (0.0, 0.0, 0.0),
}


def half_extents_m(shape: Shape) -> tuple[float, float, float]:
    """Half the sides of the box around a primitive in its own frame, infinite around a plane [m]."""
    match shape:
        case Sphere(radius_m=radius_m):
            return radius_m, radius_m, radius_m
        case Capsule(radius_m=radius_m, half_length_m=half_length_m):
            return radius_m, radius_m, radius_m + half_length_m
        case Cylinder(radius_m=radius_m, half_length_m=half_length_m):
            return radius_m, radius_m, half_length_m
        case Box(half_extents_m=half) | Ellipsoid(semi_axes_m=half):
            return half
    return math.inf, math.inf, math.inf


def bounding_radius_m(shape: Shape) -> float:
    """The radius of the ball around a primitive's origin that holds it, infinite for a plane [m]."""
    half = half_extents_m(shape)
    match shape:
        case Box():
            return math.hypot(*half)
        case Cylinder():
            return math.hypot(*half[1:])
    return max(half)
