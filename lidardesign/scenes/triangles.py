"""Ray casting against triangle meshes in one frame by Embree; the only module that calls it.

Meshes are recentred in float64 before they become Embree's float32, and rays that start far away are advanced to their
neighbourhood first, which keeps sub-micrometre accuracy far from the origin.

Embree runs in its robust mode, without which a quarter of the rays aimed at vertices slip through. With it one in a
hundred still does: it misses, or hits the back of a closed mesh from outside. So rays that miss or hit a triangle's
back can be cast a second time from a shifted origin; a nearer hit of that cast replaces the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from lidardesign.numerics import COARSE_SLACK, unit_vectors
from lidardesign.scenes.rays import Hits
from lidardesign.scenes.scene import Mesh

FARTHEST_M = 1e30  # range of an unlimited ray in Embree
# Rays that start further than this many radii from the meshes' ball are advanced to it in float64.
FAR_RADII = 4.0
# Lateral shift of the second cast as a share of the meshes' radius: some ten roundings of Embree's float32, and no
# more than the error of its ranges.
BESIDE_SHARE = COARSE_SLACK
# A second hit is another surface if it is nearer by more than this share of the range or radius.
NEARER_SHARE = 1e-4
# Unequal shares of the two lateral axes avoid a mesh's planes of symmetry, which hold many of its vertices.
BESIDE_SLANT = 0.618


@dataclass
class SecondCasts:
    """Counts of rays cast a second time.

    Arguments:
        rays: Number of rays in all.
        cast: Number of second casts at meshes.
        found: Number of second casts with a nearer hit, whose ray slipped through the first time.
    """

    rays: int = 0
    cast: int = 0
    found: int = 0

    def __add__(self, other: SecondCasts) -> SecondCasts:
        return SecondCasts(self.rays + other.rays, self.cast + other.cast, self.found + other.found)


class Triangles:
    """Meshes in one Embree scene, recentred; `centre_m` (3,) and `radius_m` give their bounding ball."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        corners = np.concatenate([mesh.bounds_m for mesh in meshes])
        self.centre_m = (corners.min(axis=0) + corners.max(axis=0)) / 2
        self.radius_m = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0))) / 2
        self._scene = EmbreeScene()
        self._geometries = [
            TriangleMesh(self._scene, (mesh.vertices - self.centre_m).astype(np.float32), mesh.faces) for mesh in meshes
        ]

    def trace(
        self, origins: np.ndarray, directions: np.ndarray, limit_m: np.ndarray, twice: SecondCasts | None = None
    ) -> Hits:
        """First hits of finite float64 rays of unit length, with the numbers of meshes as bodies.

        Hits at or beyond limits (N,) are misses. Normals follow the winding of the faces. With `twice`, doubtful rays
        are cast again and counted there.
        """
        hits = Hits.none(len(origins))
        if not len(origins):
            return hits
        local = origins - self.centre_m
        advance_m = advances_m(local, directions, self.radius_m)
        near = local + advance_m[:, None] * directions
        limit = np.clip(limit_m - advance_m, 0.0, FARTHEST_M).astype(np.float32)
        found = self.run(near.astype(np.float32), directions.astype(np.float32), limit)
        if twice is not None:
            self._cast_again(found, near, directions, limit, twice)
        range_m = found["tfar"] + advance_m
        rows = np.flatnonzero((found["primID"] >= 0) & (range_m < limit_m))
        hits.range_m[rows], hits.body[rows] = range_m[rows], found["geomID"][rows]
        hits.normal[rows] = unit_vectors(found["Ng"][rows].astype(np.float64))
        return hits

    def _cast_again(
        self,
        found: dict[str, np.ndarray],
        near: np.ndarray,
        directions: np.ndarray,
        limit_m: np.ndarray,
        counted: SecondCasts,
    ) -> None:
        """Cast rays that missed or hit a triangle's back again from a shifted origin, and keep nearer hits."""
        missed = found["primID"] < 0
        doubtful = np.flatnonzero(missed | (np.einsum("nk,nk->n", found["Ng"], directions) > 0))
        counted.cast += len(doubtful)
        if not len(doubtful):
            return
        toward, first_m = directions[doubtful], found["tfar"][doubtful]
        behind_m = first_m - NEARER_SHARE * np.maximum(first_m, self.radius_m)
        until = np.where(missed[doubtful], limit_m[doubtful], np.maximum(behind_m, 0.0)).astype(np.float32)
        # A vector of about unit length across each direction, (N, 3) to (N, 3)
        x, y, z = toward.T
        sign = np.copysign(1.0, z)
        share = -1.0 / (sign + z)
        mixed = x * y * share
        across = np.empty_like(toward)
        across[:, 0] = 1.0 + sign * x * x * share + BESIDE_SLANT * mixed
        across[:, 1] = sign * mixed + BESIDE_SLANT * (sign + y * y * share)
        across[:, 2] = -sign * x - BESIDE_SLANT * y
        beside = near[doubtful] + BESIDE_SHARE * self.radius_m * across
        again = self.run(beside.astype(np.float32), toward.astype(np.float32), until)
        nearer = again["primID"] >= 0
        counted.found += int(nearer.sum())
        for name in ("primID", "geomID", "tfar", "Ng"):
            found[name][doubtful[nearer]] = again[name][nearer]

    def run(self, local: np.ndarray, directions: np.ndarray, limit_m: np.ndarray) -> dict[str, np.ndarray]:
        """Embree's result for float32 rays."""
        return self._scene.run(local, directions, dists=limit_m, output=True)


def advances_m(local: np.ndarray, directions: np.ndarray, radius_m: np.ndarray | float) -> np.ndarray:
    """Distance to advance distant origins towards meshes around 0, where float32 is too coarse, shape (N,) [m]."""
    far = np.einsum("nk,nk->n", local, local) > (FAR_RADII * radius_m) ** 2
    if not far.any():
        return np.zeros(len(local))
    closest = -np.einsum("nk,nk->n", local, directions)
    return np.where(far, np.maximum(closest - 2 * radius_m, 0.0), 0.0)


_mesh_casters: WeakKeyDictionary[Mesh, Triangles] = WeakKeyDictionary()


def mesh_caster(mesh: Mesh) -> Triangles:
    """Shared caster of a mesh in its own frame, kept as long as the mesh."""
    if mesh not in _mesh_casters:
        _mesh_casters[mesh] = Triangles([mesh])
    return _mesh_casters[mesh]
