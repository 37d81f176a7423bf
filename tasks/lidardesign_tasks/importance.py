"""How much the parts of a surface count: by how obliquely they are seen, how rough they are, and where they are.

A density of rays that count alike is even over angles: what is far away or seen obliquely gets few rays for its area.
With the exponent e of the area a part counts as (r^2 / cos(incidence))^e, the area in a solid angle: 1 spreads returns
evenly over the surface. Roughness is the rms distance of the surface from its own best plane within a ball, as
CloudCompare and other tools for scans define it: what straight lines between returns miss there. With its exponent e a
part counts as (roughness / mean roughness)^e.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from lidardesign.errors import ConfigError
from lidardesign.scenes.surface import sample_triangles
from lidardesign.space import DesignSpace
from lidardesign.task import Vector, random_generator
from lidardesign_tasks.surroundings import Surroundings

# What is flatter than this share of the mean roughness counts as if it were so rough: no part counts nothing.
LEAST_ROUGHNESS = 0.1
# At the rim of a surface the area in a solid angle has no bound; next to the sensor it vanishes.
FLATTEST_COSINE, NEAREST_SHARE = 0.1, 0.01
# A plane through so many points has an rms distance good to a tenth.
POINTS_PER_BALL = 100
LEAST_PER_BALL = 25
LEAST_POINTS, MOST_POINTS = 2_000, 400_000
VERTICES_AT_ONCE = 2048
# Roundings of coordinates that a distance from a plane passes through.
ROUNDINGS = 64


class Importance(Surroundings):
    """What of a surface counts more than the rest, if anything."""

    area_exponent: float = Field(
        0.0,
        ge=0,
        le=2,
        description="the surface counts as the area that a solid angle covers of it, seen from the middle of the "
        "sensors' places, to this power: 0 spreads rays evenly over angles, 1 evenly over the surface",
    )
    roughness_exponent: float = Field(
        0.0, ge=0, le=4, description="the surface counts as its local roughness to this power; 0: evenly"
    )
    roughness_radius_m: float = Field(
        0.015, gt=0, le=1e6, description="radius of the ball that roughness is measured in [m]"
    )
    region_centre_m: Vector | None = Field(
        None, description="centre of a region of interest, in the frame of the surface before its pose [m]"
    )
    region_radius_m: float | None = Field(None, gt=0, le=1e6, description="its radius: a ball [m]")
    region_half_size_m: Vector | None = Field(None, description="or its half size along x, y, z: a box [m]")
    region_weight: float = Field(
        4.0, gt=1e-3, le=1e3, description="how many times as much the region counts as the rest"
    )
    region_edge_m: float = Field(0.01, ge=0, le=1e6, description="distance over which this fades around it [m]")

    @model_validator(mode="after")
    def _one_region(self) -> Importance:
        given = sum(shape is not None for shape in (self.region_radius_m, self.region_half_size_m))
        fields = type(self).model_fields
        given += sum(getattr(self, key) != fields[key].default for key in ("region_weight", "region_edge_m"))
        if self.region_centre_m is None and given:
            raise ValueError("a region needs its centre: region_centre_m")
        if self.region_centre_m is not None and (self.region_radius_m is None) == (self.region_half_size_m is None):
            raise ValueError("a region is a ball or a box: give region_radius_m or region_half_size_m, not both")
        if self.region_half_size_m is not None and min(self.region_half_size_m) <= 0:
            raise ValueError("half sizes of a region are above 0 m")
        return self

    def weights(self, vertices: np.ndarray, faces: np.ndarray, viewpoint_m: np.ndarray) -> np.ndarray | None:
        """How much a surface counts at its vertices (V, 3) [m], seen from a place (3,), shape (V,); None: evenly."""
        factors = []
        if self.area_exponent > 0:
            factors.append(relative_area(vertices, faces, viewpoint_m) ** self.area_exponent)
        if self.roughness_exponent > 0:
            factors.append(relative_roughness(vertices, faces, self.roughness_radius_m) ** self.roughness_exponent)
        if self.region_centre_m is not None:
            factors.append(self.region_weight ** self.share_of_region(vertices))
        return np.prod(factors, axis=0) if factors else None

    def refuse_empty_region(self, surfaces: Sequence[np.ndarray]) -> None:
        """Refuse a region that no surface has a vertex in; vertices of each, shapes (V, 3) [m].

        Raises:
            ConfigError: So it is.
        """
        if self.region_centre_m is None or any(self.share_of_region(vertices).any() for vertices in surfaces):
            return
        every = np.concatenate(surfaces)
        low, high = every.min(axis=0), every.max(axis=0)
        spans = ", ".join(f"{name} {a:.3g} to {b:.3g}" for name, a, b in zip("xyz", low, high, strict=True))
        raise ConfigError(
            "the region holds no vertex of any surface",
            where="task.region_centre_m",
            allowed=f"the surfaces reach from {spans} m",
            hint="move or widen the region, or subdivide the mesh",
        )

    def share_of_region(self, points: np.ndarray) -> np.ndarray:
        """1 in the region and 0 beyond its edge, linear between, at points (N, 3) [m], shape (N,)."""
        offset = points - np.array(self.region_centre_m)
        if self.region_half_size_m is None:
            outside_m = np.linalg.norm(offset, axis=1) - self.region_radius_m
        else:
            outside_m = np.linalg.norm(np.maximum(np.abs(offset) - np.array(self.region_half_size_m), 0.0), axis=1)
        if self.region_edge_m == 0:
            return (outside_m <= 0).astype(np.float64)
        return np.clip(1.0 - outside_m / self.region_edge_m, 0.0, 1.0)


# Keys that say what counts more, and nothing about the scenes.
WEIGHING_KEYS = tuple(key for key in Importance.model_fields if key not in Surroundings.model_fields)


def middle_of_origins(space: DesignSpace) -> np.ndarray:
    """The middle of a design space's origins, shape (3,) [m]."""
    return (np.array(space.low[:3]) + np.array(space.high[:3])) / 2


def relative_area(vertices: np.ndarray, faces: np.ndarray, viewpoint_m: np.ndarray) -> np.ndarray:
    """The area that a solid angle covers of a surface at its vertices (V, 3), over its median, shape (V,).

    Surfaces count as seen no more flatly than `FLATTEST_COSINE`, from whichever side.
    """
    facing = _facing(vertices, faces)
    look = vertices - viewpoint_m
    distance = np.linalg.norm(look, axis=1)
    length = np.linalg.norm(facing, axis=1) * distance
    cosine = np.abs(np.einsum("vk,vk->v", facing, look)) / np.where(length > 0, length, 1.0)
    area = np.maximum(distance, distance.max() * NEAREST_SHARE) ** 2 / np.maximum(cosine, FLATTEST_COSINE)
    return area / np.median(area)


def relative_roughness(vertices: np.ndarray, faces: np.ndarray, radius_m: float) -> np.ndarray:
    """Roughness at the vertices (V, 3) of a mesh over its mean by area, at least `LEAST_ROUGHNESS`, shape (V,).

    A surface without any roughness is 1 everywhere.
    """
    roughness = vertex_roughness(vertices, faces, radius_m)
    area = np.linalg.norm(_doubled_normals(vertices, faces), axis=1)
    mean = float(area @ roughness[faces].mean(axis=1) / area.sum())
    # below rounding of the coordinates, flat is flat
    if mean <= ROUNDINGS * np.spacing(np.abs(vertices).max()):
        return np.ones(len(vertices))
    return np.maximum(roughness / mean, LEAST_ROUGHNESS)


def vertex_roughness(vertices: np.ndarray, faces: np.ndarray, radius_m: float) -> np.ndarray:
    """The rms distance of the surface within a ball around each vertex from its own best plane, shape (V,) [m].

    Only what faces the same half space as the vertex is its surface: not the far side of a thin part, nor what lies
    under the skin. The surface is that of `POINTS_PER_BALL` even points per ball, as far as `MOST_POINTS` go.

    Raises:
        ConfigError: They leave fewer than `LEAST_PER_BALL` in a ball.
    """
    from scipy.spatial import cKDTree

    doubled = _doubled_normals(vertices, faces)
    area_m2 = float(np.linalg.norm(doubled, axis=1).sum()) / 2
    count = int(np.clip(POINTS_PER_BALL * area_m2 / (math.pi * radius_m**2), LEAST_POINTS, MOST_POINTS))
    least_m = math.sqrt(LEAST_PER_BALL * area_m2 / (math.pi * MOST_POINTS))
    if radius_m < least_m:
        raise ConfigError(
            f"balls of {radius_m:g} m are too small to measure {area_m2:.3g} m^2 of surface with",
            where="task.roughness_radius_m",
            allowed=f"at least {least_m:.2g} m here",
        )
    points, face = sample_triangles(vertices, faces, count, random_generator(0, "roughness"))
    tree, facing, normals = cKDTree(points), _facing(vertices, faces), doubled[face]
    roughness = np.zeros(len(vertices))
    for start in range(0, len(vertices), VERTICES_AT_ONCE):
        centres = np.arange(start, min(start + VERTICES_AT_ONCE, len(vertices)))
        lists = tree.query_ball_point(vertices[centres], radius_m, return_sorted=False)
        row = np.repeat(np.arange(len(centres)), [len(found) for found in lists])
        near = np.concatenate([np.asarray(found, dtype=np.int64) for found in lists])
        same = np.einsum("nk,nk->n", normals[near], facing[centres[row]]) > 0
        row, near = row[same], near[same]
        roughness[centres] = _off_plane(row, points[near] - vertices[centres[row]], len(centres))
    return roughness


def _doubled_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of faces as long as twice their areas, shape (F, 3) [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def _facing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of vertices, the sum of those of their faces by area, shape (V, 3) [m^2]."""
    facing, doubled = np.zeros_like(vertices), _doubled_normals(vertices, faces)
    for corner in range(3):
        np.add.at(facing, faces[:, corner], doubled)
    return facing


def _off_plane(row: np.ndarray, offset: np.ndarray, count: int) -> np.ndarray:
    """The rms distance of the points (P, 3) of each row from their best plane, 0 without points, shape (count,)."""
    total = np.maximum(np.bincount(row, minlength=count), 1)
    mean = np.stack([np.bincount(row, offset[:, i], minlength=count) / total for i in range(3)], axis=1)
    centred = offset - mean[row]
    moments = [
        [np.bincount(row, centred[:, i] * centred[:, j], minlength=count) / total for j in range(3)] for i in range(3)
    ]
    least = np.linalg.eigvalsh(np.moveaxis(np.array(moments), 2, 0))[:, 0]
    return np.sqrt(np.maximum(least, 0.0))
