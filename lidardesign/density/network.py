"""The normalizing flow: autoregressive rational-quadratic splines from a uniform box to the box of design space.

The density is a chain over the dimensions in the order of a ray's physics, p(x, y, z) p(azimuth, elevation | origin)
p(range | ray), one dimension at a time. Each is mapped from its base coordinate by a stack of splines, whose parameters
one network finds from the finished coordinates before it. So where a surface lies along a ray is a function of the ray
itself, and both directions, sampling and the density of foreign points, cost one network pass a dimension.
Coordinates are the free dimensions scaled to [-1, 1]. Networks see each as itself and as waves of a few frequencies:
with those they follow a surface's relief in fewer steps.

For an azimuth that spans the full turn the outer slopes are tied and each spline starts half a turn away, so that the
density is continuous across 0 / 2 pi; networks see its waves alone.

Splines are zuko's, with learned outer slopes and circles. On the CPU compiled kernels run (`spline_kernels`): a layer's
splines then cost about what their exponentials do, and the derivatives of the inverse are written out too. On other
devices `BoundedSpline` runs as array operations; it is also what the kernels are tested against.

References:
    Neural Spline Flows, Durkan et al. 2019. Normalizing Flows on Tori and Spheres, Rezende et al. 2020. Fourier
    Features Let Networks Learn High Frequency Functions in Low Dimensional Domains, Tancik et al. 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from zuko.transforms import MonotonicRQSTransform

from lidardesign.numerics import FLOAT32_ROUNDING, safe_sqrt

# How far the networks' last layer is scaled down at the start, so that the flow begins near the identity.
INITIAL_SCALE = 0.1
# Whole numbers of waves over a coordinate's range, so that those of a circle close.
WAVES = (1.0, 2.0, 4.0)
BOUND = 1.0  # of the box
# Foreign points and base samples are kept this far inside the box, where splines are smooth.
EDGE = FLOAT32_ROUNDING
# The smallest slope that a stack of splines may take; its inverse is the steepest. What may be steeper has gradients
# that grow without end where a steep spline follows a flat one, and learning by steps of one size diverges.
MINIMUM_SLOPE = 1e-4


class _Constant(nn.Module):
    """Spline parameters shared by all points, of a dimension without inputs."""

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
    """Network inputs of a coordinate: itself unless periodic, and its waves, (N,) to (N, features)."""
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
        """Values of all dimensions, each given those before it, and the log density of the samples."""
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

        Both have the parameters' dtype and device.
        """
        conditions = self._uniform(count, self.context, generator) if self.context else None
        return self._uniform(count, self.features, generator), conditions

    def _uniform(self, count: int, columns: int, generator: torch.Generator) -> Tensor:
        points = torch.rand(count, columns, generator=generator, dtype=torch.float64)
        return (2 * points - 1).to(next(self.parameters()))


class BoundedSpline(MonotonicRQSTransform):
    """A rational-quadratic spline of [-1, 1] onto itself whose outer slopes are learned as well.

    Arguments:
        widths: Unconstrained bin widths, with shape (*, K).
        heights: Unconstrained bin heights, with shape (*, K).
        derivatives: Unconstrained knot slopes, with shape (*, K + 1).
        periodic: Mask of the dimensions on a circle, with shape (D,), or None.
        slope: The smallest slope that it may take; its inverse is the steepest.
    """

    def __init__(
        self,
        widths: Tensor,
        heights: Tensor,
        derivatives: Tensor,
        periodic: Tensor | None = None,
        slope: float = MINIMUM_SLOPE,
    ) -> None:
        super().__init__(widths, heights, derivatives[..., 1:-1], bound=BOUND, slope=slope)
        softened = derivatives / (1 + abs(derivatives / math.log(slope)))
        slopes = torch.exp(softened)
        if periodic is not None:
            outer = torch.exp((softened[..., :1] + softened[..., -1:]) / 2)
            slopes = torch.where(periodic[:, None], torch.cat([outer, slopes[..., 1:-1], outer], dim=-1), slopes)
        self.derivatives = slopes
        self.periodic = periodic
        # accumulated widths can pass the bound by rounding; the last knots are exact
        self.horizontal = torch.cat([self.horizontal[..., :-1], torch.full_like(self.horizontal[..., :1], BOUND)], -1)
        self.vertical = torch.cat([self.vertical[..., :-1], torch.full_like(self.vertical[..., :1], BOUND)], -1)

    def _turned(self, values: Tensor) -> Tensor:
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
        share = (2 * c / (-b - safe_sqrt(b**2 - 4 * a * c))).clamp(0.0, 1.0)
        return self._turned(x0 + share * (x1 - x0))


def _softness(layers: int) -> float:
    """The soft-clipping constant c that bounds the slopes of a stack of splines, see `spline_kernels`."""
    return 2 * layers / abs(math.log(MINIMUM_SLOPE))


class _CompiledSplines(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, parameters: Tensor, periodic: bool, inverted: bool, held: bool
    ) -> tuple[Tensor, Tensor]:
        from lidardesign.density import spline_kernels

        values, parameters = values.detach().contiguous(), parameters.detach().contiguous()
        count, layers, each = parameters.shape
        shares = parameters.new_empty(count, layers, 2 * (each // 3))
        bins, places = torch.empty(count, layers, dtype=torch.int32), torch.empty(count, layers, dtype=torch.float64)
        out, log_slopes = torch.empty_like(values), torch.empty_like(values)
        arrays = [tensor.numpy() for tensor in (shares, bins, places, out, log_slopes)]
        kernel = spline_kernels.inverse if inverted else spline_kernels.forward
        kernel(parameters.numpy(), values.numpy(), periodic, _softness(layers), EDGE, *arrays)
        ctx.save_for_backward(parameters, shares, bins, places)
        ctx.periodic, ctx.inverted, ctx.held = periodic, inverted, held
        if held:
            ctx.mark_non_differentiable(out)
        return out, log_slopes

    @staticmethod
    def backward(ctx: Any, by_value: Tensor, by_slope: Tensor) -> tuple[Tensor | None, Tensor, None, None, None]:
        from lidardesign.density import spline_kernels

        parameters, *kept = ctx.saved_tensors
        by_parameters, by_argument = torch.empty_like(parameters), torch.empty_like(by_slope)
        spline_kernels.gradient(
            parameters.numpy(),
            *(tensor.numpy() for tensor in kept),
            ctx.periodic,
            _softness(parameters.shape[1]),
            ctx.inverted or ctx.held,
            *(tensor.contiguous().numpy() for tensor in (by_value, by_slope)),
            by_parameters.numpy(),
            by_argument.numpy(),
        )
        return None if ctx.held else by_argument, by_parameters, None, None, None


def array_splines(values: Tensor, parameters: Tensor, periodic: bool, *, inverted: bool) -> tuple[Tensor, Tensor]:
    """The same as `splines` as array operations, but for held values."""
    count, total = parameters.shape[-1] // 3, torch.zeros_like(values)
    circles = torch.tensor([True], device=values.device) if periodic else None
    layers = [layer.split([count, count, count + 1], dim=-1) for layer in parameters[:, :, None].unbind(dim=1)]
    for layer in reversed(layers) if inverted else layers:
        made = BoundedSpline(*layer, circles, MINIMUM_SLOPE ** (1 / len(layers)))
        there = made.inv(values[:, None]) if inverted else values[:, None]
        out, log_slope = made.call_and_ladj(there)
        values, total = (there if inverted else out)[:, 0], total + log_slope[:, 0]
    return values, total


def splines(
    values: Tensor, parameters: Tensor, periodic: bool, *, inverted: bool = False, held: bool = False
) -> tuple[Tensor, Tensor]:
    """Values of stacks of splines, or of their inverses, and the log slopes of the stacks there.

    Arguments:
        values: In [-1, 1], shape (N,).
        parameters: Unconstrained widths, heights and slopes one after another, shape (N, splines, 3 K + 1).
        periodic: Whether the dimension lies on a circle.
        inverted: Whether `values` are outputs whose arguments are wanted.
        held: Whether the values found are fixed: log slopes then change with parameters as those of the inverse do.

    Returns:
        Both of shape (N,), differentiable by values and parameters.
    """
    if values.device.type == "cpu":
        return _CompiledSplines.apply(values, parameters, periodic, inverted, held)
    if held:
        with torch.no_grad():
            values, _ = array_splines(values, parameters, periodic, inverted=False)
        return values, array_splines(values, parameters, periodic, inverted=True)[1]
    return array_splines(values, parameters, periodic, inverted=inverted)
