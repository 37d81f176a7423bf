"""Compiled closed forms of single primitives in their own frames: signed distances, crossings by lines, normals."""

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
def _ellipsoid_distance(axes, q, gradient):  # noqa: ANN001, ANN202
    """Signed distance of an ellipsoid at a point in its own frame, with its gradient (3,).

    The nearest point is e_i^2 q_i / (t + e_i^2), where t makes it lie on the surface (Eberly 2013, "Distance from a
    point to an ellipse, an ellipsoid, or a hyperellipsoid"). With w = 1 + t / e^2 for the smallest semi-axis e, the
    sum of squares is convex and falls in w > 0: Newton's steps from the left of its root never pass it.
    """
    least = min(axes[0], axes[1], axes[2])
    w, inside = 0.0, 0.0
    for k in range(3):
        ratio = (axes[k] / least) * (axes[k] / least)
        place = abs(q[k]) / axes[k]
        inside += place * place
        if axes[k] == least:
            place = max(place, OFF_MIDDLE)
        w = max(w, ratio * (place - 1.0) + 1.0)
    for _ in range(MOST_NEWTON_STEPS):
        value, slope = -1.0, 0.0
        for k in range(3):
            ratio = (axes[k] / least) * (axes[k] / least)
            place = abs(q[k]) / axes[k]
            if axes[k] == least:
                place = max(place, OFF_MIDDLE)
            below = w + (ratio - 1.0)
            share = ratio * place / below
            value += share * share
            slope += 2.0 * share * share / below
        step = value / slope
        w += step
        if step <= EPSILON * w:
            break
    squared, length = 0.0, 0.0
    for k in range(3):
        ratio = (axes[k] / least) * (axes[k] / least)
        place = abs(q[k]) / axes[k]
        if axes[k] == least:
            place = max(place, OFF_MIDDLE)
        # the nearest point as a share of the semi-axis
        share = ratio * place / (w + (ratio - 1.0))
        away = axes[k] * share - abs(q[k])
        squared += away * away
        gradient[k] = share / axes[k] * (1.0 if q[k] >= 0.0 else -1.0)
        length += gradient[k] * gradient[k]
    for k in range(3):
        gradient[k] /= math.sqrt(length)
    return math.sqrt(squared) * (-1.0 if inside < 1.0 else 1.0)


@njit(cache=True, nogil=True)
def _cylinder_distance(radius, half_length, q, gradient):  # noqa: ANN001, ANN202
    """Signed distance of a cylinder at a point in its own frame, with its gradient (3,)."""
    radial = math.sqrt(q[0] * q[0] + q[1] * q[1])
    side, end = radial - radius, abs(q[2]) - half_length
    by_side, by_end = max(side, 0.0), max(end, 0.0)
    distance = math.sqrt(by_side * by_side + by_end * by_end)
    if distance > 0.0:
        by_side, by_end = by_side / distance, by_end / distance
    else:
        distance = max(side, end)
        by_side, by_end = (1.0, 0.0) if side > end else (0.0, 1.0)
    gradient[0] = by_side * q[0] / radial if radial > 0.0 else 0.0
    gradient[1] = by_side * q[1] / radial if radial > 0.0 else 0.0
    gradient[2] = by_end if q[2] >= 0.0 else -by_end
    return distance


@njit(cache=True, nogil=True)
def primitive_distance(kind, size, q, gradient):  # noqa: ANN001, ANN201
    """Signed distance of any primitive but a sphere at a point in its own frame, with its gradient (3,)."""
    if kind == CYLINDER:
        return _cylinder_distance(size[0], size[1], q, gradient)
    if kind == ELLIPSOID:
        return _ellipsoid_distance(size, q, gradient)
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
def box_roots(low, high, origin, direction):  # noqa: ANN001, ANN201
    """Where a line enters and leaves a box between two corners (3,) each; NaN where it passes."""
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
def _cylinder_roots(radius, half_length, origin, direction):  # noqa: ANN001, ANN202
    """Where a line is both between the planes of the ends and in the endless cylinder (as in `primitives`)."""
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
    start, along, length = np.empty(3), np.empty(3), 0.0
    for k in range(3):
        start[k], along[k] = origin[k] / axes[k], direction[k] / axes[k]
        length += along[k] * along[k]
    length = math.sqrt(length)
    for k in range(3):
        along[k] /= length
    near, far = _ball_roots(start, along, 1.0)
    return near / length, far / length


@njit(cache=True, nogil=True)
def primitive_roots(kind, size, origin, direction, work):  # noqa: ANN001, ANN201
    """Where a line enters and leaves a primitive, NaN where it passes; `work` (3,) is overwritten."""
    if kind == SPHERE:
        return _ball_roots(origin, direction, size[0])
    if kind == BOX:
        for k in range(3):
            work[k] = -size[k]
        return box_roots(work, size, origin, direction)
    if kind == CAPSULE:
        return _capsule_roots(size, origin, direction, work)
    if kind == CYLINDER:
        return _cylinder_roots(size[0], size[1], origin, direction)
    if kind == ELLIPSOID:
        return _ellipsoid_roots(size, origin, direction)
    if direction[2] == 0.0:
        return np.nan, np.nan
    return -origin[2] / direction[2], np.nan


@njit(cache=True, nogil=True, inline="always")
def primitive_normal(kind, size, point, out):  # noqa: ANN001, ANN201
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
    elif kind == CYLINDER:
        radial = math.sqrt(point[0] * point[0] + point[1] * point[1])
        if abs(point[2]) * size[0] > radial * size[1]:
            out[2] = 1.0 if point[2] >= 0.0 else -1.0
        else:
            out[0], out[1] = point[0] / radial, point[1] / radial
    elif kind == ELLIPSOID:
        x, y, z = point[0] / size[0] ** 2, point[1] / size[1] ** 2, point[2] / size[2] ** 2
        length = math.sqrt(x * x + y * y + z * z)
        out[0], out[1], out[2] = x / length, y / length, z / length
    else:
        z = point[2] - min(max(point[2], -size[1]), size[1]) if kind == CAPSULE else point[2]
        length = math.sqrt(point[0] * point[0] + point[1] * point[1] + z * z)
        if length > 0.0:
            out[0], out[1], out[2] = point[0] / length, point[1] / length, z / length
