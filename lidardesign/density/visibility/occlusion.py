"""Visibility of many frames: first hits on occluders in their own frames, only for the columns that matter to a ray.

Primitives are crossed in closed form by compiled loops; meshes are cast at in their own frame, so that all frames of a
moving robot share one Embree scene per link. T = exp(-beta max(0, range - m - hit)) and its derivative are those of
`visibility.Raycast`: exact but for silhouettes that sweep over a ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.density.fields.bodies import Bodies, occluding_bodies
from lidardesign.density.visibility.quadrature import MINIMUM_COSINE, Optics, RayBatch, RayGradient
from lidardesign.geometry.triangles import mesh_caster
from lidardesign.scene import Scene


@dataclass(frozen=True, eq=False)
class Pairs:
    """Rays with the columns that matter to them, row by row.

    Arguments:
        row_starts: Where each ray's pairs begin, shape (N + 1,).
        columns: Shape (P,).
        distances: Of the observed points to the columns' targets, shape (P,) [m].
        bodies: The nearest target body of each, shape (P,).
    """

    row_starts: np.ndarray
    columns: np.ndarray
    distances: np.ndarray
    bodies: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """The ray of each pair, shape (P,)."""
        return np.repeat(np.arange(len(self.row_starts) - 1), np.diff(self.row_starts))

    def where(self, kept: np.ndarray) -> Pairs:
        """Those that a mask (P,) keeps."""
        row_starts = np.concatenate([[0], np.cumsum(kept)])[self.row_starts]
        return Pairs(row_starts, self.columns[kept], self.distances[kept], self.bodies[kept])


@dataclass(frozen=True, eq=False)
class Blocked:
    """What occluders do to pairs.

    Arguments:
        log_values: log T, shape (P,).
        pairs: The pairs that something blocks, shape (K,).
        rows: Their rays, shape (K,).
        hit_m: Where they are blocked, shape (K,) [m].
        plane: Minus the derivative of the hit range by the origin, shape (K, 3).
        attenuation_per_m: beta.
    """

    log_values: np.ndarray
    pairs: np.ndarray
    rows: np.ndarray
    hit_m: np.ndarray
    plane: np.ndarray
    attenuation_per_m: float

    def add_gradient(self, weights: np.ndarray, out: RayGradient) -> None:
        """Add the derivatives of sum_p weights_p log T_p, weights (P,), by each ray's origin, direction and range."""
        out.pull_behind(self.rows, self.attenuation_per_m * weights[self.pairs], self.hit_m, self.plane)


class BodyRaycast:
    """First hits on the occluders of columns.

    Arguments:
        bodies: The occluders, sorted by column.
    """

    name = "raycast"

    def __init__(self, bodies: Bodies) -> None:
        self.bodies = bodies
        self._casters = [mesh_caster(mesh) for mesh in bodies.grids.meshes]

    @classmethod
    def of(cls, scenes: Sequence[Scene]) -> BodyRaycast:
        """The occluders of all scenes and frames."""
        return cls(occluding_bodies(scenes))

    def take(self, columns: np.ndarray) -> BodyRaycast:
        """The same for some columns."""
        return BodyRaycast(self.bodies.take(columns))

    def blocked(self, rays: RayBatch, pairs: Pairs, optics: Optics) -> Blocked:
        """log T of every pair, and what its gradient needs."""
        limit_m = rays.ranges - optics.margin_m
        hits, normals = self.first_hits(rays, pairs, limit_m)
        chosen = np.flatnonzero(np.isfinite(hits))
        rows = pairs.rows[chosen]
        log_values = np.zeros(len(hits))
        log_values[chosen] = -optics.attenuation_per_m * (limit_m[rows] - hits[chosen])
        # normals face the origin, so the cosine with the direction is negative
        cosine = np.minimum(np.einsum("pk,pk->p", normals[chosen], rays.directions[rows]), -MINIMUM_COSINE)
        plane = normals[chosen] / cosine[:, None]
        return Blocked(log_values, chosen, rows, hits[chosen], plane, optics.attenuation_per_m)

    def first_hits(self, rays: RayBatch, pairs: Pairs, limit_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ranges of first hits before a limit, infinite without one (P,), and normals facing the origin (P, 3)."""
        from lidardesign.density.visibility import hit_kernels

        bodies, count = self.bodies, len(pairs.columns)
        hits, normals = np.empty(count), np.zeros((count, 3))
        hit_kernels.first_hits(
            bodies.kinds, bodies.sizes, bodies.to_body, bodies.low, bodies.high, bodies.starts,
            pairs.row_starts, pairs.columns, rays.origins, rays.directions, limit_m, hits, normals,
        )  # fmt: skip
        if bodies.grids.meshes:
            self._add_meshes(rays, pairs, limit_m, hits, normals)
        return hits, normals

    def _add_meshes(
        self, rays: RayBatch, pairs: Pairs, limit_m: np.ndarray, hits: np.ndarray, normals: np.ndarray
    ) -> None:
        rows, chosen, body = self._candidates(rays, pairs, limit_m)
        row_of_grid = self.bodies.grid[body]
        for number, caster in enumerate(self._casters, start=1):
            mine = np.flatnonzero(row_of_grid == number)
            if not len(mine):
                continue
            pose, ray, pair = self.bodies.to_body[body[mine]], rows[mine], chosen[mine]
            origins = np.einsum("pij,pj->pi", pose[:, :, :3], rays.origins[ray]) + pose[:, :, 3]
            directions = np.einsum("pij,pj->pi", pose[:, :, :3], rays.directions[ray])
            range_m, normal = caster.trace(origins, directions, np.minimum(limit_m[ray], hits[pair]))
            nearer = np.flatnonzero(range_m < hits[pair])
            # a pair may meet the same mesh in two poses: the nearest is written last
            nearer = nearer[np.argsort(-range_m[nearer], kind="stable")]
            facing = np.sign(np.einsum("pk,pk->p", normal[nearer], directions[nearer]))
            turned = np.einsum("pij,pi->pj", pose[nearer, :, :3], normal[nearer])
            hits[pair[nearer]] = range_m[nearer]
            normals[pair[nearer]] = -np.where(facing == 0, 1.0, facing)[:, None] * turned

    def _candidates(
        self, rays: RayBatch, pairs: Pairs, limit_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        from lidardesign.density.visibility import hit_kernels

        bodies, room = self.bodies, max(len(pairs.columns), 1)
        while True:
            rows, chosen, body = (np.empty(room, dtype=np.int64) for _ in range(3))
            count = hit_kernels.mesh_candidates(
                bodies.kinds, bodies.to_body, bodies.grid, *bodies.mesh_bounds, bodies.low, bodies.high, bodies.starts,
                pairs.row_starts, pairs.columns, rays.origins, rays.directions, limit_m, rows, chosen, body,
            )  # fmt: skip
            if count <= room:
                return rows[:count], chosen[:count], body[:count]
            room = count


class NoOcclusion:
    """Every ray reaches its point: T = 1."""

    name = "off"

    def take(self, columns: np.ndarray) -> NoOcclusion:
        """See `BodyRaycast`."""
        return self

    def blocked(self, rays: RayBatch, pairs: Pairs, optics: Optics) -> Blocked:
        """See `BodyRaycast`."""
        none, empty = np.zeros(0, dtype=np.int64), np.zeros(0)
        return Blocked(np.zeros(len(pairs.columns)), none, none, empty, np.zeros((0, 3)), 0.0)
