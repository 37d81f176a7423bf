"""Samples of a learned density and its values at points: a flow that the target thins.

A flow is a continuous map. Where the target ends at once, at a silhouette or behind an occluder, some of the flow's
mass leaks to places where no ray is worth anything: few samples, but each some hundred nats deep, so that they make up
most of KL(p || pi). The target knows them. A sample whose weight w = p* / p is below the mean weight Z is therefore
kept with the probability w / Z alone. What is kept has the density

    min(p, p* / Z) / A,    with A the share that is kept, which is 1 - TV(p, pi),

and weights of max(w, Z) A. Nothing is lost: what is left out weighs little. Where rays are learned
along conditions A is another one for each of their values, and the flow is not thinned.

References:
    Rejection control and sequential importance sampling, Liu, Chen and Wong 1998.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch

from lidardesign.density.flow.flow import DesignFlow
from lidardesign.density.flow.objective import Coordinates
from lidardesign.density.target.target import Target
from lidardesign.numerics import logsumexp
from lidardesign.samples import Samples

POINTS_AT_ONCE = 16384


@dataclass(eq=False)
class LearnedFlow:
    """A flow, the target that it was learned for, and the stream that its samples are drawn from."""

    flow: DesignFlow
    target: Target
    coordinates: Coordinates
    generator: torch.Generator


@dataclass(frozen=True)
class Thinning:
    """Which samples of a flow are kept.

    Arguments:
        log_least: log of the weight p* / p below which a sample is kept by chance.
        log_share: log of the share that is kept.
    """

    log_least: float
    log_share: float

    @classmethod
    def of(cls, log_weights: np.ndarray) -> Self:
        """The thinning at the mean weight of a flow's samples, from log p* - log p, shape (N,)."""
        log_count = math.log(len(log_weights))
        log_least = float(logsumexp(log_weights)) - log_count
        return cls(log_least, float(logsumexp(np.minimum(log_weights - log_least, 0.0))) - log_count)

    def log_prob(self, log_prob: np.ndarray, log_target: np.ndarray) -> np.ndarray:
        """The log density that is left of a flow's at any points with log p*, shapes (N,)."""
        return np.minimum(log_prob, log_target - self.log_least) - self.log_share

    def thinned(self, samples: Samples, generator: torch.Generator) -> Samples:
        """Those of a flow's samples that are kept, with the thinned density."""
        chance = torch.rand(len(samples), generator=generator, dtype=torch.float64, device=generator.device)
        kept = samples.subset(np.log(chance.cpu().numpy()) < samples.log_weights - self.log_least)
        return replace(kept, log_prob=self.log_prob(kept.log_prob, kept.log_target))


def draw_samples(learned: LearnedFlow, count: int) -> Samples:
    """Fresh samples of the flow with their log density and log target, in chunks."""
    points, log_prob, flow, coordinates = [], [], learned.flow, learned.coordinates
    with torch.no_grad():
        for start in range(0, count, POINTS_AT_ONCE):
            size = min(POINTS_AT_ONCE, count - start)
            base, conditions = flow.draw(size, learned.generator)
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
