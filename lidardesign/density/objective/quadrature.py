"""The transmittance integral by midpoints, and how many midpoints hidden points need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from lidardesign.density.fields.distance import Field, TableField, table_kernels
from lidardesign.density.objective.visibility import (
    ROWS_AT_ONCE,
    Columns,
    Optics,
    RayBatch,
    RayGradient,
    Transmittance,
    Visibility,
)
from lidardesign.numerics import EPSILON_FLOAT32

# Beyond this many sharpness lengths from every surface, sigmoid(-k d) is about 2e-9, far less than the rounding of the
# sum along a ray, and is not evaluated.
CUTOFF_LENGTHS = 20.0
CHUNK_BYTES = 64 * 2**20
# Derivatives of the integrand by the distances: of tables those of the midpoints that attenuate (`table_quadrature`),
# of other fields those of all, shape (N, points, columns).
Slopes = tuple[np.ndarray, np.ndarray, np.ndarray] | np.ndarray


@dataclass(frozen=True, eq=False)
class _Depth:
    """Optical depths with everything that their gradient needs, per chunk of rays."""

    log_values: np.ndarray
    lengths: np.ndarray
    slopes: list[tuple[slice, Slopes]]
    add_gradient: Callable[[slice, Slopes, np.ndarray, RayGradient], None]

    def gradient(self, weights: np.ndarray) -> RayGradient:
        out = RayGradient.zeros(len(self.lengths))
        for rows, slope in self.slopes:
            self.add_gradient(rows, slope, -weights[rows], out)
        # the step grows with the length: d depth / d length at fixed integrand is depth / length
        ahead = self.lengths > 0
        by_step = np.einsum("nc,nc->n", weights, self.log_values)
        out.ranges[ahead] += by_step[ahead] / self.lengths[ahead]
        out.ranges[~ahead] = 0.0
        return out


class Quadrature(Visibility):
    """The transmittance integral over the occluders' distances by midpoints.

    A surface without an inside occludes as a shell of its `shell_m` to either side. The margin grows by the thickest
    shell, so that such a surface does not hide itself either.

    Arguments:
        field: Distances of the occluders.
        points: Midpoints per ray; what is thinner than range / points can be missed.
    """

    name = "quadrature"

    def __init__(self, field: Field, points: int) -> None:
        self.field, self.points = field, points
        self._shell_m = float(field.shell_m.max(initial=0.0))
        if isinstance(field, TableField):
            self._clear = np.empty(len(field.table), dtype=np.float32)
            table_kernels().cell_minimum(field.table, field.grid.counts, self._clear)
            self._clear -= np.float32(self._shell_m)

    @property
    def rows_at_once(self) -> int:
        """Rays whose midpoints, with slopes at all columns, fill a chunk."""
        return min(max(1, CHUNK_BYTES // (self.points * (8 + 4 * self.field.columns))), ROWS_AT_ONCE)

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`; the field's contiguous rows make all columns cheap, so the mask only leaves out."""
        lengths = np.maximum(rays.ranges - optics.margin_m - self._shell_m, 0.0)
        depth, slopes = np.zeros(columns.shape), []
        for start in range(0, len(lengths), self.rows_at_once):
            rows = slice(start, min(start + self.rows_at_once, len(lengths)))
            slope = self._integrate(rays, lengths, rows, optics, depth, differentiable)
            if differentiable:
                slopes.append((rows, slope))
        add_gradient = partial(self._add_gradient, rays, lengths, EPSILON_FLOAT32 * optics.sharpness_per_m)
        return _Depth(np.where(columns, -depth, 0.0), lengths, slopes, add_gradient)

    def _integrate(
        self, rays: RayBatch, lengths: np.ndarray, rows: slice, optics: Optics, depth: np.ndarray, differentiable: bool
    ) -> Slopes:
        count, columns = rows.stop - rows.start, self.field.columns
        if isinstance(self.field, TableField):
            room = count * self.points if differentiable else 0
            starts, midpoints = np.zeros(count + 1, dtype=np.int64), np.empty(room, dtype=np.int64)
            slopes = starts, midpoints, np.empty((room, columns), dtype=np.float32)
            table_kernels().table_quadrature(
                self.field.arrays, self._clear, self.field.shell_m,
                (rays.origins[rows], rays.directions[rows], lengths[rows]), self.points,
                optics.attenuation_per_m, optics.sharpness_per_m, CUTOFF_LENGTHS / optics.sharpness_per_m,
                depth[rows], slopes,
            )  # fmt: skip
            return slopes
        places = self._places(rays, lengths, rows).reshape(-1, 3)
        distances = self.field.distances(places).reshape(count, self.points, columns) - self.field.shell_m
        inside = 1.0 / (1.0 + np.exp(np.clip(optics.sharpness_per_m * distances, -60.0, 60.0)))
        rate = optics.attenuation_per_m * (lengths[rows] / self.points)[:, None, None]
        depth[rows] = (rate * inside).sum(axis=1)
        return -rate * optics.sharpness_per_m * inside * (1.0 - inside)

    def _places(self, rays: RayBatch, lengths: np.ndarray, rows: slice) -> np.ndarray:
        along = (np.arange(self.points) + 0.5) / self.points * lengths[rows, None]
        return rays.origins[rows, None] + along[..., None] * rays.directions[rows, None]

    def _add_gradient(
        self, rays: RayBatch, lengths: np.ndarray, least: float,
        rows: slice, slopes: Slopes, weights: np.ndarray, out: RayGradient,
    ) -> None:  # fmt: skip
        if isinstance(self.field, TableField):
            table_kernels().table_quadrature_gradient(
                self.field.arrays, (rays.origins[rows], rays.directions[rows], lengths[rows]), self.points, slopes,
                least, np.ascontiguousarray(weights), (out.origins[rows], out.directions[rows], out.ranges[rows]),
            )  # fmt: skip
            return
        places = self._places(rays, lengths, rows)
        column_weights = (weights[:, None, :] * slopes).reshape(-1, self.field.columns)
        by_place = self.field.gradient(places.reshape(-1, 3), column_weights).reshape(places.shape)
        share = (np.arange(self.points) + 0.5) / self.points
        out.origins[rows] += by_place.sum(axis=1)
        out.directions[rows] += np.einsum("m,nmk->nk", share, by_place) * lengths[rows, None]
        out.ranges[rows] += np.einsum("m,nmk,nk->n", share, by_place, rays.directions[rows])
