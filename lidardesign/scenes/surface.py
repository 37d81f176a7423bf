"""Area-uniform points on meshes and primitives, and the kinds and lengths of shapes for compiled loops."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from lidardesign.numerics import ROUNDING
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Round, Scene, Shape, Sphere
from lidardesign.space import RANGE, DesignSpace

# Kinds of bodies in compiled loops; a mesh is one of the grids of distance fields.
SPHERE, BOX, CAPSULE, PLANE, GRID, CYLINDER, ELLIPSOID = range(7)
KINDS: dict[type, int] = {
    Sphere: SPHERE, Box: BOX, Capsule: CAPSULE, Plane: PLANE, Mesh: GRID, Cylinder: CYLINDER, Ellipsoid: ELLIPSOID,
}  # fmt: skip
# Lengths of shapes, as compiled loops take them; planes and meshes have none.
SIZES: dict[type, Callable[..., tuple[float, float, float]]] = {
    Sphere: lambda shape: (shape.radius_m, 0.0, 0.0),
    Box: lambda shape: shape.half_extents_m,
    Capsule: lambda shape: (shape.radius_m, shape.half_length_m, 0.0),
    Cylinder: lambda shape: (shape.radius_m, shape.half_length_m, 0.0),
    Ellipsoid: lambda shape: shape.semi_axes_m,
    Plane: lambda shape: (0.0, 0.0, 0.0),
    Mesh: lambda shape: (0.0, 0.0, 0.0),
}
# Relative rounding of squared distances with a wide margin: bounding balls are never missed.
BALL_SLACK = ROUNDING


# Corners of a box of half extents 1, and the corners of its sides, seen from outside against the clock.
BOX_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
BOX_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


class Sampled(NamedTuple):
    """Points (K, 3) [m] and the corners of each one's triangle (K, 3, 3); on primitives all three are the point."""

    points: np.ndarray
    triangles: np.ndarray


def sample_triangles(
    vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Area-uniform points (count, 3) and the indices of their faces, in ascending order.

    Places along the cumulated area are stratified, which halves the noise of means over the surface.
    A surface without area gives its vertices.

    Raises:
        ValueError: There are no faces.
    """
    if not len(faces):
        raise ValueError("a surface without faces has no points")
    corners = vertices[faces]
    cumulated = np.cumsum(doubled_areas(corners))
    places = (np.arange(count) + generator.random(count)) / count * cumulated[-1]
    chosen = np.minimum(np.searchsorted(cumulated, places, side="right"), len(faces) - 1)
    root, share = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    return (1 - root) * a + root * (1 - share) * b + root * share * c, chosen


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles by their corners, (N, 3, 3) to (N,) [m^2]."""
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
    """Area of a body's surface [m^2]; of a plane, the square within reach of the space."""
    match body.shape:
        case Sphere(radius_m=radius_m):
            return 4 * math.pi * radius_m**2
        case Box(half_extents_m=(x, y, z)):
            return 8 * (x * y + y * z + z * x)
        case Capsule(radius_m=radius_m, half_length_m=half_length_m):
            return 4 * math.pi * radius_m * (radius_m + half_length_m)
        case Cylinder(radius_m=radius_m, half_length_m=half_length_m):
            return 2 * math.pi * radius_m * (radius_m + 2 * half_length_m)
        case Ellipsoid(semi_axes_m=(x, y, z)):
            from scipy.special import elliprg

            # Carlson's integral R_G (DLMF 19.33.1)
            return 4 * math.pi * x * y * z * float(elliprg(x**-2, y**-2, z**-2))
        case Plane():
            return (2 * _reach_m(space)) ** 2
        case Mesh(vertices=vertices, faces=faces):
            return float(doubled_areas(vertices[faces]).sum() / 2)


def target_area_m2(scene: Scene, space: DesignSpace) -> float:
    """Area of all targets of a scene [m^2]."""
    return sum(surface_area_m2(body, space) for body in scene.bodies if body.is_target)


def _reach_m(space: DesignSpace) -> float:
    return space.high[RANGE] + float(np.linalg.norm(np.array(space.high[:3]) - np.array(space.low[:3]))) / 2


def _on_body(body: Body, space: DesignSpace, count: int, generator: np.random.Generator, frame: int) -> Sampled:
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


def _on_primitive(shape: Round | Box, count: int, generator: np.random.Generator) -> np.ndarray:
    if isinstance(shape, Box):
        half = np.array(shape.half_extents_m)
        points, area = generator.uniform(-half, half, (count, 3)), half.prod() / half
        axis = generator.choice(3, count, p=area / area.sum())
        points[np.arange(count), axis] = half[axis] * generator.choice([-1.0, 1.0], count)
        return points
    if isinstance(shape, Cylinder):
        turn, on_end = generator.uniform(0, 2 * math.pi, count), generator.random(count)
        on_end = on_end * (shape.radius_m + 2 * shape.half_length_m) < shape.radius_m
        radius = shape.radius_m * np.where(on_end, np.sqrt(generator.random(count)), 1.0)
        height = generator.uniform(-shape.half_length_m, shape.half_length_m, count)
        height = np.where(on_end, np.copysign(shape.half_length_m, height), height)
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if isinstance(shape, Sphere):
        return shape.radius_m * direction
    if isinstance(shape, Ellipsoid):
        axes = np.array(shape.semi_axes_m)
        # a ball stretched to it grows in area by |direction / axes| there, at most by 1 / the smallest axis
        growth = np.linalg.norm(direction / axes, axis=1) * axes.min()
        accepted = axes * direction[generator.random(count) < growth]
        rest = count - len(accepted)
        return np.concatenate([accepted, _on_primitive(shape, rest, generator)]) if rest else accepted
    # a capsule is a sphere cut at its equator with a cylinder in between
    ends = shape.radius_m * direction + np.sign(direction[:, 2:]) * np.array([0, 0, shape.half_length_m])
    turn = generator.uniform(0, 2 * math.pi, count)
    height = generator.uniform(-shape.half_length_m, shape.half_length_m, count)
    side = np.stack([shape.radius_m * np.cos(turn), shape.radius_m * np.sin(turn), height], axis=1)
    on_side = generator.random(count) * (shape.radius_m + shape.half_length_m) < shape.half_length_m
    return np.where(on_side[:, None], side, ends)


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles per cell of a grid of vertices, shape (2 (rows - 1) (columns - 1), 3)."""
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, up = first + 1, first + columns
    return np.concatenate([np.stack([first, right, up], axis=1), np.stack([right, up + 1, up], axis=1)])


def round_triangles(shape: Round, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and outward faces (F, 3) of a round shape with `steps` steps round its z axis."""
    turn = np.linspace(0.0, 2 * np.pi, steps + 1)
    half = np.linspace(0.0, np.pi / 2, steps // 4 + 1)
    latitude = np.concatenate([half[::-1], -half])
    radius, height = np.cos(latitude), np.sin(latitude)
    if isinstance(shape, Cylinder):
        radius, height = np.array([0.0, 1.0, 1.0, 0.0]), np.array([1.0, 1.0, -1.0, -1.0])
    ring = np.stack([np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn)), np.outer(height, turn**0)], axis=2)
    vertices = ring * half_extents_m(shape)
    if isinstance(shape, Capsule):
        ends = np.repeat([shape.half_length_m, -shape.half_length_m], len(half))
        vertices[..., 2] = shape.radius_m * height[:, None] + ends[:, None]
    return vertices.reshape(-1, 3), grid_faces(len(radius), len(turn))


def half_extents_m(shape: Shape) -> tuple[float, float, float]:
    """Half extents of a primitive's bounding box in its own frame, infinite for a plane [m]."""
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
    """Radius of a primitive's bounding ball around its origin, infinite for a plane [m]."""
    half = half_extents_m(shape)
    match shape:
        case Box():
            return math.hypot(*half)
        case Cylinder():
            return math.hypot(*half[1:])
    return max(half)
