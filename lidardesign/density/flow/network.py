"""The normalizing flow: autoregressive rational-quadratic splines from a uniform box to the box of design space.

The density is a chain over the dimensions in the order of a ray's physics, p(x, y, z) p(azimuth, elevation | origin)
p(range | ray), one dimension at a time. Each is mapped from its base coordinate by a stack of splines, whose parameters
one network finds from the finished coordinates before it. So where a surface lies along a ray is a function of the ray
itself, and both directions, sampling and the density of foreign points, cost one network pass a dimension.
Coordinates are the free dimensions scaled to [-1, 1]. Networks see each as itself and as waves of a few frequencies:
with those they follow a surface's relief in fewer steps.

For an azimuth that spans the full turn the outer slopes are tied and each spline starts half a turn away, so that the
density is continuous across 0 / 2 pi; networks see its waves alone.

References:
    Neural Spline Flows, Durkan et al. 2019. Normalizing Flows on Tori and Spheres, Rezende et al. 2020. Fourier
    Features Let Networks Learn High Frequency Functions in Low Dimensional Domains, Tancik et al. 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lidardesign.density.flow.splines import BOUND, splines

# How far the networks' last layer is scaled down at the start, so that the flow begins near the identity.
INITIAL_SCALE = 0.1
# Whole numbers of waves over a coordinate's range, so that those of a circle close.
WAVES = (1.0, 2.0, 4.0)


class _Constant(nn.Module):
    """Spline parameters that all points share, where there is nothing to see."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.empty(1, outputs))

    def forward(self, features: Tensor) -> Tensor:
        return self.values.expand(len(features), -1)


def _network(inputs: int, hidden: int, outputs: int) -> nn.Module:
    if not inputs:
        return _Constant(outputs)
    first, second, last = nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, outputs)
    return nn.Sequential(first, nn.ReLU(inplace=True), second, nn.ReLU(inplace=True), last)


def _seen(values: Tensor, periodic: bool) -> Tensor:
    """What networks see of a coordinate, (N,) to (N, features)."""
    angles = math.pi * values[:, None] * torch.tensor(WAVES).to(values)
    waves = torch.cat([torch.cos(angles), torch.sin(angles)], dim=1)
    return waves if periodic else torch.cat([values[:, None], waves], dim=1)


class DesignFlow(nn.Module):
    """A density over the free dimensions of design space, scaled to [-1, 1].

    Arguments:
        features: The number of learned dimensions.
        context: The number of conditioning dimensions.
        layers: Splines in the stack of each dimension.
        hidden: The width of each network's two hidden layers.
        bins: Spline bins.
        periodic: Which of the learned dimensions lie on a circle.
        generator: Draws the initial weights.
    """

    def __init__(
        self,
        features: int,
        context: int = 0,
        *,
        layers: int,
        hidden: int,
        bins: int,
        periodic: Sequence[bool] = (),
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.features, self.context = features, context
        self._periodic, self._layers = list(periodic) or [False] * features, layers
        self.networks = nn.ModuleList()
        width = context * (1 + 2 * len(WAVES))
        # torch draws initial weights from its global stream; they are replaced by the generator's below
        with torch.random.fork_rng(devices=[]):
            for circular in self._periodic:
                self.networks.append(_network(width, hidden, layers * (3 * bins + 1)))
                width += 2 * len(WAVES) + (not circular)
        with torch.no_grad():
            for parameter in self.parameters():
                bound = 1 / math.sqrt(parameter.shape[-1])
                parameter.uniform_(-bound, bound, generator=generator)
            for network in self.networks:
                for parameter in list(network.parameters())[-2:]:
                    parameter.mul_(INITIAL_SCALE)

    @property
    def log_base(self) -> float:
        """The log density of the uniform base on [-1, 1]^D."""
        return -self.features * math.log(2 * BOUND)

    def forward(self, base: Tensor, context: Tensor | None = None, *, held: bool = False) -> tuple[Tensor, Tensor]:
        """Samples and their log density of base points: (N, D), (N, context) to (N, D) and (N,).

        With `held` samples are fixed points: the gradient of their log density is that of `log_prob` at them.
        """
        return self._chained(base, context, held=held)

    def log_prob(self, values: Tensor, context: Tensor | None = None) -> Tensor:
        """The log density of any points in [-1, 1]^D, (N, D) to (N,); -inf outside, also for NaN."""
        outside = ~(values.abs() <= BOUND).all(dim=-1)
        inside = torch.where(outside[:, None], 0.0, values)
        return torch.where(outside, -torch.inf, self._chained(inside, context, inverted=True)[1])

    def _chained(
        self, given: Tensor, context: Tensor | None, *, inverted: bool = False, held: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Each dimension's values after the other's, and the log density at the samples' end."""
        log_prob, columns = torch.full_like(given[:, 0], self.log_base), []
        seen = [] if context is None else [_seen(column, False) for column in context.unbind(dim=1)]
        for n, (network, periodic) in enumerate(zip(self.networks, self._periodic, strict=True)):
            features = torch.cat(seen, dim=1) if seen else given[:, :0]
            parameters = network(features).unflatten(1, (self._layers, -1))
            values, log_slope = splines(given[:, n], parameters, periodic, inverted=inverted, held=held)
            log_prob = log_prob - log_slope
            columns.append(values)
            if n + 1 < self.features:
                seen = [features, _seen(given[:, n] if inverted else values, periodic)]
        return torch.stack(columns, dim=1), log_prob

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
        """Uniform base points, shape (count, D), and uniform conditions, shape (count, context), or None without any.

        Both are in the parameters' type and place.
        """
        conditions = self._uniform(count, self.context, generator) if self.context else None
        return self._uniform(count, self.features, generator), conditions

    def _uniform(self, count: int, columns: int, generator: torch.Generator) -> Tensor:
        points = torch.rand(count, columns, generator=generator, dtype=torch.float64)
        return (2 * points - 1).to(next(self.parameters()))
