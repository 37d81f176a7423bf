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
# Elements that compiled loops take at a time.
UNROLLED = 32
# Reassociation vectorises the sums; NaN and infinity keep their meaning (no `nnan`, no `ninf`).
FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, nogil=True, inline="always")
def along_axis(low, count, inverse_step, place):  # noqa: ANN001, ANN201
    """Cell, fraction in it and excess beyond the grid of a coordinate."""
    t = (place - low) * inverse_step
    inside = min(max(t, 0.0), count - 1.0)
    cell = min(int(inside), int(count) - 2)
    return cell, inside - cell, (t - inside) / inverse_step


@njit(cache=True, nogil=True, inline="always")
def _cell(counts, low, inverse_step, x, y, z):  # noqa: ANN001, ANN202
    """The row of the first corner of a point's cell, fractions in the cell and excess beyond the grid."""
    i, fx, ex = along_axis(low[0], counts[0], inverse_step, x)
    j, fy, ey = along_axis(low[1], counts[1], inverse_step, y)
    k, fz, ez = along_axis(low[2], counts[2], inverse_step, z)
    return (i * counts[1] + j) * counts[2] + k, (fx, fy, fz), (ex, ey, ez)


@njit(cache=True, nogil=True, inline="always")
def _squared(v):  # noqa: ANN001, ANN202
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@njit(cache=True, nogil=True, inline="always")
def _corners(counts, first):  # noqa: ANN001, ANN202
    """The rows of the eight corners of a cell: x changes first, z last."""
    up, across = counts[2], counts[1] * counts[2]
    return (
        (first, first + across, first + up, first + across + up),
        (first + 1, first + across + 1, first + up + 1, first + across + up + 1),
    )


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _blend(table, corners, fraction, out):  # noqa: ANN001, ANN202
    """The rows of a cell's corners summed with their trilinear weights, shape (C,)."""
    (a, b, c, d), (e, f, g, h), (x, y, z) = corners[0], corners[1], fraction
    wa, wb = np.float32((1.0 - x) * (1.0 - y) * (1.0 - z)), np.float32(x * (1.0 - y) * (1.0 - z))
    wc, wd = np.float32((1.0 - x) * y * (1.0 - z)), np.float32(x * y * (1.0 - z))
    we, wf = np.float32((1.0 - x) * (1.0 - y) * z), np.float32(x * (1.0 - y) * z)
    wg, wh = np.float32((1.0 - x) * y * z), np.float32(x * y * z)
    for n in range(table.shape[1]):
        low = wa * table[a, n] + wb * table[b, n] + wc * table[c, n] + wd * table[d, n]
        out[n] = low + we * table[e, n] + wf * table[f, n] + wg * table[g, n] + wh * table[h, n]


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _contract(table, corners, fraction, column_weight, zero):  # noqa: ANN001, ANN202
    """Derivatives of sum_c weight_c * value_c by the axes inside one cell, per step; summed in the type of `zero`."""
    (a, b, c, d), (e, f, g, h), (x, y, z) = corners[0], corners[1], fraction
    sa = sb = sc = sd = se = sf = sg = sh = zero
    for n in range(table.shape[1]):
        weight = column_weight[n]
        sa += table[a, n] * weight
        sb += table[b, n] * weight
        sc += table[c, n] * weight
        sd += table[d, n] * weight
        se += table[e, n] * weight
        sf += table[f, n] * weight
        sg += table[g, n] * weight
        sh += table[h, n] * weight
    by_x = (1.0 - z) * ((1.0 - y) * (sb - sa) + y * (sd - sc)) + z * ((1.0 - y) * (sf - se) + y * (sh - sg))
    by_y = (1.0 - z) * ((1.0 - x) * (sc - sa) + x * (sd - sb)) + z * ((1.0 - x) * (sg - se) + x * (sh - sf))
    by_z = (1.0 - y) * ((1.0 - x) * (se - sa) + x * (sf - sb)) + y * ((1.0 - x) * (sg - sc) + x * (sh - sd))
    return by_x, by_y, by_z


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _lengthen(row, squared):  # noqa: ANN001, ANN202
    """Turn distances (C,) on a face of the grid into those of a point beyond it, in place."""
    for c in range(row.shape[0]):
        inner = max(row[c], 0.0)
        row[c] = math.sqrt(squared + inner * inner)


@njit(cache=True, nogil=True, fastmath=FAST)
def table_distances(field, points, out):  # noqa: ANN001, ANN201
    """Distances of all columns at points: points (N, 3), out (N, C)."""
    table, inverse_step = field.table, field.inverse_step
    counts, low = (field.counts[0], field.counts[1], field.counts[2]), (field.low[0], field.low[1], field.low[2])
    for n in range(points.shape[0]):
        first, fraction, excess = _cell(counts, low, inverse_step, points[n, 0], points[n, 1], points[n, 2])
        _blend(table, _corners(counts, first), fraction, out[n])
        if _squared(excess) > 0.0:
            _lengthen(out[n], _squared(excess))


@njit(cache=True, nogil=True, fastmath=FAST)
def table_gradient(field, points, weights, out):  # noqa: ANN001, ANN201
    """Gradients of sum_c weights_nc * d_c(points_n): weights (N, C), out (N, 3)."""
    table, inverse_step = field.table, field.inverse_step
    counts, low = (field.counts[0], field.counts[1], field.counts[2]), (field.low[0], field.low[1], field.low[2])
    row, column_weight = np.zeros(table.shape[1], table.dtype), np.zeros(table.shape[1])
    for n in range(points.shape[0]):
        first, fraction, excess = _cell(counts, low, inverse_step, points[n, 0], points[n, 1], points[n, 2])
        corners, squared, outward = _corners(counts, first), _squared(excess), 0.0
        for c in range(table.shape[1]):
            column_weight[c] = weights[n, c]
        if squared > 0.0:
            _blend(table, corners, fraction, row)
            outward = _pulled(row, squared, column_weight)
        slope = _contract(table, corners, fraction, column_weight, 0.0)
        for k in range(3):
            out[n, k] = outward * excess[k] if excess[k] != 0.0 else slope[k] * inverse_step


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _pulled(row, squared, column_weight):  # noqa: ANN001, ANN202
    """Turn weights (C,) of a point beyond the grid into those of its face; return that of the outward pull."""
    outward = 0.0
    for c in range(row.shape[0]):
        inner = max(row[c], 0.0)
        share = column_weight[c] / math.sqrt(squared + inner * inner)
        outward += share
        column_weight[c] = share * inner
    return outward


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
def table_quadrature(field, clear, shell, rays, points_per_ray, attenuation, sharpness, cutoff, depth, slopes) -> None:  # noqa: ANN001
    """Optical depths along rays by midpoints, and the slopes that their gradient needs.

    Cells whose every column is further than `cutoff` from a surface cannot attenuate and are never read.

    Arguments:
        field: The table of distances.
        clear: The smallest distance in each cell, shape (G,).
        shell: Half thickness of surfaces without an inside, per column, shape (C,) [m].
        rays: Origins (N, 3), directions (N, 3) and lengths (N,) that are integrated from 0 [m].
        points_per_ray: The number of midpoints, M.
        attenuation, sharpness: beta and k [1/m].
        cutoff: The distance beyond which nothing attenuates [m].
        depth: Out: integral of attenuation * sigmoid(-sharpness * d), shape (N, C).
        slopes: Out: where the midpoints that attenuate begin for each ray (N + 1,), which these are (N M,), and the
            derivatives of the integrand by the distances there, times the step, shape (N M, C); (0, 0) when no
            gradient is needed.
    """
    table, inverse_step = field.table, field.inverse_step
    counts, low = (field.counts[0], field.counts[1], field.counts[2]), (field.low[0], field.low[1], field.low[2])
    (origins, directions, lengths), (starts, midpoints, slope) = rays, slopes
    columns, keep, kept = table.shape[1], slope.shape[0] > 0, 0
    # room for whole turns of the loops: what is left over would be taken one by one
    wide = -(-columns // UNROLLED) * UNROLLED
    row, inside, bits = np.zeros(wide, table.dtype), np.zeros(wide, np.float32), np.zeros(wide, np.int32)
    powers, total, thickness = bits.view(np.float32), np.zeros(wide, np.float32), np.zeros(wide, np.float32)
    steepness, one = np.float32(sharpness), np.float32(1.0)
    thickness[:columns] = shell
    for n in range(origins.shape[0]):
        step = lengths[n] / points_per_ray
        total[:] = 0.0
        for m in range(points_per_ray):
            along = (m + 0.5) * step
            first, fraction, excess = _cell(
                counts, low, inverse_step,
                origins[n, 0] + along * directions[n, 0],
                origins[n, 1] + along * directions[n, 1],
                origins[n, 2] + along * directions[n, 2],
            )  # fmt: skip
            squared = _squared(excess)
            if squared > cutoff * cutoff or clear[first] > cutoff:
                continue
            _blend(table, _corners(counts, first), fraction, row)
            if squared > 0.0:
                _lengthen(row, squared)
            for c in range(wide):
                row[c] -= thickness[c]
            _insides(row, steepness, bits, powers, inside)
            for c in range(wide):
                total[c] += inside[c]
            if keep:
                factor = np.float32(-attenuation * step * sharpness)
                for c in range(columns):
                    slope[kept, c] = factor * inside[c] * (one - inside[c])
                midpoints[kept] = m
                kept += 1
        if keep:
            starts[n + 1] = kept
        for c in range(columns):
            depth[n, c] = attenuation * step * total[c]


@njit(cache=True, nogil=True, fastmath=FAST)
def table_quadrature_gradient(field, rays, points_per_ray, slopes, least, weights, out) -> None:  # noqa: ANN001
    """Add the gradients of sum_c weights_nc * depth_nc to `out`: by origin (N, 3), direction (N, 3) and length (N,).

    The step stays the same here; the caller adds the derivative by it, which is depth / length. Midpoints whose
    weighted slopes come to less than `least` [1/m] are passed over.
    """
    table, inverse_step = field.table, field.inverse_step
    counts, low = (field.counts[0], field.counts[1], field.counts[2]), (field.low[0], field.low[1], field.low[2])
    (origins, directions, lengths), (starts, midpoints, slope) = rays, slopes
    by_origin, by_direction, by_length = out
    columns, zero = table.shape[1], np.float32(0.0)
    row, column_weight = np.zeros(columns, table.dtype), np.zeros(columns, table.dtype)
    share = np.zeros(columns, table.dtype)
    for n in range(origins.shape[0]):
        step = lengths[n] / points_per_ray
        for c in range(columns):
            share[c] = weights[n, c]
        for kept in range(starts[n], starts[n + 1]):
            followed = zero
            for c in range(columns):
                column_weight[c] = share[c] * slope[kept, c]
                followed += abs(column_weight[c])
            if followed < least:
                continue
            along = (midpoints[kept] + 0.5) * step
            first, fraction, excess = _cell(
                counts, low, inverse_step,
                origins[n, 0] + along * directions[n, 0],
                origins[n, 1] + along * directions[n, 1],
                origins[n, 2] + along * directions[n, 2],
            )  # fmt: skip
            corners, squared, outward = _corners(counts, first), _squared(excess), 0.0
            if squared > 0.0:
                _blend(table, corners, fraction, row)
                outward = _pulled(row, squared, column_weight)
            found = _contract(table, corners, fraction, column_weight, zero)
            for k in range(3):
                value = outward * excess[k] if excess[k] != 0.0 else found[k] * inverse_step
                by_origin[n, k] += value
                by_direction[n, k] += along * value
                by_length[n] += (midpoints[kept] + 0.5) / points_per_ray * value * directions[n, k]


@njit(cache=True, nogil=True, fastmath=FAST)
def table_values(field, points, out):  # noqa: ANN001, ANN201
    """Values of all columns at points, constant beyond the grid's faces: points (N, 3), out (N, C)."""
    counts, low = (field.counts[0], field.counts[1], field.counts[2]), (field.low[0], field.low[1], field.low[2])
    for n in range(points.shape[0]):
        first, fraction, _ = _cell(counts, low, field.inverse_step, points[n, 0], points[n, 1], points[n, 2])
        _blend(field.table, _corners(counts, first), fraction, out[n])


@njit(cache=True, nogil=True, fastmath=FAST)
def table_value_gradient(field, points, weights, out):  # noqa: ANN001, ANN201
    """Gradients of sum_c weights_nc * value_c(points_n): weights (N, C), out (N, 3)."""
    counts, low = (field.counts[0], field.counts[1], field.counts[2]), (field.low[0], field.low[1], field.low[2])
    for n in range(points.shape[0]):
        first, fraction, excess = _cell(counts, low, field.inverse_step, points[n, 0], points[n, 1], points[n, 2])
        found = _contract(field.table, _corners(counts, first), fraction, weights[n], 0.0)
        for k in range(3):
            out[n, k] = found[k] * field.inverse_step if excess[k] == 0.0 else 0.0
