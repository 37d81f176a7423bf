"""The normalizing flow: autoregressive rational-quadratic splines from a uniform box to the box of design space.

Every layer maps u_i = h(z_i; z_<i) in one pass from base to design point (paper, section 4.3), so that sampling with
its log determinant costs one network pass per layer; the density of foreign points inverts the layers and costs one
pass per dimension and layer. Coordinates are the free dimensions scaled to [-1, 1]. Splines are zuko's, with two
differences: all knot slopes are learned, the outer ones too, and for an azimuth that spans the full turn the outer
slopes are tied and the spline starts half a turn away, so that the density is continuous across 0 / 2 pi.

References:
    Neural Spline Flows, Durkan et al. 2019. Normalizing Flows on Tori and Spheres, Rezende et al. 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from zuko.flows.autoregressive import MaskedAutoregressiveTransform
from zuko.transforms import MonotonicRQSTransform

BOUND = 1.0
# Base samples and foreign points are kept this far inside the box, where splines are smooth.
EDGE = 1e-7
# How far the networks' last layer is scaled down at the start, so that the flow begins near the identity.
INITIAL_SCALE = 0.1
# Half the logarithm of the steepest slope that a spline may take; e^9 resolves a 0.1 mm shell in a 1 m range.
MINIMUM_SLOPE = 1e-4


class BoundedSpline(MonotonicRQSTransform):
    """A rational-quadratic spline of [-1, 1] onto itself whose outer slopes are learned as well.

    Arguments:
        widths: Unconstrained bin widths, with shape (*, K).
        heights: Unconstrained bin heights, with shape (*, K).
        derivatives: Unconstrained knot slopes, with shape (*, K + 1).
        periodic: Mask of the dimensions on a circle, with shape (D,), or None.
    """

    def __init__(self, widths: Tensor, heights: Tensor, derivatives: Tensor, periodic: Tensor | None = None) -> None:
        super().__init__(widths, heights, derivatives[..., 1:-1], bound=BOUND, slope=MINIMUM_SLOPE)
        softened = derivatives / (1 + abs(derivatives / math.log(MINIMUM_SLOPE)))
        slopes = torch.exp(softened)
        if periodic is not None:
            outer = torch.exp((softened[..., :1] + softened[..., -1:]) / 2)
            tied = torch.cat([outer, slopes[..., 1:-1], outer], dim=-1)
            slopes = torch.where(periodic[:, None], tied, slopes)
        self.derivatives = slopes
        self.periodic = periodic
        # accumulated widths can pass the bound by rounding; the last knots are exact
        self.horizontal = torch.cat([self.horizontal[..., :-1], torch.full_like(self.horizontal[..., :1], BOUND)], -1)
        self.vertical = torch.cat([self.vertical[..., :-1], torch.full_like(self.vertical[..., :1], BOUND)], -1)

    def _turned(self, values: Tensor) -> Tensor:
        """The periodic dimensions half a turn on."""
        if self.periodic is None:
            return values
        return torch.where(self.periodic, torch.where(values >= 0, values - BOUND, values + BOUND), values)

    def call_and_ladj(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The spline's values and log slopes at x, with shape (*, D)."""
        return super().call_and_ladj(self._turned(x).clamp(-BOUND + EDGE, BOUND - EDGE))

    def _call(self, x: Tensor) -> Tensor:
        return super()._call(self._turned(x).clamp(-BOUND + EDGE, BOUND - EDGE))

    def _inverse(self, y: Tensor) -> Tensor:
        x = super()._inverse(y.clamp(-BOUND + EDGE, BOUND - EDGE))
        return self._turned(x)


def _order(features: int, layer: int) -> Tensor:
    """The rank of each dimension in a layer: reversed in every other layer, but the last one (the range) stays last.

    Where a ray's surface lies is a function of the ray, so the range is always drawn given all the others.
    """
    import os
    if os.environ.get("ORD") == "alt":
        return torch.arange(features) if layer % 2 == 0 else torch.arange(features).flip(0)
    rank = torch.arange(features)
    return rank if layer % 2 == 0 else torch.cat([rank[:-1].flip(0), rank[-1:]])


class DesignFlow(nn.Module):
    """A density over the free dimensions of design space, scaled to [-1, 1].

    Arguments:
        features: The number of learned dimensions D.
        context: The number of conditioning dimensions.
        layers: The number of spline layers.
        hidden: The width of each layer's two hidden layers.
        bins: Spline bins.
        periodic: Which of the D dimensions lie on a circle.
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
        mask = torch.tensor(list(periodic), dtype=torch.bool) if any(periodic) else None
        self.register_buffer("periodic", mask, persistent=False)
        shapes = [(bins,), (bins,), (bins + 1,)]
        self.layers = nn.ModuleList(
            MaskedAutoregressiveTransform(
                features,
                context,
                order=_order(features, layer),
                univariate=self._spline,
                shapes=shapes,
                hidden_features=(hidden, hidden),
            )
            for layer in reversed(range(layers))
        )
        self._initialise(generator)

    def _spline(self, widths: Tensor, heights: Tensor, derivatives: Tensor) -> BoundedSpline:
        return BoundedSpline(widths, heights, derivatives, self.periodic)

    def _initialise(self, generator: torch.Generator) -> None:
        for parameter in self.parameters():
            bound = 1 / math.sqrt(parameter.shape[-1])
            with torch.no_grad():
                parameter.uniform_(-bound, bound, generator=generator)
        for layer in self.layers:
            last = list(layer.parameters())[-2:]
            with torch.no_grad():
                for parameter in last:
                    parameter.mul_(INITIAL_SCALE)

    @property
    def log_base(self) -> float:
        """The log density of the uniform base on [-1, 1]^D."""
        return -self.features * math.log(2 * BOUND)

    def forward(self, base: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Samples and their log density of base points: (N, D), (N, context) to (N, D) and (N,)."""
        values, log_prob = base, torch.full_like(base[:, 0], self.log_base)
        for layer in self.layers:
            values, log_slope = layer(context).call_and_ladj(values)
            log_prob = log_prob - self._summed(log_slope)
        return values, log_prob

    def log_prob(self, values: Tensor, context: Tensor | None = None) -> Tensor:
        """The log density of any points in [-1, 1]^D, (N, D) to (N,); -inf outside."""
        outside = (values.abs() > BOUND).any(dim=-1)
        values = values.clamp(-BOUND, BOUND)
        log_prob = torch.full_like(values[:, 0], self.log_base)
        for layer in reversed(self.layers):
            transform = layer(context)
            values = transform.inv(values)
            _, log_slope = transform.call_and_ladj(values)
            log_prob = log_prob - self._summed(log_slope)
        return torch.where(outside, -torch.inf, log_prob)

    def _summed(self, log_slope: Tensor) -> Tensor:
        return log_slope.sum(dim=-1) if log_slope.ndim == 2 else log_slope

    def draw_base(self, count: int, generator: torch.Generator) -> Tensor:
        """Uniform base points, shape (count, D), in the parameters' type and place."""
        like = next(self.parameters())
        points = torch.rand(count, self.features, generator=generator, dtype=torch.float64)
        return (2 * points - 1).to(dtype=like.dtype, device=like.device)
