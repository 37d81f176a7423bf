"""Compiled loops over rays and the bodies of the columns that matter to them: first hits, and meshes to cast at.

Primitives are crossed in closed form in their own frames. The arrays are those of `bodies.Bodies`; world bounding boxes
decide which bodies are looked at.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.density.fields.body_kernels import to_frame
from lidardesign.density.fields.grids import BOX, CAPSULE, GRID, PLANE, SPHERE


@njit(cache=True, nogil=True, inline="always")
def _turn(to_body, b, vectors, n, out):  # noqa: ANN001, ANN202
    for k in range(3):
        out[k] = (
            to_body[b, k, 0] * vectors[n, 0] + to_body[b, k, 1] * vectors[n, 1] + to_body[b, k, 2] * vectors[n, 2]
        )


@njit(cache=True, nogil=True, inline="always")
def _ball_roots(origin, direction, radius):  # noqa: ANN001, ANN202
    """Both crossings of a line with a ball, NaN where it passes by; |direction| is 1."""
    along = origin[0] * direction[0] + origin[1] * direction[1] + origin[2] * direction[2]
    squared = 0.0
    for k in range(3):
        across = origin[k] - along * direction[k]
        squared += across * across
    room = radius * radius - squared
    if room < 0.0:
        return np.nan, np.nan
    half = math.sqrt(room)
    return -along - half, -along + half


@njit(cache=True, nogil=True, inline="always")
def _box_roots(low, high, origin, direction):  # noqa: ANN001, ANN202
    near, far = -np.inf, np.inf
    for k in range(3):
        if direction[k] == 0.0:
            if origin[k] < low[k] or origin[k] > high[k]:
                return np.nan, np.nan
            continue
        one, other = (low[k] - origin[k]) / direction[k], (high[k] - origin[k]) / direction[k]
        near, far = max(near, min(one, other)), min(far, max(one, other))
    if near > far:
        return np.nan, np.nan
    return near, far


@njit(cache=True, nogil=True)
def _capsule_roots(size, origin, direction, centred):  # noqa: ANN001, ANN202
    """A line meets the side, or the cap on whose side it meets the endless cylinder (as in `simulate.raycast`)."""
    radius, half_length = size[0], size[1]
    across = direction[0] * direction[0] + direction[1] * direction[1]
    roots = (np.nan, np.nan)
    near, far = np.nan, np.nan
    half = 0.0
    along = 0.0
    if across > 0.0:
        along = (origin[0] * direction[0] + origin[1] * direction[1]) / across
        x, y = origin[0] - along * direction[0], origin[1] - along * direction[1]
        room = radius * radius - x * x - y * y
        if room < 0.0:
            return roots
        half = math.sqrt(room / across)
    for end in (-1.0, 1.0):
        side = -along + end * half
        height = origin[2] + side * direction[2] if across > 0.0 else end * direction[2] * np.inf
        value = side
        if not abs(height) <= half_length:
            centred[0], centred[1] = origin[0], origin[1]
            centred[2] = origin[2] - (half_length if height > 0.0 else -half_length)
            first, second = _ball_roots(centred, direction, radius)
            value = first if end < 0.0 else second
        if end < 0.0:
            near = value
        else:
            far = value
    return near, far


@njit(cache=True, nogil=True)
def _primitive_roots(kind, size, origin, direction, work):  # noqa: ANN001, ANN202
    if kind == SPHERE:
        return _ball_roots(origin, direction, size[0])
    if kind == BOX:
        for k in range(3):
            work[k] = -size[k]
        return _box_roots(work, size, origin, direction)
    if kind == CAPSULE:
        return _capsule_roots(size, origin, direction, work)
    if direction[2] == 0.0:
        return np.nan, np.nan
    return -origin[2] / direction[2], np.nan


@njit(cache=True, nogil=True, inline="always")
def _normal(kind, size, point, out):  # noqa: ANN001, ANN202
    """Outward normal of a primitive at a point on it, in its frame."""
    out[0], out[1], out[2] = 0.0, 0.0, 0.0
    if kind == PLANE:
        out[2] = 1.0
    elif kind == BOX:
        axis, largest = 0, -1.0
        for k in range(3):
            share = abs(point[k]) / size[k]
            if share > largest:
                axis, largest = k, share
        out[axis] = 1.0 if point[axis] >= 0.0 else -1.0
    else:
        z = point[2] - min(max(point[2], -size[1]), size[1]) if kind == CAPSULE else point[2]
        length = math.sqrt(point[0] * point[0] + point[1] * point[1] + z * z)
        if length > 0.0:
            out[0], out[1], out[2] = point[0] / length, point[1] / length, z / length


@njit(cache=True, nogil=True, inline="always")
def _boxes_meet(low, high, b, start, end):  # noqa: ANN001, ANN202
    """Whether the box from `start` (3,) to `end` (3,) meets box b."""
    for k in range(3):  # noqa: SIM110 - numba compiles the loop to half the time of one expression
        if start[k] > high[b, k] or end[k] < low[b, k]:
            return False
    return True


@njit(cache=True, nogil=True, inline="always")
def _segment_box(origins, directions, limits, n, start, end):  # noqa: ANN001, ANN202
    """The bounding box of ray n up to its limit."""
    for k in range(3):
        tip = origins[n, k] + limits[n] * directions[n, k]
        start[k], end[k] = min(origins[n, k], tip), max(origins[n, k], tip)


@njit(cache=True, nogil=True)
def first_hits(  # noqa: ANN201
    kinds, sizes, to_body, low, high, starts,  # noqa: ANN001
    row_starts, columns, origins, directions, limits, hits, normals,  # noqa: ANN001
):  # fmt: skip
    """First hits of rays on the primitives of columns, before a limit.

    Arguments:
        row_starts, columns: Ray-column pairs as `near_columns` lists them.
        origins, directions: Rays, shape (N, 3); directions of unit length.
        limits: Where rays end, shape (N,) [m].
        hits: Out: ranges, infinite without a hit, shape (P,) [m].
        normals: Out: world normals that face the origin, shape (P, 3).
    """
    q, turned, work, point = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    local, start, end = np.zeros(3), np.zeros(3), np.zeros(3)
    for n in range(origins.shape[0]):
        _segment_box(origins, directions, limits, n, start, end)
        for pair in range(row_starts[n], row_starts[n + 1]):
            best, body = limits[n], -1
            for b in range(starts[columns[pair]], starts[columns[pair] + 1]):
                if kinds[b] == GRID or not _boxes_meet(low, high, b, start, end):
                    continue
                to_frame(to_body, b, origins, n, q)
                _turn(to_body, b, directions, n, turned)
                near, far = _primitive_roots(kinds[b], sizes[b], q, turned, work)
                value = near if near >= 0.0 else far
                if value >= 0.0 and value < best:
                    best, body = value, b
            hits[pair] = np.inf
            if body < 0:
                continue
            hits[pair] = best
            to_frame(to_body, body, origins, n, q)
            _turn(to_body, body, directions, n, turned)
            for k in range(3):
                point[k] = q[k] + best * turned[k]
            _normal(kinds[body], sizes[body], point, local)
            facing = local[0] * turned[0] + local[1] * turned[1] + local[2] * turned[2]
            sign = -1.0 if facing > 0.0 else 1.0
            for k in range(3):
                normals[pair, k] = sign * (
                    to_body[body, 0, k] * local[0] + to_body[body, 1, k] * local[1] + to_body[body, 2, k] * local[2]
                )


@njit(cache=True, nogil=True)
def mesh_candidates(  # noqa: ANN201
    kinds, to_body, grid, mesh_low, mesh_high, low, high, starts,  # noqa: ANN001
    row_starts, columns, origins, directions, limits, rows, pairs, bodies,  # noqa: ANN001
):  # fmt: skip
    """Pairs and mesh bodies whose own bounding box the ray passes before its limit.

    Returns:
        Their number; where it is above the room in `rows`, `pairs` and `bodies`, the call has to be repeated.
    """
    q, turned, start, end = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    total, room = 0, pairs.shape[0]
    for n in range(origins.shape[0]):
        _segment_box(origins, directions, limits, n, start, end)
        for pair in range(row_starts[n], row_starts[n + 1]):
            for b in range(starts[columns[pair]], starts[columns[pair] + 1]):
                if kinds[b] != GRID or not _boxes_meet(low, high, b, start, end):
                    continue
                to_frame(to_body, b, origins, n, q)
                _turn(to_body, b, directions, n, turned)
                near, far = _box_roots(mesh_low[grid[b]], mesh_high[grid[b]], q, turned)
                if not (far >= 0.0 and near < limits[n]):
                    continue
                if total < room:
                    rows[total], pairs[total], bodies[total] = n, pair, b
                total += 1
    return total
