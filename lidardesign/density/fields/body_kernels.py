"""Compiled loops over bodies in their own frames: columns that matter at a point, distances, importance, first hits.

Every loop takes the arrays of bodies (`bodies.BodyArrays`): sorted by column, `starts` tells where each column begins,
and for each body its world bounding box, which decides whether it is looked at at all. Primitives are crossed by rays
in closed form; meshes only tell which rays pass their boxes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.density.fields.bodies import BOX, CAPSULE, CYLINDER, ELLIPSOID, GRID, GROUP_COLUMNS, PLANE, SPHERE
from lidardesign.density.fields.primitive_kernels import (
    box_roots,
    primitive_distance,
    primitive_normal,
    primitive_roots,
)
from lidardesign.density.fields.table_kernels import corners, locate, trilinear_slope


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


@njit(cache=True, nogil=True, inline="always")
def _corner_values(values, placed, q, cell, fraction, excess, index, weight, found):  # noqa: ANN001, ANN202
    """The values at the corners of a point's cell in a grid, one of `grids`, into `found` (8,); the excess squared."""
    low, counts, inverse_step, start = placed[:3], placed[3:6], placed[6], int(placed[7])
    squared = locate(counts, low, inverse_step, q, cell, fraction, excess)
    corners(counts, cell, fraction, index, weight)
    for corner in range(8):
        found[corner] = values[start + index[corner]]
    return squared


@njit(cache=True, nogil=True)
def _grid_distance(values, placed, q, gradient):  # noqa: ANN001, ANN202
    """Signed distance of a mesh by its grid, a row of `grids`, at a point in its own frame, with its gradient (3,)."""
    cell, fraction, excess = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    index, weight, found = np.zeros(8, np.int64), np.zeros(8), np.zeros(8)
    squared = _corner_values(values, placed, q, cell, fraction, excess, index, weight, found)
    value = 0.0
    for corner in range(8):
        value += weight[corner] * found[corner]
    for axis in range(3):
        gradient[axis] = trilinear_slope(found, fraction, axis) * placed[6]
    if squared == 0.0:
        return value
    inner = max(value, 0.0)
    distance = math.sqrt(squared + inner * inner)
    for k in range(3):
        gradient[k] = excess[k] / distance if excess[k] != 0.0 else gradient[k] * inner / distance
    return distance


@njit(cache=True, nogil=True, inline="always")
def _distance(kinds, sizes, to_body, grid, values, grids, b, points, n, q, gradient):  # noqa: ANN001, ANN202
    """Signed distance of body b at point n, its gradient in the body's frame."""
    to_frame(to_body, b, points, n, q)
    if kinds[b] == SPHERE:
        length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        scale = 1.0 / length if length > 0.0 else 0.0
        gradient[0], gradient[1], gradient[2] = q[0] * scale, q[1] * scale, q[2] * scale
        return length - sizes[b, 0]
    if kinds[b] != GRID:
        return primitive_distance(kinds[b], sizes[b], q, gradient)
    return _grid_distance(values, grids[grid[b]], q, gradient)


@njit(cache=True, nogil=True, inline="always")
def _plain_distance(kinds, sizes, to_body, grid, values, grids, b, points, n, q):  # noqa: ANN001, ANN202
    """`_distance` without a gradient: primitives are written out, since calls and slices cost more than they do."""
    kind = kinds[b]
    to_frame(to_body, b, points, n, q)
    if kind == GRID:
        return _grid_distance(values, grids[grid[b]], q, np.zeros(3))
    if kind == PLANE:
        return q[2]
    if kind in (CYLINDER, ELLIPSOID):
        return primitive_distance(kind, sizes[b], q, np.zeros(3))
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
def _column_distance(kinds, sizes, to_body, grid, values, grids, first, last, points, n, reach, q):  # noqa: ANN001, ANN202
    """Distance of the nearest of some bodies to point n, and which it is; `reach` (B,) tells how far their boxes are.

    The body whose box is nearest goes first; after it hardly any other has to be evaluated.
    """
    if first == last:
        return np.inf, -1
    if last == first + 1:
        return _plain_distance(kinds, sizes, to_body, grid, values, grids, first, points, n, q), first
    leader, least = first, _least(reach, first, last)
    while reach[leader] > least:
        leader += 1
    distance = _plain_distance(kinds, sizes, to_body, grid, values, grids, leader, points, n, q)
    body, limit = leader, max(distance, 0.0) * max(distance, 0.0)
    # counting takes all at once, and mostly finds the leader alone
    if _within(reach, first, last, limit) == (1 if least < limit or least == 0.0 else 0):
        return distance, body
    for b in range(first, last):
        if (reach[b] >= limit and reach[b] > 0.0) or b == leader:
            continue
        value = _plain_distance(kinds, sizes, to_body, grid, values, grids, b, points, n, q)
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


@njit(cache=True, nogil=True)
def near_columns(bodies, group_edges, points, log_weights, group_weights, precision, tolerance, row_starts, out):  # noqa: ANN001, ANN201
    """The columns whose term log_weight - precision * d^2 / 2 is within a tolerance of the best one, for each point.

    Bounding boxes bound the terms from above, first of groups of neighbouring columns (frames of one motion are close
    together), then of columns; only columns that could matter are evaluated, each by its nearest body.

    Arguments:
        bodies: The arrays of all bodies.
        group_edges: Boxes around `GROUP_COLUMNS` columns each, low sides and high sides by axis, shape (6, groups).
        points: Shape (N, 3).
        log_weights, group_weights: Per column, and the largest of each group.
        precision: 1 / sigma^2 [1/m^2].
        tolerance: In nats.
        row_starts: Out: where each point's pairs begin, shape (N + 1,).
        out: Columns, distances and nearest bodies, one entry per pair, as many as there is room for.

    Returns:
        The number of pairs; where it is above the room, the lists are cut off and the call has to be repeated.
    """
    kinds, sizes, to_body, grid, values, grids, _, _, edges, starts = bodies
    columns, distances, nearest = out
    count, groups, room = starts.shape[0] - 1, group_edges.shape[1], columns.shape[0]
    q = np.zeros(3)
    hopes, reach = np.empty(groups), np.empty(kinds.shape[0])
    # of the point at hand: columns that are not yet too far off, their distances and their nearest bodies
    candidates, candidate_m, candidate_body = np.empty(count, np.int64), np.empty(count), np.empty(count, np.int64)
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
            first, last = g * GROUP_COLUMNS, min((g + 1) * GROUP_COLUMNS, count)
            _outside_squared(edges, starts[first], starts[last], points, n, reach)
            for c in range(first, last):
                alone = starts[c + 1] == starts[c] + 1
                if alone and log_weights[c] - 0.5 * precision * reach[starts[c]] < best - tolerance:
                    continue
                distance, body = _column_distance(
                    kinds, sizes, to_body, grid, values, grids, starts[c], starts[c + 1], points, n, reach, q
                )
                term = log_weights[c] - 0.5 * precision * distance * distance
                if term < best - tolerance:
                    continue
                best = max(best, term)
                candidates[kept], candidate_m[kept], candidate_body[kept] = c, distance, body
                kept += 1
        for k in range(kept):
            if log_weights[candidates[k]] - 0.5 * precision * candidate_m[k] * candidate_m[k] < best - tolerance:
                continue
            if total < room:
                columns[total], distances[total], nearest[total] = candidates[k], candidate_m[k], candidate_body[k]
            total += 1
    row_starts[points.shape[0]] = total
    return total


@njit(cache=True, nogil=True)
def add_gradients(bodies, points, row_starts, nearest, weights, out):  # noqa: ANN001, ANN201
    """Gradients of sum_pairs weight * d(body, point): pairs as `near_columns` lists them, out (N, 3)."""
    kinds, sizes, to_body, grid, values, grids = bodies[:6]
    q, gradient = np.zeros(3), np.zeros(3)
    out[:] = 0.0
    for n in range(points.shape[0]):
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = nearest[pair]
            if weights[pair] == 0.0:
                continue
            _distance(kinds, sizes, to_body, grid, values, grids, b, points, n, q, gradient)
            for k in range(3):
                for i in range(3):
                    out[n, k] += weights[pair] * to_body[b, i, k] * gradient[i]


@njit(cache=True, nogil=True)
def distances_of(bodies, chosen, points, out):  # noqa: ANN001, ANN201
    """Distance of one body each at points: chosen (N,), points (N, 3), out (N,)."""
    kinds, sizes, to_body, grid, values, grids = bodies[:6]
    q, gradient = np.zeros(3), np.zeros(3)
    for n in range(points.shape[0]):
        out[n] = _distance(kinds, sizes, to_body, grid, values, grids, chosen[n], points, n, q, gradient)


@njit(cache=True, nogil=True)
def all_distances(bodies, points, out, nearest):  # noqa: ANN001, ANN201
    """Distances of the nearest body of every column: out (N, C), and which body it was: nearest (N, C)."""
    kinds, sizes, to_body, grid, values, grids, _, _, _, starts = bodies
    q, gradient = np.zeros(3), np.zeros(3)
    out[:] = np.inf
    nearest[:] = -1
    for n in range(points.shape[0]):
        for c in range(starts.shape[0] - 1):
            for b in range(starts[c], starts[c + 1]):
                value = _distance(kinds, sizes, to_body, grid, values, grids, b, points, n, q, gradient)
                if value < out[n, c]:
                    out[n, c] = value
                    nearest[n, c] = b


@njit(cache=True, nogil=True)
def pair_log_weights(bodies, constants, values, points, row_starts, nearest, out):  # noqa: ANN001, ANN201
    """log weights of pairs of a point and a body, listed as `near_columns` does: out (P,).

    Arguments:
        bodies: The arrays of all bodies.
        constants: log weight of each body as a whole, shape (B,).
        values: log weights of all grids of meshes, end to end; bodies of grid 0 have none.
        points, row_starts: As in `near_columns`.
        nearest: The body of each pair, -1 for none.
    """
    grid, to_body, grids = bodies.grid, bodies.to_body, bodies.grids
    cell, fraction, excess, q = np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3)
    index, weight, found = np.zeros(8, np.int64), np.zeros(8), np.zeros(8)
    for n in range(points.shape[0]):
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = nearest[pair]
            if b < 0:
                out[pair] = 0.0
                continue
            total, g = constants[b], grid[b]
            if g > 0:
                to_frame(to_body, b, points, n, q)
                _corner_values(values, grids[g], q, cell, fraction, excess, index, weight, found)
                for corner in range(8):
                    total += weight[corner] * found[corner]
            out[pair] = total


@njit(cache=True, nogil=True)
def add_log_weight_gradients(bodies, values, points, row_starts, nearest, weights, out):  # noqa: ANN001, ANN201
    """Add the gradients of sum_pairs weight * log weight of its body at the point to out (N, 3)."""
    grid, to_body, grids = bodies.grid, bodies.to_body, bodies.grids
    cell, fraction, excess, q = np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3)
    index, corner_weight, found = np.zeros(8, np.int64), np.zeros(8), np.zeros(8)
    for n in range(points.shape[0]):
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = nearest[pair]
            if b < 0 or weights[pair] == 0.0 or grid[b] == 0:
                continue
            g = grid[b]
            to_frame(to_body, b, points, n, q)
            _corner_values(values, grids[g], q, cell, fraction, excess, index, corner_weight, found)
            for axis in range(3):
                if excess[axis] == 0.0:
                    slope = weights[pair] * trilinear_slope(found, fraction, axis) * grids[g, 6]
                    for k in range(3):
                        out[n, k] += slope * to_body[b, axis, k]


@njit(cache=True, nogil=True, inline="always")
def _turn(to_body, b, vectors, n, out):  # noqa: ANN001, ANN202
    for k in range(3):
        out[k] = to_body[b, k, 0] * vectors[n, 0] + to_body[b, k, 1] * vectors[n, 1] + to_body[b, k, 2] * vectors[n, 2]


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
def first_hits(bodies, row_starts, columns, rays, hits, normals):  # noqa: ANN001, ANN201
    """First hits of rays on the primitives of columns, before a limit.

    Arguments:
        bodies: The arrays of all bodies.
        row_starts, columns: Ray-column pairs as `near_columns` lists them.
        rays: Origins (N, 3), directions of unit length (N, 3), and where rays end (N,) [m].
        hits: Out: ranges, infinite without a hit, shape (P,) [m].
        normals: Out: world normals that face the origin, shape (P, 3).
    """
    kinds, sizes, to_body, starts = bodies.kinds, bodies.sizes, bodies.to_body, bodies.starts
    low, high, (origins, directions, limits) = bodies.low, bodies.high, rays
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
                near, far = primitive_roots(kinds[b], sizes[b], q, turned, work)
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
            primitive_normal(kinds[body], sizes[body], point, local)
            facing = local[0] * turned[0] + local[1] * turned[1] + local[2] * turned[2]
            sign = -1.0 if facing > 0.0 else 1.0
            for k in range(3):
                normals[pair, k] = sign * (
                    to_body[body, 0, k] * local[0] + to_body[body, 1, k] * local[1] + to_body[body, 2, k] * local[2]
                )


@njit(cache=True, nogil=True)
def mesh_candidates(bodies, mesh_bounds, row_starts, columns, rays, out):  # noqa: ANN001, ANN201
    """Pairs and mesh bodies whose own bounding box the ray passes before its limit.

    Arguments:
        bodies, row_starts, columns, rays: As in `first_hits`.
        mesh_bounds: Low and high corners of the meshes in their own frames, by grid, shape (grids, 3) each [m].
        out: Rays, pairs and bodies, as many as there is room for.

    Returns:
        Their number; where it is above the room, the call has to be repeated.
    """
    kinds, to_body, grid, starts = bodies.kinds, bodies.to_body, bodies.grid, bodies.starts
    low, high = bodies.low, bodies.high
    (origins, directions, limits), (mesh_low, mesh_high), (out_rows, out_pairs, out_bodies) = rays, mesh_bounds, out
    q, turned, start, end = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    total, room = 0, out_pairs.shape[0]
    for n in range(origins.shape[0]):
        _segment_box(origins, directions, limits, n, start, end)
        for pair in range(row_starts[n], row_starts[n + 1]):
            for b in range(starts[columns[pair]], starts[columns[pair] + 1]):
                if kinds[b] != GRID or not _boxes_meet(low, high, b, start, end):
                    continue
                to_frame(to_body, b, origins, n, q)
                _turn(to_body, b, directions, n, turned)
                near, far = box_roots(mesh_low[grid[b]], mesh_high[grid[b]], q, turned)
                if not (far >= 0.0 and near < limits[n]):
                    continue
                if total < room:
                    out_rows[total], out_pairs[total], out_bodies[total] = n, pair, b
                total += 1
    return total
