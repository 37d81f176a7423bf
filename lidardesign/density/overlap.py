"""The share of a learned density's mass that is in the wrong place: its total variation to the normalised target.

Samples of the density alone cannot see what it dropped, and proposals that follow the surfaces alone cannot see what
leaked away from them. The overlap of both densities is the mean of min(1, pi / p) over samples of p, and that of
min(1, p / pi) over samples of pi = p* / Z. The two agree at one log Z only, which is the bridge estimate of it with the
bridge min(p, p* / Z); both means are of values in [0, 1], so no weight can spoil them.

References:
    Simulating ratios of normalizing constants via a simple identity, Meng and Wong 1996.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from lidardesign.errors import NumericalError
from lidardesign.numerics import SLACK, TINY, logsumexp, normalised_weights

# Where log Z is found to: far below what samples can tell.
LOG_Z_TOLERANCE_NATS = SLACK
# A group of fewer points than this on either side is judged by the groups that have more.
LEAST_POINTS = 8
# Densities that share less than this share nothing, and the division by it is safe.
LEAST_SHARED = TINY


@dataclass(frozen=True)
class Overlap:
    """How far a density is from its target.

    Arguments:
        misplaced: The total variation, 0 to 1.
        error: Its standard error over other samples and other proposals.
        log_z: log of the target's integral, by the bridge.
    """

    misplaced: float
    error: float
    log_z: float


@dataclass(frozen=True, eq=False)
class Sides:
    """Points of both densities and what is known at them.

    Arguments:
        at_samples: log p* - log p at samples of p, shape (N,); -inf where p* is 0.
        at_proposals: log p* - log p at proposals, shape (M,); +inf where p is 0.
        log_weights: log p* - log q of the proposals, up to a constant, shape (M,).
        sample_groups, proposal_groups: The condition group of each point, shapes (N,) and (M,), or None.
    """

    at_samples: np.ndarray
    at_proposals: np.ndarray
    log_weights: np.ndarray
    sample_groups: np.ndarray | None = None
    proposal_groups: np.ndarray | None = None


def overlap(sides: Sides) -> Overlap:
    """The total variation of a density and its target; with condition groups, their mean.

    Groups are alike in their conditions' share, so the mean over them is that over conditions.

    Raises:
        NumericalError: A value is NaN, or one side has no points of finite weight.
    """
    if sides.sample_groups is None or sides.proposal_groups is None:
        return _overlap(sides.at_samples, sides.at_proposals, sides.log_weights)
    parts = []
    for group in np.unique(sides.sample_groups):
        mine, theirs = sides.sample_groups == group, sides.proposal_groups == group
        if min(mine.sum(), theirs.sum()) >= LEAST_POINTS:
            parts.append(_overlap(sides.at_samples[mine], sides.at_proposals[theirs], sides.log_weights[theirs]))
    if not parts:
        return _overlap(sides.at_samples, sides.at_proposals, sides.log_weights)
    return Overlap(
        misplaced=float(np.mean([part.misplaced for part in parts])),
        error=float(np.linalg.norm([part.error for part in parts])) / len(parts),
        log_z=float(np.mean([part.log_z for part in parts])),
    )


def _overlap(at_samples: np.ndarray, at_proposals: np.ndarray, log_weights: np.ndarray) -> Overlap:
    _check(at_samples, at_proposals, log_weights)
    weights = normalised_weights(log_weights)
    finite = at_samples[np.isfinite(at_samples)]
    start = float(logsumexp(finite)) - math.log(len(at_samples))

    def gap(log_z: float) -> float:
        return _mean_kept(at_samples - log_z) - float(weights @ np.exp(np.minimum(log_z - at_proposals, 0.0)))

    low, high = _bracket(gap, start)
    log_z = float(brentq(gap, low, high, xtol=LOG_Z_TOLERANCE_NATS))
    kept = np.exp(np.minimum(at_samples - log_z, 0.0))
    reached = np.exp(np.minimum(log_z - at_proposals, 0.0))
    shared = float(kept.mean())
    # of the overlap, p is the lesser density on `rare` and pi on the rest; a shift of log Z trades one for the other
    rare = float((at_samples >= log_z).mean())
    rest = shared - rare
    variances = np.square(kept - shared).mean() / len(kept), float(np.square(weights * (reached - shared)).sum())
    error = math.hypot(rare * math.sqrt(variances[0]), rest * math.sqrt(variances[1])) / max(shared, LEAST_SHARED)
    return Overlap(misplaced=1.0 - shared, error=error, log_z=log_z)


def _mean_kept(log_ratios: np.ndarray) -> float:
    return float(np.exp(np.minimum(log_ratios, 0.0)).mean())


def _bracket(gap: Callable[[float], float], start: float) -> tuple[float, float]:
    """Two values of log Z with the root between them; the gap falls from 1 to -1, to 0 where nothing is shared."""
    low = high = start
    reach = 1.0
    while gap(low) < 0:
        low, reach = low - reach, 2 * reach
    reach = 1.0
    while gap(high) > 0:
        high, reach = high + reach, 2 * reach
    return low, high


def _check(at_samples: np.ndarray, at_proposals: np.ndarray, log_weights: np.ndarray) -> None:
    if any(np.isnan(values).any() for values in (at_samples, at_proposals, log_weights)):
        raise NumericalError("a density is NaN at the points that it is compared at")
    if not np.isfinite(at_samples).any() or not np.isfinite(log_weights).any():
        raise NumericalError("the target is 0 at all points that the density is compared at")
