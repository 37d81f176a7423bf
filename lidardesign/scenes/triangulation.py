"""Bodies as triangles, which are drawn or filled with points: meshes thinned, round bodies in steps, planes cut."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.numerics import TINY
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Body, Box, Mesh, Plane, Round, Scene
from lidardesign.scenes.surface import BOX_CORNERS, BOX_QUADS, round_triangles

STEPS = 24  # round a round body
PLANE_MARGIN = 0.1  # of the scene's extent, beyond which an infinite plane is not drawn


def body_triangles(body: Body, frame: int, bounds_m: np.ndarray, share: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """World vertices (V, 3) float32 [m] and faces (F, 3) int32 of a body; planes are cut at bounds (2, 3).

    Meshes are thinned to about a share of their triangles.
    """
    pose = body.pose(frame)
    vertices, faces = own_triangles(body, pose, bounds_m, share)
    return (vertices @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32), faces


def own_triangles(
    body: Body, pose: np.ndarray, bounds_m: np.ndarray, share: float = 1.0, steps: int = STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """`body_triangles` in the body's own frame, round bodies in `steps` steps; the pose is used for planes."""
    shape = body.shape
    if isinstance(shape, Mesh):
        vertices, faces = thinned(shape.vertices, shape.faces, math.ceil(share * len(shape.faces)))
    elif isinstance(shape, Round):
        vertices, faces = round_triangles(shape, steps)
    elif isinstance(shape, Box):
        # corners of their own for every side keep the light from rounding the edges
        vertices = (BOX_CORNERS * np.asarray(shape.half_extents_m))[np.ravel(BOX_QUADS)]
        faces = np.array([(k, k + 1 + half, k + 2 + half) for half in (0, 1) for k in range(0, 24, 4)])
    else:
        # the part of the plane z = 0 below a scene's bounds, in the plane's own frame
        corners = np.array([[x, y, z] for x in bounds_m[:, 0] for y in bounds_m[:, 1] for z in bounds_m[:, 2]])
        local = (corners - pose[:3, 3]) @ pose[:3, :3]
        (x0, y0), (x1, y1) = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
        vertices = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
        faces = np.array([[0, 1, 2], [0, 2, 3]])
    return vertices, faces.astype(np.int32)


def thinned(vertices: np.ndarray, faces: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most about `most` faces, by merging the vertices of each cell of a grid into their mean."""
    cells = math.sqrt(max(most, 1))
    while len(faces) > most:
        low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0).max()
        cell = np.floor((vertices - low) / max(extent, TINY) * cells).astype(np.int64)
        _, group = np.unique(cell, axis=0, return_inverse=True)
        group = group.reshape(-1)
        counts = np.bincount(group)
        vertices = np.stack([np.bincount(group, column) / counts for column in vertices.T], axis=1)
        faces = group[faces]
        first, second, third = faces.T
        faces = faces[(first != second) & (second != third) & (third != first)]
        cells *= 0.7
    return vertices, faces


def scene_bounds(scene: Scene, frame: int, rays: list[Rays]) -> np.ndarray:
    """Bounds of everything finite in a scene and of the rays' origins, with a margin, shape (2, 3) [m]."""
    finite = [body for body in scene.bodies if not isinstance(body.shape, Plane)]
    points = [ray.origin_m for ray in rays] + [body_triangles(body, frame, np.zeros((2, 3)))[0] for body in finite]
    everything = np.concatenate([*points, np.zeros((0, 3))])
    if not len(everything):
        return np.array([[-1.0] * 3, [1.0] * 3])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = PLANE_MARGIN * max(float((high - low).max()), PLANE_MARGIN)
    return np.stack([low - margin, high + margin])
