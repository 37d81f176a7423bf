"""The two losses of learning: reverse KL along paths, then balancing by values.

The path-wise loss (paper, eq. 7) moves samples along the gradient of log p* and finds the surfaces while sigma is
annealed. It cannot find how much mass belongs on either side of a silhouette, because there p* jumps as one scene
after another is hidden and its gradient has no term for the jump: on faces it stays at a KL of 0.25 nats with the neck
starved by a factor of three. Balancing needs the values of p* only. For flow samples it follows the gradient of
the reverse KL in its log-variance form. For samples of p* from independent proposals it follows that of the mean
squared weight, the inverse of the ESS, which brings back what the flow dropped. Few samples leak to where log p* is
-100 and below, yet they would make up most of the KL: these are led back along paths, with a cost that grows like
their distance in sigmas.

Balancing has to trust densities that the flow finds at places (`round_trip_nats`). Sampling runs splines forward, the
density of a place inverts them, layer after layer. Where splines are steep, rounding between the layers is what the
inverse multiplies: float32 fails before float64 does. Measured on learned flows of the face, the arm and the warehouse:
6e-6 to 6e-5 nats in float32, 1e-13 to 1e-12 in float64.

References:
    VarGrad, Richter et al. 2020. Flow annealed importance sampling bootstrap, Midgley et al. 2023.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from lidardesign.density.coordinates import Coordinates, log_target, log_target_values
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.target import Target
from lidardesign.density.training.sampling import log_prob_of_unit
from lidardesign.numerics import effective_sample_size, logsumexp, normalised_weights

# Log weights further than this from the mean pull no harder.
LARGEST_PULL_NATS = 5.0
# Where the density is starved, a proposal counts by its weight p* / p, up to this factor: the gradient of E[w^2].
LARGEST_EMPHASIS = 300.0
# The share of the proposals' term beside the reverse KL on the flow's own samples, and that of the leaked ones.
LEAK_WEIGHT = 3.0
FORWARD_SHARE = 0.5


def effective_share(log_weights: Tensor) -> float:
    """(sum w)^2 / (N sum w^2) of log weights, shape (N,)."""
    return effective_sample_size(log_weights.detach().double().cpu().numpy())


def pathwise_loss(
    flow: DesignFlow,
    target: Target,
    coordinates: Coordinates,
    count: int,
    sigma_m: float,
    eta: float,
    generator: torch.Generator,
) -> tuple[Tensor, float, float]:
    """mean of (1 + eta) log p(d) - log p*(d) over flow samples; also its value for reports and the batch's ESS."""
    base, conditions = flow.draw(count, generator)
    learned, log_prob = flow(base, conditions)
    log_p_star = log_target(coordinates.join(learned, conditions), target, coordinates, sigma_m)
    loss = ((1 + eta) * log_prob - log_p_star).sum() / count
    log_prob, log_p_star = log_prob.detach(), log_p_star.detach()
    return loss, float(((1 + eta) * log_prob - log_p_star).mean()), effective_share(log_p_star - log_prob)


@dataclass(frozen=True, eq=False)
class Pool:
    """Proposals weighted to p*, of which balancing draws the starved ones more often.

    Arguments:
        unit: Unit points of all free dimensions, shape (M, free).
        log_target: log p* at them, shape (M,).
        weights: Their normalised weights p* / q, shape (M,).
        emphasis: How much more often than by its weight each is drawn, shape (M,).
    """

    unit: Tensor
    log_target: Tensor
    weights: Tensor
    emphasis: Tensor

    @classmethod
    def of(cls, unit: np.ndarray, log_target: np.ndarray, log_proposal: np.ndarray) -> Pool:
        """The pool of proposals with log p* and log q."""
        counting = log_target > -np.inf
        unit, log_target, log_proposal = unit[counting], log_target[counting], log_proposal[counting]
        weights = normalised_weights(log_target - log_proposal)
        return cls(*map(torch.as_tensor, (unit, log_target, weights, np.ones(len(weights)))))

    @cached_property
    def cumulated(self) -> Tensor:
        """Cumulated probabilities of being drawn, shape (M,)."""
        drawn = torch.cumsum(self.weights * self.emphasis, dim=0)
        return drawn / drawn[-1]

    def emphasised(self, flow: DesignFlow, coordinates: Coordinates) -> Pool:
        """The same proposals, drawn in proportion to p* (1 + p* / p): those that the flow starves more often."""
        log_weights = self.log_target - log_prob_of_unit(flow, coordinates, self.unit).to(self.log_target)
        # E_pi[p / p*] = 1 / Z
        log_z = -torch.logsumexp(torch.log(self.weights) - log_weights, dim=0)
        starved = (log_weights - log_z).clamp(max=float(np.log(LARGEST_EMPHASIS))).exp()
        # a flow with non-finite parameters gives no emphasis
        return replace(self, emphasis=1.0 + torch.nan_to_num(starved, nan=0.0))

    def draw(self, count: int, generator: torch.Generator, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit points, shape (count, free), log p* at them and the weights that make them samples of p*, (count,)."""
        places = torch.rand(count, generator=generator, dtype=torch.float64).to(self.cumulated.device)
        chosen = torch.searchsorted(self.cumulated, places).clamp(max=len(self.unit) - 1)
        weights = (self.weights * self.emphasis).sum() / self.emphasis[chosen]
        return self.unit[chosen].to(like), self.log_target[chosen].to(like), weights.to(like)

    def to(self, device: torch.device) -> Pool:
        """The same on a device."""
        return Pool(*(values.to(device) for values in (self.unit, self.log_target, self.weights, self.emphasis)))


def balancing_loss(
    flow: DesignFlow, target: Target, coordinates: Coordinates, count: int, pool: Pool, generator: torch.Generator
) -> tuple[Tensor, float, float]:
    """A loss whose gradient balances mass by values of p*; also the reverse KL loss and the batch's ESS."""
    base, conditions = flow.draw(count, generator)
    learned, own = flow(base, conditions, held=True)
    log_weights = log_target_values(coordinates.join(learned, conditions), target, coordinates) - own.detach()
    log_z = logsumexp(log_weights) - np.log(count)
    centred = log_weights - log_z
    pull = centred.clamp(-LARGEST_PULL_NATS, LARGEST_PULL_NATS)
    pull = pull - pull.mean()
    proposed, proposed_target, proposed_weights = pool.draw(count, generator, learned)
    contexts = None if conditions is None else proposed[:, coordinates.conditions]
    others = flow.log_prob(proposed[:, coordinates.learned], contexts)
    starved = (proposed_target - others.detach() - log_z).clamp(max=np.log(LARGEST_EMPHASIS)).exp()
    loss = -(pull * own).sum() / count - FORWARD_SHARE * (proposed_weights * starved * others).sum() / count
    leaked = centred < -LARGEST_PULL_NATS
    if leaked.any():
        few = None if conditions is None else conditions[leaked]
        again, _ = flow(base[leaked], few)
        log_p_star = log_target(coordinates.join(again, few), target, coordinates, target.optics.sigma_m)
        # the summed distances of leaked samples from the target, in sigmas
        cost = torch.sqrt((-2 * log_p_star).clamp(min=1.0)).sum()
        loss = loss + LEAK_WEIGHT * cost / count
    return loss, float(-log_weights.mean()), effective_share(log_weights)


# Weights are then off by one in a hundred.
TOLERANCE_NATS = 1e-2


@torch.no_grad()
def round_trip_nats(flow: DesignFlow, count: int, generator: torch.Generator) -> float:
    """The largest difference of the two log densities over `count` samples [nats]; inf where one is not finite."""
    base, conditions = flow.draw(count, generator)
    values, drawn = flow(base, conditions)
    off = (drawn - flow.log_prob(values, conditions)).abs()
    return float(torch.nan_to_num(off, nan=torch.inf).max())
