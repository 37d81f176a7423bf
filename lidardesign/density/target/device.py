"""The target density where the flow is: distance tables and quadrature as tensors, differentiated by autograd.

With a flow on a GPU the compiled loops of `target` would send every batch to the processor and back. What lives in
tables can stay on the device instead: meshes at rest, seen directly or through a quadrature. Ray casting is Embree's
and moving bodies are compiled loops; they stay on the processor. All columns are summed; `Target` leaves out what is
further than its tolerance below the best one, which changes p* by less than columns * exp(-tolerance).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from lidardesign.density.fields.distance import TableField
from lidardesign.density.fields.grids import Grid
from lidardesign.density.target.target import Target
from lidardesign.density.visibility.quadrature import NoVisibility, Optics, Quadrature
from lidardesign.numerics import logsumexp, safe_sqrt
from lidardesign.space import AZIMUTH, ELEVATION, RANGE

# Beyond so many sharpness lengths a sigmoid is 0 or 1 to every digit, and its exponential would overflow float32.
EXPONENT_LIMIT = 60.0
CORNERS = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True, eq=False)
class DeviceTarget(Target):
    """A target that can also be evaluated as tensors on a device; `on_device` makes one.

    Arguments:
        device: Where its tensors are.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @cached_property
    def _table(self) -> _Table:
        return _Table(self.field.table, self.field.grid, self.device)

    @cached_property
    def _occluders(self) -> _Table | None:
        if isinstance(self.visibility, NoVisibility):
            return None
        field = self.visibility.field
        return self._table if field is self.field else _Table(field.table, field.grid, self.device)

    @cached_property
    def _weights(self) -> _Table | None:
        importance = self.importance
        return None if importance is None else _Table(importance.table, importance.grid, self.device)

    def drawn(self, columns: np.ndarray) -> DeviceTarget:
        """See `Target`; what is on the device stays there."""
        few = super().drawn(columns)
        vars(few).update(_table=self._table, _occluders=self._occluders, _weights=self._weights)
        return few

    def log_density_of_unit(self, unit: Tensor, sigma_m: float | None = None) -> Tensor:
        """log p* of unit points on the device, differentiable: (N, len(free)) to (N,)."""
        optics = self.optics if sigma_m is None else self.optics.widened(sigma_m)
        size = self.rows_at_once
        return torch.cat([self._log_density(rows, optics) for rows in unit.split(size)])

    def _log_density(self, unit: Tensor, optics: Optics) -> Tensor:
        origins, toward, range_m = self._rays(unit)
        observed = origins + range_m[:, None] * toward
        distances = self._table.distances(observed)
        weights = torch.as_tensor(self.log_column_weights).to(unit)
        terms = weights - distances.square() / (2 * optics.sigma_m**2)
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

    def __init__(self, table: np.ndarray, grid: Grid, device: torch.device) -> None:
        self._table = torch.as_tensor(table).to(device)
        self._low = torch.as_tensor(grid.low).to(device)
        self._counts = torch.as_tensor(grid.counts).to(device)
        self._corners = CORNERS.to(device)
        self._step = float(grid.step)

    def distances(self, places: Tensor) -> Tensor:
        """Distances of all columns at places, (N, 3) to (N, columns): trilinear; a lower bound outside the grid."""
        cells, inside = self._cells(places)
        values = self._blended(inside)
        beyond = ((cells - inside) * self._step).square().sum(dim=-1, keepdim=True)
        outside = beyond > 0
        return torch.where(outside, safe_sqrt(beyond + values.clamp(min=0).square()), values)

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
    if type(target) is not Target or not isinstance(target.field, TableField):
        return target
    visibility = target.visibility
    tables = isinstance(visibility, Quadrature) and isinstance(visibility.field, TableField)
    if not tables and not isinstance(visibility, NoVisibility):
        return target
    return DeviceTarget(**{part.name: getattr(target, part.name) for part in fields(target)}, device=device)


def stays_on(target: Target, device: torch.device) -> bool:
    """Whether steps of a flow on a device need no evaluation elsewhere."""
    return device.type == "cpu" or isinstance(target, DeviceTarget)
