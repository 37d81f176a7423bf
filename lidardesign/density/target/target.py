"""The target density p*(d): how often, over the scenes of a task, a design point sees a surface (paper, eq. 3 to 5).

log p*(d) = logsumexp_i [ log w_i(s) - SDF_i(s)^2 / (2 sigma^2) + log T_i(d) ], s = M(d); one term per column, that is
per scene, or per frame of a moving scene. w_i is the column's own weight, 1 / frames, times the importance of the
surface next to s, where there is one (`importance`). Visibility is only computed for columns whose surface term is
within `surface_tolerance_nats` (t) of the best one at that point; the others are left out, which changes p* by less
than columns * exp(-t) of the largest surface term there.

An order of points in which neighbours in space follow each other and find each other's memory in the cache.

Results do not depend on it, to the last bit: every point is evaluated by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import Field, TableField, build_field, scene_columns
from lidardesign.density.fields.importance import LogWeights, build_log_weights
from lidardesign.density.visibility.quadrature import (
    NoVisibility,
    Optics,
    Quadrature,
    RayBatch,
    Raycast,
    RayGradient,
    Visibility,
)
from lidardesign.density.visibility.receiver import HeardVisibility, common_receiver
from lidardesign.errors import ConfigError, NumericalError
from lidardesign.numerics import SLACK, logsumexp
from lidardesign.run.clock import phase
from lidardesign.scene import Mesh, Scene
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace, observed_point

# Cells per axis are 2 to this power: finer than the points of a batch lie apart.
LEVELS = 6


def nearby_order(points: np.ndarray) -> np.ndarray:
    """The order of points (N, 3) along a Z-shaped curve through their bounding box, shape (N,) (Morton 1966)."""
    if len(points) < 2:
        return np.arange(len(points))
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    # points that share a coordinate have no extent there
    shares = (points - low) / np.where(size > 0, size, 1.0)
    cells = np.minimum((shares * 2**LEVELS).astype(np.int64), 2**LEVELS - 1)
    keys = np.zeros(len(points), dtype=np.int64)
    for level in range(LEVELS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> level) & 1) << (3 * level + axis)
    return np.argsort(keys, kind="stable")


PADDING_SIGMAS = 4.0
# Points times columns at a time: some ten arrays of so many float64 are in use at once.
PAIRS_AT_ONCE = 2**22
MOST_QUADRATURE_BODIES = 2000
# d direction / d sin(elevation) grows without bound at the poles; it is capped at this cosine of the elevation.
MINIMUM_POLE_COSINE = 1e-4


@dataclass(frozen=True, eq=False)
class Target:
    """The unnormalised target density of a set of scenes.

    Arguments:
        field: Distances to the targets, one column per scene and frame.
        visibility: How occlusion is computed.
        log_column_weights: log of the columns' own weights, shape (columns,).
        optics: The final sigma and what goes with it.
        space: The design space; it fixes the chart that gradients are given in.
        surface_tolerance_nats: See the module docstring.
        importance: How much the surfaces count; None: 1 everywhere.
    """

    field: Field
    visibility: Visibility
    log_column_weights: np.ndarray
    optics: Optics
    space: DesignSpace
    surface_tolerance_nats: float = 16.0
    importance: LogWeights | None = None

    @property
    def columns(self) -> int:
        """The number of scenes and frames."""
        return len(self.log_column_weights)

    @property
    def rows_at_once(self) -> int:
        """How many points keep the memory bounded."""
        return int(np.clip(PAIRS_AT_ONCE // self.columns, 1, self.visibility.rows_at_once))

    @property
    def log_peak(self) -> float:
        """What no surface term of a single column exceeds."""
        return float(self.log_column_weights.max()) + (0.0 if self.importance is None else self.importance.peak)

    def drawn(self, columns: np.ndarray) -> Target:
        """An estimate of p* from some columns alone, weighted to stand for all; the others need no visibility."""
        weights = np.full(self.columns, -np.inf)
        weights[columns] = self.log_column_weights[columns] + np.log(self.columns / len(columns))
        return replace(self, log_column_weights=weights)

    def log_proximity(self, points: np.ndarray, sigma_m: float | None = None) -> np.ndarray:
        """log of the sum of surface terms at the scene points that design points (N, 6) observe, shape (N,)."""
        sigma_m = self.optics.sigma_m if sigma_m is None else sigma_m
        values = np.empty(len(points))
        for start in range(0, len(points), self.rows_at_once):
            rows = slice(start, start + self.rows_at_once)
            observed = observed_point(points[rows])
            distances = self.field.distances(observed).astype(np.float64)
            values[rows] = logsumexp(self.surface_terms(observed, distances, sigma_m), axis=1)
        return values

    def log_density(self, points: np.ndarray, sigma_m: float | None = None) -> np.ndarray:
        """log p* of design points, (N, 6) to (N,), at the final sigma unless a wider one is given."""
        return self._in_chunks(points, sigma_m, gradient=False)[0]

    def log_density_and_gradient(
        self, points: np.ndarray, sigma_m: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """log p* and its gradient by the chart coordinates of `space`: (N, 6) to (N,) and (N, 6)."""
        return self._in_chunks(points, sigma_m, gradient=True)

    @phase("target")
    def _in_chunks(
        self, points: np.ndarray, sigma_m: float | None, gradient: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        points = np.asarray(points, dtype=np.float64)
        if wrong := unusable(points):
            raise NumericalError(wrong, where="target density")
        optics = self.optics if sigma_m is None else self.optics.widened(sigma_m)
        values, gradients = np.empty(len(points)), np.empty((len(points) if gradient else 0, 6))
        size, order = self.rows_at_once, nearby_order(observed_point(points))
        for start in range(0, len(points), size):
            rows = order[start : start + size]
            values[rows], by_chart = self._evaluate(points[rows], optics, gradient)
            if gradient:
                gradients[rows] = by_chart
        return values, gradients

    def _evaluate(self, points: np.ndarray, optics: Optics, gradient: bool) -> tuple[np.ndarray, np.ndarray | None]:
        rays = RayBatch.of(points)
        observed = rays.observed
        distances = self.field.distances(observed).astype(np.float64)
        surface = self.surface_terms(observed, distances, optics.sigma_m)
        active = surface >= surface.max(axis=1, keepdims=True, initial=-np.inf) - self.surface_tolerance_nats
        passed = self.visibility.transmittance(rays, active, optics, differentiable=gradient)
        terms = np.where(active, surface + passed.log_values, -np.inf)
        values, shares = self._log_sums(terms)
        if not gradient:
            return values, None
        by_point = self.field.gradient(observed, -shares * distances / optics.sigma_m**2)
        if self.importance is not None:
            by_point += self.importance.gradient(observed, shares)
        by_ray = passed.gradient(shares)
        by_ray.add_by_point(by_point, rays)
        return values, self._by_chart(points, by_ray)

    def surface_terms(self, observed: np.ndarray, distances: np.ndarray, sigma_m: float) -> np.ndarray:
        """log w - distance^2 / (2 sigma^2) at scene points (N, 3), shape (N, columns)."""
        terms = self.log_column_weights - np.square(distances / sigma_m) / 2
        return terms if self.importance is None else terms + self.importance.values(observed)

    def _log_sums(self, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """log of the sum of exp(terms) of each point (N,), and the share of each term in it (N, columns)."""
        peak = terms.max(axis=1, keepdims=True)
        shares = np.exp(terms - peak)
        total = shares.sum(axis=1, keepdims=True)
        shares /= total
        return (peak + np.log(total))[:, 0], shares

    def _by_chart(self, points: np.ndarray, by_ray: RayGradient) -> np.ndarray:
        sin_a, cos_a = np.sin(points[:, AZIMUTH]), np.cos(points[:, AZIMUTH])
        sin_e, cos_e = np.sin(points[:, ELEVATION]), np.cos(points[:, ELEVATION])
        by_elevation = np.stack([-sin_e * cos_a, -sin_e * sin_a, cos_e], axis=1)
        if self.space.measure == "solid_angle":
            by_elevation /= np.maximum(cos_e, MINIMUM_POLE_COSINE)[:, None]
        by_azimuth = np.stack([-cos_e * sin_a, cos_e * cos_a, np.zeros_like(sin_a)], axis=1)
        by_chart = np.empty((len(points), 6))
        by_chart[:, :3] = by_ray.origins
        by_chart[:, AZIMUTH] = np.einsum("nk,nk->n", by_ray.directions, by_azimuth)
        by_chart[:, ELEVATION] = np.einsum("nk,nk->n", by_ray.directions, by_elevation)
        by_chart[:, RANGE] = by_ray.ranges
        return by_chart


def unusable(points: np.ndarray) -> str | None:
    """What makes design points (N, 6) none, by the name of the dimension; a range of 0 is one."""
    if np.isfinite(points).all() and points[:, RANGE].min(initial=0.0) >= -SLACK:
        return None
    for name, values in zip(DIMENSIONS, points.T, strict=True):
        if not np.isfinite(values).all():
            return f"{int((~np.isfinite(values)).sum())} design points are not finite in {name}"
    return f"range_m is {points[:, RANGE].min():g} m, which is negative"


def build_target(
    scenes: Sequence[Scene], space: DesignSpace, settings: DensitySettings, visibility: str, *, compiled: bool = True
) -> Target:
    """The target of scenes.

    Arguments:
        scenes: One term per scene and frame; where they have a fixed receiver, it must see the points too.
        space: The design space.
        settings: Its numbers.
        visibility: raycast, quadrature or off; `prepare_target` decides auto.
        compiled: False for a few evaluations without gradient, which are not worth loading the kernels.

    Raises:
        ConfigError: A quadrature over too many moving bodies, or scenes with different receivers.
    """
    optics = Optics.of(settings)
    fields = {"resolution": settings.field_resolution, "padding_m": PADDING_SIGMAS * settings.sigma_m}
    frames = [scenes[index].frames for index, _ in scene_columns(scenes)]
    log_column_weights = -np.log(np.array(frames, dtype=np.float64))
    receiver = common_receiver(scenes)
    if is_of_frames(scenes, visibility):
        # frames builds on this module
        from lidardesign.density.target.frames import build_frames_target

        return build_frames_target(scenes, space, settings, visibility, log_column_weights, **fields)
    check_quadrature(scenes, visibility)
    field = build_field(scenes, lambda body: body.is_target, **fields)
    if isinstance(field, TableField):
        field = replace(field, compiled=compiled)
    importance = build_log_weights(scenes, field)
    way = _build_visibility(scenes, settings, visibility, field, fields)
    return Target(
        field=field,
        visibility=way if receiver is None else HeardVisibility(way, receiver),
        log_column_weights=log_column_weights,
        optics=optics,
        space=space,
        surface_tolerance_nats=settings.surface_tolerance_nats,
        importance=importance,
    )


def is_of_frames(scenes: Sequence[Scene], visibility: str) -> bool:
    """Whether scenes are best evaluated body by body, frame by frame (`frames`)."""
    return (
        common_receiver(scenes) is None
        and visibility != "quadrature"
        and not any(_has_mesh_at_rest(scene) for scene in scenes)
    )


def check_quadrature(scenes: Sequence[Scene], visibility: str) -> None:
    """Refuse a quadrature that would evaluate every body of thousands of frames at every midpoint."""
    moving = sum(scene.frames * len(scene.bodies) for scene in scenes if scene.frames > 1)
    if visibility == "quadrature" and moving > MOST_QUADRATURE_BODIES:
        raise ConfigError(
            f"a quadrature over {moving} bodies in all frames would take minutes a step",
            where="density.visibility",
            allowed=f"at most {MOST_QUADRATURE_BODIES}",
            hint="density.visibility=raycast looks only at the frames that matter",
        )


def _has_mesh_at_rest(scene: Scene) -> bool:
    """Whether a target of a scene is best kept in the table that all scenes at rest share."""
    return scene.frames == 1 and any(isinstance(body.shape, Mesh) for body in scene.bodies if body.is_target)


def _build_visibility(
    scenes: Sequence[Scene], settings: DensitySettings, visibility: str, field: Field, fields: dict
) -> Visibility:
    if visibility == "off":
        return NoVisibility()
    if visibility == "raycast":
        return Raycast(scenes)
    same = all(body.role == "both" for scene in scenes for body in scene.bodies)
    occluders = field if same else build_field(scenes, lambda body: body.is_occluder, **fields)
    return Quadrature(occluders, settings.quadrature_points)
