"""The target density p*(d): how often, over the scenes of a task, a design point sees a surface (paper, eq. 3 to 5).

log p*(d) = logsumexp_i [ log w_i(s) - SDF_i(s)^2 / (2 sigma^2) + log T_i(d) ], s = M(d); one term per column, that is
per scene, or per frame of a moving scene. w_i is the column's own weight, 1 / frames, times the importance of the
surface next to s, where there is one (`fields.importance`). Only columns whose surface term is within
`surface_tolerance_nats` (t) of the best one at a point are looked at further; the others are left out, which changes p*
by less than columns * exp(-t) of the largest surface term there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import TableField, build_field, scene_columns
from lidardesign.density.fields.importance import build_log_weights
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.surfaces import MovingFrames, SceneTable, Surfaces, raycast
from lidardesign.density.objective.visibility import (
    BistaticVisibility,
    NoVisibility,
    Optics,
    RayBatch,
    Visibility,
    common_receiver,
)
from lidardesign.errors import ConfigError, NumericalError
from lidardesign.numerics import SLACK
from lidardesign.run.clock import phase
from lidardesign.scenes.scene import Mesh, Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, observed_point

PADDING_SIGMAS = 4.0
MOST_QUADRATURE_BODIES = 2000
# d direction / d sin(elevation) grows without bound at the poles; it is capped at this cosine of the elevation.
MINIMUM_POLE_COSINE = 1e-4


@dataclass(frozen=True, eq=False)
class Target:
    """The unnormalised target density of a set of scenes.

    Arguments:
        scenes: What it is the density of, one column per scene and frame.
        surfaces: The targets of the columns, with their importance.
        visibility: How occlusion is computed.
        optics: The final sigma and what goes with it.
        space: The design space; it fixes the chart that gradients are given in.
        surface_tolerance_nats: See the module docstring.
    """

    scenes: tuple[Scene, ...]
    surfaces: Surfaces
    visibility: Visibility
    optics: Optics
    space: DesignSpace
    surface_tolerance_nats: float = 16.0

    @property
    def columns(self) -> int:
        """The number of scenes and frames."""
        return len(self.surfaces.log_column_weights)

    @property
    def rows_at_once(self) -> int:
        """The number of points evaluated at a time, which bounds memory."""
        return min(self.surfaces.rows_at_once, self.visibility.rows_at_once)

    def with_visibility(self, way: Visibility) -> Target:
        """The same target with another visibility, also towards the scenes' receiver where they have one."""
        receiver = common_receiver(self.scenes)
        return replace(self, visibility=way if receiver is None else BistaticVisibility(way, receiver))

    def subsample(self, columns: np.ndarray) -> Target:
        """An estimate of p* from some columns alone, weighted to stand for all; the others need no visibility."""
        return replace(self, surfaces=self.surfaces.subsample(columns), visibility=self.visibility.take(columns))

    def log_proximity(self, points: np.ndarray) -> np.ndarray:
        """log of the sum of surface terms at the scene points that design points (N, 6) observe, shape (N,)."""
        observed, values = observed_point(points), np.empty(len(points))
        for start in range(0, len(points), self.rows_at_once):
            rows = slice(start, start + self.rows_at_once)
            values[rows] = self.surfaces.log_proximity(observed[rows], self.optics.sigma_m, self.surface_tolerance_nats)
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
    def _in_chunks(self, points: np.ndarray, sigma_m: float | None, gradient: bool) -> tuple[np.ndarray, np.ndarray]:
        points = np.asarray(points, dtype=np.float64)
        if not np.isfinite(points).all() or points[:, RANGE].min(initial=0.0) < -SLACK:
            raise NumericalError("design points are not finite, or their range_m is negative", where="target density")
        optics = self.optics if sigma_m is None else self.optics.widened(sigma_m)
        values, gradients = np.empty(len(points)), np.empty((len(points) if gradient else 0, 6))
        for start in range(0, len(points), self.rows_at_once):
            rows = slice(start, start + self.rows_at_once)
            values[rows], by_chart = self._evaluate(points[rows], optics, gradient)
            if gradient:
                gradients[rows] = by_chart
        return values, gradients

    def _evaluate(self, points: np.ndarray, optics: Optics, gradient: bool) -> tuple[np.ndarray, np.ndarray | None]:
        """log p* and its gradient for one chunk; a function of its own frees the chunk's arrays."""
        rays = RayBatch.of(points)
        near = self.surfaces.near(rays.observed, optics.sigma_m, self.surface_tolerance_nats)
        passed = self.visibility.transmittance(rays, near.columns, optics, differentiable=gradient)
        values, shares = near.log_sums(passed.log_values)
        if not gradient:
            return values, None
        by_point, by_ray = near.gradient(shares), passed.gradient(shares)
        by_ray.add_by_point(by_point, rays)
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
        return values, by_chart


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
    scenes = tuple(scenes)
    fields = {"resolution": settings.field_resolution, "padding_m": PADDING_SIGMAS * settings.sigma_m}
    log_column_weights = -np.log(np.array([scenes[index].frames for index, _ in scene_columns(scenes)], np.float64))
    # meshes at rest are best kept in the table that all scenes at rest share
    at_rest = [body for scene in scenes if scene.frames == 1 for body in scene.bodies if body.is_target]
    tabled = visibility == "quadrature" or any(isinstance(body.shape, Mesh) for body in at_rest)
    moving = sum(scene.frames * len(scene.bodies) for scene in scenes if scene.frames > 1)
    if visibility == "quadrature" and moving > MOST_QUADRATURE_BODIES:
        # every body of thousands of frames would be evaluated at every midpoint
        raise ConfigError(
            f"a quadrature over {moving} bodies in all frames would take minutes per step",
            where="density.visibility",
            allowed=f"at most {MOST_QUADRATURE_BODIES}",
            hint="density.visibility=raycast looks only at the frames that matter",
        )
    field = build_field(scenes, lambda body: body.is_target, **fields)
    if isinstance(field, TableField):
        field = replace(field, compiled=compiled)
    importance = build_log_weights(scenes, field)
    if common_receiver(scenes) is None and not tabled:
        bodies = field.bodies if importance is None else importance.bodies
        surfaces: Surfaces = MovingFrames(bodies, log_column_weights, importance)
    else:
        surfaces = SceneTable(field, log_column_weights, importance)
    if visibility == "off":
        way: Visibility = NoVisibility()
    elif visibility == "raycast":
        way = raycast(surfaces, scenes)
    else:
        same = all(body.role == "both" for scene in scenes for body in scene.bodies)
        occluders = field if same else build_field(scenes, lambda body: body.is_occluder, **fields)
        way = Quadrature(occluders, settings.quadrature_points)
    target = Target(scenes, surfaces, way, Optics.of(settings), space, settings.surface_tolerance_nats)
    return target.with_visibility(way)
