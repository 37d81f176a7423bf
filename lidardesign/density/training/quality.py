"""Quality of a learned density, measured on its own samples and on points drawn independently of it.

Neither sees everything. Samples of the density p cannot see what it starves or dropped: where pi = p* / Z is a hundred
times larger than p, they hardly ever are. Points of pi, which independent proposals become by their weights, see it,
but not what leaked away to where pi is nothing. Effective sample size and KL divergence are therefore estimated on
both sides, and the worse is reported:

    ESS = 1 / E_pi[pi / p], from weights w = p* / p of samples: (sum w)^2 / (N sum w^2);
    KL(p || pi) on samples, KL(pi || p) on points of pi.

Coverage is the share of the target's mass that lies where p is at least a tenth of pi.

Misplaced is the share of the density's mass in the wrong place: its total variation TV = 1/2 integral |p - pi|. It is
the one unit of all errors of a density's numerical choices: by the triangle inequality the errors of several choices
add up at most. The overlap of both densities is the mean of min(1, pi / p) over samples of p, and that of min(1, p /
pi) over points of pi. The two agree at one log Z only, which is the bridge estimate of it with the bridge min(p, p* /
Z); both means are of values in [0, 1], so no weight can spoil them.

References:
    Simulating ratios of normalizing constants via a simple identity, Meng and Wong 1996.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import brentq

from lidardesign.density.training.losses import TOLERANCE_NATS, round_trip_nats
from lidardesign.density.training.sampling import (
    CONDITION_GROUPS,
    LearnedFlow,
    Thinning,
    condition_groups,
    draw_samples,
    log_density_of,
)
from lidardesign.errors import NumericalError
from lidardesign.estimates import Estimate, effective_share_error, log_mean_error, standard_error, weighted_mean_error
from lidardesign.numerics import SLACK, TINY, logsumexp, normalised_weights
from lidardesign.run.clock import phase
from lidardesign.samples import Samples

# A point counts as covered where p >= COVERED_RATIO * p* / Z.
COVERED_RATIO = 0.1


def quality(log_prob: np.ndarray, log_target: np.ndarray, groups: np.ndarray | None = None) -> dict[str, Estimate]:
    """Figures of samples of p, shapes (N,), against their target; with `groups` (one per condition value) their means.

    Errors are standard errors over other samples of the flow.

    Returns:
        ess: (sum w)^2 / (N sum w^2), 0 to 1. kl_nats: KL(p || p* / Z) = mean(log p - log p*) + log Z. log_z: log of the
        integral of p* over the chart.

    Raises:
        NumericalError: A log density is NaN or infinite.
    """
    log_weights = log_target - log_prob
    if not len(log_weights) or not np.isfinite(log_weights).all():
        raise _no_weights(log_weights)
    return _quality(log_weights) if groups is None else _mean(list(quality_by_group(log_weights, groups).values()))


def _no_weights(log_weights: np.ndarray) -> NumericalError:
    return NumericalError(
        f"{int((~np.isfinite(log_weights)).sum())} of {len(log_weights)} samples of the flow have no finite weight",
        hint="a smaller learning.rate, or learning.dtype=float64",
    )


def _mean(parts: list[dict[str, Estimate]]) -> dict[str, Estimate]:
    """The mean figures of condition groups, which have samples of their own."""
    means = {}
    for name, first in parts[0].items():
        values, errors = [part[name].value for part in parts], [part[name].error for part in parts]
        means[name] = replace(first, value=float(np.mean(values)), error=float(np.linalg.norm(errors)) / len(parts))
    return means


def quality_by_group(log_weights: np.ndarray, groups: np.ndarray) -> dict[int, dict[str, Estimate]]:
    """The figures of every condition group by its number, from log p* - log p and groups, shapes (N,)."""
    return {int(group): _quality(log_weights[groups == group]) for group in np.unique(groups)}


def _quality(log_weights: np.ndarray) -> dict[str, Estimate]:
    log_count, log_sum = math.log(len(log_weights)), float(logsumexp(log_weights))
    log_z, ess = log_sum - log_count, math.exp(2 * log_sum - float(logsumexp(2 * log_weights)) - log_count)
    weights, mean = np.exp(log_weights - log_weights.max()), log_weights.mean()
    # of the log of the mean weight less the mean log weight, of the same samples
    kl_error = standard_error(weights / weights.mean() - 1 - (log_weights - mean))
    return {
        "ess": Estimate(ess, effective_share_error(weights)),
        "kl_nats": Estimate(float(log_z - mean), kl_error, "nats"),
        "log_z": Estimate(log_z, log_mean_error(weights), "nats"),
    }


def coverage(
    log_prob: np.ndarray, log_target: np.ndarray, log_proposal: np.ndarray, log_z: np.ndarray | float
) -> Estimate:
    """The covered share of the target's mass, from proposals with their three log densities, shapes (N,).

    With conditions `log_z` has the value of each proposal's condition group, shape (N,).
    """
    log_mass = log_target - log_proposal
    mass = np.exp(log_mass - log_mass.max())
    covered = log_prob >= log_target - log_z + math.log(COVERED_RATIO)
    return Estimate(float(mass[covered].sum() / mass.sum()), weighted_mean_error(covered.astype(np.float64), mass))


# Tolerance of the root log Z, far below its statistical error.
LOG_Z_TOLERANCE_NATS = SLACK
# A group of fewer points than this on either side is judged by the groups that have more.
LEAST_POINTS = 8
# An overlap below this counts as none, so that dividing by it is safe.
LEAST_SHARED = TINY
# Beyond so many nats a ratio of densities is no number that can be summed.
LARGEST_NATS = 300.0


def worse_of(samples: Mapping[str, Estimate], probes: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """The figures of a density from samples and probes, of both sides the lower ESS and the larger KL."""
    ess = min(samples["ess"], probes["ess"], key=lambda estimate: estimate.value)
    kl_nats = max(samples["kl_nats"], probes["kl_nats"], key=lambda estimate: estimate.value)
    return {**samples, **probes, "ess": ess, "kl_nats": kl_nats}


def overlap(
    at_samples: np.ndarray,
    at_proposals: np.ndarray,
    log_weights: np.ndarray,
    sample_groups: np.ndarray | None = None,
    proposal_groups: np.ndarray | None = None,
) -> dict[str, Estimate]:
    """The distance of a density from its target as proposals see it; with condition groups, their mean.

    Groups are alike in their conditions' share, so the mean over them is that over conditions. Errors are standard
    errors over other samples and other proposals.

    Arguments:
        at_samples: log p* - log p at samples of p, shape (N,); -inf where p* is 0.
        at_proposals: log p* - log p at proposals, shape (M,); +inf where p is 0.
        log_weights: log p* - log q of the proposals, up to a constant, shape (M,).
        sample_groups, proposal_groups: The condition group of each point, shapes (N,) and (M,), or None.

    Returns:
        ess: The effective sample size, 0 to 1. kl_nats: KL(pi || p). misplaced: The total variation, 0 to 1.

    Raises:
        NumericalError: A value is NaN, or one side has no points of finite weight.
    """
    parts = []
    for group in [] if sample_groups is None else np.unique(sample_groups):
        mine, theirs = sample_groups == group, proposal_groups == group
        if min(mine.sum(), theirs.sum()) >= LEAST_POINTS:
            parts.append(_overlap(at_samples[mine], at_proposals[theirs], log_weights[theirs]))
    return _mean(parts) if parts else _overlap(at_samples, at_proposals, log_weights)


def _overlap(at_samples: np.ndarray, at_proposals: np.ndarray, log_weights: np.ndarray) -> dict[str, Estimate]:
    if any(np.isnan(values).any() for values in (at_samples, at_proposals, log_weights)):
        raise NumericalError("a density is NaN where it is compared")
    if not np.isfinite(at_samples).any() or not np.isfinite(log_weights).any():
        raise NumericalError("the target is 0 wherever the density is compared with it")
    weights = normalised_weights(log_weights)

    def shares(log_z: float) -> tuple[np.ndarray, np.ndarray]:
        """min(1, pi / p) at the samples and min(1, p / pi) at the proposals."""
        return np.exp(np.minimum(at_samples - log_z, 0.0)), np.exp(np.minimum(log_z - at_proposals, 0.0))

    def gap(log_z: float) -> float:
        at_own, at_others = shares(log_z)
        return float(at_own.mean()) - float(weights @ at_others)

    start = float(logsumexp(at_samples[np.isfinite(at_samples)])) - math.log(len(at_samples))
    log_z = float(brentq(gap, *_bracket(gap, start), xtol=LOG_Z_TOLERANCE_NATS))
    at_own, at_others = shares(log_z)
    shared = float(at_own.mean())
    # of the overlap, p is the lesser density on `rare` and pi on the rest; a shift of log Z trades one for the other
    rare = float((at_samples >= log_z).mean())
    rest = shared - rare
    own = np.square(at_own - shared).mean() / len(at_own)
    others = float(np.square(weights * (at_others - shared)).sum())
    error = math.hypot(rare * math.sqrt(own), rest * math.sqrt(others)) / max(shared, LEAST_SHARED)
    starved_nats = np.clip(at_proposals - log_z, -LARGEST_NATS, LARGEST_NATS)
    ratios = np.exp(starved_nats)
    mean_ratio = float(weights @ ratios)
    # rounding of the two sides may take the ESS beyond 1
    ess, ess_error = min(1.0 / mean_ratio, 1.0), weighted_mean_error(ratios, weights) / mean_ratio**2
    kl_nats, kl_error = max(float(weights @ starved_nats), 0.0), weighted_mean_error(starved_nats, weights)
    return {
        "ess": Estimate(ess, ess_error),
        "kl_nats": Estimate(kl_nats, kl_error, "nats"),
        "misplaced": Estimate(1.0 - shared, error),
    }


def _bracket(gap: Callable[[float], float], start: float) -> tuple[float, float]:
    """Two values of log Z that bracket the root of a gap that falls from 1 to -1 (0 without overlap)."""
    ends = []
    for side in (-1.0, 1.0):
        end, reach = start, 1.0
        while side * gap(end) > 0:
            end, reach = end + side * reach, 2 * reach
        ends.append(end)
    return ends[0], ends[1]


# So many samples go back to the flow's base.
ROUND_TRIPS = 1000
NOT_COVERED = (
    "coverage could not be measured and counts as 0, and misplaced leaves out what the density dropped: "
    "no independently drawn ray fits in the space"
)


@dataclass(frozen=True, eq=False)
class MeasuredFlow:
    """Fresh samples of a flow, and its figures with their errors.

    Arguments:
        samples: The thinned samples with both log densities.
        estimates: ess, kl_nats, log_z, coverage, and misplaced: the share of the mass in the wrong place.
        round_trip_nats: See `round_trip`.
        notes: Lines for the user.
        thinning: What the flow was thinned by.
    """

    samples: Samples
    estimates: dict[str, Estimate]
    thinning: Thinning
    round_trip_nats: float = 0.0
    notes: tuple[str, ...] = ()


@phase("measuring")
def measure(learned: LearnedFlow, probes: Samples, count: int) -> MeasuredFlow:
    """The density that `count` fresh samples of a flow are thinned to, and its figures from these and from probes.

    Probes are drawn independently of the flow, and the density that they are drawn from is known up to a constant.

    Raises:
        NumericalError: A sample has no finite weight.
    """
    samples, notes = draw_samples(learned, count), []
    space = samples.space
    if not np.isfinite(samples.log_weights.max()):
        raise _no_weights(samples.log_weights)
    thinning = Thinning.of(samples.log_weights, condition_groups(space, samples.points))
    samples = thinning.thinned(samples, learned.generator)
    groups = condition_groups(space, samples.points)
    figures, covered = quality(samples.log_prob, samples.log_target, groups), Estimate(0.0, None)
    sides = samples.log_weights, samples.log_weights, samples.log_weights, groups, groups
    if len(probes):
        theirs = condition_groups(space, probes.points)
        log_prob = thinning.log_prob(log_density_of(learned, probes.points), probes.log_target, theirs)
        log_z = _log_z_at(probes.points, samples, groups, figures["log_z"].value)
        covered = coverage(log_prob, probes.log_target, probes.log_prob, log_z)
        sides = samples.log_weights, probes.log_target - log_prob, probes.log_weights, groups, theirs
    else:
        notes.append(NOT_COVERED)
    estimates = worse_of(figures, overlap(*sides)) | {"coverage": covered}
    off = round_trip_nats(learned.flow, ROUND_TRIPS, torch.Generator().manual_seed(0))
    if off > TOLERANCE_NATS:
        notes.append(
            f"log densities are off by up to {off:.2g} nats: the flow's splines are too steep to be inverted in "
            "float64; fewer learning.layers are easier to invert"
        )
    return MeasuredFlow(samples, estimates, thinning, off, tuple(notes))


def _log_z_at(points: np.ndarray, samples: Samples, groups: np.ndarray | None, mean_log_z: float) -> np.ndarray | float:
    """log Z of the condition group of each point; the mean where there are no conditions or no samples."""
    if groups is None:
        return mean_log_z
    by_group = np.full(CONDITION_GROUPS, mean_log_z)
    for group, part in quality_by_group(samples.log_weights, groups).items():
        by_group[group] = part["log_z"].value
    return by_group[condition_groups(samples.space, points)]


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
            raise NumericalError("a density has no finite mass where it is compared")
    first, second = (normalised_weights(values - log_proposal) for values in (log_first, log_second))
    apart = np.abs(first - second) / 2
    sign = np.sign(first - second) / 2
    influence = apart - first * (sign @ first) + second * (sign @ second)
    return float(apart.sum()), float(np.sqrt(np.square(influence).sum()))
