"""Chamfer and Frechet distances between a reconstruction and the truth, and the surface that a sensor could have seen.

`chamfer_m` is between points; `SurfaceCloud.distance_m` goes from points to triangles, for tasks that score surfaces
(the shipped ones do so in `lidardesign_tasks.surface.surface_score`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy

from lidardesign.errors import DataError
from lidardesign.numerics import SLACK
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import in_view
from lidardesign.scenes.scene import Receiver, Scene
from lidardesign.scenes.surface import sample_body, sample_triangles
from lidardesign.space import RANGE, DesignSpace, aim

if TYPE_CHECKING:
    from lidardesign.scenes.distances import TriangleTree

# Embree works in float32: its ranges are good to 4e-7 of the scene's size, and worse at grazing incidence
HIT_TOLERANCE = 1e-4
RANDOM_ORIGINS = 7  # beside the corners and the centre of a free origin box
LARGEST_DRAW = 200_000  # candidates per round; bounds memory
DRAW_ROUNDS = 12
# One place in a thousand is so many mean spacings of a cloud's points from all of them: 2 sqrt(ln(1000) / pi)
GAP_SPACINGS = 2.97
# Of 2.5, 3, 3.5, 4 and 5 spacings this one gives the plain cropped grid its least error on faces, from 100 to 576 rays.
MOST_SPACINGS = 3.0
# Spacings of so many rays are kept for the next scene: those of larger frames would take up memory.
MOST_KEPT_RAYS = 4096


def chamfer_m(first: np.ndarray, second: np.ndarray) -> float:
    """The Chamfer distance of two point sets: the sum of the two mean nearest distances [m].

    Arguments:
        first: Points, shape (N, D).
        second: Points, shape (M, D).

    Raises:
        ValueError: A set without points.
    """
    if not len(first) or not len(second):
        raise ValueError("a set without points has no distance")
    return float(nearest_m(second, first).mean() + nearest_m(first, second).mean())


def nearest_m(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """The distance of each query (M, D) to the nearest of the points (N, D), shape (M,) [m]."""
    return scipy.spatial.cKDTree(points).query(queries)[0]


def discrete_frechet_m(first: np.ndarray, second: np.ndarray) -> float:
    """The discrete Frechet distance of two paths [m]: the shortest leash with which both can be walked.

    Eiter and Mannila, Computing discrete Frechet distance (1994), along anti-diagonals: all pairs of points whose
    indices have the same sum follow from the two sums before it.

    Arguments:
        first: Points in the order of the path, shape (N, D).
        second: Points, shape (M, D).

    Raises:
        ValueError: A path without points.
    """
    if not len(first) or not len(second):
        raise ValueError("a path without points has no distance")
    apart = np.sqrt(((first[:, None] - second[None]) ** 2).sum(axis=-1))
    rows, columns = apart.shape
    # leashes by row, one place to the right: a pair's three predecessors are at its place and the one before
    before, last = np.full(rows + 1, np.inf), np.full(rows + 1, np.inf)
    before[0] = -np.inf  # nothing has been walked before the first pair
    for total in range(rows + columns - 1):
        low, high = max(0, total - columns + 1), min(rows, total + 1)
        shortest = np.minimum(np.minimum(last[low + 1 : high + 1], last[low:high]), before[low:high])
        now = np.full(rows + 1, np.inf)
        now[low + 1 : high + 1] = np.maximum(np.diagonal(apart[:, ::-1], columns - 1 - total), shortest)
        before, last = last, now
    return float(last[rows])


@dataclass(frozen=True, eq=False)
class SurfaceCloud:
    r"""A surface as its triangles, and points on them that stand for its area.

    Between two clouds of density n the nearest *points* are :math:`0.5 / \sqrt{n}` apart even if the
    surfaces agree (1.6 mm for 5000 points on a head). Distances to the nearest triangle do not have that floor.

    Arguments:
        points: Area-uniform points [m], shape (K, 3).
        triangles: Corners of the triangles [m], each once, shape (T, 3, 3).

    Raises:
        ValueError: There are no points.
    """

    points: np.ndarray
    triangles: np.ndarray

    def __post_init__(self) -> None:
        if not len(self.points):
            raise ValueError("a surface without points has no distance")

    @cached_property
    def _tree(self) -> TriangleTree:
        from lidardesign.scenes.distances import TriangleTree

        return TriangleTree(self.triangles)

    @cached_property
    def gap_m(self) -> float:
        """The distance from all points that one place of the surface in a thousand exceeds [m].

        Beyond r there is no point with the probability exp(-pi n r^2), and neighbours are 0.5 / sqrt(n) apart.
        """
        if len(self.points) < 2:
            return 0.0
        return GAP_SPACINGS * float(scipy.spatial.cKDTree(self.points).query(self.points, k=2)[0][:, 1].mean())

    def distance_m(self, queries: np.ndarray) -> np.ndarray:
        """Exact distances to the nearest triangle [m], (N, 3) to (N,)."""
        return self._tree.distance_m(queries)


def ray_spacing(directions: np.ndarray) -> np.ndarray:
    """The local spacing of rays: the mean distance of each to its neighbours on the unit sphere.

    Neighbours are those of the Delaunay triangulation of all rays: the rings of a spinning scanner have neighbours in
    other rings, although many rays of their own are nearer.

    Arguments:
        directions: Unit vectors of all rays that were fired, with a return or without, shape (N, 3).

    Returns:
        Chords of the unit sphere, shape (N,); infinite where fewer than three directions, or all on a line, have no
        triangles.
    """
    found = _ray_spacing if len(directions) <= MOST_KEPT_RAYS else _ray_spacing.__wrapped__
    return found(np.ascontiguousarray(directions, dtype=np.float64).tobytes()).copy()


@lru_cache(maxsize=512)
def _ray_spacing(directions: bytes) -> np.ndarray:
    """`ray_spacing` of unit vectors as bytes, cached for rays that are fired in many scenes: a tenth of `evaluate`."""
    distinct, inverse = np.unique(np.frombuffer(directions).reshape(-1, 3), axis=0, return_inverse=True)
    spacing = np.full(len(distinct), np.inf)
    faces, seen = _delaunay_faces(distinct)
    if faces is not None:
        edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        length = np.linalg.norm(np.subtract(*distinct[seen][edges].transpose(1, 0, 2)), axis=1)
        ends, count = edges.reshape(-1), int(seen.sum())
        met = np.bincount(ends, minlength=count)
        total = np.bincount(ends, np.repeat(length, 2), count)
        spacing[seen] = np.divide(total, met, out=np.full(count, np.inf), where=met > 0)
    return spacing[inverse.reshape(-1)]


def delaunay_surface(
    points: np.ndarray,
    viewpoint: np.ndarray,
    *,
    steepest_deg: float = 90.0,
    spacing: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """The surface through returns that are neighbours as seen from a viewpoint.

    Delaunay triangulation of the directions in stereographic coordinates about their mean, which maps
    circles to circles, so that the triangles are those of the sphere. Points are sorted first: the result
    does not depend on their order, not even on regular grids, where the triangulation is not unique.

    Arguments:
        points: Measured points [m], shape (N, 3).
        viewpoint: Where they are seen from [m], shape (3,).
        steepest_deg: Triangles seen at a flatter angle than this from their normal are left out: they bridge
            from one surface to another behind it.
        spacing: Spacing of rays at each point, as `ray_spacing` of all that were fired, shape (N,). Triangles
            with an edge of more than three spacings are left out: rays in between saw nothing there.

    If no triangle is left, all stay.

    Returns:
        Vertices (V, 3) and faces (F, 3), or `None` below 3 directions or when all are collinear.
    """
    points, first = np.unique(np.asarray(points, dtype=np.float64), axis=0, return_index=True)
    spacing = np.full(len(points), np.inf) if spacing is None else spacing[first]
    offset = points - viewpoint
    range_m = np.linalg.norm(offset, axis=1)
    points, offset, range_m, spacing = (values[range_m > 0] for values in (points, offset, range_m, spacing))
    directions = offset / range_m[:, None]
    faces, seen = _delaunay_faces(directions)
    if faces is None:
        return None
    vertices = points[seen]
    # cosine of the angle between a triangle's normal and the line of sight, 0 to 1
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normal, sight = np.cross(b - a, c - a), (a + b + c) / 3 - viewpoint
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(sight, axis=1)
    across = np.abs(np.einsum("fk,fk->f", normal, sight))
    kept = np.divide(across, lengths, out=np.zeros(len(a)), where=lengths > 0) >= math.cos(math.radians(steepest_deg))
    corners = directions[seen][faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    kept &= longest <= MOST_SPACINGS * spacing[seen][faces].mean(axis=1)
    return vertices, faces[kept] if kept.any() else faces


def _delaunay_faces(directions: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Delaunay triangles (F, 3) of the directions (N, 3) in a mask, and the mask; None where they span none."""
    if len(directions) < 3:
        return None, np.ones(len(directions), dtype=bool)
    plane, seen = _stereographic(directions)
    try:
        return scipy.spatial.Delaunay(plane[seen]).simplices, seen
    except scipy.spatial.QhullError:  # fewer than 3 points, or all of them collinear
        return None, seen


def _stereographic(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates about the mean direction, shape (N, 2), and a mask without the point opposite to it."""
    mean = directions.mean(axis=0)
    length = np.linalg.norm(mean)
    opposite = SLACK  # directions this near (in 1 + cos) to the antipode have no finite coordinates
    mean = mean / length if length > opposite else np.array([0.0, 0.0, 1.0])
    right = np.cross(np.eye(3)[np.argmin(np.abs(mean))], mean)
    right /= np.linalg.norm(right)
    scale = 1 + directions @ mean
    seen = scale > opposite
    across = directions @ np.stack([right, np.cross(mean, right)], axis=1)
    return 2 * across / np.where(seen, scale, 1.0)[:, None], seen


def surface_cloud(vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator) -> SurfaceCloud:
    """A triangle mesh with area-uniform points on it."""
    points, _ = sample_triangles(vertices, faces, count, generator)
    return SurfaceCloud(points, vertices[faces])


def visible_surface(
    scene: Scene, space: DesignSpace, count: int, generator: np.random.Generator, *, frame: int = 0
) -> SurfaceCloud:
    """The part of the targets' surface that some admissible ray could see: the truth of a metric.

    A point counts when, from one of the tried origins, its direction and distance lie in the space and
    nothing is in front of it. A free origin box is tried at its corners, its centre and a few random places.
    Where the scene has a fixed receiver, that must see the point too.

    Raises:
        DataError: No part of any target can be seen.
    """
    caster, origins = SceneCaster(scene, frame), trial_origins(space, generator)
    targets = [body for body in scene.bodies if body.is_target]
    points, triangles, found, draw = [], [], 0, 3 * count
    for _ in range(DRAW_ROUNDS):
        candidates = sample_body(targets, space, min(draw, LARGEST_DRAW), generator, frame)
        seen = is_received(caster, scene.receiver, candidates.points)
        seen[seen] = is_visible(caster, space, origins, candidates.points[seen])
        points.append(candidates.points[seen])
        triangles.append(candidates.triangles[seen])
        found += int(seen.sum())
        if found >= count:
            break
        draw = int(1.5 * (count - found) * len(seen) / max(int(seen.sum()), 1)) + 1
    if not found:
        raise DataError(
            "no ray of the design space sees any part of a target",
            where=f"scene {scene.name!r}",
            hint="move the sensors, or widen angles and range of the design space, to reach the targets",
        )
    keep = np.sort(generator.choice(found, count, replace=found < count))
    corners = np.concatenate(triangles)[keep].reshape(-1, 9)
    return SurfaceCloud(np.concatenate(points)[keep], np.unique(corners, axis=0).reshape(-1, 3, 3))


def trial_origins(space: DesignSpace, generator: np.random.Generator) -> np.ndarray:
    """Origins that visibility is tried from, shape (K, 3): corners, centre, random places of the box."""
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    free = np.flatnonzero(low < high)
    if not len(free):
        return low[None]
    corners = np.repeat(low[None], 2 ** len(free), axis=0)
    corners[:, free] = list(itertools.product(*[(low[i], high[i]) for i in free]))
    return np.concatenate([(low + high)[None] / 2, corners, generator.uniform(low, high, (RANDOM_ORIGINS, 3))])


def is_visible(caster: SceneCaster, space: DesignSpace, origins: np.ndarray, points: np.ndarray) -> np.ndarray:
    """True for points that an admissible ray from one of the origins sees first, (O, 3), (N, 3) to (N,)."""
    visible = np.zeros(len(points), dtype=bool)
    for origin in origins:
        left = np.flatnonzero(~visible)
        design = aim(origin, points[left])
        admissible = space.contains(design) & (design[:, RANGE] > 0)
        left, design = left[admissible], design[admissible]
        hits = caster.first_hit(design[:, :3], points[left] - origin)
        visible[left] = hits.range_m > design[:, RANGE] * (1 - HIT_TOLERANCE)
    return visible


def is_received(caster: SceneCaster, receiver: Receiver | None, points: np.ndarray) -> np.ndarray:
    """True for points (N, 3) in the view of a fixed receiver with nothing in front, (N,); all without one."""
    if receiver is None:
        return np.ones(len(points), dtype=bool)
    received = in_view(receiver, points)
    way = points[received] - np.asarray(receiver.origin_m)
    hits = caster.first_hit(np.asarray(receiver.origin_m), way)
    received[received] = hits.range_m > np.linalg.norm(way, axis=1) * (1 - HIT_TOLERANCE)
    return received
