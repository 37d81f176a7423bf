"""The bridge between the flow's unit coordinates and the target: values and gradients for automatic differentiation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidardesign.density.target.device import DeviceTarget
from lidardesign.density.target.target import Target
from lidardesign.errors import NumericalError
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, X, Y, Z


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Which free dimensions are learned and which are conditions, and what a unit volume is worth.

    Unit points list the free dimensions in the space's order, each scaled to [-1, 1].
    """

    space: DesignSpace

    @cached_property
    def learned(self) -> list[int]:
        """Positions of the learned dimensions among the free ones."""
        return [n for n, i in enumerate(self.space.free) if i not in self.space.conditioned]

    @cached_property
    def conditions(self) -> list[int]:
        """Positions of the conditioning dimensions among the free ones."""
        return [n for n, i in enumerate(self.space.free) if i in self.space.conditioned]

    @property
    def blocks(self) -> list[list[int]]:
        """Learned dimensions by block of the flow's chain: origin, then direction, then range.

        An azimuth on a circle stands alone, so that everything after it sees its sine and cosine: inside a block the
        elevation would see where the circle was cut open.
        """
        names = [self.space.free[n] for n in self.learned]
        angles = ((AZIMUTH,), (ELEVATION,)) if self.space.full_azimuth else ((AZIMUTH, ELEVATION),)
        groups = ((X, Y, Z), *angles, (RANGE,))
        parts = [[k for k, i in enumerate(names) if i in group] for group in groups]
        return [part for part in parts if part]

    @cached_property
    def half_widths(self) -> np.ndarray:
        """Chart lengths per unit coordinate, shape (len(free),)."""
        free = list(self.space.free)
        return (self.space.chart_high[free] - self.space.chart_low[free]) / 2

    @property
    def log_unit_volume(self) -> float:
        """log of the chart volume of one unit volume over all free dimensions."""
        return float(np.log(self.half_widths).sum())

    @property
    def log_condition_density(self) -> float:
        """log of the uniform density of the conditions, per unit volume."""
        return -len(self.conditions) * float(np.log(2.0))

    def join(self, learned: Tensor, conditions: Tensor | None) -> Tensor:
        """Unit points of learned and conditioning coordinates, shape (N, len(free))."""
        if conditions is None:
            return learned
        unit = learned.new_empty(len(learned), len(self.space.free))
        unit[:, self.learned], unit[:, self.conditions] = learned, conditions
        return unit


class _LogTarget(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, unit: Tensor, target: Target, coordinates: Coordinates, sigma_m: float) -> Tensor:
        points = coordinates.space.from_unit(unit.detach().to("cpu", torch.float64).numpy())
        values, by_chart = target.log_density_and_gradient(points, sigma_m)
        by_unit = by_chart[:, list(coordinates.space.free)] * coordinates.half_widths
        ctx.save_for_backward(torch.as_tensor(by_unit, dtype=unit.dtype, device=unit.device))
        return torch.as_tensor(values, dtype=unit.dtype, device=unit.device)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None, None]:
        (by_unit,) = ctx.saved_tensors
        return upstream[:, None] * by_unit, None, None, None


def log_target(unit: Tensor, target: Target, coordinates: Coordinates, sigma_m: float) -> Tensor:
    """log p* of unit points at a sigma, differentiable: (N, len(free)) to (N,)."""
    if isinstance(target, DeviceTarget):
        return target.log_density_of_unit(_finite(unit), sigma_m)
    return _LogTarget.apply(unit, target, coordinates, sigma_m)


@torch.no_grad()
def log_target_values(unit: Tensor, target: Target, coordinates: Coordinates) -> Tensor:
    """log p* of unit points at the final sigma, without a gradient: (N, len(free)) to (N,)."""
    if isinstance(target, DeviceTarget):
        return target.log_density_of_unit(_finite(unit))
    points = coordinates.space.from_unit(unit.cpu().double().numpy())
    return torch.as_tensor(target.log_density(points)).to(unit)


def _finite(unit: Tensor) -> Tensor:
    """Points as they are.

    Raises:
        NumericalError: One is not finite.
    """
    if not torch.isfinite(unit).all():
        raise NumericalError("design points are not finite", where="target density")
    return unit
