"""How far two densities are apart: the share of the mass that is in the wrong place.

That is their total variation, TV = 1/2 integral |a - b| of the normalised densities. It is the one unit of all errors
of a density's numerical choices: by the triangle inequality the errors of several choices add up at most.
"""

from __future__ import annotations

import numpy as np

from lidardesign.errors import NumericalError
from lidardesign.numerics import normalised_weights


def misplaced_share(log_first: np.ndarray, log_second: np.ndarray, log_proposal: np.ndarray) -> tuple[float, float]:
    """The total variation of two unnormalised densities from weighted points, and its standard error.

    Both are normalised by the same points, whose noise therefore largely cancels. The standard error is that of the
    estimate's influence function (Hampel 1974), the normalisation included.

    Arguments:
        log_first, log_second: log of the two densities at the points, shape (N,); -inf where they are 0.
        log_proposal: log of the density that the points were drawn from, up to a constant, shape (N,).

    Raises:
        NumericalError: A value is NaN or +inf, or one of the densities is 0 at all points.
    """
    for log_density in (log_first, log_second):
        if np.isnan(log_density).any() or np.isposinf(log_density).any() or np.isneginf(log_density).all():
            raise NumericalError("a density has no finite mass at the points that it is compared at")
    first, second = (normalised_weights(values - log_proposal) for values in (log_first, log_second))
    apart = np.abs(first - second) / 2
    sign = np.sign(first - second) / 2
    influence = apart - first * (sign @ first) + second * (sign @ second)
    return float(apart.sum()), float(np.sqrt(np.square(influence).sum()))
