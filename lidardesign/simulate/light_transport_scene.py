"""A frame of a scene as shapes of the light-transport simulator: float32 around a centre of its own.

Spheres and the sides of capsules stay exact, boxes become twelve triangles. An infinite plane ends where little light
could come from: it is as large as `PLANE_REACHES` times the distance to what is looked at, in squares that grow
outward, so that what is near keeps its accuracy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidardesign.scene import Body, Box, Capsule, Mesh, Plane, Scene, Sphere

# Half sizes of a plane's nested squares, in reaches. What lies further sends back less than 1e-4 of its light.
PLANE_REACHES = (2.0, 10.0, 100.0)
_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
_BOX_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def exported(
    scene: Scene, frame: int, centre_m: np.ndarray, reach_m: float, *, matt: bool = False
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """The shapes of a frame as JSON and their arrays.

    Arguments:
        scene: The scene; all of its bodies, whatever their role.
        frame: The time frame.
        centre_m: What becomes the origin, shape (3,) [m].
        reach_m: The furthest distance from it that is looked at [m].
        matt: Whether what mirrors and glass do not scatter is lost.
    """
    shapes, arrays = [], {}
    for number, body in enumerate(scene.bodies):
        document, own = _shape(body, frame, centre_m, reach_m)
        shares = {"reflectance": float(body.reflectance), "specular": 0.0, "transmission": 0.0}
        if not matt:
            shares |= {"specular": float(body.specular), "transmission": float(body.transmission)}
        shapes.append({**document, **shares})
        arrays.update({f"{name}{number}": values for name, values in own.items()})
    return shapes, arrays


def _shape(
    body: Body, frame: int, centre_m: np.ndarray, reach_m: float
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    pose, shape = body.pose(frame), body.shape
    rotation, place = pose[:3, :3], pose[:3, 3] - centre_m
    if isinstance(shape, Sphere):
        return _round([place, place], shape.radius_m), {}
    if isinstance(shape, Capsule):
        half = shape.half_length_m * rotation[:, 2]
        return _round([place - half, place + half], shape.radius_m), {}
    if isinstance(shape, Plane):
        nearest = rotation[:, 2] * (rotation[:, 2] @ place)
        vertices, faces = _plane(max(reach_m, float(np.linalg.norm(nearest))))
        return {"kind": "mesh"}, {"vertices": vertices @ rotation.T + nearest, "faces": faces}
    vertices, faces = _box(shape) if isinstance(shape, Box) else _triangles(shape)
    return {"kind": "mesh"}, {"vertices": vertices @ rotation.T + place, "faces": faces}


def _round(ends: list[np.ndarray], radius_m: float) -> dict[str, Any]:
    return {"kind": "round", "ends": [end.tolist() for end in ends], "radius": float(radius_m)}


def _triangles(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices, mesh.faces


def _box(box: Box) -> tuple[np.ndarray, np.ndarray]:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    return signs * np.array(box.half_extents_m), _split(_BOX_QUADS)


def _plane(reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Nested squares around the point of the plane z = 0 below the centre."""
    rings = [_SQUARE * (reaches * reach_m) for reaches in PLANE_REACHES]
    quads = [(0, 1, 2, 3)]
    for ring in range(len(rings) - 1):
        inner, outer = 4 * ring, 4 * (ring + 1)
        quads += [(outer + k, outer + (k + 1) % 4, inner + (k + 1) % 4, inner + k) for k in range(4)]
    return np.concatenate(rings), _split(quads)


def _split(quads: Any) -> np.ndarray:
    return np.array([[a, b, c] if half == 0 else [a, c, d] for a, b, c, d in quads for half in (0, 1)], dtype=np.int32)
