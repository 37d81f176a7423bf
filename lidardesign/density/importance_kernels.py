"""Compiled loops over grids of log weights: as those of distances, but constant beyond the grid's faces."""

from __future__ import annotations

import numpy as np
from numba import njit

from lidardesign.density.body_kernels import to_frame
from lidardesign.density.kernels import FAST, corners, locate


@njit(cache=True, nogil=True, fastmath=FAST)
def table_values(table, counts, low, inverse_step, points, out):  # noqa: ANN001, ANN201
    """Values of all columns at points: table (G, C), points (N, 3), out (N, C)."""
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
def table_gradient(table, counts, low, inverse_step, points, weights, out):  # noqa: ANN001, ANN201
    """Gradients of sum_c weights_nc * value_c(points_n): weights (N, C), out (N, 3)."""
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
            out[n, axis] = _slope(dots, fraction, axis) * inverse_step if excess[axis] == 0.0 else 0.0


@njit(cache=True, nogil=True, inline="always")
def _slope(values, fraction, axis):  # noqa: ANN001, ANN202
    """The derivative of a cell's trilinear value along an axis, per step; values (8,) at its corners."""
    total = 0.0
    for corner in range(8):
        share = 1.0 if (corner >> axis) & 1 else -1.0
        for k in range(3):
            if k != axis:
                share *= fraction[k] if (corner >> k) & 1 else 1.0 - fraction[k]
        total += share * values[corner]
    return total


@njit(cache=True, nogil=True, inline="always")
def _corner_values(values, start, counts, low, inverse_step, q, cell, fraction, excess, index, weight, found):  # noqa: ANN001, ANN202
    """The values at the corners of a point's cell in a grid that begins at `start`, into `found` (8,)."""
    locate(counts, low, inverse_step, q, cell, fraction, excess)
    corners(counts, cell, fraction, index, weight)
    for corner in range(8):
        found[corner] = values[start + index[corner]]


@njit(cache=True, nogil=True)
def pair_values(  # noqa: ANN201
    constants, to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    points, row_starts, bodies, out,  # noqa: ANN001
):  # fmt: skip
    """log weights of pairs of a point and a body, listed as `body_kernels.near_columns` does: out (P,).

    Arguments:
        constants: log weight of each body as a whole, shape (B,).
        values: log weights of all grids of meshes, end to end; bodies of grid 0 have none.
        bodies: The body of each pair, -1 for none.
    """
    cell, fraction, excess, q = np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3)
    index, weight, found = np.zeros(8, np.int64), np.zeros(8), np.zeros(8)
    for n in range(points.shape[0]):
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = bodies[pair]
            if b < 0:
                out[pair] = 0.0
                continue
            total, g = constants[b], grid[b]
            if g > 0:
                to_frame(to_body, b, points, n, q)
                _corner_values(
                    values, grid_starts[g], counts[g], lows[g], steps[g],
                    q, cell, fraction, excess, index, weight, found,
                )  # fmt: skip
                for corner in range(8):
                    total += weight[corner] * found[corner]
            out[pair] = total


@njit(cache=True, nogil=True)
def add_pair_gradients(  # noqa: ANN201
    to_body, grid, values, grid_starts, counts, lows, steps,  # noqa: ANN001
    points, row_starts, bodies, weights, out,  # noqa: ANN001
):  # fmt: skip
    """Add the gradients of sum_pairs weight * log weight of its body at the point to out (N, 3)."""
    cell, fraction, excess, q = np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3)
    index, corner_weight, found = np.zeros(8, np.int64), np.zeros(8), np.zeros(8)
    for n in range(points.shape[0]):
        for pair in range(row_starts[n], row_starts[n + 1]):
            b = bodies[pair]
            if b < 0 or weights[pair] == 0.0 or grid[b] == 0:
                continue
            g = grid[b]
            to_frame(to_body, b, points, n, q)
            _corner_values(
                values, grid_starts[g], counts[g], lows[g], steps[g],
                q, cell, fraction, excess, index, corner_weight, found,
            )  # fmt: skip
            for axis in range(3):
                if excess[axis] == 0.0:
                    slope = weights[pair] * _slope(found, fraction, axis) * steps[g]
                    for k in range(3):
                        out[n, k] += slope * to_body[b, axis, k]
