"""Compiled loops over grid tables: distances, contracted gradients, the visibility quadrature.

A table holds the distances of all C columns (scenes, or frames of scenes) at every grid point in one row, so that the
eight corners of a cell are eight contiguous reads. Gradients are never formed per column: a caller hands in one weight
per column and gets the weighted sum, which costs one more pass over the same rows.

Outside the grid a point p with nearest grid point q gets sqrt(|p - q|^2 + d(q)^2), a lower bound of the distance
because the surface lies inside the convex box; it is continuous across the box's faces.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# exp(x) = 2^n p(r) in float32: x = n ln 2 + r, |r| <= ln 2 / 2; Cody and Waite's two-part ln 2, p from Cephes expf.
LOG2_E = np.float32(1.44269504088896341)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
EXP_POLYNOMIAL = tuple(
    np.float32(c)
    for c in (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
)
EXPONENT_LIMIT = np.float32(60.0)
FLOAT32_BIAS, FLOAT32_MANTISSA_BITS = 127, 23
# Reassociation vectorises the sums; NaN and infinity keep their meaning (no `nnan`, no `ninf`).
FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, nogil=True, inline="always")
def locate(counts, low, inverse_step, p, cell, fraction, excess):  # noqa: ANN001, ANN201
    """Cell, fraction in it and excess beyond the grid of one point; returns the squared excess."""
    squared = 0.0
    for k in range(3):
        t = (p[k] - low[k]) * inverse_step
        top = counts[k] - 1.0
        clamped = min(max(t, 0.0), top)
        excess[k] = (t - clamped) / inverse_step
        squared += excess[k] * excess[k]
        cell[k] = min(int(clamped), counts[k] - 2)
        fraction[k] = clamped - cell[k]
    return squared


@njit(cache=True, nogil=True, inline="always")
def corners(counts, cell, fraction, index, weight):  # noqa: ANN001, ANN201
    """Row indices and trilinear weights of a cell's eight corners."""
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1
        index[corner] = ((cell[0] + i) * counts[1] + cell[1] + j) * counts[2] + cell[2] + k
        wx = fraction[0] if i else 1.0 - fraction[0]
        wy = fraction[1] if j else 1.0 - fraction[1]
        wz = fraction[2] if k else 1.0 - fraction[2]
        weight[corner] = wx * wy * wz


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _blend(table, index, weight, out):  # noqa: ANN001, ANN202
    """The eight rows summed with their weights, shape (C,)."""
    w0, w1, w2, w3 = weight[0], weight[1], weight[2], weight[3]
    w4, w5, w6, w7 = weight[4], weight[5], weight[6], weight[7]
    r0, r1, r2, r3 = table[index[0]], table[index[1]], table[index[2]], table[index[3]]
    r4, r5, r6, r7 = table[index[4]], table[index[5]], table[index[6]], table[index[7]]
    for c in range(table.shape[1]):
        out[c] = w0 * r0[c] + w1 * r1[c] + w2 * r2[c] + w3 * r3[c] + w4 * r4[c] + w5 * r5[c] + w6 * r6[c] + w7 * r7[c]


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _contract(table, index, column_weight, fraction, inverse_step, dots, out):  # noqa: ANN001, ANN202
    """Gradient of sum_c weight_c * d_c inside one cell, added to out (3,); `dots` (8,) is room to work in."""
    for corner in range(8):
        row = table[index[corner]]
        total = 0.0
        for c in range(table.shape[1]):
            total += row[c] * column_weight[c]
        dots[corner] = total
    fx, fy, fz = fraction[0], fraction[1], fraction[2]
    gx = gy = gz = 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1
        wx = fx if i else 1.0 - fx
        wy = fy if j else 1.0 - fy
        wz = fz if k else 1.0 - fz
        gx += (1.0 if i else -1.0) * wy * wz * dots[corner]
        gy += (1.0 if j else -1.0) * wx * wz * dots[corner]
        gz += (1.0 if k else -1.0) * wx * wy * dots[corner]
    out[0] += gx * inverse_step
    out[1] += gy * inverse_step
    out[2] += gz * inverse_step


@njit(cache=True, nogil=True, fastmath=FAST)
def table_distances(field, points, out):  # noqa: ANN001, ANN201
    """Distances of all columns at points: points (N, 3), out (N, C)."""
    table, counts, low, inverse_step = field.table, field.counts, field.low, field.inverse_step
    cell, fraction, excess = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    index, weight = np.zeros(8, np.int64), np.zeros(8, table.dtype)
    for n in range(points.shape[0]):
        squared = locate(counts, low, inverse_step, points[n], cell, fraction, excess)
        corners(counts, cell, fraction, index, weight)
        _blend(table, index, weight, out[n])
        if squared > 0.0:
            for c in range(table.shape[1]):
                inner = max(out[n, c], 0.0)
                out[n, c] = math.sqrt(squared + inner * inner)


@njit(cache=True, nogil=True, fastmath=FAST)
def table_gradient(field, points, weights, out):  # noqa: ANN001, ANN201
    """Gradients of sum_c weights_nc * d_c(points_n): weights (N, C), out (N, 3)."""
    table, counts, low, inverse_step = field.table, field.counts, field.low, field.inverse_step
    columns = table.shape[1]
    cell, fraction, excess = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    index, corner_weight = np.zeros(8, np.int64), np.zeros(8, table.dtype)
    row, column_weight = np.zeros(columns, table.dtype), np.zeros(columns)
    gradient, dots = np.zeros(3), np.zeros(8)
    for n in range(points.shape[0]):
        squared = locate(counts, low, inverse_step, points[n], cell, fraction, excess)
        corners(counts, cell, fraction, index, corner_weight)
        gradient[:] = 0.0
        outward = 0.0
        for c in range(columns):
            column_weight[c] = weights[n, c]
        if squared > 0.0:
            _blend(table, index, corner_weight, row)
            for c in range(columns):
                inner = max(row[c], 0.0)
                share = column_weight[c] / math.sqrt(squared + inner * inner)
                outward += share
                column_weight[c] = share * inner
        _contract(table, index, column_weight, fraction, inverse_step, dots, gradient)
        for k in range(3):
            out[n, k] = outward * excess[k] if excess[k] != 0.0 else gradient[k]


@njit(cache=True, nogil=True)
def cell_minimum(table, counts, out):  # noqa: ANN001, ANN201
    """The smallest distance of any column at any corner of each cell, stored at its first corner: out (G,)."""
    columns = table.shape[1]
    smallest = np.empty(table.shape[0], table.dtype)
    for g in range(table.shape[0]):
        value = table[g, 0]
        for c in range(1, columns):
            value = min(value, table[g, c])
        smallest[g] = value
    for i in range(counts[0]):
        for j in range(counts[1]):
            for k in range(counts[2]):
                value = np.inf
                for corner in range(8):
                    a = min(i + (corner & 1), counts[0] - 1)
                    b = min(j + ((corner >> 1) & 1), counts[1] - 1)
                    c = min(k + ((corner >> 2) & 1), counts[2] - 1)
                    value = min(value, smallest[(a * counts[1] + b) * counts[2] + c])
                out[(i * counts[1] + j) * counts[2] + k] = value


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _insides(distance, sharpness, bits, powers, out):  # noqa: ANN001, ANN202
    """sigmoid(-sharpness * distance) of float32 distances (C,), to float32 rounding: `math.exp` does not vectorise.

    `bits` (int32) and `powers` (float32) are the same memory: 2^n is written as bits and read as a number.
    """
    c0, c1, c2, c3, c4, c5 = EXP_POLYNOMIAL
    one, half = np.float32(1.0), np.float32(0.5)
    for c in range(distance.shape[0]):
        x = min(max(sharpness * distance[c], -EXPONENT_LIMIT), EXPONENT_LIMIT)
        n = np.floor(x * LOG2_E + half)
        r = x - n * LN2_HIGH - n * LN2_LOW
        out[c] = ((((((c0 * r + c1) * r + c2) * r + c3) * r + c4) * r + c5) * r * r + r) + one
        bits[c] = (np.int32(n) + FLOAT32_BIAS) << FLOAT32_MANTISSA_BITS
    for c in range(distance.shape[0]):
        out[c] = one / (one + powers[c] * out[c])


@njit(cache=True, nogil=True, fastmath=FAST)
def table_quadrature(field, clear, shell, rays, points_per_ray, attenuation, sharpness, cutoff, depth, slope) -> None:  # noqa: ANN001
    """Optical depths along rays by midpoints, and the slopes that their gradient needs.

    Cells whose every column is further than `cutoff` from a surface cannot attenuate and are never read.

    Arguments:
        field: The table of distances.
        clear: The smallest distance in each cell, shape (G,).
        shell: Half thickness of surfaces without an inside, per column, shape (C,) [m].
        rays: Origins (N, 3), directions (N, 3) and lengths (N,) that are integrated from 0 [m].
        points_per_ray: The number of midpoints.
        attenuation, sharpness: beta and k [1/m].
        depth: Out: integral of attenuation * sigmoid(-sharpness * d), shape (N, C).
        slope: Out: derivative of the integrand by the distance times the step, shape (N, M, C); pass shape
            (0, 0, 0) when no gradient is needed.
    """
    table, counts, low, inverse_step = field.table, field.counts, field.low, field.inverse_step
    origins, directions, lengths = rays
    columns = table.shape[1]
    cell, fraction, excess, p = np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3)
    index, weight, row = np.zeros(8, np.int64), np.zeros(8, table.dtype), np.zeros(columns, table.dtype)
    inside, bits = np.zeros(columns, np.float32), np.zeros(columns, np.int32)
    powers, total = bits.view(np.float32), np.zeros(columns, np.float32)
    steepness, one, thickness = np.float32(sharpness), np.float32(1.0), shell.astype(np.float32)
    keep = slope.shape[0] > 0
    for n in range(origins.shape[0]):
        step = lengths[n] / points_per_ray
        total[:] = 0.0
        for m in range(points_per_ray):
            along = (m + 0.5) * step
            for k in range(3):
                p[k] = origins[n, k] + along * directions[n, k]
            squared = locate(counts, low, inverse_step, p, cell, fraction, excess)
            first = (cell[0] * counts[1] + cell[1]) * counts[2] + cell[2]
            if squared > cutoff * cutoff or clear[first] > cutoff:
                continue
            corners(counts, cell, fraction, index, weight)
            _blend(table, index, weight, row)
            if squared > 0.0:
                for c in range(columns):
                    inner = max(row[c], 0.0)
                    row[c] = math.sqrt(squared + inner * inner)
            for c in range(columns):
                row[c] -= thickness[c]
            _insides(row, steepness, bits, powers, inside)
            for c in range(columns):
                total[c] += inside[c]
            if keep:
                factor = np.float32(-attenuation * step * sharpness)
                for c in range(columns):
                    slope[n, m, c] = factor * inside[c] * (one - inside[c])
        for c in range(columns):
            depth[n, c] = attenuation * step * total[c]


@njit(cache=True, nogil=True, fastmath=FAST)
def table_quadrature_gradient(field, clear, rays, cutoff, slope, weights, by_origin, by_direction, by_length) -> None:  # noqa: ANN001
    """Gradients of sum_c weights_nc * depth_nc by origin (N, 3), direction (N, 3) and length (N,), at fixed step.

    The caller adds the derivative by the step itself, which is depth / length.
    """
    table, counts, low, inverse_step = field.table, field.counts, field.low, field.inverse_step
    origins, directions, lengths = rays
    columns = table.shape[1]
    points_per_ray = slope.shape[1]
    cell, fraction, excess, p = np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3)
    index, corner_weight = np.zeros(8, np.int64), np.zeros(8, table.dtype)
    row, column_weight = np.zeros(columns, table.dtype), np.zeros(columns, table.dtype)
    share, gradient, dots = np.zeros(columns, table.dtype), np.zeros(3), np.zeros(8)
    for n in range(origins.shape[0]):
        step = lengths[n] / points_per_ray
        for c in range(columns):
            share[c] = weights[n, c]
        for m in range(points_per_ray):
            along = (m + 0.5) * step
            for k in range(3):
                p[k] = origins[n, k] + along * directions[n, k]
            squared = locate(counts, low, inverse_step, p, cell, fraction, excess)
            first = (cell[0] * counts[1] + cell[1]) * counts[2] + cell[2]
            if squared > cutoff * cutoff or clear[first] > cutoff:
                continue
            for c in range(columns):
                column_weight[c] = share[c] * slope[n, m, c]
            corners(counts, cell, fraction, index, corner_weight)
            outward = 0.0
            if squared > 0.0:
                _blend(table, index, corner_weight, row)
                for c in range(columns):
                    inner = max(row[c], 0.0)
                    pull = column_weight[c] / math.sqrt(squared + inner * inner)
                    outward += pull
                    column_weight[c] = pull * inner
            gradient[:] = 0.0
            _contract(table, index, column_weight, fraction, inverse_step, dots, gradient)
            for k in range(3):
                value = outward * excess[k] if excess[k] != 0.0 else gradient[k]
                by_origin[n, k] += value
                by_direction[n, k] += along * value
                by_length[n] += (m + 0.5) / points_per_ray * value * directions[n, k]


@njit(cache=True, nogil=True, inline="always")
def trilinear_slope(values, fraction, axis):  # noqa: ANN001, ANN201
    """The derivative of a cell's trilinear value along an axis, per step; values (8,) at its corners."""
    total = 0.0
    for corner in range(8):
        share = 1.0 if (corner >> axis) & 1 else -1.0
        for k in range(3):
            if k != axis:
                share *= fraction[k] if (corner >> k) & 1 else 1.0 - fraction[k]
        total += share * values[corner]
    return total


@njit(cache=True, nogil=True, fastmath=FAST)
def table_values(field, points, out):  # noqa: ANN001, ANN201
    """Values of all columns at points, constant beyond the grid's faces: points (N, 3), out (N, C)."""
    table, counts, low, inverse_step = field.table, field.counts, field.low, field.inverse_step
    cell, fraction, excess = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    index, weight = np.zeros(8, np.int64), np.zeros(8, table.dtype)
    for n in range(points.shape[0]):
        locate(counts, low, inverse_step, points[n], cell, fraction, excess)
        corners(counts, cell, fraction, index, weight)
        for c in range(table.shape[1]):
            out[n, c] = 0.0
        for corner in range(8):
            share, row = weight[corner], table[index[corner]]
            for c in range(table.shape[1]):
                out[n, c] += share * row[c]


@njit(cache=True, nogil=True, fastmath=FAST)
def table_value_gradient(field, points, weights, out):  # noqa: ANN001, ANN201
    """Gradients of sum_c weights_nc * value_c(points_n): weights (N, C), out (N, 3)."""
    table, counts, low, inverse_step = field.table, field.counts, field.low, field.inverse_step
    cell, fraction, excess = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    index, corner_weight, dots = np.zeros(8, np.int64), np.zeros(8), np.zeros(8)
    for n in range(points.shape[0]):
        locate(counts, low, inverse_step, points[n], cell, fraction, excess)
        corners(counts, cell, fraction, index, corner_weight)
        for corner in range(8):
            row, total = table[index[corner]], 0.0
            for c in range(table.shape[1]):
                total += row[c] * weights[n, c]
            dots[corner] = total
        for axis in range(3):
            out[n, axis] = trilinear_slope(dots, fraction, axis) * inverse_step if excess[axis] == 0.0 else 0.0
