"""What a learned density is worth: effective sample size, KL divergence, log Z, and coverage.

The first three come from fresh samples of the flow with unclipped importance weights w = p* / p and cannot see a mode
that the flow dropped. Coverage can: it is the share of the target's mass, estimated from independent proposals, that
lies where the flow's density is at least a tenth of the normalised target's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.errors import NumericalError
from lidardesign.estimates import Estimate, effective_share_error, log_mean_error, standard_error, weighted_mean_error
from lidardesign.numerics import logsumexp

# A point counts as covered where p >= COVERED_RATIO * p* / Z.
COVERED_RATIO = 0.1


@dataclass(frozen=True)
class Quality:
    """Figures of a learned density against its target, and their standard errors over other samples of the flow.

    Arguments:
        ess: (sum w)^2 / (N sum w^2), 0 to 1.
        kl_nats: KL(p || p* / Z) = mean(log p - log p*) + log Z [nats].
        log_z: log of the integral of p* over the chart.
        ess_error, kl_error_nats, log_z_error: Their standard errors.
    """

    ess: float
    kl_nats: float
    log_z: float
    ess_error: float
    kl_error_nats: float
    log_z_error: float

    def estimates(self) -> dict[str, Estimate]:
        """The figures with their errors by name."""
        return {
            "ess": Estimate(self.ess, self.ess_error),
            "kl_nats": Estimate(self.kl_nats, self.kl_error_nats, "nats"),
            "log_z": Estimate(self.log_z, self.log_z_error, "nats"),
        }


def quality(log_prob: np.ndarray, log_target: np.ndarray, groups: np.ndarray | None = None) -> Quality:
    """ESS, KL and log Z of samples of p, shapes (N,); with `groups` (one per condition value) each is averaged.

    Raises:
        NumericalError: A log density is NaN or infinite.
    """
    log_weights = log_target - log_prob
    if not len(log_weights) or not np.isfinite(log_weights).all():
        raise NumericalError(
            f"{int((~np.isfinite(log_weights)).sum())} of {len(log_weights)} samples of the flow have no finite weight",
            hint="a smaller learning.rate, or learning.dtype=float64",
        )
    if groups is None:
        return _quality(log_weights)
    parts = list(quality_by_group(log_weights, groups).values())
    figures = (np.mean([getattr(part, name) for part in parts]) for name in ("ess", "kl_nats", "log_z"))
    # groups have samples of their own
    errors = ([getattr(part, name) for part in parts] for name in ("ess_error", "kl_error_nats", "log_z_error"))
    return Quality(*map(float, figures), *(float(np.linalg.norm(error)) / len(parts) for error in errors))


def quality_by_group(log_weights: np.ndarray, groups: np.ndarray) -> dict[int, Quality]:
    """The figures of every condition group by its number, from log p* - log p and groups, shapes (N,)."""
    return {int(group): _quality(log_weights[groups == group]) for group in np.unique(groups)}


def _quality(log_weights: np.ndarray) -> Quality:
    log_count = math.log(len(log_weights))
    log_sum = float(logsumexp(log_weights))
    log_z = log_sum - log_count
    ess = math.exp(2 * log_sum - float(logsumexp(2 * log_weights)) - log_count)
    weights = np.exp(log_weights - log_weights.max())
    mean = log_weights.mean()
    return Quality(
        ess=ess,
        kl_nats=float(log_z - mean),
        log_z=log_z,
        ess_error=effective_share_error(weights),
        # the log of the mean weight less the mean log weight, of the same samples
        kl_error_nats=standard_error(weights / weights.mean() - 1 - (log_weights - mean)),
        log_z_error=log_mean_error(weights),
    )


def coverage(
    log_prob: np.ndarray, log_target: np.ndarray, log_proposal: np.ndarray, log_z: np.ndarray | float
) -> Estimate:
    """The covered share of the target's mass, from proposals with their three log densities, shapes (N,).

    With conditions `log_z` has the value of each proposal's condition group, shape (N,). No proposals cover nothing.
    """
    if not len(log_target):
        return Estimate(0.0, None)
    log_mass = log_target - log_proposal
    mass = np.exp(log_mass - log_mass.max())
    covered = log_prob >= log_target - log_z + math.log(COVERED_RATIO)
    share = float(mass[covered].sum() / mass.sum())
    return Estimate(share, weighted_mean_error(covered.astype(np.float64), mass))
