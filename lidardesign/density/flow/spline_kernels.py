"""Compiled rational-quadratic splines of [-1, 1] onto itself: values, log slopes, inverses and all their derivatives.

The same function as `splines.BoundedSpline`, which is the reference and what runs on other devices. Written out, a
spline of K bins costs its 2 K exponentials and one pass over its parameters; as array operations it passes over them
some fifty times. Inside, arithmetic is float64 whatever the type of the parameters is.

Parameters of one spline are K widths, K heights and K + 1 slopes, all unconstrained. With c = 2 / |log slope_min|,

    shares = softmax(u / (1 + c |u|)),   slopes = exp(v / (1 + c |v| / 2)).

References:
    Neural Spline Flows, Durkan et al. 2019, eq. 4 to 8.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# Reassociation vectorises the sums; NaN and infinity keep their meaning (no `nnan`, no `ninf`).
FAST = {"reassoc", "contract", "nsz", "arcp"}
BOUND = 1.0


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _shares(raw, softness, out) -> None:  # noqa: ANN001
    """Shares of bins from their unconstrained sizes, shape (K,)."""
    largest = -np.inf
    for j in range(raw.shape[0]):
        value = raw[j] / (1.0 + abs(raw[j]) * softness)
        out[j] = value
        largest = max(largest, value)
    total = 0.0
    for j in range(raw.shape[0]):
        share = math.exp(out[j] - largest)
        out[j] = share
        total += share
    for j in range(raw.shape[0]):
        out[j] /= total


@njit(cache=True, nogil=True, inline="always")
def _bins(raw, count, softness, share):  # noqa: ANN001, ANN202
    """Shares of widths and of heights, written one after the other into `share` (2 K,)."""
    _shares(raw[:count], softness, share[:count])
    _shares(raw[count : 2 * count], softness, share[count:])
    return share[:count], share[count:]


@njit(cache=True, nogil=True, inline="always")
def _softened(value, softness):  # noqa: ANN001, ANN202
    return value / (1.0 + abs(value) * softness)


@njit(cache=True, nogil=True, inline="always")
def _slopes(raw, k, softness, periodic):  # noqa: ANN001, ANN202
    """The slopes at both knots of bin k; the outer ones of a circle are one."""
    last = raw.shape[0] - 1
    if periodic and (k == 0 or k == last - 1):
        outer = math.exp((_softened(raw[0], softness) + _softened(raw[last], softness)) / 2)
        first = outer if k == 0 else math.exp(_softened(raw[k], softness))
        second = outer if k == last - 1 else math.exp(_softened(raw[k + 1], softness))
        return first, second
    return math.exp(_softened(raw[k], softness)), math.exp(_softened(raw[k + 1], softness))


@njit(cache=True, nogil=True, inline="always")
def _turned(value, periodic):  # noqa: ANN001, ANN202
    """A coordinate on a circle half a turn on."""
    if not periodic:
        return value
    return value - BOUND if value >= 0.0 else value + BOUND


@njit(cache=True, nogil=True, inline="always")
def _bin_of(shares, place):  # noqa: ANN001, ANN202
    """The bin that a place in (-1, 1) lies in, and where that bin begins."""
    begin = -BOUND
    for j in range(shares.shape[0] - 1):
        end = begin + 2.0 * BOUND * shares[j]
        if place <= end:
            return j, begin
        begin = end
    return shares.shape[0] - 1, begin


@njit(cache=True, nogil=True, inline="always")
def _begin_of(shares, k):  # noqa: ANN001, ANN202
    total = 0.0
    for j in range(k):
        total += shares[j]
    return BOUND * (2.0 * total - 1.0)


@njit(cache=True, nogil=True, inline="always")
def _log_slope(s, z, first, second):  # noqa: ANN001, ANN202
    """log of the spline's slope at the share z of a bin of mean slope s."""
    across = z * (1.0 - z)
    rise = 2.0 * s * across + first * (1.0 - z) ** 2 + second * z * z
    return 2.0 * math.log(s) + math.log(rise) - 2.0 * math.log(s + (first + second - 2.0 * s) * across)


@njit(cache=True, nogil=True)
def forward(parameters, values, periodic, softness, edge, shares, bins, out, log_slopes) -> None:  # noqa: ANN001
    """Values and log slopes.

    Arguments:
        parameters: Shape (N, D, 3 K + 1).
        values: Where to evaluate, shape (N, D).
        periodic: Which dimensions lie on a circle, shape (D,).
        softness: 2 / |log of the smallest slope|.
        edge: Values are kept this far inside [-1, 1].
        shares: Out: shares of widths and heights, shape (N, D, 2 K), for the gradient.
        bins: Out: the bin of each value, shape (N, D).
        out, log_slopes: Out: shape (N, D).
    """
    count = (parameters.shape[2] - 1) // 3
    for n in range(parameters.shape[0]):
        for d in range(parameters.shape[1]):
            raw = parameters[n, d]
            widths, heights = _bins(raw, count, softness, shares[n, d])
            x = min(max(_turned(values[n, d], periodic[d]), -BOUND + edge), BOUND - edge)
            k, x0 = _bin_of(widths, x)
            first, second = _slopes(raw[2 * count :], k, softness / 2, periodic[d])
            width, height = 2.0 * BOUND * widths[k], 2.0 * BOUND * heights[k]
            s = height / width
            z = min((x - x0) / width, 1.0)
            across = z * (1.0 - z)
            y = (s * z * z + first * across) / (s + (first + second - 2.0 * s) * across)
            bins[n, d] = k
            out[n, d] = min(max(_begin_of(heights, k) + height * y, -BOUND), BOUND)
            log_slopes[n, d] = _log_slope(s, z, first, second)


@njit(cache=True, nogil=True)
def inverse(parameters, values, periodic, softness, edge, shares, bins, out, log_slopes) -> None:  # noqa: ANN001
    """Where the spline takes `values`, and the log slopes there; arguments as of `forward`."""
    count = (parameters.shape[2] - 1) // 3
    for n in range(parameters.shape[0]):
        for d in range(parameters.shape[1]):
            raw = parameters[n, d]
            widths, heights = _bins(raw, count, softness, shares[n, d])
            y = min(max(values[n, d], -BOUND + edge), BOUND - edge)
            k, y0 = _bin_of(heights, y)
            first, second = _slopes(raw[2 * count :], k, softness / 2, periodic[d])
            width, height = 2.0 * BOUND * widths[k], 2.0 * BOUND * heights[k]
            s = height / width
            rise = y - y0
            bend = rise * (first + second - 2.0 * s)
            a, b, c = height * (s - first) + bend, height * first - bend, -s * rise
            # positive but for rounding: the spline is monotone
            root = math.sqrt(max(b * b - 4.0 * a * c, 0.0))
            z = min(max(2.0 * c / (-b - root), 0.0), 1.0) if rise > 0.0 else 0.0
            bins[n, d] = k
            out[n, d] = _turned(_begin_of(widths, k) + z * width, periodic[d])
            log_slopes[n, d] = _log_slope(s, z, first, second)


@njit(cache=True, nogil=True, inline="always")
def _add_shares(raw, share, k, by_begin, by_size, softness, out) -> None:  # noqa: ANN001
    """The gradient by unconstrained sizes: `by_begin` of where bin k begins, `by_size` of its size."""
    mean = 2.0 * BOUND * by_size * share[k]
    for j in range(k):
        mean += 2.0 * BOUND * by_begin * share[j]
    for j in range(raw.shape[0]):
        pull = 2.0 * BOUND * (by_begin if j < k else (by_size if j == k else 0.0)) - mean
        soft = 1.0 + abs(raw[j]) * softness
        out[j] = share[j] * pull / (soft * soft)


@njit(cache=True, nogil=True, inline="always")
def _add_slope(raw, j, by_log, softness, periodic, out) -> None:  # noqa: ANN001
    """The gradient by the unconstrained slope j, from that by its log."""
    last = raw.shape[0] - 1
    if periodic and (j == 0 or j == last):
        for end in (0, last):
            soft = 1.0 + abs(raw[end]) * softness
            out[end] += by_log / 2 / (soft * soft)
        return
    soft = 1.0 + abs(raw[j]) * softness
    out[j] += by_log / (soft * soft)


@njit(cache=True, nogil=True)
def gradient(  # noqa: ANN201
    parameters, shares, bins, base, periodic, softness, inverted, by_value, by_slope, by_parameters, by_argument,  # noqa: ANN001
):  # fmt: skip
    """Gradients of sum by_value * value + by_slope * log slope, of `forward` or of `inverse`.

    An inverse's value is z(y) with f(z; p) = y: dz = (dy - df/dp dp) / f', and its log slope depends on z as well.

    Arguments:
        parameters, periodic, softness: As of `forward`.
        shares, bins: As it left them.
        base: The argument of the forward function, shape (N, D): what was put in, or what the inverse gave.
        inverted: Whether the values were those of `inverse`.
        by_value, by_slope: Shape (N, D).
        by_parameters: Out: shape (N, D, 3 K + 1).
        by_argument: Out: by what was put in, shape (N, D).
    """
    count = (parameters.shape[2] - 1) // 3
    for n in range(parameters.shape[0]):
        for d in range(parameters.shape[1]):
            raw, share, out = parameters[n, d], shares[n, d], by_parameters[n, d]
            widths, heights, k = share[:count], share[count:], bins[n, d]
            first, second = _slopes(raw[2 * count :], k, softness / 2, periodic[d])
            x = _turned(base[n, d], periodic[d])
            width, height = 2.0 * BOUND * widths[k], 2.0 * BOUND * heights[k]
            s = height / width
            z = min(max((x - _begin_of(widths, k)) / width, 0.0), 1.0)
            across, rest = z * (1.0 - z), 1.0 - z
            below = s + (first + second - 2.0 * s) * across
            above = s * z * z + first * across
            rise = 2.0 * s * across + first * rest * rest + second * z * z
            slope = s * s * rise / (below * below)
            by_z = 2.0 * (s * (1.0 - 2.0 * z) - first * rest + second * z) / rise
            by_z -= 2.0 * (first + second - 2.0 * s) * (1.0 - 2.0 * z) / below
            up, lift = by_value[n, d], by_slope[n, d]
            by_place = lift * by_z
            if inverted:
                by_argument[n, d] = (up + by_place / width) / slope
                up = -by_argument[n, d]
            else:
                by_argument[n, d] = up * slope + by_place / width
            by_place += up * slope * width
            by_s = up * height * (z * z * below - above * (1.0 - 2.0 * across)) / (below * below)
            by_s += lift * (2.0 / s + 2.0 * across / rise - 2.0 * (1.0 - 2.0 * across) / below)
            by_first = up * height * across * (below - above) / (below * below)
            by_first += lift * (rest * rest / rise - 2.0 * across / below)
            by_second = -up * height * above * across / (below * below)
            by_second += lift * (z * z / rise - 2.0 * across / below)
            by_height = up * above / below + by_s / width
            _add_shares(
                raw[:count], widths, k, -by_place / width, -(by_place * z + by_s * s) / width, softness, out[:count]
            )
            _add_shares(raw[count : 2 * count], heights, k, up, by_height, softness, out[count : 2 * count])
            slopes = out[2 * count :]
            slopes[:] = 0.0
            _add_slope(raw[2 * count :], k, by_first * first, softness / 2, periodic[d], slopes)
            _add_slope(raw[2 * count :], k + 1, by_second * second, softness / 2, periodic[d], slopes)
