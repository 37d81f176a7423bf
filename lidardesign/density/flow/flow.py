"""The normalizing flow: autoregressive rational-quadratic splines from a uniform box to the box of design space.

The density is a chain of blocks in the order of a ray's physics, p(origin) p(direction | origin) p(range | ray). Inside
a block every layer maps u_i = h(z_i; z_<i) in one pass from base to design point (paper, section 4.3); a block sees the
finished coordinates of the blocks before it. So where a surface lies along a ray is a function of the ray itself, and
mass can move between directions without relearning the surface.
Sampling with its log determinant costs one network pass per layer; the density of foreign points inverts the layers
and costs one pass per layer and dimension of its block. Coordinates are the free dimensions scaled to [-1, 1].

Networks are zuko's; splines as well, with two differences (`splines`): all knot slopes are learned, the outer ones
too, and for an azimuth that spans the full turn the outer slopes are tied and the spline starts half a turn away, so
that the density is continuous across 0 / 2 pi; such an azimuth is a block of its own, and later blocks see its sine and
cosine.

References:
    Neural Spline Flows, Durkan et al. 2019. Normalizing Flows on Tori and Spheres, Rezende et al. 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import linear
from zuko.flows.autoregressive import MaskedAutoregressiveTransform

from lidardesign.density.flow.splines import BOUND, BoundedSpline, spline

# How far the networks' last layer is scaled down at the start, so that the flow begins near the identity.
INITIAL_SCALE = 0.1


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
        self.register_buffer("periodic", torch.tensor(list(periodic), dtype=torch.bool), persistent=False)
        features, self.parameters_each = len(self.dimensions), 3 * bins + 1
        rank = torch.arange(features)
        self.orders = [rank if layer % 2 == 0 else rank.flip(0) for layer in range(layers)]
        self.layers = nn.ModuleList(
            MaskedAutoregressiveTransform(
                features,
                context,
                order=order,
                univariate=BoundedSpline,
                shapes=[(bins,), (bins,), (bins + 1,)],
                hidden_features=(hidden, hidden),
            )
            for order in self.orders
        )

    def forward(self, values: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor]:
        """Outputs and the summed log slope: (N, d) to (N, d) and (N,)."""
        total = torch.zeros_like(values[:, 0])
        for layer in self.layers:
            values, log_slope = spline(values, self._of_splines(layer, values, context), self.periodic)
            total = total + log_slope.sum(dim=-1)
        return values, total

    def log_slope(self, values: Tensor, context: Tensor | None) -> Tensor:
        """The summed log slope at the base points of outputs: (N, d) to (N,)."""
        total = torch.zeros_like(values[:, 0])
        for layer, order in zip(reversed(self.layers), reversed(self.orders), strict=True):
            values, log_slope = self._inverted(layer, order, values, context)
            total = total + log_slope
        return total

    def _of_splines(self, layer: nn.Module, values: Tensor, context: Tensor | None) -> Tensor:
        """The unconstrained parameters of a layer's splines, shape (N, d, parameters of one)."""
        if len(self.dimensions) > 1:
            return layer.hyper(_joined(values, context)).unflatten(-1, (-1, self.parameters_each))
        if context is not None:
            return layer.hyper(context)[:, None]
        return torch.cat(list(layer.phi), dim=-1).expand(len(values), 1, -1)

    def _inverted(
        self, layer: nn.Module, order: Tensor, outputs: Tensor, context: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """A layer's inputs, shape (N, d), and its summed log slope there, shape (N,): dimension after dimension."""
        if len(self.dimensions) == 1:
            parameters = self._of_splines(layer, outputs, context)
            inputs, log_slope = spline(outputs, parameters, self.periodic, inverted=True)
            return inputs, log_slope[:, 0]
        *modules, last = layer.hyper
        columns = list(torch.zeros_like(outputs).split(1, dim=-1))
        total = torch.zeros_like(outputs[:, 0])
        for turn, dimension in enumerate(order.argsort().tolist()):
            hidden = _joined(torch.cat(columns, dim=-1), context)
            # the first one depends on the context alone: without one, all points share its parameters
            hidden = hidden[:1] if turn == 0 and context is None else hidden
            for module in modules:
                hidden = module(hidden)
            rows = slice(dimension * self.parameters_each, (dimension + 1) * self.parameters_each)
            parameters = linear(hidden, last.mask[rows] * last.weight[rows], last.bias[rows])[:, None]
            parameters, column = parameters.expand(len(outputs), -1, -1), slice(dimension, dimension + 1)
            columns[dimension], log_slope = spline(outputs[:, column], parameters, self.periodic[column], inverted=True)
            total = total + log_slope[:, 0]
        return torch.cat(columns, dim=-1), total


def _joined(values: Tensor, context: Tensor | None) -> Tensor:
    return values if context is None else torch.cat([values, context], dim=-1)


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
        with torch.no_grad():
            for parameter in self.parameters():
                bound = 1 / math.sqrt(parameter.shape[-1])
                parameter.uniform_(-bound, bound, generator=generator)
            for layer in (layer for block in self.blocks for layer in block.layers):
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
        return torch.cat([values for _, values in sorted(finished, key=lambda pair: pair[0])], dim=-1), log_prob

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

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
        """Uniform base points, shape (count, D), and uniform conditions, shape (count, context), or None without any.

        Both are in the parameters' type and place.
        """
        conditions = self._uniform(count, self.context, generator) if self.context else None
        return self._uniform(count, self.features, generator), conditions

    def _uniform(self, count: int, columns: int, generator: torch.Generator) -> Tensor:
        points = torch.rand(count, columns, generator=generator, dtype=torch.float64)
        return (2 * points - 1).to(next(self.parameters()))
