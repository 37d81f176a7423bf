"""Points uniform in area on meshes and primitives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidardesign.scene import Body, Box, Capsule, Mesh, Plane, Scene, Sphere
from lidardesign.space import RANGE, DesignSpace


class Sampled(NamedTuple):
    """Points (K, 3) [m] and the corners of the triangle of each (K, 3, 3); on primitives all three are it."""

    points: np.ndarray
    triangles: np.ndarray


def sample_triangles(
    vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Area-uniform points (count, 3) and the index of the face of each, in ascending order.

    Places along the cumulated area are stratified, which halves the noise of means over the surface.
    A surface without area gives its vertices.

    Raises:
        ValueError: There are no faces.
    """
    if not len(faces):
        raise ValueError("a surface without faces has no points")
    corners = vertices[faces]
    cumulated = np.cumsum(_doubled_areas(corners))
    places = (np.arange(count) + generator.random(count)) / count * cumulated[-1]
    chosen = np.minimum(np.searchsorted(cumulated, places, side="right"), len(faces) - 1)
    root, share = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    return (1 - root) * a + root * (1 - share) * b + root * share * c, chosen


def _doubled_areas(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def sample_body(
    bodies: Sequence[Body], space: DesignSpace, count: int, generator: np.random.Generator, frame: int = 0
) -> Sampled:
    """Area-uniform points on bodies; an infinite plane counts as far as the space reaches."""
    if len(bodies) == 1:
        return _on_body(bodies[0], space, count, generator, frame)
    area = np.array([surface_area_m2(body, space) for body in bodies])
    numbers = generator.multinomial(count, area / area.sum())
    parts = [_on_body(body, space, n, generator, frame) for body, n in zip(bodies, numbers, strict=True) if n]
    return Sampled(np.concatenate([p.points for p in parts]), np.concatenate([p.triangles for p in parts]))


def surface_area_m2(body: Body, space: DesignSpace) -> float:
    """The area of a body's surface [m^2]; of a plane, the square that the space can reach."""
    match body.shape:
        case Sphere(radius_m=radius_m):
            return 4 * math.pi * radius_m**2
        case Box(half_extents_m=(x, y, z)):
            return 8 * (x * y + y * z + z * x)
        case Capsule(radius_m=radius_m, half_length_m=half_length_m):
            return 4 * math.pi * radius_m * (radius_m + half_length_m)
        case Plane():
            return (2 * _reach_m(space)) ** 2
        case Mesh(vertices=vertices, faces=faces):
            return float(_doubled_areas(vertices[faces]).sum() / 2)


def target_area_m2(scene: Scene, space: DesignSpace) -> float:
    """The area of all targets of a scene [m^2]."""
    return sum(surface_area_m2(body, space) for body in scene.bodies if body.is_target)


def _reach_m(space: DesignSpace) -> float:
    return space.high[RANGE] + float(np.linalg.norm(np.array(space.high[:3]) - np.array(space.low[:3]))) / 2


def _on_body(
    body: Body, space: DesignSpace, count: int, generator: np.random.Generator, frame: int
) -> Sampled:
    pose = body.pose(frame)
    if isinstance(body.shape, Mesh):
        mesh = body.shape
        points, chosen = sample_triangles(mesh.vertices, mesh.faces, count, generator)
        corners = mesh.vertices[mesh.faces[chosen]]
        return Sampled(points @ pose[:3, :3].T + pose[:3, 3], corners @ pose[:3, :3].T + pose[:3, 3])
    if isinstance(body.shape, Plane):
        centre = (np.array(space.low[:3]) + np.array(space.high[:3])) / 2
        local = (centre - pose[:3, 3]) @ pose[:3, :3] + generator.uniform(-_reach_m(space), _reach_m(space), (count, 3))
        local[:, 2] = 0.0
    else:
        local = _on_primitive(body.shape, count, generator)
    points = local @ pose[:3, :3].T + pose[:3, 3]
    return Sampled(points, np.repeat(points[:, None], 3, axis=1))


def _on_primitive(shape: Sphere | Box | Capsule, count: int, generator: np.random.Generator) -> np.ndarray:
    if isinstance(shape, Box):
        half = np.array(shape.half_extents_m)
        points, area = generator.uniform(-half, half, (count, 3)), half.prod() / half
        axis = generator.choice(3, count, p=area / area.sum())
        points[np.arange(count), axis] = half[axis] * generator.choice([-1.0, 1.0], count)
        return points
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if isinstance(shape, Sphere):
        return shape.radius_m * direction
    # a capsule is a sphere cut at its equator with a cylinder in between
    ends = shape.radius_m * direction + np.sign(direction[:, 2:]) * np.array([0, 0, shape.half_length_m])
    turn = generator.uniform(0, 2 * math.pi, count)
    height = generator.uniform(-shape.half_length_m, shape.half_length_m, count)
    side = np.stack([shape.radius_m * np.cos(turn), shape.radius_m * np.sin(turn), height], axis=1)
    on_side = generator.random(count) * (shape.radius_m + shape.half_length_m) < shape.half_length_m
    return np.where(on_side[:, None], side, ends)
