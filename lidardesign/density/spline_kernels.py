"""Compiled stacks of rational-quadratic splines of [-1, 1] onto itself: values, log slopes, inverses, all derivatives.

The same function as `splines.array_splines`, which is the reference and what runs on other devices. Written out, a
spline of K bins costs its 2 K exponentials and one pass over its parameters; as array operations it passes over them
some fifty times. Inside a stack arithmetic is float64 whatever the type of the parameters is.

Parameters of one spline are K widths, K heights and K + 1 slopes, all unconstrained. With c = 2 / |log slope_min|,

    shares = softmax(u / (1 + c |u|)),   slopes = exp(v / (1 + c |v| / 2)).

References:
    Neural Spline Flows, Durkan et al. 2019, eq. 4 to 8.
"""

from __future__ import annotations

import math

from numba import njit

# Reassociation vectorises the sums; NaN and infinity keep their meaning (no `nnan`, no `ninf`). Numpy's divisions raise
# nothing: a check of each divisor would keep loops from being vectorised.
OPTIONS = {"cache": True, "nogil": True, "fastmath": {"reassoc", "contract", "nsz", "arcp"}, "error_model": "numpy"}
BOUND = 1.0
SQUARINGS = 5
TAYLOR = tuple(1.0 / math.factorial(power) for power in range(12))


@njit(**OPTIONS)
def _exponential(x):  # noqa: ANN001, ANN202
    """exp(x) for |x| < 10 to 14 digits, by arithmetic alone: that is vectorised, and `math.exp` is not."""
    x = x / 2.0**SQUARINGS
    out = TAYLOR[11]
    out = out * x + TAYLOR[10]
    out = out * x + TAYLOR[9]
    out = out * x + TAYLOR[8]
    out = out * x + TAYLOR[7]
    out = out * x + TAYLOR[6]
    out = out * x + TAYLOR[5]
    out = out * x + TAYLOR[4]
    out = out * x + TAYLOR[3]
    out = out * x + TAYLOR[2]
    out = out * x + 1.0
    out = out * x + 1.0
    for _ in range(SQUARINGS):
        out = out * out
    return out


@njit(**OPTIONS)
def _softened(value, softness):  # noqa: ANN001, ANN202
    return value / (1.0 + abs(value) * softness)


@njit(**OPTIONS)
def _find_shares(raw, softness, out) -> None:  # noqa: ANN001
    """Shares of widths and of heights, one after the other, from their unconstrained sizes, shape (2 K,)."""
    count = out.shape[0] // 2
    for j in range(2 * count):
        out[j] = _exponential(_softened(raw[j], softness))
    of_widths = of_heights = 0.0
    for j in range(count):
        of_widths += out[j]
        of_heights += out[count + j]
    of_widths, of_heights = 1.0 / of_widths, 1.0 / of_heights
    for j in range(count):
        out[j] *= of_widths
        out[count + j] *= of_heights


@njit(**OPTIONS)
def _slopes(raw, k, softness, periodic):  # noqa: ANN001, ANN202
    """The slopes at both knots of bin k; the outer ones of a circle are one."""
    last = raw.shape[0] - 1
    first, second = _softened(raw[k], softness), _softened(raw[k + 1], softness)
    if periodic and (k == 0 or k == last - 1):
        outer = (_softened(raw[0], softness) + _softened(raw[last], softness)) / 2
        first = outer if k == 0 else first
        second = outer if k == last - 1 else second
    return _exponential(first), _exponential(second)


@njit(**OPTIONS)
def _turned(value, periodic):  # noqa: ANN001, ANN202
    """A coordinate half a turn further on its circle; itself where it is not periodic."""
    if not periodic:
        return value
    return value - BOUND if value >= 0.0 else value + BOUND


@njit(**OPTIONS)
def _bin_of(shares, place):  # noqa: ANN001, ANN202
    """The bin that a place in (-1, 1) lies in, and where that bin begins."""
    begin = -BOUND
    for j in range(shares.shape[0] - 1):
        end = begin + 2.0 * BOUND * shares[j]
        if place <= end:
            return j, begin
        begin = end
    return shares.shape[0] - 1, begin


@njit(**OPTIONS)
def _begin_of(shares, k):  # noqa: ANN001, ANN202
    total = 0.0
    for j in range(k):
        total += shares[j]
    return BOUND * (2.0 * total - 1.0)


@njit(**OPTIONS)
def _log_slope(s, z, first, second):  # noqa: ANN001, ANN202
    """log of the spline's slope at the share z of a bin of mean slope s."""
    across = z * (1.0 - z)
    rise = 2.0 * s * across + first * (1.0 - z) ** 2 + second * z * z
    below = s + (first + second - 2.0 * s) * across
    return math.log(s * s * rise / (below * below))


@njit(**OPTIONS)
def forward(parameters, values, periodic, softness, edge, shares, bins, places, out, log_slopes) -> None:  # noqa: ANN001
    """Values and summed log slopes of stacks, each spline taking what the one before it gave.

    Arguments:
        parameters: Shape (N, splines, 3 K + 1).
        values: Where to evaluate, shape (N,).
        periodic: Whether the dimension lies on a circle.
        softness: 2 / |log of the smallest slope of a spline|.
        edge: Values are kept this far inside [-1, 1].
        shares: Out: shares of widths and heights, shape (N, splines, 2 K), for the gradient.
        bins: Out: the bin at each spline, shape (N, splines).
        places: Out: the argument of each spline, shape (N, splines).
        out, log_slopes: Out: shape (N,).
    """
    count = parameters.shape[2] // 3
    for n in range(parameters.shape[0]):
        value, total = float(values[n]), 0.0
        for layer in range(parameters.shape[1]):
            raw = parameters[n, layer]
            _find_shares(raw, softness, shares[n, layer])
            widths, heights = shares[n, layer, :count], shares[n, layer, count:]
            x = min(max(_turned(value, periodic), -BOUND + edge), BOUND - edge)
            k, x0 = _bin_of(widths, x)
            first, second = _slopes(raw[2 * count :], k, softness / 2, periodic)
            width, height = 2.0 * BOUND * widths[k], 2.0 * BOUND * heights[k]
            s = height / width
            z = min((x - x0) / width, 1.0)
            across = z * (1.0 - z)
            y = (s * z * z + first * across) / (s + (first + second - 2.0 * s) * across)
            bins[n, layer], places[n, layer] = k, x
            value = min(max(_begin_of(heights, k) + height * y, -BOUND), BOUND)
            total += _log_slope(s, z, first, second)
        out[n], log_slopes[n] = value, total


@njit(**OPTIONS)
def inverse(parameters, values, periodic, softness, edge, shares, bins, places, out, log_slopes) -> None:  # noqa: ANN001
    """Arguments at which stacks have `values`, and their summed log slopes there; arguments as of `forward`."""
    count = parameters.shape[2] // 3
    for n in range(parameters.shape[0]):
        value, total = float(values[n]), 0.0
        for layer in range(parameters.shape[1] - 1, -1, -1):
            raw = parameters[n, layer]
            _find_shares(raw, softness, shares[n, layer])
            widths, heights = shares[n, layer, :count], shares[n, layer, count:]
            y = min(max(value, -BOUND + edge), BOUND - edge)
            k, y0 = _bin_of(heights, y)
            first, second = _slopes(raw[2 * count :], k, softness / 2, periodic)
            width, height = 2.0 * BOUND * widths[k], 2.0 * BOUND * heights[k]
            s = height / width
            rise = y - y0
            bend = rise * (first + second - 2.0 * s)
            a, b, c = height * (s - first) + bend, height * first - bend, -s * rise
            # positive but for rounding: the spline is monotone
            root = math.sqrt(max(b * b - 4.0 * a * c, 0.0))
            z = min(max(2.0 * c / (-b - root), 0.0), 1.0) if rise > 0.0 else 0.0
            x = _begin_of(widths, k) + z * width
            bins[n, layer], places[n, layer] = k, x
            value = _turned(x, periodic)
            total += _log_slope(s, z, first, second)
        out[n], log_slopes[n] = value, total


@njit(**OPTIONS, inline="always")
def _add_shares(raw, share, k, by_begin, by_size, softness, out) -> None:  # noqa: ANN001
    """The gradient by unconstrained sizes: `by_begin` of where bin k begins, `by_size` of its size."""
    mean = by_size * share[k]
    for j in range(k):
        mean += by_begin * share[j]
    for j in range(out.shape[0]):
        pull = (by_begin if j < k else (by_size if j == k else 0.0)) - mean
        soft = 1.0 + abs(raw[j]) * softness
        out[j] = 2.0 * BOUND * share[j] * pull / (soft * soft)


@njit(**OPTIONS)
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


@njit(**OPTIONS)
def gradient(  # noqa: ANN201
    parameters, shares, bins, places, periodic, softness, inverted, by_value, by_slope, by_parameters, by_argument,  # noqa: ANN001
):  # fmt: skip
    """Gradients of sum by_value * value + by_slope * log slope, of `forward` or of `inverse`.

    An inverse's value is z(y) with f(z; p) = y: dz = (dy - df/dp dp) / f', and its log slope depends on z as well.

    Arguments:
        parameters, periodic, softness: As of `forward`.
        shares, bins, places: As either left them.
        inverted: Whether the values were those of `inverse`.
        by_value, by_slope: Shape (N,).
        by_parameters: Out: shape (N, splines, 3 K + 1).
        by_argument: Out: by what was put in, shape (N,).
    """
    count, layers = parameters.shape[2] // 3, parameters.shape[1]
    for n in range(parameters.shape[0]):
        passed, lift = float(by_value[n]), float(by_slope[n])
        for turn in range(layers):
            layer = turn if inverted else layers - 1 - turn
            raw, out = parameters[n, layer], by_parameters[n, layer]
            widths, heights, k = shares[n, layer, :count], shares[n, layer, count:], bins[n, layer]
            first, second = _slopes(raw[2 * count :], k, softness / 2, periodic)
            width, height = 2.0 * BOUND * widths[k], 2.0 * BOUND * heights[k]
            s = height / width
            z = min(max((places[n, layer] - _begin_of(widths, k)) / width, 0.0), 1.0)
            across, rest = z * (1.0 - z), 1.0 - z
            below = s + (first + second - 2.0 * s) * across
            above = s * z * z + first * across
            rise = 2.0 * s * across + first * rest * rest + second * z * z
            slope = s * s * rise / (below * below)
            by_z = 2.0 * (s * (1.0 - 2.0 * z) - first * rest + second * z) / rise
            by_z -= 2.0 * (first + second - 2.0 * s) * (1.0 - 2.0 * z) / below
            by_place = lift * by_z
            if inverted:
                passed = (passed + by_place / width) / slope
                up = -passed
            else:
                up = passed
                passed = up * slope + by_place / width
            by_place += up * slope * width
            by_s = up * height * (z * z * below - above * (1.0 - 2.0 * across)) / (below * below)
            by_s += lift * (2.0 / s + 2.0 * across / rise - 2.0 * (1.0 - 2.0 * across) / below)
            by_first = up * height * across * (below - above) / (below * below)
            by_first += lift * (rest * rest / rise - 2.0 * across / below)
            by_second = -up * height * above * across / (below * below)
            by_second += lift * (z * z / rise - 2.0 * across / below)
            by_height = up * above / below + by_s / width
            by_width = -(by_place * z + by_s * s) / width
            _add_shares(raw[:count], widths, k, -by_place / width, by_width, softness, out[:count])
            _add_shares(raw[count : 2 * count], heights, k, up, by_height, softness, out[count : 2 * count])
            slopes = out[2 * count :]
            slopes[:] = 0.0
            _add_slope(raw[2 * count :], k, by_first * first, softness / 2, periodic, slopes)
            _add_slope(raw[2 * count :], k + 1, by_second * second, softness / 2, periodic, slopes)
        by_argument[n] = passed
