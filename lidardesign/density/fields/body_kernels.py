"""Compiled loops over bodies in their own frames: which columns matter at a point, distances, gradients.

Every loop takes the arrays of `bodies.Bodies`: bodies sorted by column, `starts` telling where each column begins, and
for each body its world bounding box, which decides whether it is looked at at all.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.density.fields.grids import BOX, CAPSULE, PLANE, SPHERE
from lidardesign.density.fields.kernels import corners, locate


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
def _plain_distance(  # noqa: ANN202
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient,  # noqa: ANN001
):  # fmt: skip
    """`_distance` without a gradient: primitives are written out, since calls and slices cost more than they do."""
    kind = kinds[b]
    if kind != SPHERE and kind != BOX and kind != CAPSULE and kind != PLANE:
        return _distance(
            kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient
        )
    to_frame(to_body, b, points, n, q)
    if kind == PLANE:
        return q[2]
    if kind == BOX:
        x, y, z = abs(q[0]) - sizes[b, 0], abs(q[1]) - sizes[b, 1], abs(q[2]) - sizes[b, 2]
        deepest = max(x, y, z)
        if deepest <= 0.0:
            return deepest
        x, y, z = max(x, 0.0), max(y, 0.0), max(z, 0.0)
        return math.sqrt(x * x + y * y + z * z)
    above = q[2] - min(max(q[2], -sizes[b, 1]), sizes[b, 1]) if kind == CAPSULE else q[2]
    return math.sqrt(q[0] * q[0] + q[1] * q[1] + above * above) - sizes[b, 0]


# Boxes have no NaN; without it to care for, the three axes of many boxes are compared at once.
BOXES = {"nnan", "nsz"}


@njit(cache=True, nogil=True, fastmath=BOXES)
def _outside_squared(edges, first, last, points, n, out) -> None:  # noqa: ANN001
    """Squared distances of point n to boxes `first` to `last`, 0 inside; edges (6, B) are low and then high sides."""
    x, y, z = points[n, 0], points[n, 1], points[n, 2]
    for b in range(first, last):
        along = max(max(edges[0, b] - x, x - edges[3, b]), 0.0)
        across = max(max(edges[1, b] - y, y - edges[4, b]), 0.0)
        above = max(max(edges[2, b] - z, z - edges[5, b]), 0.0)
        out[b] = along * along + across * across + above * above


@njit(cache=True, nogil=True, fastmath=BOXES | {"reassoc"})
def _least(reach, first, last):  # noqa: ANN001, ANN202
    least = reach[first]
    for b in range(first + 1, last):
        least = min(least, reach[b])
    return least


@njit(cache=True, nogil=True, fastmath=BOXES)
def _within(reach, first, last, limit):  # noqa: ANN001, ANN202
    """How many of some bodies a point is in the box of, or nearer to it than the root of `limit`."""
    count = 0
    for b in range(first, last):
        count += 1 if reach[b] < limit or reach[b] == 0.0 else 0
    return count


@njit(cache=True, nogil=True, inline="always")
def _column_distance(  # noqa: ANN202
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    first, last, points, n, reach, q, gradient,  # noqa: ANN001
):  # fmt: skip
    """Distance of the nearest of some bodies to point n, and which it is; `reach` (B,) tells how far their boxes are.

    The body whose box is nearest goes first; after it hardly any other has to be evaluated.
    """
    if first == last:
        return np.inf, -1
    if last == first + 1:
        return _plain_distance(
            kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, first, points, n, q, gradient
        ), first
    leader, least = first, _least(reach, first, last)
    while reach[leader] > least:
        leader += 1
    distance = _plain_distance(
        kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, leader, points, n, q, gradient
    )
    body, limit = leader, max(distance, 0.0) * max(distance, 0.0)
    # counting takes all at once, and mostly finds the leader alone
    if _within(reach, first, last, limit) == (1 if least < limit or least == 0.0 else 0):
        return distance, body
    for b in range(first, last):
        if (reach[b] >= limit and reach[b] > 0.0) or b == leader:
            continue
        value = _plain_distance(
            kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, b, points, n, q, gradient
        )
        if value < distance:
            distance, body, limit = value, b, max(value, 0.0) * max(value, 0.0)
    return distance, body


@njit(cache=True, nogil=True, inline="always")
def _most_promising(group_edges, group_weights, precision, points, n, hopes):  # noqa: ANN001, ANN202
    """What each group could come to at point n at best, into `hopes`; which group hopes for most."""
    _outside_squared(group_edges, 0, hopes.shape[0], points, n, hopes)
    leader = 0
    for g in range(hopes.shape[0]):
        hopes[g] = group_weights[g] - 0.5 * precision * hopes[g]
        if hopes[g] > hopes[leader]:
            leader = g
    return leader


@njit(cache=True, nogil=True, inline="always")
def _add_near(  # noqa: ANN202
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, starts, first, last,  # noqa: ANN001
    points, n, log_weights, precision, tolerance, reach, q, gradient, best, kept, seen, found, nearest,  # noqa: ANN001
):  # fmt: skip
    """Append those of columns `first` to `last` that are not yet too far off; the best term and the number by then."""
    for c in range(first, last):
        alone = starts[c + 1] == starts[c] + 1
        if alone and log_weights[c] - 0.5 * precision * reach[starts[c]] < best - tolerance:
            continue
        distance, body = _column_distance(
            kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,
            starts[c], starts[c + 1], points, n, reach, q, gradient,
        )  # fmt: skip
        term = log_weights[c] - 0.5 * precision * distance * distance
        if term < best - tolerance:
            continue
        best = max(best, term)
        seen[kept], found[kept], nearest[kept] = c, distance, body
        kept += 1
    return best, kept


@njit(cache=True, nogil=True)
def near_columns(  # noqa: ANN201
    kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    edges, starts, group_edges, group_columns,  # noqa: ANN001
    points, log_weights, group_weights, precision, tolerance,  # noqa: ANN001
    row_starts, columns, distances, bodies,  # noqa: ANN001
):  # fmt: skip
    """The columns whose term log_weight - precision * d^2 / 2 is within a tolerance of the best one, for each point.

    Bounding boxes bound the terms from above, first of groups of neighbouring columns (frames of one motion are close
    together), then of columns; only columns that could matter are evaluated, each by its nearest body.

    Arguments:
        edges: World bounding boxes of the bodies, low sides and high sides by axis, shape (6, B).
        group_edges: The same of boxes around `group_columns` columns each.
        points: Shape (N, 3).
        log_weights, group_weights: Per column, and the largest of each group.
        precision: 1 / sigma^2 [1/m^2].
        tolerance: In nats.
        row_starts: Out: where each point's pairs begin, shape (N + 1,).
        columns, distances, bodies: Out: one entry per pair, as many as there is room for.

    Returns:
        The number of pairs; where it is above the room, the lists are cut off and the call has to be repeated.
    """
    count, groups, room = starts.shape[0] - 1, group_edges.shape[1], columns.shape[0]
    q, gradient = np.zeros(3), np.zeros(3)
    hopes, reach = np.empty(groups), np.empty(kinds.shape[0])
    found, nearest, seen = np.empty(count), np.empty(count, np.int64), np.empty(count, np.int64)
    total = 0
    for n in range(points.shape[0]):
        row_starts[n] = total
        leader = _most_promising(group_edges, group_weights, precision, points, n, hopes)
        best, kept = -np.inf, 0
        for turn in range(groups):
            # the most promising group first: it tells how much the others may miss
            g = leader if turn == 0 else (0 if turn == leader else turn)
            if hopes[g] < best - tolerance:
                continue
            first, last = g * group_columns, min((g + 1) * group_columns, count)
            _outside_squared(edges, starts[first], starts[last], points, n, reach)
            best, kept = _add_near(
                kinds, sizes, to_body, grid, values, grid_starts, counts, lows, steps, starts, first, last,
                points, n, log_weights, precision, tolerance, reach, q, gradient, best, kept, seen, found, nearest,
            )  # fmt: skip
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
