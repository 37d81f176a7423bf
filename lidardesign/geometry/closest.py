"""Distances from points to the nearest of many triangles, exact, by a tree of boxes that numba walks.

Boxes are halved at the median of their longest side; a point visits the nearer half first and leaves out every box that
is further than what was found (Ericson, Real-Time Collision Detection, 2005, chapters 5 and 6).
"""

from __future__ import annotations

import numpy as np
from numba import njit

LEAF = 4  # triangles of a box that is not halved any more
DEEPEST = 64  # boxes that wait at once: medians halve numbers, so a tree of 2^60 triangles would fit


class TriangleTree:
    """Triangles that points are measured from.

    Arguments:
        triangles: Corners [m], shape (T, 3, 3), at least one; those without an area count as segments or points.
    """

    def __init__(self, triangles: np.ndarray) -> None:
        triangles = np.ascontiguousarray(triangles, dtype=np.float64)
        nodes = 2 * len(triangles)
        self._boxes = np.empty((nodes, 2, 3))
        self._spans = np.empty((nodes, 3), dtype=np.int64)
        order = np.arange(len(triangles))
        _build(triangles, order, self._boxes, self._spans)
        self._triangles = triangles[order]

    def distance_m(self, points: np.ndarray) -> np.ndarray:
        """The distance of each point to the nearest triangle [m], (N, 3) to (N,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        squared = np.empty(len(points))
        _nearest(points, self._triangles, self._boxes, self._spans, squared)
        return np.sqrt(squared)


@njit(cache=True, nogil=True)
def _build(triangles: np.ndarray, order: np.ndarray, boxes: np.ndarray, spans: np.ndarray) -> None:
    """Fills boxes (K, 2, 3) and spans (K, 3): first and last triangle, and the first of two children or -1."""
    middles = np.empty((len(triangles), 3))
    for t in range(len(triangles)):
        for axis in range(3):
            middles[t, axis] = (triangles[t, 0, axis] + triangles[t, 1, axis] + triangles[t, 2, axis]) / 3
    spans[0] = (0, len(triangles), -1)
    made, node = 1, 0
    while node < made:
        first, last = spans[node, 0], spans[node, 1]
        for axis in range(3):
            boxes[node, 0, axis], boxes[node, 1, axis] = np.inf, -np.inf
        for place in range(first, last):
            for corner in triangles[order[place]]:
                for axis in range(3):
                    boxes[node, 0, axis] = min(boxes[node, 0, axis], corner[axis])
                    boxes[node, 1, axis] = max(boxes[node, 1, axis], corner[axis])
        if last - first > LEAF:
            longest = np.argmax(boxes[node, 1] - boxes[node, 0])
            own = order[first:last]
            order[first:last] = own[np.argsort(middles[own, longest], kind="mergesort")]
            half = (first + last) // 2
            spans[node, 2] = made
            spans[made] = (first, half, -1)
            spans[made + 1] = (half, last, -1)
            made += 2
        node += 1


@njit(cache=True, nogil=True)
def _nearest(
    points: np.ndarray, triangles: np.ndarray, boxes: np.ndarray, spans: np.ndarray, squared: np.ndarray
) -> None:
    """Fills the squared distance of each point to the nearest triangle."""
    waiting = np.empty(DEEPEST, dtype=np.int64)
    away = np.empty(DEEPEST)
    for n in range(len(points)):
        least = np.inf
        waiting[0], away[0], depth = 0, _box_squared(points[n], boxes[0]), 1
        while depth:
            depth -= 1
            node = waiting[depth]
            if away[depth] >= least:
                continue
            child = spans[node, 2]
            if child < 0:
                for t in range(spans[node, 0], spans[node, 1]):
                    least = min(least, _triangle_squared(points[n], triangles[t]))
                continue
            near, far = _box_squared(points[n], boxes[child]), _box_squared(points[n], boxes[child + 1])
            first, second = child, child + 1
            if far < near:
                near, far, first, second = far, near, second, first
            waiting[depth], away[depth] = second, far
            waiting[depth + 1], away[depth + 1] = first, near
            depth += 2
        squared[n] = least


@njit(cache=True, nogil=True, inline="always")
def _box_squared(point: np.ndarray, box: np.ndarray) -> float:
    total = 0.0
    for axis in range(3):
        beyond = max(box[0, axis] - point[axis], point[axis] - box[1, axis], 0.0)
        total += beyond * beyond
    return total


@njit(cache=True, nogil=True)
def _triangle_squared(point: np.ndarray, triangle: np.ndarray) -> float:
    """Over the inside the distance to the plane, elsewhere that to the nearest edge; without area only edges."""
    a, b, c = triangle[0], triangle[1], triangle[2]
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    px, py, pz = point[0] - a[0], point[1] - a[1], point[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = nx * nx + ny * ny + nz * nz
    if area > 0.0:
        # the weights of b and c in the foot of the perpendicular
        of_b = (py * vz - pz * vy) * nx + (pz * vx - px * vz) * ny + (px * vy - py * vx) * nz
        of_c = (uy * pz - uz * py) * nx + (uz * px - ux * pz) * ny + (ux * py - uy * px) * nz
        if of_b >= 0.0 and of_c >= 0.0 and of_b + of_c <= area:
            height = px * nx + py * ny + pz * nz
            return height * height / area
    return min(_segment_squared(point, a, b), _segment_squared(point, b, c), _segment_squared(point, c, a))


@njit(cache=True, nogil=True)
def _segment_squared(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    length = along = 0.0
    for axis in range(3):
        side = end[axis] - start[axis]
        length += side * side
        along += side * (point[axis] - start[axis])
    share = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
    squared = 0.0
    for axis in range(3):
        apart = point[axis] - start[axis] - share * (end[axis] - start[axis])
        squared += apart * apart
    return squared
