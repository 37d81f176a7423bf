"""Samples of a learned density and its values at points: a flow that the target thins.

A flow is a continuous map. Where the target ends at once, at a silhouette or behind an occluder, some of the flow's
mass leaks to places where no ray is worth anything: few samples, but each some hundred nats deep, so that they make up
most of KL(p || pi). The target knows them. A sample whose weight w = p* / p is below the mean weight Z is therefore
kept with the probability w / Z alone. What is kept has the density

    min(p, p* / Z) / A,    with A the share that is kept, which is 1 - TV(p, pi),

and weights of max(w, Z) A. Nothing is lost: what is left out weighs little. Where rays are learned along conditions, Z
and A are those of a condition's group, and of every group as many are kept as of the one that keeps fewest. So that a
group which was learned badly takes no samples from the others, it is thinned at less than Z, to a quarter at most.

The samples that are kept are joined by points independent of the flow, where both densities p and q are known at all
points. What is drawn from either has the density m = (1 - s) p + s q, with their shares as they are, and weights
p* / m (Veach and Guibas 1995). q is known up to a constant, which is estimated by the optimal bridge between p and q.

References:
    Rejection control and sequential importance sampling, Liu, Chen and Wong 1998.
    Simulating ratios of normalizing constants via a simple identity, Meng and Wong 1996.
    Optimally combining sampling techniques for Monte Carlo rendering, Veach and Guibas 1995.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
import torch
from scipy.optimize import brentq

from lidardesign.density.coordinates import Coordinates
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.target import Target
from lidardesign.errors import BackgroundNote
from lidardesign.estimates import Estimate, log_mean_error
from lidardesign.numerics import SLACK, logsumexp
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

POINTS_AT_ONCE = 16384
CONDITION_GROUPS = 32
# Of the independent points that there are: what is tried beside the flow's samples.
MIXED_SHARES = (0.0, 0.25, 0.5, 1.0)
# Least predicted gain in effective samples by independent points; less may be noise of the pilots.
LEAST_GAIN = 1.05
# Log ratios of densities are clipped here: beyond, two densities hardly overlap.
LARGEST_NATS = 300.0
# Of the samples of a condition group: what thinning leaves at least.
LEAST_GROUP_SHARE = 0.25


def condition_groups(space: DesignSpace, points: np.ndarray) -> np.ndarray | None:
    """The condition group of points (N, 6): equal parts of the first condition's bounds, shape (N,); None without."""
    if not space.conditioned:
        return None
    first = space.conditioned[0]
    share = (points[:, first] - space.low[first]) / (space.high[first] - space.low[first])
    return np.clip((share * CONDITION_GROUPS).astype(int), 0, CONDITION_GROUPS - 1)


@dataclass(eq=False)
class LearnedFlow:
    """A flow, the target that it was learned for, and the stream that its samples are drawn from."""

    flow: DesignFlow
    target: Target
    coordinates: Coordinates
    generator: torch.Generator


@dataclass(frozen=True)
class Thinning:
    """Thinning of a flow's samples by rejection of low weights.

    Arguments:
        log_least: log of the weight p* / p below which a sample is kept by chance, by condition group; one without.
        log_share: log of the share that this keeps, by group.
    """

    log_least: tuple[float, ...]
    log_share: tuple[float, ...]

    @classmethod
    def of(cls, log_weights: np.ndarray, groups: np.ndarray | None = None) -> Self:
        """The thinning at the mean weight of a flow's samples.

        Arguments:
            log_weights: log p* - log p, shape (N,).
            groups: Their condition groups, shape (N,), where there are conditions.
        """
        parts = [log_weights] if groups is None else [log_weights[groups == n] for n in range(CONDITION_GROUPS)]
        # a group without finite weights is thinned as all of them
        parts = [part if np.isfinite(part).any() else log_weights for part in parts]
        log_least = [_log_mean(part) for part in parts]
        if groups is not None:
            log_least = [_log_least(part, most) for part, most in zip(parts, log_least, strict=True)]
        log_share = [_log_kept(part, least) for part, least in zip(parts, log_least, strict=True)]
        return cls(tuple(log_least), tuple(log_share))

    @property
    def log_kept(self) -> float:
        """log of the share of a flow's samples that is kept."""
        return min(self.log_share)

    def log_prob(self, log_prob: np.ndarray, log_target: np.ndarray, groups: np.ndarray | None = None) -> np.ndarray:
        """The log density of the thinned flow at any points with log p* and their groups, shapes (N,)."""
        least, share = self._of(groups)
        return np.minimum(log_prob, log_target - least) - share

    def thinned(self, samples: Samples, generator: torch.Generator) -> Samples:
        """Those of a flow's samples that are kept, with the thinned density."""
        groups = condition_groups(samples.space, samples.points)
        least, share = self._of(groups)
        chance = torch.rand(len(samples), generator=generator, dtype=torch.float64, device=generator.device)
        log_chance = np.minimum(samples.log_weights - least, 0.0) + self.log_kept - share
        kept = np.log(chance.cpu().numpy()) < log_chance
        log_prob = self.log_prob(samples.log_prob, samples.log_target, groups)
        return replace(samples.subset(kept), log_prob=log_prob[kept])

    def _of(self, groups: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """log_least and log_share of points' groups, shapes (N,), or () without conditions."""
        numbers = 0 if groups is None else groups
        return np.asarray(self.log_least)[numbers], np.asarray(self.log_share)[numbers]


def _log_mean(log_values: np.ndarray) -> float:
    return float(logsumexp(log_values)) - math.log(len(log_values))


def _log_kept(log_weights: np.ndarray, log_least: float) -> float:
    """log of the share of samples that is kept at a least weight."""
    return _log_mean(np.minimum(log_weights - log_least, 0.0))


def _log_least(log_weights: np.ndarray, most: float) -> float:
    """log of the largest least weight, up to `most`, at which `LEAST_GROUP_SHARE` of samples is kept."""

    def excess(log_least: float) -> float:
        return _log_kept(log_weights, log_least) - math.log(LEAST_GROUP_SHARE)

    least = float(log_weights[np.isfinite(log_weights)].min())
    if excess(most) >= 0 or excess(least) <= 0:
        return most if excess(most) >= 0 else least
    return brentq(excess, least, most)


def draw_samples(learned: LearnedFlow, count: int) -> Samples:
    """Fresh samples of the flow with their log density and log target, in chunks."""
    points, log_prob, flow, coordinates = [], [], learned.flow, learned.coordinates
    with torch.no_grad():
        for start in range(0, count, POINTS_AT_ONCE):
            base, conditions = flow.draw(min(POINTS_AT_ONCE, count - start), learned.generator)
            values, log_density = flow(base, conditions)
            unit = coordinates.join(values, conditions).cpu().double().numpy()
            points.append(coordinates.space.from_unit(unit))
            log_prob.append(log_density.cpu().double().numpy())
    points = np.concatenate(points)
    offset = coordinates.log_condition_density - coordinates.log_unit_volume
    return Samples(points, np.concatenate(log_prob) + offset, learned.target.log_density(points), coordinates.space)


def log_density_of(learned: LearnedFlow, points: np.ndarray) -> np.ndarray:
    """The flow's log density per chart volume at any design points, (N, 6) to (N,); -inf outside the space."""
    flow, coordinates = learned.flow, learned.coordinates
    # points on the space's faces may leave it by rounding
    unit = torch.as_tensor(coordinates.space.to_unit(points).clip(-1.0, 1.0))
    log_prob = log_prob_of_unit(flow, coordinates, unit).cpu().double().numpy()
    log_prob = np.where(coordinates.space.contains(points), log_prob, -np.inf)
    return log_prob + coordinates.log_condition_density - coordinates.log_unit_volume


@torch.no_grad()
def log_prob_of_unit(flow: DesignFlow, coordinates: Coordinates, unit: torch.Tensor) -> torch.Tensor:
    """The flow's log density per unit volume given the conditions, (N, free) to (N,), in its own arithmetic."""
    unit = unit.to(next(flow.parameters()))
    conditions = unit[:, coordinates.conditions] if coordinates.conditions else None
    parts = [
        flow.log_prob(unit[rows][:, coordinates.learned], None if conditions is None else conditions[rows])
        for rows in torch.arange(len(unit)).split(POINTS_AT_ONCE)
    ]
    return torch.cat(parts)


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """Points of either density, with both densities there.

    Arguments:
        points: Design points, shape (N, 6).
        log_flow: log of the density of a flow's samples, shape (N,).
        log_proposal: log of that of independent points, up to a constant; -inf where there are none, shape (N,).
        log_target: log p*, shape (N,).
    """

    points: np.ndarray
    log_flow: np.ndarray
    log_proposal: np.ndarray
    log_target: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, keep: slice) -> KnownPoints:
        """Some of them."""
        return KnownPoints(*(getattr(self, one.name)[keep] for one in fields(self)))

    def log_weights(self, share: float, log_constant: float) -> np.ndarray:
        """log p* / m at the points where a share of all is independent, shape (N,)."""
        log_mixed = self.log_flow
        if share > 0:
            log_proposal = math.log(share) + self.log_proposal - log_constant
            log_mixed = np.logaddexp(math.log1p(-share) + self.log_flow, log_proposal)
        return self.log_target - log_mixed


def log_constant(flow: KnownPoints, independent: KnownPoints) -> Estimate:
    """log of the unknown factor of the independent points' density, by the optimal bridge [nats].

    Raises:
        ValueError: The two densities do not overlap.
    """
    share = len(independent) / (len(flow) + len(independent))
    ratios = [np.clip(one.log_proposal - one.log_flow, -LARGEST_NATS, LARGEST_NATS) for one in (flow, independent)]

    def bridged(constant: float) -> tuple[np.ndarray, np.ndarray]:
        """q / m at points of the flow and p / m at independent ones."""
        mine, theirs = (ratio - constant for ratio in ratios)
        log_share, log_rest = math.log(share), math.log1p(-share)
        return np.exp(-np.logaddexp(log_share, log_rest - mine)), np.exp(-np.logaddexp(log_rest, log_share + theirs))

    def excess(constant: float) -> float:
        mine, theirs = bridged(constant)
        return float(mine.mean() - theirs.mean())

    found = brentq(excess, -2 * LARGEST_NATS, 2 * LARGEST_NATS, xtol=SLACK)
    mine, theirs = bridged(found)
    return Estimate(found, math.hypot(log_mean_error(mine), log_mean_error(theirs)), "nats")


def effective_count_of_mixture(
    flow: KnownPoints, independent: KnownPoints, counts: tuple[int, int], constant: float, space: DesignSpace
) -> float:
    """The effective sample size of a mixture of a flow's and independent samples, estimated from other draws.

    Arguments:
        flow, independent: Draws of both.
        counts: Numbers of samples of each.
        constant: See `log_constant`.
        space: The design space; effective sizes of condition groups add up.
    """
    total = sum(counts)
    drawn, worth = [flow, independent] if counts[1] else [flow], 0.0
    log_weights = np.concatenate([one.log_weights(counts[1] / total, constant) for one in drawn])
    stands_for = np.repeat([count / len(one) for count, one in zip(counts, drawn, strict=False)], [*map(len, drawn)])
    groups = condition_groups(space, np.concatenate([one.points for one in drawn]))
    for group in [None] if groups is None else np.unique(groups):
        mine = slice(None) if group is None else groups == group
        weights = np.exp(log_weights[mine] - log_weights[mine].max())
        worth += float((stands_for[mine] @ weights) ** 2 / (stands_for[mine] @ np.square(weights)))
    return worth


@dataclass(frozen=True, eq=False)
class MixedSamples:
    """Samples of a flow and independent points together.

    Arguments:
        samples: All of them, with the density that they were drawn from together.
        independent: How many of them are independent points.
        effective: How many distinct samples of equal weight they are worth; `of_flow`: those of the flow alone.
        constant: log of the constant of the independent points' density, with its standard error [nats]; None where
            their density is not known at samples of the flow.
    """

    samples: Samples
    independent: int
    effective: float
    of_flow: float
    constant: Estimate | None

    @property
    def notes(self) -> tuple[str, ...]:
        """A line about the independent points, where there are some."""
        if not self.independent or self.constant is None or self.constant.error is None:
            return ()
        return (
            BackgroundNote(
                f"{self.independent} independent points beside {len(self.samples) - self.independent} samples of the "
                f"flow: {self.effective:.0f} distinct samples of equal weight, {self.of_flow:.0f} of the flow alone; "
                f"the constant of their density is known to {self.constant.error:.1%}"
            ),
        )

    def as_dict(self) -> dict[str, float]:
        """The plain values of files and JSON."""
        return {
            "flow": len(self.samples) - self.independent,
            "independent": self.independent,
            "effective": self.effective,
            "effective_of_flow": self.of_flow,
            **({} if self.constant is None else {"log_constant_error_nats": self.constant.error or 0.0}),
        }

    @classmethod
    def of_flow_alone(cls, samples: Samples, constant: Estimate | None = None) -> Self:
        """Samples of a flow without independent points."""
        return cls(samples, 0, samples.independent, samples.independent, constant)


def mixed(
    samples: Samples, kept: KnownPoints, pool: KnownPoints, pilots: tuple[KnownPoints, KnownPoints]
) -> MixedSamples:
    """Samples of a flow with as many independent points as give the largest effective size, or none.

    Arguments:
        samples: Of the flow.
        kept: The same points with both densities.
        pool: Independent points.
        pilots: Other draws of both, by which the share is chosen.
    """
    alone, space = samples.independent, samples.space
    constant = log_constant(kept, pool)
    numbers = [round(share * len(pool)) for share in MIXED_SHARES]
    worth = [effective_count_of_mixture(*pilots, (len(kept), number), constant.value, space) for number in numbers]
    best = int(np.argmax(worth))
    if worth[best] > LEAST_GAIN * worth[0]:
        number = numbers[best]
        both = [kept, pool.subset(slice(number))]
        log_target = np.concatenate([one.log_target for one in both])
        share = number / (len(kept) + number)
        log_mixed = log_target - np.concatenate([one.log_weights(share, constant.value) for one in both])
        together = Samples(np.concatenate([one.points for one in both]), log_mixed, log_target, space)
        # the same point may be drawn again and again, which counts once
        if together.independent > alone:
            return MixedSamples(together, number, together.independent, alone, constant)
    return MixedSamples.of_flow_alone(samples, constant)
