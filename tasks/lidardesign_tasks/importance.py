"""Importance of the parts of a surface: by area per solid angle, roughness, and a region of interest.

Without importance a density of rays is even over angles: distant or oblique parts get few rays for their area. With the
exponent e of the area a part has the weight (r^2 / cos(incidence))^e, the area per solid angle: 1 spreads returns
evenly over the surface. Roughness is the rms distance of the surface from its own best plane within a ball, as in
CloudCompare and other tools for scans: the error of straight lines between returns there. With its exponent e a part
has the weight (roughness / mean roughness)^e.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from lidardesign import ConfigError, DesignSpace, Vector, random_generator, sample_triangles
from lidardesign_tasks.surroundings import Surroundings

# Lower limit of roughness as a share of its mean, so that no part has the weight 0.
LEAST_ROUGHNESS = 0.1
# Lower limits of cosine and distance: the area per solid angle is unbounded at a rim and 0 at the sensor.
FLATTEST_COSINE, NEAREST_SHARE = 0.1, 0.01
# Points per ball, for an rms distance accurate to a tenth.
POINTS_PER_BALL = 100
LEAST_PER_BALL = 25
LEAST_POINTS, MOST_POINTS = 2_000, 400_000
VERTICES_AT_ONCE = 2048
# Rounding errors of coordinates in a distance from a plane.
ROUNDINGS = 64


class Importance(Surroundings):
    """Importance of parts of a surface, even by default."""

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
        """Importance at vertices (V, 3) [m], seen from a viewpoint (3,), shape (V,); None: even."""
        factors = []
        if self.area_exponent > 0:
            factors.append(relative_area(vertices, faces, viewpoint_m) ** self.area_exponent)
        if self.roughness_exponent > 0:
            factors.append(relative_roughness(vertices, faces, self.roughness_radius_m) ** self.roughness_exponent)
        if self.region_centre_m is not None:
            factors.append(self.region_weight ** self.share_of_region(vertices))
        return np.prod(factors, axis=0) if factors else None

    def refuse_empty_region(self, surfaces: Sequence[np.ndarray]) -> None:
        """Refuse a region without any vertex of the surfaces, given by vertices (V, 3) [m] each.

        Raises:
            ConfigError: The region is empty.
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
        """Share of the region at points (N, 3) [m]: 1 inside, 0 beyond its edge, linear between, shape (N,)."""
        offset = points - np.array(self.region_centre_m)
        if self.region_half_size_m is None:
            outside_m = np.linalg.norm(offset, axis=1) - self.region_radius_m
        else:
            outside_m = np.linalg.norm(np.maximum(np.abs(offset) - np.array(self.region_half_size_m), 0.0), axis=1)
        if self.region_edge_m == 0:
            return (outside_m <= 0).astype(np.float64)
        return np.clip(1.0 - outside_m / self.region_edge_m, 0.0, 1.0)


# Keys of the importance, which do not change the scenes.
WEIGHING_KEYS = tuple(key for key in Importance.model_fields if key not in Surroundings.model_fields)


def middle_of_origins(space: DesignSpace) -> np.ndarray:
    """Centre of a design space's origins, shape (3,) [m]."""
    return (np.array(space.low[:3]) + np.array(space.high[:3])) / 2


def relative_area(vertices: np.ndarray, faces: np.ndarray, viewpoint_m: np.ndarray) -> np.ndarray:
    """Area per solid angle at the vertices (V, 3) of a surface over its median, shape (V,).

    The cosine of incidence is at least `FLATTEST_COSINE`, from either side.
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
    """Rms distance of the surface within a ball around each vertex from its own best plane, shape (V,) [m].

    Only parts that face the same half space as the vertex are included: not the far side of a thin part, nor inner
    layers. The surface is sampled by `POINTS_PER_BALL` even points per ball, at most `MOST_POINTS` in all.

    Raises:
        ConfigError: These are fewer than `LEAST_PER_BALL` per ball.
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
    """Normals of faces with twice their areas as lengths, shape (F, 3) [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def _facing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of vertices, the sum of those of their faces by area, shape (V, 3) [m^2]."""
    facing, doubled = np.zeros_like(vertices), _doubled_normals(vertices, faces)
    for corner in range(3):
        np.add.at(facing, faces[:, corner], doubled)
    return facing


def _off_plane(row: np.ndarray, offset: np.ndarray, count: int) -> np.ndarray:
    """Rms distance of the points (P, 3) of each row from their best plane, 0 without points, shape (count,) [m]."""
    total = np.maximum(np.bincount(row, minlength=count), 1)
    mean = np.stack([np.bincount(row, offset[:, i], minlength=count) / total for i in range(3)], axis=1)
    centred = offset - mean[row]
    moments = [
        [np.bincount(row, centred[:, i] * centred[:, j], minlength=count) / total for j in range(3)] for i in range(3)
    ]
    least = np.linalg.eigvalsh(np.moveaxis(np.array(moments), 2, 0))[:, 0]
    return np.sqrt(np.maximum(least, 0.0))
