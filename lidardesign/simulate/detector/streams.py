"""Counter-based random numbers: pure functions of (key, row, draw).

A number is a hash of an effect's key, the index of a ray and the index of a draw, so that it does not depend on the
order, the chunks or the other effects of a simulation. The hash is three rounds of the finaliser of
splitmix64 (Steele, Lea and Flood 2014), one per word, each added to the hash of the words before it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, vectorize

from lidardesign.simulate.detector.physics import MOST_COUNTS

# 2^64 over the golden ratio, which makes the hash of 0 differ from 0, and the finaliser's multipliers
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST = np.uint64(0xBF58476D1CE4E5B9)
SECOND = np.uint64(0x94D049BB133111EB)
SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31))
# the upper 53 bits fill a float64's mantissa; half a step more keeps 0 and 1 out
MANTISSA_SHIFT = np.uint64(11)
STEP = 2.0**-53

# Wichura 1988, algorithm AS 241 (PPND16): rational functions for the centre, the tails and the far tails
CENTRE_TOP = (
    3.3871328727963666080e0,
    1.3314166789178437745e2,
    1.9715909503065514427e3,
    1.3731693765509461125e4,
    4.5921953931549871457e4,
    6.7265770927008700853e4,
    3.3430575583588128105e4,
    2.5090809287301226727e3,
)
CENTRE_BOTTOM = (
    1.0,
    4.2313330701600911252e1,
    6.8718700749205790830e2,
    5.3941960214247511077e3,
    2.1213794301586595867e4,
    3.9307895800092710610e4,
    2.8729085735721942674e4,
    5.2264952788528545610e3,
)
TAIL_TOP = (
    1.42343711074968357734e0,
    4.63033784615654529590e0,
    5.76949722146069140550e0,
    3.64784832476320460504e0,
    1.27045825245236838258e0,
    2.41780725177450611770e-1,
    2.27238449892691845833e-2,
    7.74545014278341407640e-4,
)
TAIL_BOTTOM = (
    1.0,
    2.05319162663775882187e0,
    1.67638483018380384940e0,
    6.89767334985100004550e-1,
    1.48103976427480074590e-1,
    1.51986665636164571966e-2,
    5.47593808499534494600e-4,
    1.05075007164441684324e-9,
)
FAR_TOP = (
    6.65790464350110377720e0,
    5.46378491116411436990e0,
    1.78482653991729133580e0,
    2.96560571828504891230e-1,
    2.65321895265761230930e-2,
    1.24266094738807843860e-3,
    2.71155556874348757815e-5,
    2.01033439929228813265e-7,
)
FAR_BOTTOM = (
    1.0,
    5.99832206555887937690e-1,
    1.36929880922735805310e-1,
    1.48753612908506148525e-2,
    7.86869131145613259100e-4,
    1.84631831751005468180e-5,
    1.42151175831644588870e-7,
    2.04426310338993978564e-15,
)
CENTRE_HALF_WIDTH, CENTRE_RADIUS = 0.425, 0.180625
TAIL_START, TAIL_END = 1.6, 5.0
# Below this mean a Poisson quantile is found by summing probabilities; above it by the expansion of Cornish and
# Fisher (1938) to its third term, which is then off by less than one count.
SUMMED_MEAN = 32.0


@njit(cache=True, nogil=True, inline="always")
def _mixed(word):  # noqa: ANN001, ANN202
    """The finaliser of splitmix64."""
    word = (word ^ (word >> SHIFTS[0])) * FIRST
    word = (word ^ (word >> SHIFTS[1])) * SECOND
    return word ^ (word >> SHIFTS[2])


@njit(cache=True, nogil=True)
def uniform(key, row, draw):  # noqa: ANN001, ANN201
    """A number in (0, 1) for a key (below 2^64), a row and a draw; for compiled loops."""
    word = _mixed(np.uint64(key) + GOLDEN)
    word = _mixed(word + np.uint64(row) * GOLDEN + GOLDEN)
    word = _mixed(word + np.uint64(draw) * GOLDEN + GOLDEN)
    return (float(word >> MANTISSA_SHIFT) + 0.5) * STEP


@njit(cache=True, nogil=True)
def _ratio(top, bottom, value):  # noqa: ANN001, ANN202
    """A rational function by Horner's rule, coefficients in ascending order."""
    above, below = 0.0, 0.0
    for k in range(len(top) - 1, -1, -1):
        above = above * value + top[k]
        below = below * value + bottom[k]
    return above / below


@njit(cache=True, nogil=True)
def normal_quantile(share):  # noqa: ANN001, ANN201
    """The standard normal quantile of a share in (0, 1), to 1e-15 relative (Wichura 1988, AS 241)."""
    offset = share - 0.5
    if abs(offset) <= CENTRE_HALF_WIDTH:
        return offset * _ratio(CENTRE_TOP, CENTRE_BOTTOM, CENTRE_RADIUS - offset * offset)
    distance = math.sqrt(-math.log(min(share, 1.0 - share)))
    if distance <= TAIL_END:
        value = _ratio(TAIL_TOP, TAIL_BOTTOM, distance - TAIL_START)
    else:
        value = _ratio(FAR_TOP, FAR_BOTTOM, distance - TAIL_END)
    return value if offset > 0 else -value


@njit(cache=True, nogil=True)
def normal(key, row, draw):  # noqa: ANN001, ANN201
    """A standard normal number for a key, a row and a draw; for compiled loops."""
    return normal_quantile(uniform(key, row, draw))


@njit(cache=True, nogil=True)
def poisson_quantile(mean, share):  # noqa: ANN001, ANN201
    """The least count whose Poisson distribution function reaches a share in (0, 1)."""
    mean = min(mean, MOST_COUNTS)
    if mean <= 0:
        return 0
    if mean > SUMMED_MEAN:
        z = normal_quantile(share)
        spread = math.sqrt(mean)
        place = mean + spread * z + (z * z - 1.0) / 6.0 + (z - z * z * z) / (72.0 * spread)
        return max(math.ceil(place - 0.5), 0)
    count = 0
    probability = math.exp(-mean)
    total = probability
    # terminates for any share: the probabilities fall below the rounding of their sum
    while total < share and probability > total * STEP:
        count += 1
        probability *= mean / count
        total += probability
    return count


@vectorize(["float64(uint64, uint64, uint64)"], cache=True)
def _uniforms(key, row, draw):  # noqa: ANN001, ANN202
    return uniform(key, row, draw)


@vectorize(["float64(uint64, uint64, uint64)"], cache=True)
def _normals(key, row, draw):  # noqa: ANN001, ANN202
    return normal(key, row, draw)


@vectorize(["float64(float64)"], cache=True)
def normal_quantiles(shares):  # noqa: ANN001, ANN201
    """Standard normal quantiles of shares in (0, 1), of any shape."""
    return normal_quantile(shares)


def uniforms(key: int, rows: np.ndarray, draws: np.ndarray | int = 0) -> np.ndarray:
    """Numbers in (0, 1) for a key, rows and draws that broadcast against each other."""
    return _uniforms(np.uint64(key), np.asarray(rows, np.uint64), np.asarray(draws, np.uint64))


def normals(key: int, rows: np.ndarray, draws: np.ndarray | int = 0) -> np.ndarray:
    """Standard normal numbers for a key, rows and draws that broadcast against each other."""
    return _normals(np.uint64(key), np.asarray(rows, np.uint64), np.asarray(draws, np.uint64))
