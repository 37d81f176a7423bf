"""Visibility T_i(d): how much of a ray reaches the point that it observes (paper, section 4.1).

Three ways, one interface: `Raycast` (exact first hit per column with Embree; T = exp(-beta max(0, range - m - hit)),
differentiated through the plane of the hit triangle, so without the term for silhouettes that sweep over a ray),
`Quadrature` (the transmittance integral by midpoints over the occluders' distances, fully differentiable) and
`NoVisibility`. All work on columns, one per scene and frame, and only where a column can matter.

Where a ray starts on a surface or in a solid, `Raycast` sees what simulation returns: on a surface it is met at once,
so T = exp(-beta max(0, range - m)); from inside, its way out is the first hit, and a half space that the ray goes
deeper into has none. `Quadrature` lets such a ray fade from its start within the solid. Range 0 gives T = 1 in all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import Field, TableField, scene_columns
from lidardesign.geometry.raycast import shared_caster, trace_each
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction

# A grazing hit moves without bound when its ray turns; its derivative is capped at this cosine.
MINIMUM_COSINE = 0.05
# Beyond this many sharpness lengths from every surface, sigmoid(-k d) is below 1e-13 and is not evaluated.
CUTOFF_LENGTHS = 30.0
CHUNK_BYTES = 64 * 2**20
ROWS_AT_ONCE = 8192


@dataclass(frozen=True)
class Optics:
    """The numbers of the target density at one sigma.

    Arguments:
        sigma_m: Standard deviation of the surface proximity [m].
        attenuation_per_m: beta [1/m].
        sharpness_per_m: k [1/m].
        margin_m: m [m].
    """

    sigma_m: float
    attenuation_per_m: float
    sharpness_per_m: float
    margin_m: float

    @classmethod
    def of(cls, settings: DensitySettings) -> Optics:
        """The final numbers of a configuration, with its `None`s derived.

        The derived defaults keep the peak on a plane within 0.2 mm and T on the visible surface above 0.99,
        and make 5 mm of solid matter or of hidden depth opaque: exp(-1000 * 0.005) < 0.01.
        """
        sharp = max(1000.0, 5.0 / settings.sigma_m)
        return cls(
            sigma_m=settings.sigma_m,
            attenuation_per_m=settings.attenuation_per_m or sharp,
            sharpness_per_m=settings.sharpness_per_m or sharp,
            margin_m=settings.sigma_m if settings.margin_m is None else settings.margin_m,
        )

    def widened(self, sigma_m: float) -> Optics:
        """The same at a wider sigma, as annealing needs it: lengths grow and rates fall by the ratio."""
        ratio = sigma_m / self.sigma_m
        return replace(
            self,
            sigma_m=sigma_m,
            attenuation_per_m=self.attenuation_per_m / ratio,
            sharpness_per_m=self.sharpness_per_m / ratio,
            margin_m=self.margin_m * ratio,
        )


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Rays of design points: origins (N, 3), unit directions (N, 3), ranges (N,) [m]."""

    origins: np.ndarray
    directions: np.ndarray
    ranges: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> RayBatch:
        """The rays of design points, (N, 6)."""
        directions = direction(points[:, AZIMUTH], points[:, ELEVATION])
        return cls(np.ascontiguousarray(points[:, :3]), directions, np.ascontiguousarray(points[:, RANGE]))

    @property
    def observed(self) -> np.ndarray:
        """The scene points that they listen at, shape (N, 3)."""
        return self.origins + self.ranges[:, None] * self.directions


@dataclass(eq=False)
class RayGradient:
    """Derivatives of one number per ray by its origin (N, 3), direction (N, 3) and range (N,)."""

    origins: np.ndarray
    directions: np.ndarray
    ranges: np.ndarray

    @classmethod
    def zeros(cls, count: int) -> RayGradient:
        """All zero, for `count` rays."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count))

    def pull_behind(self, rows: np.ndarray, pull: np.ndarray, hit_m: np.ndarray, plane: np.ndarray) -> None:
        """Subtract the derivatives of sum pull * (range - hit) over hits: of ray `rows`, at `hit_m`, shapes (P,).

        Arguments:
            rows, pull, hit_m: Shape (P,); a ray may have many hits.
            plane: Normals over their product with the direction, minus the hit's derivative by the origin, (P, 3).
        """
        count = len(self.ranges)
        self.ranges -= np.bincount(rows, pull, minlength=count)
        for axis in range(3):
            force = pull * plane[:, axis]
            self.origins[:, axis] -= np.bincount(rows, force, minlength=count)
            self.directions[:, axis] -= np.bincount(rows, force * hit_m, minlength=count)

    def add_by_point(self, by_point: np.ndarray, rays: RayBatch) -> None:
        """Add the derivatives by the observed scene points, shape (N, 3)."""
        self.origins += by_point
        self.directions += rays.ranges[:, None] * by_point
        self.ranges += np.einsum("nk,nk->n", by_point, rays.directions)


class Transmittance(Protocol):
    """log T of a batch, and its gradient contracted with one weight per ray and column."""

    log_values: np.ndarray

    def gradient(self, weights: np.ndarray) -> RayGradient:
        """Derivatives of sum_c weights_nc log T_nc, weights (N, columns)."""
        ...


class Visibility(Protocol):
    """A way to compute visibility; `rows_at_once` is how many rays keep its memory bounded with gradients."""

    name: str
    rows_at_once: int

    def transmittance(
        self, rays: RayBatch, active: np.ndarray, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """log T where `active` (N, columns), 0 elsewhere; its gradient may only be asked for if `differentiable`."""
        ...


@dataclass(frozen=True, eq=False)
class _Clear:
    log_values: np.ndarray
    count: int

    def gradient(self, weights: np.ndarray) -> RayGradient:
        return RayGradient.zeros(self.count)


class NoVisibility:
    """Every ray reaches its point: T = 1."""

    name = "off"
    rows_at_once = ROWS_AT_ONCE

    def transmittance(
        self, rays: RayBatch, active: np.ndarray, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`."""
        return _Clear(np.zeros(active.shape), len(rays.ranges))


@dataclass(frozen=True, eq=False)
class _Blocked:
    """The ray-column pairs that something blocks, as flat lists."""

    log_values: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    hit_m: np.ndarray
    plane: np.ndarray  # normal / (normal . direction): minus the derivative of the hit range by the origin
    attenuation_per_m: float

    def gradient(self, weights: np.ndarray) -> RayGradient:
        out = RayGradient.zeros(len(self.log_values))
        pull = self.attenuation_per_m * weights[self.rows, self.columns]
        out.pull_behind(self.rows, pull, self.hit_m, self.plane)
        return out


class Raycast:
    """Exact first hits: exact also for plates that are thinner than any quadrature step."""

    name = "raycast"
    rows_at_once = ROWS_AT_ONCE

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self._casters = [
            shared_caster(scenes[index], frame, only="occluders") for index, frame in scene_columns(scenes)
        ]

    def transmittance(
        self, rays: RayBatch, active: np.ndarray, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`."""
        log_values = np.zeros(active.shape)
        columns, rows = np.nonzero(active.T)
        starts = np.concatenate([[0], np.cumsum(active.sum(axis=0))])
        limit_m = rays.ranges[rows] - optics.margin_m
        hits = trace_each(self._casters, starts, rays.origins[rows], rays.directions[rows], limit_m)
        blocked = np.flatnonzero(hits.body >= 0)
        rows, columns, hit_m, normal = rows[blocked], columns[blocked], hits.range_m[blocked], hits.normal[blocked]
        log_values[rows, columns] = -optics.attenuation_per_m * (limit_m[blocked] - hit_m)
        # normals face the origin, so the cosine with the direction is negative
        cosine = np.minimum(np.einsum("nk,nk->n", normal, rays.directions[rows]), -MINIMUM_COSINE)
        return _Blocked(log_values, rows, columns, hit_m, normal / cosine[:, None], optics.attenuation_per_m)


@dataclass(frozen=True, eq=False)
class _Depth:
    """Optical depths with everything that their gradient needs, per chunk of rays."""

    log_values: np.ndarray
    lengths: np.ndarray
    slopes: list[tuple[slice, np.ndarray]]
    contract: Callable[[slice, np.ndarray, np.ndarray, RayGradient], None]

    def gradient(self, weights: np.ndarray) -> RayGradient:
        out = RayGradient.zeros(len(self.lengths))
        for rows, slope in self.slopes:
            self.contract(rows, slope, -weights[rows], out)
        # the step grows with the length: d depth / d length at fixed integrand is depth / length
        ahead = self.lengths > 0
        by_step = np.einsum("nc,nc->n", weights, self.log_values)
        out.ranges[ahead] += by_step[ahead] / self.lengths[ahead]
        out.ranges[~ahead] = 0.0
        return out


class Quadrature:
    """The transmittance integral over the occluders' distances by midpoints.

    A surface without an inside occludes as a shell of its `shell_m` to either side. The margin grows by the thickest
    shell, so that such a surface does not hide itself either.

    Arguments:
        field: Distances of the occluders.
        points: Midpoints per ray; what is thinner than range / points can be missed.
        thickest_m: The thickest shell elsewhere, where this field has a part of the scenes only [m].
    """

    name = "quadrature"

    def __init__(self, field: Field, points: int, thickest_m: float = 0.0) -> None:
        self.field, self.points = field, points
        self.thickest_m = self._shell_m = float(field.shell_m.max(initial=thickest_m))
        if isinstance(field, TableField):
            from lidardesign.density.fields import kernels

            self._clear = np.empty(len(field.table), dtype=np.float32)
            kernels.cell_minimum(field.table, field.grid.counts, self._clear)
            self._clear -= np.float32(self._shell_m)

    @property
    def rows_at_once(self) -> int:
        """Rays whose slopes at all midpoints and columns fill a chunk."""
        return min(max(1, CHUNK_BYTES // (4 * self.points * self.field.columns)), ROWS_AT_ONCE)

    def transmittance(
        self, rays: RayBatch, active: np.ndarray, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`; the field's contiguous rows make all columns cheap, so `active` only masks."""
        lengths = np.maximum(rays.ranges - optics.margin_m - self._shell_m, 0.0)
        depth, slopes = np.zeros(active.shape), []
        for start in range(0, len(lengths), self.rows_at_once):
            rows = slice(start, min(start + self.rows_at_once, len(lengths)))
            slope = self._integrate(rays, lengths, rows, optics, depth, differentiable)
            if differentiable:
                slopes.append((rows, slope))
        return _Depth(np.where(active, -depth, 0.0), lengths, slopes, self._contract(rays, lengths, optics))

    def _integrate(
        self, rays: RayBatch, lengths: np.ndarray, rows: slice, optics: Optics, depth: np.ndarray, differentiable: bool
    ) -> np.ndarray:
        shape = (rows.stop - rows.start, self.points, self.field.columns)
        slope = np.empty(shape if differentiable else (0, 0, 0), dtype=np.float32)
        if isinstance(self.field, TableField):
            from lidardesign.density.fields import kernels

            kernels.table_quadrature(
                self.field.table, self._clear, *self.field.geometry, self.field.shell_m,
                rays.origins[rows], rays.directions[rows], lengths[rows], self.points,
                optics.attenuation_per_m, optics.sharpness_per_m, CUTOFF_LENGTHS / optics.sharpness_per_m,
                depth[rows], slope,
            )  # fmt: skip
            return slope
        places, steps = self._places(rays, lengths, rows)
        distances = self.field.distances(places.reshape(-1, 3)).reshape(shape) - self.field.shell_m
        exponent = np.clip(optics.sharpness_per_m * distances, -60.0, 60.0)
        inside = 1.0 / (1.0 + np.exp(exponent))
        rate = optics.attenuation_per_m * steps[:, None, None]
        depth[rows] = (rate * inside).sum(axis=1)
        if differentiable:
            slope[:] = -rate * optics.sharpness_per_m * inside * (1.0 - inside)
        return slope

    def _places(self, rays: RayBatch, lengths: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        along = (np.arange(self.points) + 0.5) / self.points * lengths[rows, None]
        places = rays.origins[rows, None] + along[..., None] * rays.directions[rows, None]
        return places, lengths[rows] / self.points

    def _contract(
        self, rays: RayBatch, lengths: np.ndarray, optics: Optics
    ) -> Callable[[slice, np.ndarray, np.ndarray, RayGradient], None]:
        def table(rows: slice, slope: np.ndarray, weights: np.ndarray, out: RayGradient) -> None:
            from lidardesign.density.fields import kernels

            kernels.table_quadrature_gradient(
                self.field.table, self._clear, *self.field.geometry,
                rays.origins[rows], rays.directions[rows], lengths[rows],
                CUTOFF_LENGTHS / optics.sharpness_per_m, slope, np.ascontiguousarray(weights),
                out.origins[rows], out.directions[rows], out.ranges[rows],
            )  # fmt: skip

        def general(rows: slice, slope: np.ndarray, weights: np.ndarray, out: RayGradient) -> None:
            places, _ = self._places(rays, lengths, rows)
            column_weights = (weights[:, None, :] * slope).reshape(-1, self.field.columns)
            by_place = self.field.gradient(places.reshape(-1, 3), column_weights).reshape(places.shape)
            share = (np.arange(self.points) + 0.5) / self.points
            out.origins[rows] += by_place.sum(axis=1)
            out.directions[rows] += np.einsum("m,nmk->nk", share, by_place) * lengths[rows, None]
            out.ranges[rows] += np.einsum("m,nmk,nk->n", share, by_place, rays.directions[rows])

        return table if isinstance(self.field, TableField) else general
