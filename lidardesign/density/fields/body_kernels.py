"""Compiled loops over bodies in their own frames: columns that matter at a point, distances, importance, first hits.

Every loop takes the arrays of bodies (`bodies.BodyArrays`): sorted by column, `starts` tells where each column begins,
and for each body its world bounding box, which decides whether it is looked at at all. Primitives have signed distances
in closed form, and are crossed by rays in closed form; meshes only tell which rays pass their boxes.

What is called once per body takes points, directions and sizes as tuples of three numbers, which compiled loops keep in
registers, and at most the arrays of a pose: each further array that is handed on costs as much as the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.density.fields.bodies import GROUP_COLUMNS
from lidardesign.density.fields.table_kernels import along_axis
from lidardesign.numerics import EPSILON, TINY
from lidardesign.scenes.primitive_kernels import (
    box_roots,
    normal_at_range,
    placed,
    primitive_roots,
    row,
    turned,
    turned_back,
)
from lidardesign.scenes.surface import BOX, CAPSULE, CYLINDER, ELLIPSOID, GRID, PLANE, SPHERE

# Boxes have no NaN; without it to care for, the three axes of many boxes are compared at once.
BOXES = {"nnan", "nsz"}
# A point is taken to be at least so far from the middle plane of an ellipsoid, as a share of its smallest semi-axis:
# below it the two nearest points, above and below the plane, are one.
OFF_MIDDLE = EPSILON
MOST_NEWTON_STEPS = 60  # to the nearest point of an ellipsoid


@njit(cache=True, nogil=True)
def _cell(values, grids, g, q):  # noqa: ANN001, ANN202
    """A point in grid g, a row of `grids`: values at the corners of its cell, fractions in it, excess beyond it."""
    counts, inverse_step = (grids[g, 3], grids[g, 4], grids[g, 5]), grids[g, 6]
    i, fx, ex = along_axis(grids[g, 0], counts[0], inverse_step, q[0])
    j, fy, ey = along_axis(grids[g, 1], counts[1], inverse_step, q[1])
    k, fz, ez = along_axis(grids[g, 2], counts[2], inverse_step, q[2])
    row = int(counts[2])
    plane, a = int(counts[1]) * row, int(grids[g, 7])
    a += i * plane + j * row + k
    near = values[a], values[a + plane], values[a + row], values[a + plane + row]
    far = values[a + 1], values[a + plane + 1], values[a + row + 1], values[a + plane + row + 1]
    return (near, far), (fx, fy, fz), (ex, ey, ez)


@njit(cache=True, nogil=True, inline="always")
def _trilinear(corners, fraction):  # noqa: ANN001, ANN202
    """The value in a cell and its derivatives along the axes, per step."""
    (a, b, c, d), (e, f, g, h) = corners
    x, y, z = fraction
    # along z, then y, then x
    a, b, c, d = (a, e - a), (b, f - b), (c, g - c), (d, h - d)
    a0, b0, c0, d0 = a[0] + z * a[1], b[0] + z * b[1], c[0] + z * c[1], d[0] + z * d[1]
    left, right = a0 + y * (c0 - a0), b0 + y * (d0 - b0)
    by_y = (1.0 - x) * (c0 - a0) + x * (d0 - b0)
    by_z = (1.0 - x) * ((1.0 - y) * a[1] + y * c[1]) + x * ((1.0 - y) * b[1] + y * d[1])
    return left + x * (right - left), (right - left, by_y, by_z)


@njit(cache=True, nogil=True)
def _grid_distance(values, grids, g, q):  # noqa: ANN001, ANN202
    """Signed distance of a mesh by its grid at a point in its own frame, and its gradient."""
    corners, fraction, excess = _cell(values, grids, g, q)
    value, slope = _trilinear(corners, fraction)
    x, y, z = slope[0] * grids[g, 6], slope[1] * grids[g, 6], slope[2] * grids[g, 6]
    squared = excess[0] * excess[0] + excess[1] * excess[1] + excess[2] * excess[2]
    if squared == 0.0:
        return value, (x, y, z)
    inner = max(value, 0.0)
    distance = math.sqrt(squared + inner * inner)
    x = excess[0] / distance if excess[0] != 0.0 else x * inner / distance
    y = excess[1] / distance if excess[1] != 0.0 else y * inner / distance
    z = excess[2] / distance if excess[2] != 0.0 else z * inner / distance
    return distance, (x, y, z)


@njit(cache=True, nogil=True, inline="always")
def _distance(kind, size, values, grids, g, q):  # noqa: ANN001, ANN202
    """Signed distance of any body at a point in its own frame."""
    if kind == GRID:
        return _grid_distance(values, grids, g, q)[0]
    return primitive_distance(kind, size, q)


@njit(cache=True, nogil=True, fastmath=BOXES)
def _outside_squared(edges, first, last, p, out) -> None:  # noqa: ANN001
    """Squared distances of a point to boxes `first` to `last`, 0 inside; edges (6, B) are low and then high sides."""
    x, y, z = p
    for b in range(first, last):
        along = max(max(edges[0, b] - x, x - edges[3, b]), 0.0)
        across = max(max(edges[1, b] - y, y - edges[4, b]), 0.0)
        above = max(max(edges[2, b] - z, z - edges[5, b]), 0.0)
        out[b] = along * along + across * across + above * above


@njit(cache=True, nogil=True, fastmath=BOXES | {"reassoc"})
def _least(reach, first, last):  # noqa: ANN001, ANN202
    least = np.inf
    for b in range(first, last):
        least = min(least, reach[b])
    return least


@njit(cache=True, nogil=True, fastmath=BOXES)
def _within(reach, first, last, limit):  # noqa: ANN001, ANN202
    """The number of bodies whose box holds a point or is nearer to it than the root of `limit`."""
    count = 0
    for b in range(first, last):
        count += 1 if reach[b] < limit or reach[b] == 0.0 else 0
    return count


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
    count, groups, room, half = starts.shape[0] - 1, group_edges.shape[1], columns.shape[0], 0.5 * precision
    hopes, reach = np.empty(groups), np.empty(kinds.shape[0])
    # of the point at hand: columns that are not yet too far off, their distances and their nearest bodies
    candidates, candidate_m, candidate_body = np.empty(count, np.int64), np.empty(count), np.empty(count, np.int64)
    total = 0
    for n in range(points.shape[0]):
        row_starts[n] = total
        p = row(points, n)
        _outside_squared(group_edges, 0, groups, p, hopes)
        leader = 0
        for g in range(groups):
            hopes[g] = group_weights[g] - half * hopes[g]
            if hopes[g] > hopes[leader]:
                leader = g
        best, kept = -np.inf, 0
        for turn in range(groups):
            # the most promising group first: it sets the bound that others must reach
            g = leader if turn == 0 else (0 if turn == leader else turn)
            if hopes[g] < best - tolerance:
                continue
            begin, end = g * GROUP_COLUMNS, min((g + 1) * GROUP_COLUMNS, count)
            _outside_squared(edges, starts[begin], starts[end], p, reach)
            for c in range(begin, end):
                first, last = starts[c], starts[c + 1]
                least = reach[first] if last == first + 1 else _least(reach, first, last)
                if log_weights[c] - half * least < best - tolerance:
                    continue
                distance, body, limit = np.inf, -1, np.inf
                # the body whose box is nearest goes first; after it hardly any other has to be evaluated
                b = first
                while b < last and reach[b] > least:
                    b += 1
                near = b
                others = first
                while b < last:
                    value = _distance(kinds[b], row(sizes, b), values, grids, grid[b], placed(to_body, b, p))
                    if value < distance:
                        distance, body, limit = value, b, max(value, 0.0) * max(value, 0.0)
                    if others == first:
                        # counting takes all at once, and mostly finds the first alone
                        alone = last == first + 1 or _within(reach, first, last, limit) == (
                            1 if least < limit or least == 0.0 else 0
                        )
                        if alone:
                            break
                    b = others
                    while b < last and (b == near or (reach[b] >= limit and reach[b] > 0.0)):
                        b += 1
                    others = b + 1
                term = log_weights[c] - half * distance * distance
                if term < best - tolerance:
                    continue
                best = max(best, term)
                candidates[kept], candidate_m[kept], candidate_body[kept] = c, distance, body
                kept += 1
        for k in range(kept):
            if log_weights[candidates[k]] - half * candidate_m[k] * candidate_m[k] < best - tolerance:
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
    for n in range(points.shape[0]):
        p, x, y, z = row(points, n), 0.0, 0.0, 0.0
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = nearest[pair]
            if weights[pair] == 0.0:
                continue
            q = placed(to_body, b, p)
            if kinds[b] == GRID:
                own = _grid_distance(values, grids, grid[b], q)[1]
            else:
                own = primitive_gradient(kinds[b], row(sizes, b), q)
            slope = turned_back(to_body, b, own)
            x += weights[pair] * slope[0]
            y += weights[pair] * slope[1]
            z += weights[pair] * slope[2]
        out[n, 0], out[n, 1], out[n, 2] = x, y, z


@njit(cache=True, nogil=True)
def distances_of(bodies, chosen, points, out):  # noqa: ANN001, ANN201
    """Distance of one body each at points: chosen (N,), points (N, 3), out (N,)."""
    kinds, sizes, to_body, grid, values, grids = bodies[:6]
    for n in range(points.shape[0]):
        b = chosen[n]
        out[n] = _distance(kinds[b], row(sizes, b), values, grids, grid[b], placed(to_body, b, row(points, n)))


@njit(cache=True, nogil=True)
def all_distances(bodies, points, out, nearest):  # noqa: ANN001, ANN201
    """Distances of the nearest body of every column: out (N, C), and which body it was: nearest (N, C)."""
    kinds, sizes, to_body, grid, values, grids, _, _, _, starts = bodies
    out[:] = np.inf
    nearest[:] = -1
    for n in range(points.shape[0]):
        p = row(points, n)
        for c in range(starts.shape[0] - 1):
            for b in range(starts[c], starts[c + 1]):
                value = _distance(kinds[b], row(sizes, b), values, grids, grid[b], placed(to_body, b, p))
                if value < out[n, c]:
                    out[n, c] = value
                    nearest[n, c] = b


@njit(cache=True, nogil=True)
def pair_log_weights(bodies, constants, values, points, row_starts, nearest, out):  # noqa: ANN001, ANN201
    """log weights of pairs of a point and a body, listed as `near_columns` does.

    Arguments:
        bodies: The arrays of all bodies.
        constants: log weight of each body as a whole, shape (B,).
        values: log weights of all grids of meshes, end to end; bodies of grid 0 have none.
        points, row_starts: As in `near_columns`.
        nearest: The body of each pair, -1 for none.
        out: Out: the log weights, shape (P,).
    """
    grid, to_body, grids = bodies.grid, bodies.to_body, bodies.grids
    for n in range(points.shape[0]):
        p = row(points, n)
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = nearest[pair]
            out[pair] = 0.0 if b < 0 else constants[b]
            if b >= 0 and grid[b] > 0:
                corners, fraction, _ = _cell(values, grids, grid[b], placed(to_body, b, p))
                out[pair] += _trilinear(corners, fraction)[0]


@njit(cache=True, nogil=True)
def add_log_weight_gradients(bodies, values, points, row_starts, nearest, weights, out):  # noqa: ANN001, ANN201
    """Add the gradients of sum_pairs weight * log weight of its body at the point to out (N, 3)."""
    grid, to_body, grids = bodies.grid, bodies.to_body, bodies.grids
    for n in range(points.shape[0]):
        p = row(points, n)
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = nearest[pair]
            if b < 0 or weights[pair] == 0.0 or grid[b] == 0:
                continue
            corners, fraction, excess = _cell(values, grids, grid[b], placed(to_body, b, p))
            slope, scale = _trilinear(corners, fraction)[1], weights[pair] * grids[grid[b], 6]
            # log weights stay the same beyond the faces of their grid
            x = scale * slope[0] if excess[0] == 0.0 else 0.0
            y = scale * slope[1] if excess[1] == 0.0 else 0.0
            z = scale * slope[2] if excess[2] == 0.0 else 0.0
            found = turned_back(to_body, b, (x, y, z))
            for k in range(3):
                out[n, k] += found[k]


@njit(cache=True, nogil=True, fastmath=BOXES)
def _entries(edges, first, last, origin, inverse, limit, out) -> None:  # noqa: ANN001
    """Fill `out` with the distances at which a ray enters boxes `first` to `last`; inf for those it misses."""
    (x, y, z), (by_x, by_y, by_z) = origin, inverse
    for b in range(first, last):
        left, right = (edges[0, b] - x) * by_x, (edges[3, b] - x) * by_x
        back, front = (edges[1, b] - y) * by_y, (edges[4, b] - y) * by_y
        under, over = (edges[2, b] - z) * by_z, (edges[5, b] - z) * by_z
        enters = max(max(min(left, right), min(back, front)), max(min(under, over), 0.0))
        leaves = min(min(max(left, right), max(back, front)), min(max(under, over), limit))
        out[b] = enters if enters <= leaves else np.inf


@njit(cache=True, nogil=True, inline="always")
def _inverse(value):  # noqa: ANN001, ANN202
    """The inverse of a number, finite for 0, so that crossings lie beyond every range."""
    return 1.0 / math.copysign(max(abs(value), TINY), value)


@njit(cache=True, nogil=True)
def first_hits(bodies, mesh_bounds, row_starts, columns, rays, hits, normals, out):  # noqa: ANN001, ANN201
    """First hits of rays on the primitives of columns, before a limit, and the meshes whose own box is met before that.

    Arguments:
        bodies: The arrays of all bodies.
        mesh_bounds: Low and high corners of the meshes in their own frames, by grid, shape (grids, 3) each [m].
        row_starts, columns: Ray-column pairs as `near_columns` lists them.
        rays: Origins (N, 3), directions of unit length (N, 3), and where rays end (N,) [m].
        hits: Out: ranges, infinite without a hit, shape (P,) [m].
        normals: Out: world normals that face the origin, shape (P, 3); zero without a hit.
        out: Rays, pairs and bodies of meshes, as many as there is room for.

    Returns:
        The number of meshes to cast at; where it is above the room, the call has to be repeated.
    """
    kinds, sizes, to_body, grid, starts = bodies.kinds, bodies.sizes, bodies.to_body, bodies.grid, bodies.starts
    (origins, directions, limits), (mesh_low, mesh_high), (out_rows, out_pairs, out_bodies) = rays, mesh_bounds, out
    edges, entries, meshes, room = bodies.edges, np.empty(kinds.shape[0]), 0, out_pairs.shape[0]
    for n in range(origins.shape[0]):
        origin, direction, seen = row(origins, n), row(directions, n), row_starts[n]
        inverse = _inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2])
        for pair in range(row_starts[n], row_starts[n + 1]):
            if pair == seen:
                # columns that follow each other are looked at together
                while seen < row_starts[n + 1] and columns[seen] == columns[pair] + seen - pair:
                    seen += 1
                _entries(
                    edges, starts[columns[pair]], starts[columns[seen - 1] + 1], origin, inverse, limits[n], entries
                )
            first, last, best, body = starts[columns[pair]], starts[columns[pair] + 1], limits[n], -1
            for b in range(first, last):
                if entries[b] >= best or kinds[b] == GRID:
                    continue
                near, far = primitive_roots(
                    kinds[b], row(sizes, b), placed(to_body, b, origin), turned(to_body, b, direction)
                )
                value = near if near >= 0.0 else far
                if value >= 0.0 and value < best:
                    best, body = value, b
            for b in range(first, last if mesh_low.shape[0] > 1 else first):
                if entries[b] >= best or kinds[b] != GRID:
                    continue
                near, far = box_roots(
                    row(mesh_low, grid[b]), row(mesh_high, grid[b]),
                    placed(to_body, b, origin), turned(to_body, b, direction),
                )  # fmt: skip
                if far >= 0.0 and near < best:
                    if meshes < room:
                        out_rows[meshes], out_pairs[meshes], out_bodies[meshes] = n, pair, b
                    meshes += 1
            x, y, z, hits[pair] = 0.0, 0.0, 0.0, np.inf
            if body >= 0:
                hits[pair] = best
                (x, y, z), cosine = normal_at_range(
                    kinds[body], row(sizes, body), to_body, body, origin, direction, best
                )
                if cosine > 0.0:
                    x, y, z = -x, -y, -z
            normals[pair, 0], normals[pair, 1], normals[pair, 2] = x, y, z
    return meshes


@njit(cache=True, nogil=True)
def rays_in_frames(to_body, chosen, rows, rays, out):  # noqa: ANN001, ANN201
    """Rays `rows` (K,) of origins and directions (N, 3) in the frames of the bodies `chosen` (K,): out (K, 3) each."""
    for k in range(rows.shape[0]):
        origin = placed(to_body, chosen[k], row(rays[0], rows[k]))
        direction = turned(to_body, chosen[k], row(rays[1], rows[k]))
        for axis in range(3):
            out[0][k, axis], out[1][k, axis] = origin[axis], direction[axis]


@njit(cache=True, nogil=True)
def _ellipsoid_distance(axes, q):  # noqa: ANN001, ANN202
    """Signed distance of an ellipsoid at a point in its own frame, and its gradient.

    The nearest point is e_i^2 q_i / (t + e_i^2), where t makes it lie on the surface (Eberly 2013, "Distance from a
    point to an ellipse, an ellipsoid, or a hyperellipsoid"). With w = 1 + t / e^2 for the smallest semi-axis e, the
    sum of squares is convex and falls in w > 0: Newton's steps from the left of its root never pass it.
    """
    least = min(axes[0], axes[1], axes[2])
    ratio, place, share = np.empty(3), np.empty(3), np.empty(3)
    w, inside = 0.0, 0.0
    for k in range(3):
        ratio[k] = (axes[k] / least) * (axes[k] / least)
        place[k] = abs(q[k]) / axes[k]
        inside += place[k] * place[k]
        if axes[k] == least:
            place[k] = max(place[k], OFF_MIDDLE)
        w = max(w, ratio[k] * (place[k] - 1.0) + 1.0)
    for _ in range(MOST_NEWTON_STEPS):
        value, slope = -1.0, 0.0
        for k in range(3):
            below = w + (ratio[k] - 1.0)
            part = ratio[k] * place[k] / below
            value += part * part
            slope += 2.0 * part * part / below
        step = value / slope
        w += step
        if step <= EPSILON * w:
            break
    squared, length = 0.0, 0.0
    for k in range(3):
        # the nearest point as a share of the semi-axis
        share[k] = ratio[k] * place[k] / (w + (ratio[k] - 1.0))
        away = axes[k] * share[k] - abs(q[k])
        squared += away * away
        share[k] *= (1.0 if q[k] >= 0.0 else -1.0) / axes[k]
        length += share[k] * share[k]
    length = math.sqrt(length)
    gradient = share[0] / length, share[1] / length, share[2] / length
    return math.sqrt(squared) * (-1.0 if inside < 1.0 else 1.0), gradient


@njit(cache=True, nogil=True, inline="always")
def primitive_distance(kind, size, q):  # noqa: ANN001, ANN201
    """Signed distance of any primitive at a point in its own frame."""
    x, y, z = q
    if kind in (SPHERE, CAPSULE):
        if kind == CAPSULE:
            z -= min(max(z, -size[1]), size[1])
        return math.sqrt(x * x + y * y + z * z) - size[0]
    if kind == BOX:
        x, y, z = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
        deepest = max(x, y, z)
        if deepest <= 0.0:
            return deepest
        x, y, z = max(x, 0.0), max(y, 0.0), max(z, 0.0)
        return math.sqrt(x * x + y * y + z * z)
    if kind == CYLINDER:
        side, end = math.sqrt(x * x + y * y) - size[0], abs(z) - size[1]
        if side <= 0.0 and end <= 0.0:
            return max(side, end)
        side, end = max(side, 0.0), max(end, 0.0)
        return math.sqrt(side * side + end * end)
    if kind == ELLIPSOID:
        return _ellipsoid_distance(size, q)[0]
    return z


@njit(cache=True, nogil=True)
def primitive_gradient(kind, size, q):  # noqa: ANN001, ANN201
    """The gradient of the signed distance of any primitive at a point in its own frame."""
    x, y, z = q
    if kind in (SPHERE, CAPSULE):
        if kind == CAPSULE:
            z -= min(max(z, -size[1]), size[1])
        length = math.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0.0 else 0.0
        return x * scale, y * scale, z * scale
    if kind == CYLINDER:
        radial = math.sqrt(x * x + y * y)
        side, end = radial - size[0], abs(z) - size[1]
        by_side, by_end = max(side, 0.0), max(end, 0.0)
        distance = math.sqrt(by_side * by_side + by_end * by_end)
        if distance > 0.0:
            by_side, by_end = by_side / distance, by_end / distance
        else:
            by_side, by_end = (1.0, 0.0) if side > end else (0.0, 1.0)
        outward = by_side / radial if radial > 0.0 else 0.0
        return outward * x, outward * y, by_end if z >= 0.0 else -by_end
    if kind == ELLIPSOID:
        return _ellipsoid_distance(size, q)[1]
    if kind == PLANE:
        return 0.0, 0.0, 1.0
    right, ahead, up = (1.0 if x >= 0.0 else -1.0), (1.0 if y >= 0.0 else -1.0), (1.0 if z >= 0.0 else -1.0)
    x, y, z = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
    deepest = max(x, y, z)
    if deepest > 0.0:
        x, y, z = max(x, 0.0), max(y, 0.0), max(z, 0.0)
        distance = math.sqrt(x * x + y * y + z * z)
        return x / distance * right, y / distance * ahead, z / distance * up
    if x == deepest:
        return right, 0.0, 0.0
    return (0.0, ahead, 0.0) if y == deepest else (0.0, 0.0, up)
