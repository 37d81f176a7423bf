"""Exact distances from points to the nearest of many triangles, by a bounding box tree in numba.

Sets of triangles are halved at the median of their longest extent until few are left. Eight boxes, or eight triangles,
are measured at once with SIMD; a point visits the nearest boxes first and skips every box that is further than the
nearest triangle so far (Ericson, Real-Time Collision Detection, 2005, chapters 5 and 6).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.numerics import EPSILON, SQUARABLE

HALVINGS = 3  # of the triangles of a box, to those of its children
WIDTH = 2**HALVINGS  # children of a box, and triangles of a leaf
FLAT = 8 * EPSILON  # share of the longest side below which a triangle's height is rounding noise
DEEPEST = 128  # boxes on the stack: seven more with each level, so a tree of 2^50 triangles would fit


class TriangleTree:
    """Bounding box tree of triangles, for distances of points.

    Arguments:
        triangles: Corners [m], shape (T, 3, 3), at least one; those without an area count as segments or points.
    """

    def __init__(self, triangles: np.ndarray) -> None:
        triangles = np.ascontiguousarray(triangles, dtype=np.float64)
        most = 2 * len(triangles) // WIDTH + 1  # leaves are half full at least
        self._boxes = np.empty((most, 6, WIDTH))
        self._children = np.empty((most, WIDTH), dtype=np.int64)
        members = np.empty((most, WIDTH), dtype=np.int64)
        leaves = _build_boxes(triangles, self._boxes, self._children, members)
        frames = np.empty((len(triangles), 17))
        _build_frames(triangles, frames)
        self._members = members[:leaves]
        self._frames = np.ascontiguousarray(frames[self._members].transpose(0, 2, 1))

    def distance_m(self, points: np.ndarray) -> np.ndarray:
        """Distance of each point to the nearest triangle [m], (N, 3) to (N,)."""
        return self._nearest(points, math.inf)[0]

    def closest(self, points: np.ndarray, within_m: float = math.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance of each point to the nearest triangle [m], the triangle's index, and the nearest point on it [m].

        Arguments:
            points: Points [m], shape (N, 3).
            within_m: Search radius [m]; without a triangle inside it, the distance is infinite and the index -1.

        Returns:
            Shapes (N,), (N,) and (N, 3).
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance, leaves = self._nearest(points, within_m)
        triangles, places = np.full(len(points), -1), np.full((len(points), 3), np.nan)
        _closest_on(points, self._frames, leaves, self._members, triangles, places)
        return distance, triangles, places

    def _nearest(self, points: np.ndarray, within_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Distances [m], and the leaves that hold the nearest triangles, shapes (N,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        squared, leaves = np.empty(len(points)), np.empty(len(points), dtype=np.int64)
        _nearest(points, self._frames, self._boxes, self._children, within_m * within_m, squared, leaves)
        return np.sqrt(squared), leaves


@njit(cache=True, nogil=True)
def _build_boxes(triangles: np.ndarray, boxes: np.ndarray, children: np.ndarray, members: np.ndarray) -> int:
    """Fill the boxes of each node's children, (K, 6, 8) lower and upper corners, and return the number of leaves.

    A child is a node, or below 0 the complement of a leaf, (K, 8); boxes of missing children are infinitely far. Leaves
    (K, 8) hold triangles, the last one several times where they are not full.
    """
    middles = np.empty((len(triangles), 3))
    for t in range(len(triangles)):
        for axis in range(3):
            middles[t, axis] = (triangles[t, 0, axis] + triangles[t, 1, axis] + triangles[t, 2, axis]) / 3
    order = np.arange(len(triangles))
    begin, end = np.zeros(len(boxes), dtype=np.int64), np.full(len(boxes), len(triangles))
    first, last = np.empty(WIDTH, dtype=np.int64), np.empty(WIDTH, dtype=np.int64)
    extents = np.empty(3)
    made, leaves, node = 1, 0, 0
    while node < made:
        first[0], last[0], parts = begin[node], end[node], 1
        for _ in range(HALVINGS):
            for part in range(parts):
                if last[part] - first[part] > WIDTH:
                    own = order[first[part] : last[part]]
                    for axis in range(3):
                        extents[axis] = np.ptp(middles[own, axis])
                    along = middles[own, np.argmax(extents)]
                    order[first[part] : last[part]] = own[np.argsort(along, kind="mergesort")]
                    first[parts], last[parts] = (first[part] + last[part]) // 2, last[part]
                    last[part] = first[parts]
                    parts += 1
        boxes[node, :3], boxes[node, 3:], children[node] = np.inf, -np.inf, 0
        for part in range(parts):
            for t in order[first[part] : last[part]]:
                for corner in range(3):
                    for axis in range(3):
                        place = triangles[t, corner, axis]
                        boxes[node, axis, part] = min(boxes[node, axis, part], place)
                        boxes[node, 3 + axis, part] = max(boxes[node, 3 + axis, part], place)
            if last[part] - first[part] > WIDTH:
                children[node, part], begin[made], end[made] = made, first[part], last[part]
                made += 1
            else:
                for index in range(WIDTH):
                    members[leaves, index] = order[min(first[part] + index, last[part] - 1)]
                children[node, part] = ~leaves
                leaves += 1
        node += 1
    return leaves


@njit(cache=True, nogil=True)
def _nearest(
    points: np.ndarray,
    frames: np.ndarray,
    boxes: np.ndarray,
    children: np.ndarray,
    limit: float,
    squared: np.ndarray,
    leaves: np.ndarray,
) -> None:
    """Fill the squared distance of each point to the nearest triangle, and its leaf; infinite and -1 beyond a limit."""
    waiting, away = np.empty(DEEPEST, dtype=np.int64), np.empty(DEEPEST)
    apart = np.empty(WIDTH)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        least, leaf = limit, -1
        waiting[0], away[0], depth = 0, 0.0, 1
        while depth:
            depth -= 1
            node = waiting[depth]
            if away[depth] >= least:
                continue
            if node < 0:
                _triangles_squared(x, y, z, frames, ~node, apart)
                nearest = apart[0]
                for index in range(1, WIDTH):
                    nearest = min(nearest, apart[index])
                if nearest < least:
                    least, leaf = nearest, ~node
                continue
            _boxes_squared(x, y, z, boxes, node, apart)
            before = depth
            for index in range(WIDTH):
                if apart[index] < least:
                    # the nearest one is visited first
                    place = depth
                    if depth > before and away[depth - 1] < apart[index]:
                        place -= 1
                        waiting[depth], away[depth] = waiting[place], away[place]
                    waiting[place], away[place] = children[node, index], apart[index]
                    depth += 1
        squared[n], leaves[n] = least if leaf >= 0 else np.inf, leaf


# The following functions take indices, not slices, so that the compiler vectorises loops over `apart`.
@njit(cache=True, nogil=True, inline="always")
def _boxes_squared(x: float, y: float, z: float, boxes: np.ndarray, node: int, apart: np.ndarray) -> None:
    """Fill the squared distance of a point to each of a node's boxes (8,)."""
    for index in range(boxes.shape[2]):
        beyond_x = max(boxes[node, 0, index] - x, x - boxes[node, 3, index], 0.0)
        beyond_y = max(boxes[node, 1, index] - y, y - boxes[node, 4, index], 0.0)
        beyond_z = max(boxes[node, 2, index] - z, z - boxes[node, 5, index], 0.0)
        apart[index] = beyond_x * beyond_x + beyond_y * beyond_y + beyond_z * beyond_z


@njit(cache=True, nogil=True)
def _build_frames(triangles: np.ndarray, frames: np.ndarray) -> None:
    """Fill frames (T, 17): each triangle in its own plane, the longest side from the origin along the first axis.

    They hold the origin, three axes (the last one is the normal), the length of that side, the third corner, and the
    inverse squares of the lengths of the two other sides. Orthogonalised twice, the axes are exact to rounding for any
    triangle: a normal from a cross product is off by the inverse sine of a needle's sharpest angle. A triangle without
    area gets any plane through it.
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
        if height <= max(SQUARABLE, FLAT * length):
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


@njit(cache=True, nogil=True, inline="always")
def _triangles_squared(x: float, y: float, z: float, frames: np.ndarray, leaf: int, apart: np.ndarray) -> None:
    """Fill the squared distance of a point to each of a leaf's triangles (8,), whose frames are (L, 17, 8).

    Over the inside it is the distance to the plane, elsewhere that to the nearest side.
    """
    for t in range(frames.shape[2]):
        px, py, pz = x - frames[leaf, 0, t], y - frames[leaf, 1, t], z - frames[leaf, 2, t]
        along = px * frames[leaf, 3, t] + py * frames[leaf, 4, t] + pz * frames[leaf, 5, t]
        across = px * frames[leaf, 6, t] + py * frames[leaf, 7, t] + pz * frames[leaf, 8, t]
        above = px * frames[leaf, 9, t] + py * frames[leaf, 10, t] + pz * frames[leaf, 11, t]
        length, third, height = frames[leaf, 12, t], frames[leaf, 13, t], frames[leaf, 14, t]
        left, right = height * along - third * across, height * (length - along) - (length - third) * across
        beyond = along - min(max(along, 0.0), length)
        least = min(
            beyond * beyond + across * across,
            _segment_squared(along, across, third, height, frames[leaf, 15, t]),
            _segment_squared(along - length, across, third - length, height, frames[leaf, 16, t]),
        )
        apart[t] = above * above + (0.0 if (across > 0.0) & (left > 0.0) & (right > 0.0) else least)


@njit(cache=True, nogil=True, inline="always")
def _segment_squared(x: float, y: float, end_x: float, end_y: float, inverse: float) -> float:
    """Squared distance of a point (x, y) to the segment from the origin to an end, given its inverse squared length."""
    share = min(max((x * end_x + y * end_y) * inverse, 0.0), 1.0)
    beyond_x, beyond_y = x - share * end_x, y - share * end_y
    return beyond_x * beyond_x + beyond_y * beyond_y


@njit(cache=True, nogil=True)
def _closest_on(
    points: np.ndarray, frames: np.ndarray, leaves: np.ndarray, members: np.ndarray, found: np.ndarray, on: np.ndarray
) -> None:
    """Fill the nearest triangle of each point's leaf and the nearest point on it; nothing where a leaf is -1."""
    apart = np.empty(WIDTH)
    for n in range(len(points)):
        leaf = leaves[n]
        if leaf < 0:
            continue
        _triangles_squared(points[n, 0], points[n, 1], points[n, 2], frames, leaf, apart)
        t = np.argmin(apart)
        found[n] = members[leaf, t]
        frame = frames[leaf, :, t]
        offset = points[n] - frame[:3]
        along, across = (offset * frame[3:6]).sum(), (offset * frame[6:9]).sum()
        length, third, height = frame[12], frame[13], frame[14]
        left, right = height * along - third * across, height * (length - along) - (length - third) * across
        if not (across > 0.0 and left > 0.0 and right > 0.0):
            x, y, least = along, across, np.inf
            corners_x, corners_y = (0.0, length, third), (0.0, 0.0, height)
            for k in range(3):
                side_x, side_y = corners_x[(k + 1) % 3] - corners_x[k], corners_y[(k + 1) % 3] - corners_y[k]
                square = side_x * side_x + side_y * side_y
                ahead = (x - corners_x[k]) * side_x + (y - corners_y[k]) * side_y
                share = min(max(ahead / square, 0.0), 1.0) if square > SQUARABLE**2 else 0.0
                near_x, near_y = corners_x[k] + share * side_x, corners_y[k] + share * side_y
                beyond = (x - near_x) ** 2 + (y - near_y) ** 2
                if beyond < least:
                    along, across, least = near_x, near_y, beyond
        on[n] = frame[:3] + along * frame[3:6] + across * frame[6:9]
