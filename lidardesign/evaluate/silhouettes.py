"""What a scene covers when it is looked at along an axis: cells of a grid, for pictures."""

from __future__ import annotations

import numpy as np

from lidardesign.evaluate.drawing import body_triangles, drawn_share
from lidardesign.scene import Plane, Scene

MOST_STEPS = 512  # along a triangle's side: beyond, it is far larger than any picture


def silhouette(
    scene: Scene, frame: int, axes: tuple[int, int], edges: tuple[np.ndarray, np.ndarray], *, targets: bool = True
) -> np.ndarray:
    """Which cells targets (or the other bodies) cover in projection, shape (V, U) bool; infinite planes cover none.

    Arguments:
        scene, frame: What is looked at.
        axes: The world axes across and up.
        edges: Ends of the cells along both, evenly spaced [m], shapes (U + 1,) and (V + 1,).
        targets: Whether targets count, or everything else.
    """
    covered = np.zeros((len(edges[1]) - 1, len(edges[0]) - 1), dtype=bool)
    share = drawn_share(scene)
    for body in scene.bodies:
        if body.is_target == targets and not isinstance(body.shape, Plane):
            vertices, faces = body_triangles(body, frame, np.zeros((2, 3)), share)
            _cover(covered, vertices[:, list(axes)][faces].astype(np.float64), edges)
    return covered


def _cover(covered: np.ndarray, corners: np.ndarray, edges: tuple[np.ndarray, np.ndarray]) -> None:
    """Mark the cells that hold a point of a lattice, no wider than a cell, on triangles (F, 3, 2)."""
    low = np.array([edge[0] for edge in edges])
    cell = np.array([edge[1] - edge[0] for edge in edges])
    places = (corners - low) / cell
    upper = np.array(covered.shape[::-1])
    near = (places.max(axis=1) >= 0).all(axis=1) & (places.min(axis=1) < upper).all(axis=1)
    places = places[near]
    sides = np.abs(places - np.roll(places, 1, axis=1)).max(axis=(1, 2))
    steps = np.minimum(2 ** np.ceil(np.log2(np.maximum(sides, 1.0))), MOST_STEPS).astype(int)
    for count in np.unique(steps):
        lattice = _lattice(count)
        for some in np.array_split(places[steps == count], max(1, (steps == count).sum() * len(lattice) // 2_000_000)):
            inside = np.floor(np.einsum("lc,fck->flk", lattice, some)).astype(int).reshape(-1, 2)
            inside = inside[((inside >= 0) & (inside < upper)).all(axis=1)]
            covered[inside[:, 1], inside[:, 0]] = True


def _lattice(steps: int) -> np.ndarray:
    """Barycentric coordinates of a lattice on a triangle with so many steps along each side, shape (L, 3)."""
    first, second = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1))
    keep = first + second <= steps
    first, second = first[keep], second[keep]
    return np.stack([first, second, steps - first - second], axis=1) / steps
