"""Distances from points to the nearest of many triangles, exact, by a tree of boxes that numba walks.

Boxes are halved at the median of their longest side until they hold one triangle; a point visits the nearer half first
and leaves out every box that is further than what was found (Ericson, Real-Time Collision Detection, 2005, chapters 5
and 6).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.numerics import SQUARABLE

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
        _build_boxes(triangles, order, self._boxes, self._spans)
        self._frames = np.empty((len(triangles), 17))
        _build_frames(triangles[order], self._frames)

    def distance_m(self, points: np.ndarray) -> np.ndarray:
        """The distance of each point to the nearest triangle [m], (N, 3) to (N,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        squared = np.empty(len(points))
        _nearest(points, self._frames, self._boxes, self._spans, squared)
        return np.sqrt(squared)


@njit(cache=True, nogil=True)
def _build_boxes(triangles: np.ndarray, order: np.ndarray, boxes: np.ndarray, spans: np.ndarray) -> None:
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
        if last - first > 1:
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
    points: np.ndarray, frames: np.ndarray, boxes: np.ndarray, spans: np.ndarray, squared: np.ndarray
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
                least = min(least, _triangle_squared(points[n], frames[spans[node, 0]]))
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
def _build_frames(triangles: np.ndarray, frames: np.ndarray) -> None:
    """Fills frames (T, 17): each triangle in its own plane, the longest side from the origin along the first axis.

    They hold the origin, three axes (the last one is the normal), the length of that side, the third corner, and the
    inverse squares of the lengths of the two other sides. Made orthogonal twice, the axes are so to rounding whatever
    the triangle: a normal from a cross product is off by the inverse of a needle's sharpest sine. A triangle without
    area has any plane through it, and is as thin there.
    """
    sides = np.empty((3, 3))
    for t in range(len(triangles)):
        frame = frames[t]
        for k in range(3):
            sides[k] = triangles[t, (k + 1) % 3] - triangles[t, k]
        squares = (sides * sides).sum(axis=1)
        longest = np.argmax(squares)
        length, along, third = math.sqrt(squares[longest]), sides[longest], -sides[(longest + 2) % 3]
        along = along / length if length > SQUARABLE else np.array([1.0, 0.0, 0.0])
        across = third - (third * along).sum() * along
        across -= (across * along).sum() * along
        height = math.sqrt((across * across).sum())
        if height <= SQUARABLE:
            height, across = 0.0, np.zeros(3)
            across[np.argmin(np.abs(along))] = 1.0
            across -= (across * along).sum() * along
        across /= math.sqrt((across * across).sum())
        frame[:3], frame[3:6], frame[6:9] = triangles[t, longest], along, across
        frame[9] = along[1] * across[2] - along[2] * across[1]
        frame[10] = along[2] * across[0] - along[0] * across[2]
        frame[11] = along[0] * across[1] - along[1] * across[0]
        frame[12], frame[13], frame[14] = length, (third * along).sum(), height
        for place, side in ((15, (longest + 2) % 3), (16, (longest + 1) % 3)):
            frame[place] = 1 / squares[side] if squares[side] > SQUARABLE**2 else 0.0


@njit(cache=True, nogil=True)
def _triangle_squared(point: np.ndarray, frame: np.ndarray) -> float:
    """Over the inside the distance to the plane, elsewhere that to the sides which the point is beyond."""
    px, py, pz = point[0] - frame[0], point[1] - frame[1], point[2] - frame[2]
    x = px * frame[3] + py * frame[4] + pz * frame[5]
    y = px * frame[6] + py * frame[7] + pz * frame[8]
    z = px * frame[9] + py * frame[10] + pz * frame[11]
    length, third, height = frame[12], frame[13], frame[14]
    least = np.inf
    if y <= 0.0:
        beyond = x - min(max(x, 0.0), length)
        least = beyond * beyond + y * y
    if height * x <= third * y:
        least = min(least, _segment_squared(x, y, third, height, frame[15]))
    if height * (length - x) <= (length - third) * y:
        least = min(least, _segment_squared(x - length, y, third - length, height, frame[16]))
    return z * z + (least if least < np.inf else 0.0)


@njit(cache=True, nogil=True, inline="always")
def _segment_squared(x: float, y: float, end_x: float, end_y: float, inverse: float) -> float:
    """From a point of the plane to the segment from the origin to an end."""
    share = min(max((x * end_x + y * end_y) * inverse, 0.0), 1.0)
    beyond_x, beyond_y = x - share * end_x, y - share * end_y
    return beyond_x * beyond_x + beyond_y * beyond_y
