"""Visibility T_i(d): how much of a ray reaches the point that it observes (paper, section 4.1).

Three ways, one interface: ray casting (exact first hit per column with Embree; T = exp(-beta max(0, range - m - hit)),
differentiated through the plane of the surface that is hit, so without the term for silhouettes that sweep over a ray),
`quadrature.Quadrature` (the transmittance integral by midpoints over the occluders' distances, fully differentiable)
and `NoVisibility`. All work on columns, one per scene and frame, and only where a column can matter: `Raycast` where a
mask (points, columns) is set, `BodyRaycast` on `Pairs`, casting at bodies in their own frames, so that all frames of a
moving robot share one Embree scene per link.

Where a ray starts on a surface or in a solid, ray casting sees what simulation returns: on a surface it is met at once,
so T = exp(-beta max(0, range - m)); from inside, its way out is the first hit, and a half space that the ray goes
deeper into has none. `Quadrature` lets such a ray fade from its start within the solid. Range 0 gives T = 1 in all.

With a fixed receiver a design point is an emitter's ray (paper, section 3.1); its light is measured where the receiver
sees the same scene point s: log T = log T_emitter(d) + log T_receiver(s) + log view(s). The receiver's own leg is
traced as any ray is. Its view is the product over the four planes of its field of view and the two ends of its range of
sigmoid(distance inside / w) with w a quarter of sigma: an edge that the density can be trained across.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.special import expit, log_expit

from lidardesign.config import DensitySettings
from lidardesign.density.fields.bodies import Bodies, Pairs
from lidardesign.density.fields.distance import body_kernels, scene_columns
from lidardesign.errors import ConfigError
from lidardesign.scenes.casting import shared_caster, trace_each
from lidardesign.scenes.rays import receiver_axes
from lidardesign.scenes.scene import Receiver, Scene
from lidardesign.scenes.triangles import mesh_caster
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction

# A grazing hit moves without bound when its ray turns; its derivative is capped at this cosine.
MINIMUM_COSINE = 0.05
ROWS_AT_ONCE = 8192
# Room for meshes that a ray and a column may meet is not touched before it is used; too little costs a second pass.
MESHES_PER_PAIR = 4
# The width of the soft edge of a receiver's view, in sigmas.
EDGE_SIGMAS = 0.25
# Which columns matter to which rays: a mask (N, columns), or pairs of both.
Columns = np.ndarray | Pairs


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
        origins, ranges = np.ascontiguousarray(points[:, :3]), np.ascontiguousarray(points[:, RANGE])
        return cls(origins, direction(points[:, AZIMUTH], points[:, ELEVATION]), ranges)

    @property
    def observed(self) -> np.ndarray:
        """The scene points that they observe, shape (N, 3)."""
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

    def add_by_point(self, by_point: np.ndarray, rays: RayBatch) -> None:
        """Add the derivatives by the observed scene points, shape (N, 3)."""
        self.origins += by_point
        self.directions += rays.ranges[:, None] * by_point
        self.ranges += np.einsum("nk,nk->n", by_point, rays.directions)


class Transmittance(Protocol):
    """log T of a batch, one value per ray and column that were asked for, and its gradient."""

    log_values: np.ndarray

    def gradient(self, weights: np.ndarray) -> RayGradient:
        """Derivatives of sum weights * log T by each ray, weights of the shape of the values."""


class Visibility:
    """A way to compute visibility.

    `name` is that of the setting, and `rows_at_once` how many rays keep its memory bounded with gradients.
    """

    name: str
    rows_at_once = ROWS_AT_ONCE

    @cached_property
    def one_way(self) -> Visibility:
        """The visibility from a ray's origin alone, without the way back to a receiver."""
        return self

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """log T where `columns` matter, 0 elsewhere; its gradient may only be asked for if `differentiable`."""

    def take(self, columns: np.ndarray) -> Visibility:
        """The same for some columns, where it is stored by column."""
        return self


@dataclass(frozen=True, eq=False)
class Blocked:
    """The transmittance of rays and columns, of which some are blocked by a first hit.

    Arguments:
        log_values: log T.
        rays: The number of rays.
        rows: The ray of each that is blocked, shape (K,).
        index: The index of their values in `log_values`.
        hit_m: The ranges of their first hits, shape (K,) [m].
        plane: Minus the derivative of the hit range by the origin, shape (K, 3).
        attenuation_per_m: beta.
    """

    log_values: np.ndarray
    rays: int
    rows: np.ndarray
    index: Any
    hit_m: np.ndarray
    plane: np.ndarray
    attenuation_per_m: float

    @classmethod
    def at(
        cls, log_values: np.ndarray, rays: RayBatch, rows: np.ndarray, index: Any,
        hit_m: np.ndarray, normals: np.ndarray, optics: Optics,
    ) -> Blocked:  # fmt: skip
        """The transmittance of first hits.

        Arguments:
            log_values: Zeros of the shape that is asked for; written to.
            rays, rows, index, hit_m, optics: See the class.
            normals: Of the first hits, facing the origins, shape (K, 3).
        """
        log_values[index] = -optics.attenuation_per_m * (rays.ranges[rows] - optics.margin_m - hit_m)
        # normals face the origin, so the cosine with the direction is negative
        cosine = np.minimum(np.einsum("pk,pk->p", normals, rays.directions[rows]), -MINIMUM_COSINE)
        plane = normals / cosine[:, None]
        return cls(log_values, len(rays.ranges), rows, index, hit_m, plane, optics.attenuation_per_m)

    def gradient(self, weights: np.ndarray) -> RayGradient:
        """See `Transmittance`; a ray may have many hits."""
        out, pull = RayGradient.zeros(self.rays), self.attenuation_per_m * weights[self.index]
        out.ranges -= np.bincount(self.rows, pull, minlength=self.rays)
        for axis in range(3):
            force = pull * self.plane[:, axis]
            out.origins[:, axis] -= np.bincount(self.rows, force, minlength=self.rays)
            out.directions[:, axis] -= np.bincount(self.rows, force * self.hit_m, minlength=self.rays)
        return out


@dataclass(frozen=True, eq=False)
class Unmoved:
    """log T with a gradient of 0."""

    log_values: np.ndarray
    rays: int

    def gradient(self, weights: np.ndarray) -> RayGradient:
        """See `Transmittance`: 0."""
        return RayGradient.zeros(self.rays)


class NoVisibility(Visibility):
    """Every ray reaches its point: T = 1."""

    name = "off"

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`."""
        return Unmoved(np.zeros(columns.shape), len(rays.ranges))


class Raycast(Visibility):
    """Exact first hits: exact also for plates that are thinner than any quadrature step."""

    name = "raycast"

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self._casters = [
            shared_caster(scenes[index], frame, only="occluders") for index, frame in scene_columns(scenes)
        ]

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`; columns are a mask (N, columns)."""
        column, rows = np.nonzero(columns.T)
        starts = np.concatenate([[0], np.cumsum(columns.sum(axis=0))])
        limit_m = rays.ranges[rows] - optics.margin_m
        hits = trace_each(self._casters, starts, rays.origins[rows], rays.directions[rows], limit_m)
        blocked = np.flatnonzero(hits.body >= 0)
        rows, hits = rows[blocked], hits.subset(blocked)
        index = rows, column[blocked]
        return Blocked.at(np.zeros(columns.shape), rays, rows, index, hits.range_m, hits.normal, optics)


class BodyRaycast(Visibility):
    """First hits on the occluders of columns, in their own frames: primitives in closed form by compiled loops.

    Arguments:
        bodies: The occluders, sorted by column.
    """

    name = "raycast"

    def __init__(self, bodies: Bodies) -> None:
        self.bodies = bodies
        self._casters = [mesh_caster(mesh) for mesh in bodies.grids.meshes]

    def take(self, columns: np.ndarray) -> BodyRaycast:
        """See `Visibility`."""
        return BodyRaycast(self.bodies.take(columns))

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`; columns are pairs."""
        hit_m, normals = self.first_hits(rays, columns, rays.ranges - optics.margin_m)
        blocked = np.flatnonzero(np.isfinite(hit_m))
        zeros, rows = np.zeros(len(hit_m)), columns.rows[blocked]
        return Blocked.at(zeros, rays, rows, blocked, hit_m[blocked], normals[blocked], optics)

    def first_hits(self, rays: RayBatch, pairs: Pairs, limit_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ranges of first hits before a limit, infinite without one (P,), and normals facing the origin (P, 3)."""
        bodies, count, lines = self.bodies, len(pairs.columns), (rays.origins, rays.directions, limit_m)
        hits, normals, room = np.empty(count), np.empty((count, 3)), MESHES_PER_PAIR * count * bool(self._casters)
        while True:
            met = tuple(np.empty(room, dtype=np.int64) for _ in range(3))
            meshes = body_kernels().first_hits(
                bodies.arrays, bodies.mesh_bounds, pairs.row_starts, pairs.columns, lines, hits, normals, met
            )
            if meshes <= room:
                break
            room = meshes
        if meshes:
            self._cast(rays, limit_m, tuple(values[:meshes] for values in met), hits, normals)
        return hits, normals

    def _cast(
        self, rays: RayBatch, limit_m: np.ndarray, met: tuple[np.ndarray, ...], hits: np.ndarray, normals: np.ndarray
    ) -> None:
        """Enter first hits on meshes before those on primitives; `met` are rays, pairs and bodies, (K,) each."""
        bodies = self.bodies
        # all of one mesh together; small integers are sorted fast
        number = bodies.grid[met[2]]
        small = np.int16 if len(self._casters) < np.iinfo(np.int16).max else np.int64
        order = np.argsort(number.astype(small), kind="stable")
        row, pair, body = (values[order] for values in met)
        starts = np.searchsorted(number[order], np.arange(1, len(self._casters) + 2))
        local = np.empty((len(row), 3)), np.empty((len(row), 3))
        body_kernels().rays_in_frames(bodies.to_body, body, row, (rays.origins, rays.directions), local)
        for caster, first, last in zip(self._casters, starts[:-1], starts[1:], strict=True):
            origins, directions = local[0][first:last], local[1][first:last]
            limits = np.minimum(limit_m[row[first:last]], hits[pair[first:last]])
            own = caster.trace(origins, directions, limits)
            found = np.flatnonzero(own.body >= 0)
            # a pair may meet the same mesh in two poses: the nearest is written last
            found = found[np.argsort(-own.range_m[found], kind="stable")]
            normal = own.normal[found]
            facing = np.where(np.einsum("pk,pk->p", normal, directions[found]) >= 0, -1.0, 1.0)
            at, turn = first + found, bodies.to_body[body[first + found], :, :3]
            hits[pair[at]] = own.range_m[found]
            normals[pair[at]] = np.einsum("pij,pi->pj", turn, facing[:, None] * normal)


def common_receiver(scenes: Sequence[Scene]) -> Receiver | None:
    """The one receiver of all scenes; None where light is received at the rays' own origins.

    Raises:
        ConfigError: The scenes have different ones.
    """
    receivers = {scene.receiver for scene in scenes}
    if len(receivers) > 1:
        raise ConfigError(
            f"{len(receivers)} different receivers in {len(scenes)} scenes",
            where="scenes",
            allowed="one fixed receiver for all scenes of a task, or none",
        )
    return next(iter(receivers), None)


@dataclass(frozen=True, eq=False)
class _BothWays:
    log_values: np.ndarray
    rays: RayBatch
    out: Transmittance
    back_rays: RayBatch
    back: Transmittance
    view_gradient: np.ndarray

    def gradient(self, weights: np.ndarray) -> RayGradient:
        total, back = self.out.gradient(weights), self.back.gradient(weights)
        looking = self.back_rays.directions
        # the receiver stays where it is: turning its line of sight moves s across, lengthening it moves s along
        across = back.directions - np.einsum("nk,nk->n", back.directions, looking)[:, None] * looking
        reach = np.where(self.back_rays.ranges > 0, self.back_rays.ranges, np.inf)
        by_point = back.ranges[:, None] * looking + across / reach[:, None]
        by_point += weights.sum(axis=1, keepdims=True) * self.view_gradient
        total.add_by_point(by_point, self.rays)
        return total


class BistaticVisibility(Visibility):
    """Visibility from the emitter and from a fixed receiver.

    Arguments:
        one_way: How either way is computed.
        receiver: The receiver of the light.
    """

    def __init__(self, one_way: Visibility, receiver: Receiver) -> None:
        self.one_way, self.receiver = one_way, receiver
        self.name = one_way.name
        self._origin_m = np.asarray(receiver.origin_m, dtype=np.float64)
        # the boresight (3,), and inward unit normals of the field of view's four sides (4, 3)
        self._ahead, left, up = receiver_axes(receiver)
        sides = []
        for across, whole in ((left, receiver.horizontal_rad), (up, receiver.vertical_rad)):
            sides += [np.sin(whole / 2) * self._ahead + sign * np.cos(whole / 2) * across for sign in (1.0, -1.0)]
        self._inward = np.array(sides)

    @property
    def rows_at_once(self) -> int:
        """The number of rays evaluated at a time: half of one way's, since two ways are held."""
        return max(1, self.one_way.rows_at_once // 2)

    def take(self, columns: np.ndarray) -> BistaticVisibility:
        """See `Visibility`."""
        return BistaticVisibility(self.one_way.take(columns), self.receiver)

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`; columns are a mask (N, columns)."""
        observed = rays.observed
        offset = observed - self._origin_m
        reach = np.linalg.norm(offset, axis=1)
        looking = np.where(reach[:, None] > 0, offset, self._ahead)
        looking /= np.linalg.norm(looking, axis=1, keepdims=True)
        back_rays = RayBatch(np.broadcast_to(self._origin_m, offset.shape).copy(), looking, reach)
        out = self.one_way.transmittance(rays, columns, optics, differentiable=differentiable)
        back = self.one_way.transmittance(back_rays, columns, optics, differentiable=differentiable)
        log_view, by_point = self.log_view(observed, optics.sigma_m)
        values = out.log_values + back.log_values + log_view[:, None]
        return _BothWays(values, rays, out, back_rays, back, by_point)

    def log_view(self, points: np.ndarray, sigma_m: float) -> tuple[np.ndarray, np.ndarray]:
        """log of how far points (N, 3) are in view, at most 0, (N,), and its gradient (N, 3) [1/m]."""
        width_m = EDGE_SIGMAS * sigma_m
        offset = points - self._origin_m
        reach = np.linalg.norm(offset, axis=1)
        near_m, far_m = self.receiver.range_m
        inside = np.column_stack([offset @ self._inward.T, reach - near_m, far_m - reach]) / width_m
        slope = expit(-inside) / width_m
        outward = offset / np.where(reach > 0, reach, 1.0)[:, None]
        by_point = slope[:, :4] @ self._inward + (slope[:, 4] - slope[:, 5])[:, None] * outward
        return log_expit(inside).sum(axis=1), by_point
