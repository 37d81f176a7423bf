"""The bridge between the flow's unit coordinates and the target: values and gradients for automatic differentiation.

With a flow on a GPU the compiled loops of a target would send every batch to the processor and back. What lives in
tables can stay on the device instead, as tensors that autograd differentiates (`DeviceTarget`): meshes at rest, seen
directly or through a quadrature. Ray casting is Embree's and moving bodies are compiled loops; they stay on the
processor. On a device all columns are summed; `Target` leaves out what is beyond its tolerance below the best one,
which changes p* by less than columns * exp(-tolerance).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from lidardesign.density.fields.distance import GridColumns, TableField
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.surfaces import SceneTable
from lidardesign.density.objective.target import Target
from lidardesign.density.objective.visibility import NoVisibility, Optics
from lidardesign.errors import NumericalError
from lidardesign.numerics import logsumexp, safe_sqrt
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace

# Beyond so many sharpness lengths a sigmoid is 0 or 1 to every digit, and its exponential would overflow float32.
EXPONENT_LIMIT = 60.0
CORNERS = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The split of the free dimensions into learned and conditioning ones, and their chart volume.

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


@dataclass(frozen=True, eq=False)
class DeviceTarget(Target):
    """A target that can also be evaluated as tensors on a device; `on_device` makes one.

    Arguments:
        device: Where its tensors are.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @cached_property
    def _table(self) -> _Table:
        return _Table(self.surfaces.field, self.device)

    @cached_property
    def _occluders(self) -> _Table | None:
        if isinstance(self.visibility, NoVisibility):
            return None
        field = self.visibility.field
        return self._table if field is self.surfaces.field else _Table(field, self.device)

    @cached_property
    def _weights(self) -> _Table | None:
        importance = self.surfaces.importance
        return None if importance is None else _Table(importance, self.device)

    def subsample(self, columns: np.ndarray) -> DeviceTarget:
        """See `Target`; what is on the device stays there."""
        few = super().subsample(columns)
        vars(few).update(_table=self._table, _occluders=self._occluders, _weights=self._weights)
        return few

    def log_density_of_unit(self, unit: Tensor, sigma_m: float | None = None) -> Tensor:
        """log p* of unit points on the device, differentiable: (N, len(free)) to (N,).

        Raises:
            NumericalError: A point is not finite.
        """
        if not torch.isfinite(unit).all():
            raise NumericalError("design points are not finite", where="target density")
        optics = self.optics if sigma_m is None else self.optics.widened(sigma_m)
        return torch.cat([self._log_density(rows, optics) for rows in unit.split(self.rows_at_once)])

    def _log_density(self, unit: Tensor, optics: Optics) -> Tensor:
        origins, toward, range_m = self._rays(unit)
        observed = origins + range_m[:, None] * toward
        weights = torch.as_tensor(self.surfaces.log_column_weights).to(unit)
        terms = weights - self._table.distances(observed).square() / (2 * optics.sigma_m**2)
        if self._weights is not None:
            terms = terms + self._weights.values(observed)
        if self._occluders is not None:
            terms = terms - self._depth(origins, toward, range_m, optics)
        return logsumexp(terms, axis=1)

    def _rays(self, unit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Origins (N, 3), unit directions (N, 3) and ranges (N,) of unit points."""
        space = self.space
        low, high = (torch.as_tensor(np.asarray(edge)).to(unit) for edge in (space.chart_low, space.chart_high))
        free = list(space.free)
        chart = low.repeat(len(unit), 1)
        chart[:, free] = low[free] + (unit + 1) / 2 * (high - low)[free]
        azimuth, elevation = chart[:, AZIMUTH], chart[:, ELEVATION]
        sine = elevation if space.measure == "solid_angle" else torch.sin(elevation)
        cosine = safe_sqrt(1 - sine.square())
        toward = torch.stack([cosine * torch.cos(azimuth), cosine * torch.sin(azimuth), sine], dim=1)
        return chart[:, :3], toward, chart[:, RANGE]

    def _depth(self, origins: Tensor, toward: Tensor, range_m: Tensor, optics: Optics) -> Tensor:
        """Optical depths by midpoints, (N, columns); see `visibility.Quadrature`."""
        points, shell = self.visibility.points, torch.as_tensor(self.visibility.field.shell_m).to(origins)
        length = (range_m - optics.margin_m - shell.max()).clamp(min=0)
        share = (torch.arange(points, dtype=origins.dtype, device=origins.device) + 0.5) / points
        places = origins[:, None] + (share * length[:, None])[..., None] * toward[:, None]
        distances = self._occluders.distances(places.reshape(-1, 3)).reshape(len(origins), points, -1) - shell
        exponent = (optics.sharpness_per_m * distances).clamp(-EXPONENT_LIMIT, EXPONENT_LIMIT)
        return optics.attenuation_per_m * (length / points)[:, None] * torch.sigmoid(-exponent).sum(dim=1)


class _Table:
    """A table of distances, or of other values, on a device: shape (grid points, columns)."""

    def __init__(self, source: GridColumns, device: torch.device) -> None:
        grid = source.grid
        self._table = torch.as_tensor(source.table).to(device)
        self._low = torch.as_tensor(grid.low).to(device)
        self._counts = torch.as_tensor(grid.counts).to(device)
        self._corners = CORNERS.to(device)
        self._step = float(grid.step)

    def distances(self, places: Tensor) -> Tensor:
        """Distances of all columns at places, (N, 3) to (N, columns): trilinear; a lower bound outside the grid."""
        cells, inside = self._cells(places)
        values = self._blended(inside)
        beyond = ((cells - inside) * self._step).square().sum(dim=-1, keepdim=True)
        return torch.where(beyond > 0, safe_sqrt(beyond + values.clamp(min=0).square()), values)

    def values(self, places: Tensor) -> Tensor:
        """Values of all columns at places, (N, 3) to (N, columns): trilinear; those at its faces outside the grid."""
        return self._blended(self._cells(places)[1])

    def _cells(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Places in steps from the first grid point, and the nearest such places inside the grid, (N, 3) each."""
        cells = (places - self._low.to(places)) / self._step
        return cells, torch.minimum(cells.clamp(min=0), (self._counts - 1).to(places))

    def _blended(self, inside: Tensor) -> Tensor:
        first = torch.minimum(inside.detach().long(), self._counts - 2)
        fraction = (inside - first)[:, None]
        corners = self._corners[None]
        weights = torch.where(corners > 0, fraction, 1 - fraction).prod(dim=-1)
        index = first[:, None] + corners
        rows = (index[..., 0] * self._counts[1] + index[..., 1]) * self._counts[2] + index[..., 2]
        return embedding_bag(rows, self._table.to(inside.dtype), per_sample_weights=weights, mode="sum")


def on_device(target: Target, device: torch.device) -> Target:
    """The target for a flow on a device: on it where it can be, else as it is.

    It can where it is made of tables and is seen directly or by quadrature over tables.
    """
    surfaces, visibility = target.surfaces, target.visibility
    if not isinstance(surfaces, SceneTable) or not isinstance(surfaces.field, TableField):
        return target
    tables = isinstance(visibility, Quadrature) and isinstance(visibility.field, TableField)
    if not tables and not isinstance(visibility, NoVisibility):
        return target
    return DeviceTarget(**{part.name: getattr(target, part.name) for part in fields(target)}, device=device)


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
        return target.log_density_of_unit(unit, sigma_m)
    return _LogTarget.apply(unit, target, coordinates, sigma_m)


@torch.no_grad()
def log_target_values(unit: Tensor, target: Target, coordinates: Coordinates) -> Tensor:
    """log p* of unit points at the final sigma, without a gradient: (N, len(free)) to (N,)."""
    if isinstance(target, DeviceTarget):
        return target.log_density_of_unit(unit)
    points = coordinates.space.from_unit(unit.cpu().double().numpy())
    return torch.as_tensor(target.log_density(points)).to(unit)
