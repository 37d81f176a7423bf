"""What compiled loops need to know of shapes: their kinds, their lengths, and how far they reach."""

from __future__ import annotations

import math
from collections.abc import Callable

from lidardesign.numerics import ROUNDING
from lidardesign.scenes.scene import Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Shape, Sphere

# Kinds of bodies, as compiled loops know them; a mesh is one of the grids of distance fields.
SPHERE, BOX, CAPSULE, PLANE, GRID, CYLINDER, ELLIPSOID = range(7)
KINDS: dict[type, int] = {
    Sphere: SPHERE, Box: BOX, Capsule: CAPSULE, Plane: PLANE, Mesh: GRID, Cylinder: CYLINDER, Ellipsoid: ELLIPSOID,
}  # fmt: skip
# Relative rounding of squared distances, doubled many times over: bounding balls are never missed.
BALL_SLACK = ROUNDING
# Their lengths, as compiled loops take them; planes and meshes have none.
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
