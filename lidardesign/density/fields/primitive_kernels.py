"""Compiled closed forms of single primitives in their own frames: signed distances, crossings by lines, normals.

Points, directions and sizes are tuples of three numbers: compiled loops keep them in registers, where arrays would cost
as much as the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.density.fields.bodies import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE
from lidardesign.numerics import EPSILON

# A point is taken to be at least so far from the middle plane of an ellipsoid, as a share of its smallest semi-axis:
# below it the two nearest points, above and below the plane, are one.
OFF_MIDDLE = EPSILON
MOST_NEWTON_STEPS = 60


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


@njit(cache=True, nogil=True, inline="always")
def _ball_roots(origin, direction, radius):  # noqa: ANN001, ANN202
    """Both crossings of a line with a ball, NaN where it passes by; |direction| is 1."""
    along = origin[0] * direction[0] + origin[1] * direction[1] + origin[2] * direction[2]
    x, y, z = origin[0] - along * direction[0], origin[1] - along * direction[1], origin[2] - along * direction[2]
    room = radius * radius - (x * x + y * y + z * z)
    if room < 0.0:
        return np.nan, np.nan
    half = math.sqrt(room)
    return -along - half, -along + half


@njit(cache=True, nogil=True)
def box_roots(low, high, origin, direction):  # noqa: ANN001, ANN201
    """Where a line enters and leaves a box between two corners; NaN where it passes."""
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
    """A line meets the side, or the cap on whose side it meets the endless cylinder (as in `primitives`)."""
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
    """Where a line is both between the planes of the ends and in the endless cylinder (as in `primitives`)."""
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
    """Stretched along its axes it is a ball of radius 1 (as in `primitives`)."""
    x, y, z = direction[0] / axes[0], direction[1] / axes[1], direction[2] / axes[2]
    length = math.sqrt(x * x + y * y + z * z)
    start = origin[0] / axes[0], origin[1] / axes[1], origin[2] / axes[2]
    near, far = _ball_roots(start, (x / length, y / length, z / length), 1.0)
    return near / length, far / length


@njit(cache=True, nogil=True)
def primitive_roots(kind, size, origin, direction):  # noqa: ANN001, ANN201
    """Where a line enters and leaves a primitive, NaN where it passes."""
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
