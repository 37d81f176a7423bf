"""Compiled loops over bodies in their own frames: which columns matter at a point, distances, gradients.

Every loop takes the arrays of `bodies.Bodies`: bodies sorted by column, `starts` telling where each column begins, and
for each body its world bounding box, which decides whether it is looked at at all.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.density.interpolation import BOX, CAPSULE, PLANE, SPHERE
from lidardesign.density.kernels import corners, locate


@njit(cache=True, nogil=True, inline="always")
def to_frame(to_body, b, points, n, q):  # noqa: ANN001, ANN201
    """Point n in the frame of body b. Rows are indexed, not sliced: a slice costs as much as the arithmetic."""
    for k in range(3):
        q[k] = (
            to_body[b, k, 0] * points[n, 0]
            + to_body[b, k, 1] * points[n, 1]
            + to_body[b, k, 2] * points[n, 2]
            + to_body[b, k, 3]
        )


@njit(cache=True, nogil=True)
def _shape_distance(kind, size, values, start, counts, low, inverse_step, q, gradient):  # noqa: ANN001, ANN202
    """Signed distance of a body other than a sphere at a point in its own frame, with its gradient (3,)."""
    if kind == CAPSULE:
        z = q[2] - min(max(q[2], -size[1]), size[1])
        length = math.sqrt(q[0] * q[0] + q[1] * q[1] + z * z)
        gradient[0] = q[0] / length if length > 0.0 else 0.0
        gradient[1] = q[1] / length if length > 0.0 else 0.0
        gradient[2] = z / length if length > 0.0 else 0.0
        return length - size[0]
    if kind == PLANE:
        gradient[0], gradient[1], gradient[2] = 0.0, 0.0, 1.0
        return q[2]
    if kind == BOX:
        return _box_distance(size, q, gradient)
    return _grid_distance(values, start, counts, low, inverse_step, q, gradient)


@njit(cache=True, nogil=True)
def _box_distance(size, q, gradient):  # noqa: ANN001, ANN202
    squared, deepest, axis = 0.0, -np.inf, 0
    for k in range(3):
        beyond = abs(q[k]) - size[k]
        if beyond > deepest:
            deepest, axis = beyond, k
        if beyond > 0.0:
            squared += beyond * beyond
        gradient[k] = 0.0
    if squared == 0.0:
        gradient[axis] = 1.0 if q[axis] >= 0.0 else -1.0
        return deepest
    distance = math.sqrt(squared)
    for k in range(3):
        beyond = abs(q[k]) - size[k]
        if beyond > 0.0:
            gradient[k] = beyond / distance * (1.0 if q[k] >= 0.0 else -1.0)
    return distance


@njit(cache=True, nogil=True)
def _grid_distance(values, start, counts, low, inverse_step, q, gradient):  # noqa: ANN001, ANN202
    cell, fraction, excess = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    index, weight = np.zeros(8, np.int64), np.zeros(8)
    squared = locate(counts, low, inverse_step, q, cell, fraction, excess)
    corners(counts, cell, fraction, index, weight)
    value = 0.0
    for corner in range(8):
        value += weight[corner] * values[start + index[corner]]
    for axis in range(3):
        total = 0.0
        for corner in range(8):
            upper = (corner >> axis) & 1
            other = 1.0
            for k in range(3):
                if k != axis:
                    other *= fraction[k] if (corner >> k) & 1 else 1.0 - fraction[k]
            total += (1.0 if upper else -1.0) * other * values[start + index[corner]]
        gradient[axis] = total * inverse_step
    if squared == 0.0:
        return value
    inner = max(value, 0.0)
    distance = math.sqrt(squared + inner * inner)
    for k in range(3):
        gradient[k] = excess[k] / distance if excess[k] != 0.0 else gradient[k] * inner / distance
    return distance


@njit(cache=True, nogil=True, inline="always")
def _distance(kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient):  # noqa: ANN001, ANN202
    """Signed distance of body b at point n, its gradient in the body's frame."""
    to_frame(to_body, b, points, n, q)
    if kinds[b] == SPHERE:
        length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        scale = 1.0 / length if length > 0.0 else 0.0
        gradient[0], gradient[1], gradient[2] = q[0] * scale, q[1] * scale, q[2] * scale
        return length - sizes[b, 0]
    g = grid[b]
    return _shape_distance(
        kinds[b], sizes[b], values, grid_starts[g], counts[g], lows[g], steps[g], q, gradient
    )


@njit(cache=True, nogil=True, inline="always")
def _outside_squared(low, high, b, points, n):  # noqa: ANN001, ANN202
    """Squared distance of point n to box b, 0 inside."""
    x = max(low[b, 0] - points[n, 0], points[n, 0] - high[b, 0], 0.0)
    y = max(low[b, 1] - points[n, 1], points[n, 1] - high[b, 1], 0.0)
    z = max(low[b, 2] - points[n, 2], points[n, 2] - high[b, 2], 0.0)
    return x * x + y * y + z * z


@njit(cache=True, nogil=True, inline="always")
def _column_distance(  # noqa: ANN202
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    low, high, first, last, points, n, reach, q, gradient,  # noqa: ANN001
):  # fmt: skip
    """Distance of the nearest of some bodies to point n, and which it is; `reach` (B,) is scratch.

    The body whose box is nearest goes first; after it hardly any other has to be evaluated.
    """
    distance, body = np.inf, -1
    leader, least = first, np.inf
    for b in range(first, last):
        reach[b] = _outside_squared(low, high, b, points, n)
        if reach[b] < least:
            leader, least = b, reach[b]
    for turn in range(first - 1, last):
        b = leader if turn < first else turn
        if turn == leader or (reach[b] > 0.0 and (distance <= 0.0 or reach[b] >= distance * distance)):
            continue
        value = _distance(
            kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient
        )
        if value < distance:
            distance, body = value, b
    return distance, body


@njit(cache=True, nogil=True, inline="always")
def _most_promising(group_low, group_high, group_weights, precision, points, n, hopes):  # noqa: ANN001, ANN202
    """What each group could come to at point n at best, into `hopes`; which group hopes for most."""
    leader, highest = 0, -np.inf
    for g in range(hopes.shape[0]):
        hopes[g] = group_weights[g] - 0.5 * precision * _outside_squared(group_low, group_high, g, points, n)
        if hopes[g] > highest:
            leader, highest = g, hopes[g]
    return leader


@njit(cache=True, nogil=True)
def near_columns(  # noqa: ANN201
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    low, high, starts, group_low, group_high, group_columns,  # noqa: ANN001
    points, log_weights, group_weights, precision, tolerance,  # noqa: ANN001
    row_starts, columns, distances, bodies,  # noqa: ANN001
):  # fmt: skip
    """The columns whose term log_weight - precision * d^2 / 2 is within a tolerance of the best one, for each point.

    Bounding boxes bound the terms from above, first of groups of neighbouring columns (frames of one motion are close
    together), then of columns; only columns that could matter are evaluated, each by its nearest body.

    Arguments:
        group_low, group_high: Boxes around `group_columns` columns each.
        points: Shape (N, 3).
        log_weights, group_weights: Per column, and the largest of each group.
        precision: 1 / sigma^2 [1/m^2].
        tolerance: In nats.
        row_starts: Out: where each point's pairs begin, shape (N + 1,).
        columns, distances, bodies: Out: one entry per pair, as many as there is room for.

    Returns:
        The number of pairs; where it is above the room, the lists are cut off and the call has to be repeated.
    """
    count, groups, room = starts.shape[0] - 1, group_low.shape[0], columns.shape[0]
    q, gradient = np.zeros(3), np.zeros(3)
    hopes, reach = np.empty(groups), np.empty(kinds.shape[0])
    found, nearest, seen = np.empty(count), np.empty(count, np.int64), np.empty(count, np.int64)
    total = 0
    for n in range(points.shape[0]):
        row_starts[n] = total
        leader = _most_promising(group_low, group_high, group_weights, precision, points, n, hopes)
        best, kept = -np.inf, 0
        for turn in range(groups):
            # the most promising group first: it tells how much the others may miss
            g = leader if turn == 0 else (0 if turn == leader else turn)
            if hopes[g] < best - tolerance:
                continue
            for c in range(g * group_columns, min((g + 1) * group_columns, count)):
                if starts[c + 1] == starts[c] + 1:
                    squared = _outside_squared(low, high, starts[c], points, n)
                    if log_weights[c] - 0.5 * precision * squared < best - tolerance:
                        continue
                distance, body = _column_distance(
                    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,
                    low, high, starts[c], starts[c + 1], points, n, reach, q, gradient,
                )  # fmt: skip
                term = log_weights[c] - 0.5 * precision * distance * distance
                if term < best - tolerance:
                    continue
                best = max(best, term)
                seen[kept], found[kept], nearest[kept] = c, distance, body
                kept += 1
        for k in range(kept):
            if log_weights[seen[k]] - 0.5 * precision * found[k] * found[k] < best - tolerance:
                continue
            if total < room:
                columns[total], distances[total], bodies[total] = seen[k], found[k], nearest[k]
            total += 1
    row_starts[points.shape[0]] = total
    return total


@njit(cache=True, nogil=True)
def add_gradients(  # noqa: ANN201
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    points, row_starts, bodies, weights, out,  # noqa: ANN001
):  # fmt: skip
    """Gradients of sum_pairs weight * d(body, point): pairs as `near_columns` lists them, out (N, 3)."""
    q, gradient = np.zeros(3), np.zeros(3)
    out[:] = 0.0
    for n in range(points.shape[0]):
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = bodies[pair]
            if weights[pair] == 0.0:
                continue
            _distance(
                kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient
            )
            for k in range(3):
                for i in range(3):
                    out[n, k] += weights[pair] * to_body[b, i, k] * gradient[i]


@njit(cache=True, nogil=True)
def distances_of(  # noqa: ANN201
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, bodies, points, out  # noqa: ANN001
):
    """Distance of one body each at points: bodies (N,), points (N, 3), out (N,)."""
    q, gradient = np.zeros(3), np.zeros(3)
    for n in range(points.shape[0]):
        out[n] = _distance(
            kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, bodies[n], points, n, q, gradient
        )


@njit(cache=True, nogil=True)
def all_distances(  # noqa: ANN201
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, starts, points, out, nearest  # noqa: ANN001
):
    """Distances of the nearest body of every column: out (N, C), and which body it was: nearest (N, C)."""
    q, gradient = np.zeros(3), np.zeros(3)
    out[:] = np.inf
    nearest[:] = -1
    for n in range(points.shape[0]):
        for c in range(starts.shape[0] - 1):
            for b in range(starts[c], starts[c + 1]):
                value = _distance(
                    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient
                )
                if value < out[n, c]:
                    out[n, c] = value
                    nearest[n, c] = b
