"""The normalizing flow: autoregressive rational-quadratic splines from a uniform box to the box of design space.

The density is a chain of blocks in the order of a ray's physics, p(origin) p(direction | origin) p(range | ray). Inside
a block every layer maps u_i = h(z_i; z_<i) in one pass from base to design point (paper, section 4.3); a block sees the
finished coordinates of the blocks before it. So where a surface lies along a ray is a function of the ray itself, and
mass can move between directions without relearning the surface.
Sampling with its log determinant costs one network pass per layer; the density of foreign points inverts the layers
and costs one pass per layer and dimension of its block. Coordinates are the free dimensions scaled to [-1, 1].

Splines are zuko's, with two differences: all knot slopes are learned, the outer ones too, and for an azimuth that spans
the full turn the outer slopes are tied and the spline starts half a turn away, so that the density is continuous
across 0 / 2 pi; such an azimuth is a block of its own, and later blocks see its sine and cosine.

References:
    Neural Spline Flows, Durkan et al. 2019. Normalizing Flows on Tori and Spheres, Rezende et al. 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

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
        """The spline's values and log slopes at x, with shape (*, D); rounding never leaves [-1, 1]."""
        y, log_slope = super().call_and_ladj(self._turned(x).clamp(-BOUND + EDGE, BOUND - EDGE))
        return y.clamp(-BOUND, BOUND), log_slope

    def _call(self, x: Tensor) -> Tensor:
        return super()._call(self._turned(x).clamp(-BOUND + EDGE, BOUND - EDGE)).clamp(-BOUND, BOUND)

    def _inverse(self, y: Tensor) -> Tensor:
        """The root inside the bin; its discriminant is positive, but rounding may say otherwise."""
        y = y.clamp(-BOUND + EDGE, BOUND - EDGE)
        _, x0, x1, y0, y1, d0, d1, s = self.bin(self.searchsorted(self.vertical, y) - 1)
        bend = (y - y0) * (d0 + d1 - 2 * s)
        a, b, c = (y1 - y0) * (s - d0) + bend, (y1 - y0) * d0 - bend, -s * (y - y0)
        discriminant = (b**2 - 4 * a * c).clamp(min=torch.finfo(y.dtype).tiny)
        share = (2 * c / (-b - discriminant.sqrt())).clamp(0.0, 1.0)
        return self._turned(x0 + share * (x1 - x0))


class _Block(nn.Module):
    """Layers over a few dimensions, given a context.

    Arguments:
        dimensions: Positions of the block's coordinates among the flow's.
        context: The number of context features.
        periodic: Which of the block's dimensions lie on a circle.
    """

    def __init__(
        self, dimensions: Sequence[int], context: int, layers: int, hidden: int, bins: int, periodic: Sequence[bool]
    ) -> None:
        super().__init__()
        self.dimensions = list(dimensions)
        mask = torch.tensor(list(periodic), dtype=torch.bool) if any(periodic) else None
        self.register_buffer("periodic", mask, persistent=False)
        features = len(self.dimensions)
        rank = torch.arange(features)
        self.layers = nn.ModuleList(
            MaskedAutoregressiveTransform(
                features,
                context,
                order=rank if layer % 2 == 0 else rank.flip(0),
                univariate=self._spline,
                shapes=[(bins,), (bins,), (bins + 1,)],
                hidden_features=(hidden, hidden),
            )
            for layer in range(layers)
        )

    def _spline(self, widths: Tensor, heights: Tensor, derivatives: Tensor) -> BoundedSpline:
        return BoundedSpline(widths, heights, derivatives, self.periodic)

    def forward(self, values: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor]:
        """Outputs and the summed log slope: (N, d) to (N, d) and (N,)."""
        total = torch.zeros_like(values[:, 0])
        for layer in self.layers:
            values, log_slope = layer(context).call_and_ladj(values)
            total = total + _summed(log_slope)
        return values, total

    def log_slope(self, values: Tensor, context: Tensor | None) -> Tensor:
        """The summed log slope at the base points of outputs: (N, d) to (N,)."""
        total = torch.zeros_like(values[:, 0])
        for layer in reversed(self.layers):
            transform = layer(context)
            values = transform.inv(values)
            total = total + _summed(transform.call_and_ladj(values)[1])
        return total


def _summed(log_slope: Tensor) -> Tensor:
    return log_slope.sum(dim=-1) if log_slope.ndim == 2 else log_slope


class DesignFlow(nn.Module):
    """A density over the free dimensions of design space, scaled to [-1, 1].

    Arguments:
        blocks: Positions of the learned dimensions per block, in the order of the chain.
        context: The number of conditioning dimensions.
        layers: Spline layers per block.
        hidden: The width of each layer's two hidden layers.
        bins: Spline bins.
        periodic: Which of the learned dimensions lie on a circle.
        generator: Draws the initial weights.
    """

    def __init__(
        self,
        blocks: Sequence[Sequence[int]],
        context: int = 0,
        *,
        layers: int,
        hidden: int,
        bins: int,
        periodic: Sequence[bool] = (),
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.features, self.context = sum(map(len, blocks)), context
        self._periodic = list(periodic) or [False] * self.features
        self.blocks = nn.ModuleList()
        seen: list[int] = []
        # torch draws initial weights from its global stream; they are replaced by the generator's below
        with torch.random.fork_rng(devices=[]):
            for dimensions in blocks:
                width = context + len(seen) + sum(self._periodic[i] for i in seen)
                circular = [self._periodic[i] for i in dimensions]
                self.blocks.append(_Block(dimensions, width, layers, hidden, bins, circular))
                seen += dimensions
        self._initialise(generator)

    def _initialise(self, generator: torch.Generator) -> None:
        for parameter in self.parameters():
            bound = 1 / math.sqrt(parameter.shape[-1])
            with torch.no_grad():
                parameter.uniform_(-bound, bound, generator=generator)
        for block in self.blocks:
            for layer in block.layers:
                with torch.no_grad():
                    for parameter in list(layer.parameters())[-2:]:
                        parameter.mul_(INITIAL_SCALE)

    @property
    def log_base(self) -> float:
        """The log density of the uniform base on [-1, 1]^D."""
        return -self.features * math.log(2 * BOUND)

    def _features(self, finished: list[tuple[int, Tensor]], context: Tensor | None) -> Tensor | None:
        """What a block sees: conditions and finished coordinates, circular ones as cosine and sine."""
        columns = [] if context is None else [context]
        for dimension, values in finished:
            if self._periodic[dimension]:
                columns += [torch.cos(math.pi * values), torch.sin(math.pi * values)]
            else:
                columns.append(values)
        return torch.cat(columns, dim=-1) if columns else None

    def forward(self, base: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Samples and their log density of base points: (N, D), (N, context) to (N, D) and (N,)."""
        log_prob = torch.full_like(base[:, 0], self.log_base)
        finished: list[tuple[int, Tensor]] = []
        for block in self.blocks:
            values, log_slope = block(base[:, block.dimensions], self._features(finished, context))
            log_prob = log_prob - log_slope
            finished += [(dimension, values[:, [n]]) for n, dimension in enumerate(block.dimensions)]
        ordered = [values for _, values in sorted(finished, key=lambda pair: pair[0])]
        return torch.cat(ordered, dim=-1), log_prob

    def log_prob(self, values: Tensor, context: Tensor | None = None) -> Tensor:
        """The log density of any points in [-1, 1]^D, (N, D) to (N,); -inf outside, also for NaN."""
        outside = ~(values.abs() <= BOUND).all(dim=-1)
        values = torch.where(outside[:, None], 0.0, values)
        log_prob = torch.full_like(values[:, 0], self.log_base)
        finished: list[tuple[int, Tensor]] = []
        for block in self.blocks:
            log_prob = log_prob - block.log_slope(values[:, block.dimensions], self._features(finished, context))
            finished += [(dimension, values[:, [dimension]]) for dimension in block.dimensions]
        return torch.where(outside, -torch.inf, log_prob)

    def draw_base(self, count: int, generator: torch.Generator) -> Tensor:
        """Uniform base points, shape (count, D), in the parameters' type and place."""
        like = next(self.parameters())
        points = torch.rand(count, self.features, generator=generator, dtype=torch.float64)
        return (2 * points - 1).to(dtype=like.dtype, device=like.device)
