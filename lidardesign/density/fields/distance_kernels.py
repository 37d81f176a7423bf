"""Compiled closed forms of signed distances of single primitives in their own frames, and their gradients.

Points, directions and sizes are tuples of three numbers: compiled loops keep them in registers, where arrays would cost
as much as the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidardesign.numerics import EPSILON
from lidardesign.scenes.primitives import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE

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
