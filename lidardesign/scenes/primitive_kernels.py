"""Compiled loops that intersect rays with primitives in closed form, each in its own frame.

Points, directions and sizes are tuples of three numbers, which compiled loops keep in registers; arrays would cost as
much time as the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.scenes.surface import BALL_SLACK, BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE

BLOCK = 4096  # rays that are looked at together


@njit(cache=True, nogil=True, inline="always")
def row(values, n):  # noqa: ANN001, ANN201
    """Three numbers of a table as a tuple."""
    return values[n, 0], values[n, 1], values[n, 2]


@njit(cache=True, nogil=True, inline="always")
def turned(to_body, b, v):  # noqa: ANN001, ANN201
    """A world direction in the frame of body b."""
    return (
        to_body[b, 0, 0] * v[0] + to_body[b, 0, 1] * v[1] + to_body[b, 0, 2] * v[2],
        to_body[b, 1, 0] * v[0] + to_body[b, 1, 1] * v[1] + to_body[b, 1, 2] * v[2],
        to_body[b, 2, 0] * v[0] + to_body[b, 2, 1] * v[1] + to_body[b, 2, 2] * v[2],
    )


@njit(cache=True, nogil=True, inline="always")
def placed(to_body, b, p):  # noqa: ANN001, ANN201
    """A world point in the frame of body b."""
    x, y, z = turned(to_body, b, p)
    return x + to_body[b, 0, 3], y + to_body[b, 1, 3], z + to_body[b, 2, 3]


@njit(cache=True, nogil=True, inline="always")
def turned_back(to_body, b, v):  # noqa: ANN001, ANN201
    """A direction of the frame of body b in the world."""
    return (
        to_body[b, 0, 0] * v[0] + to_body[b, 1, 0] * v[1] + to_body[b, 2, 0] * v[2],
        to_body[b, 0, 1] * v[0] + to_body[b, 1, 1] * v[1] + to_body[b, 2, 1] * v[2],
        to_body[b, 0, 2] * v[0] + to_body[b, 1, 2] * v[1] + to_body[b, 2, 2] * v[2],
    )


@njit(cache=True, nogil=True, inline="always")
def _ball_roots(origin, direction, radius):  # noqa: ANN001, ANN202
    """Ranges at which a line enters and leaves a ball, NaN on a miss; |direction| is 1."""
    along = origin[0] * direction[0] + origin[1] * direction[1] + origin[2] * direction[2]
    x, y, z = origin[0] - along * direction[0], origin[1] - along * direction[1], origin[2] - along * direction[2]
    room = radius * radius - (x * x + y * y + z * z)
    if room < 0.0:
        return np.nan, np.nan
    half = math.sqrt(room)
    return -along - half, -along + half


@njit(cache=True, nogil=True)
def box_roots(low, high, origin, direction):  # noqa: ANN001, ANN201
    """Ranges at which a line enters and leaves a box between two corners, NaN on a miss."""
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
def _capsule_roots(size, origin, direction):  # noqa: ANN001, ANN202
    """Ranges at which a line enters and leaves a capsule, NaN on a miss.

    The crossing with the infinite cylinder selects side or cap, so that there is no seam for a ray to slip through.
    """
    radius, half_length = size[0], size[1]
    across = direction[0] * direction[0] + direction[1] * direction[1]
    near, far, half, along = np.nan, np.nan, 0.0, 0.0
    if across > 0.0:
        along = (origin[0] * direction[0] + origin[1] * direction[1]) / across
        x, y = origin[0] - along * direction[0], origin[1] - along * direction[1]
        room = radius * radius - x * x - y * y
        if room < 0.0:
            return near, far
        half = math.sqrt(room / across)
    for end in (-1.0, 1.0):
        side = -along + end * half
        height = origin[2] + side * direction[2] if across > 0.0 else end * direction[2] * np.inf
        value = side
        if not abs(height) <= half_length:
            cap = half_length if height > 0.0 else -half_length
            first, second = _ball_roots((origin[0], origin[1], origin[2] - cap), direction, radius)
            value = first if end < 0.0 else second
        if end < 0.0:
            near = value
        else:
            far = value
    return near, far


@njit(cache=True, nogil=True)
def _cylinder_roots(size, origin, direction):  # noqa: ANN001, ANN202
    """Ranges at which a line enters and leaves a cylinder, NaN on a miss."""
    radius, half_length = size[0], size[1]
    near, far = -np.inf, np.inf
    across = direction[0] * direction[0] + direction[1] * direction[1]
    along = (origin[0] * direction[0] + origin[1] * direction[1]) / across if across > 0.0 else 0.0
    x, y = origin[0] - along * direction[0], origin[1] - along * direction[1]
    room = radius * radius - x * x - y * y
    if room < 0.0:
        return np.nan, np.nan
    if across > 0.0:
        half = math.sqrt(room / across)
        near, far = -along - half, -along + half
    if direction[2] != 0.0:
        one, other = (-half_length - origin[2]) / direction[2], (half_length - origin[2]) / direction[2]
        near, far = max(near, min(one, other)), min(far, max(one, other))
    elif abs(origin[2]) > half_length:
        return np.nan, np.nan
    return (near, far) if near <= far else (np.nan, np.nan)


@njit(cache=True, nogil=True)
def _ellipsoid_roots(axes, origin, direction):  # noqa: ANN001, ANN202
    """Ranges at which a line enters and leaves an ellipsoid, scaled to the unit ball, NaN on a miss."""
    x, y, z = direction[0] / axes[0], direction[1] / axes[1], direction[2] / axes[2]
    length = math.sqrt(x * x + y * y + z * z)
    start = origin[0] / axes[0], origin[1] / axes[1], origin[2] / axes[2]
    near, far = _ball_roots(start, (x / length, y / length, z / length), 1.0)
    return near / length, far / length


@njit(cache=True, nogil=True)
def primitive_roots(kind, size, origin, direction):  # noqa: ANN001, ANN201
    """Ranges at which a line enters and leaves a primitive, NaN on a miss; a plane has one crossing."""
    if kind == SPHERE:
        return _ball_roots(origin, direction, size[0])
    if kind == BOX:
        return box_roots((-size[0], -size[1], -size[2]), size, origin, direction)
    if kind == CAPSULE:
        return _capsule_roots(size, origin, direction)
    if kind == CYLINDER:
        return _cylinder_roots(size, origin, direction)
    if kind == ELLIPSOID:
        return _ellipsoid_roots(size, origin, direction)
    if direction[2] == 0.0:
        return np.nan, np.nan
    return -origin[2] / direction[2], np.nan


@njit(cache=True, nogil=True)
def primitive_normal(kind, size, point):  # noqa: ANN001, ANN201
    """Outward normal of a primitive at a point on it, in its frame."""
    x, y, z = point
    if kind == PLANE:
        return 0.0, 0.0, 1.0
    if kind == BOX:
        across, along, above = abs(x) / size[0], abs(y) / size[1], abs(z) / size[2]
        if across >= along and across >= above:
            return 1.0 if x >= 0.0 else -1.0, 0.0, 0.0
        if along >= above:
            return 0.0, 1.0 if y >= 0.0 else -1.0, 0.0
        return 0.0, 0.0, 1.0 if z >= 0.0 else -1.0
    if kind == CYLINDER:
        radial = math.sqrt(x * x + y * y)
        if abs(z) * size[0] > radial * size[1]:
            return 0.0, 0.0, 1.0 if z >= 0.0 else -1.0
        return x / radial, y / radial, 0.0
    if kind == ELLIPSOID:
        x, y, z = x / size[0] ** 2, y / size[1] ** 2, z / size[2] ** 2
    elif kind == CAPSULE:
        z -= min(max(z, -size[1]), size[1])
    length = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    return x * scale, y * scale, z * scale


@njit(cache=True, nogil=True, inline="always")
def _passes(centre, radius, origin, direction, limit):  # noqa: ANN001, ANN202
    """True if a ray passes a ball before a limit."""
    x, y, z = centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2]
    along, squared = x * direction[0] + y * direction[1] + z * direction[2], x * x + y * y + z * z
    slack = BALL_SLACK * squared
    reach = radius + math.sqrt(slack)
    # without a short cut, many rays are tested at once
    return (squared - along * along <= radius * radius + slack) & (along >= -reach) & (along - reach <= limit)


@njit(cache=True, nogil=True)
def normal_at_range(kind, size, to_body, body, origin, direction, distance):  # noqa: ANN001, ANN201
    """Outward normal, in the world, of a primitive at a ray's range, and its cosine with the ray."""
    q, along = placed(to_body, body, origin), turned(to_body, body, direction)
    met = q[0] + distance * along[0], q[1] + distance * along[1], q[2] + distance * along[2]
    own = primitive_normal(kind, size, met)
    cosine = own[0] * along[0] + own[1] * along[1] + own[2] * along[2]
    return turned_back(to_body, body, own), cosine


@njit(cache=True, nogil=True)
def _keep_nearest(shapes, rays, count, passes, best, found) -> None:  # noqa: ANN001
    """Replace `best` (N,) and `found` (N,) of rays (6, N) by nearer primitives, body by body.

    Arguments:
        shapes: As in `keep_nearer`.
        rays: Origins and directions by axis, shape (6, N).
        count: How many of them are looked at.
        passes: Room for which rays pass a body's bounding ball, shape (N,).
        best, found: Ranges of the nearest hits [m] and their bodies, updated.
    """
    kinds, sizes, to_body, centres, radii, _ = shapes
    for b in range(kinds.shape[0]):
        for n in range(count):
            origin, direction = (rays[0, n], rays[1, n], rays[2, n]), (rays[3, n], rays[4, n], rays[5, n])
            passes[n] = _passes(row(centres, b), radii[b], origin, direction, best[n])
        for n in range(count):
            if not passes[n]:
                continue
            origin, direction = (rays[0, n], rays[1, n], rays[2, n]), (rays[3, n], rays[4, n], rays[5, n])
            near, far = primitive_roots(
                kinds[b], row(sizes, b), placed(to_body, b, origin), turned(to_body, b, direction)
            )
            value = near if near >= 0.0 else far
            if value >= 0.0 and value < best[n]:
                best[n], found[n] = value, b


@njit(cache=True, nogil=True)
def keep_nearer(shapes, origins, directions, limits, ranges, bodies, normals):  # noqa: ANN001, ANN201
    """Replace known hits of rays by nearer ones on primitives.

    Arguments:
        shapes: Kinds (B,), sizes (B, 3), world to body (B, 3, 4), centres (B, 3) and radii (B,) of bounding balls, and
            indices among all bodies (B,).
        origins, directions: Rays with directions of unit length, shape (N, 3).
        limits: Ends of the rays, shape (N,) [m].
        ranges, bodies, normals: Known hits, updated: shapes (N,), (N,) and (N, 3), normals outward in the world.
    """
    kinds, sizes, to_body, _, _, numbers = shapes
    total, size = origins.shape[0], min(origins.shape[0], BLOCK)
    by_axis, passes = np.empty((6, size)), np.empty(size, dtype=np.uint8)
    best, found = np.empty(size), np.empty(size, dtype=np.int64)
    for first in range(0, total, BLOCK):
        count = min(BLOCK, total - first)
        for n in range(count):
            for axis in range(3):
                by_axis[axis, n], by_axis[3 + axis, n] = origins[first + n, axis], directions[first + n, axis]
            best[n], found[n] = min(ranges[first + n], limits[first + n]), -1
        _keep_nearest(shapes, by_axis, count, passes, best, found)
        for n in range(count):
            b = found[n]
            if b < 0:
                continue
            origin, direction = row(origins, first + n), row(directions, first + n)
            ranges[first + n], bodies[first + n] = best[n], numbers[b]
            (x, y, z), _ = normal_at_range(kinds[b], row(sizes, b), to_body, b, origin, direction, best[n])
            normals[first + n, 0], normals[first + n, 1], normals[first + n, 2] = x, y, z


@njit(cache=True, nogil=True)
def passing(centre, radius, pose, origins, directions, bounds, rows, local, toward):  # noqa: ANN001, ANN201
    """Find the rays that pass a body's bounding ball before their bounds, and transform them into its frame.

    Arguments:
        centre, radius: Ball in the world, shape (3,) [m] and [m].
        pose: Pose of the body, shape (4, 4).
        origins, directions: Rays with directions of unit length, shape (N, 3).
        bounds: Ends of the rays, shape (N,) [m].
        rows, local, toward: Output: indices, origins and directions of these rays, shapes (N,), (N, 3) and (N, 3).

    Returns:
        The number of these rays.
    """
    found, ball = 0, (centre[0], centre[1], centre[2])
    for n in range(origins.shape[0]):
        origin, direction = row(origins, n), row(directions, n)
        if _passes(ball, radius, origin, direction, bounds[n]):
            x, y, z = origin[0] - pose[0, 3], origin[1] - pose[1, 3], origin[2] - pose[2, 3]
            for axis in range(3):
                local[found, axis] = x * pose[0, axis] + y * pose[1, axis] + z * pose[2, axis]
                toward[found, axis] = (
                    direction[0] * pose[0, axis] + direction[1] * pose[1, axis] + direction[2] * pose[2, axis]
                )
            rows[found] = n
            found += 1
    return found


@njit(cache=True, nogil=True)
def crossings(shapes, origins, directions, starts, limits, rows, ranges, cosines):  # noqa: ANN001, ANN201
    """Find the crossings of rays with primitives from starts up to limits, by ray, up to the size of the output.

    Arguments:
        shapes, origins, directions, limits: As in `keep_nearer`.
        starts: Starts of the rays, shape (N,) [m].
        rows, ranges, cosines: Output: index of the ray, range [m] and absolute cosine between normal and ray.

    Returns:
        The number of crossings; if it exceeds the size of the output, the call must be repeated with more room.
    """
    kinds, sizes, to_body, centres, radii, _ = shapes
    met, room = 0, rows.shape[0]
    for n in range(origins.shape[0]):
        origin, direction = row(origins, n), row(directions, n)
        for b in range(kinds.shape[0]):
            if not _passes(row(centres, b), radii[b], origin, direction, limits[n]):
                continue
            q, along = placed(to_body, b, origin), turned(to_body, b, direction)
            for value in primitive_roots(kinds[b], row(sizes, b), q, along):
                if value >= starts[n] and value < limits[n]:
                    if met < room:
                        _, cosine = normal_at_range(kinds[b], row(sizes, b), to_body, b, origin, direction, value)
                        rows[met], ranges[met], cosines[met] = n, value, abs(cosine)
                    met += 1
    return met
