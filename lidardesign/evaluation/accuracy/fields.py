"""Accuracy and cost of the density's geometry: distance fields of meshes, and visibility.

Fields of meshes are measured by their grid points along the longest side, against exact distances; bodies that are
primitives have those at any cost and need no field. Visibility is none, a quadrature or ray casting, against opaque
geometry in closed form, without a gradient: T = 1 up to the margin in front of the first hit, 0 behind it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.bodies import no_distances, place_bodies
from lidardesign.density.fields.distance import BodyField, Field, TableField, scene_columns
from lidardesign.density.fields.grids import distance_grid, grid_around
from lidardesign.density.fields.importance import build_log_weights
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.surfaces import SceneTable, raycast
from lidardesign.density.objective.target import PADDING_SIGMAS, Target, build_target
from lidardesign.density.objective.visibility import Columns, NoVisibility, Optics, RayBatch, Unmoved, Visibility
from lidardesign.evaluation.accuracy.probes import AccuracyRequest, Probes, density_sweep, draw_probes, few_columns
from lidardesign.evaluation.sweep import Measurement, Sweep, timed
from lidardesign.numerics import logsumexp
from lidardesign.scenes.scene import Body, Mesh, Scene, inverse_rigid
from lidardesign.space import DesignSpace

# Grid points of fields. The more scenes, the more their errors average out; so many can be built at every resolution.
RESOLUTIONS, COLUMNS, PROBES = (16, 24, 32, 48, 64, 96, 128), 12, 16_384
# Resolutions beyond the run's own are measured where building them for all these scenes takes at most so long.
LONGEST_SECONDS = 20.0
# A coarse field has its surfaces elsewhere: probes must meet them there too.
WIDENING = 3.0
# log T of hidden points: far below anything that counts, and finite.
LOG_OPAQUE = -1e4
# Of visibility: for cheap ways, for the quadrature on a common table, and for that over bodies one by one.
VISIBILITY_PROBES, TABLE_PROBES, BODY_PROBES = 32_768, 8192, 2048
BODY_BATCH = 256
# A quadrature over bodies without a common table evaluates every body at every midpoint of every probe.
MOST_BODIES = 120
# Compiled loops are loaded before anything is timed.
WARM_UP_PROBES = 32


def field_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The sweep over field resolutions; empty where no target is a mesh, or no ray meets one."""
    scenes, config = list(request.request.train), request.config
    if not any(isinstance(body.shape, Mesh) for scene in scenes for body in scene.bodies if body.is_target):
        return []
    visibility = request.decided_visibility or config.density.visibility
    case = FieldCase.of(scenes, config.space, config.density, config.seed, visibility)
    return [] if case is None else [resolution_sweep(case)]


def resolution_sweep(case: FieldCase) -> Sweep:
    """The sweep over grid points along the longest side of a field, against exact distances."""
    own, measurements, left_out = case.settings.field_resolution, [], ""
    for count in sorted({*RESOLUTIONS, own}):
        # the time grows like the volume
        if count > own:
            last = measurements[-1]
            if last.seconds * (count / int(last.setting)) ** 3 * len(case.few) > LONGEST_SECONDS:
                left_out = f"; {count} and more points would take long to measure"
                break
        started = time.perf_counter()
        field = fresh(case.few, case.scenes, count, case.settings)
        seconds = (time.perf_counter() - started) / len(case.few)
        error, uncertainty, values = case.errors(field)
        of_all = _bytes(field, case)
        measurements.append(Measurement(str(count), error, uncertainty, seconds, of_all, count == own, values=values))
    return density_sweep(
        knob="density.field_resolution",
        against="exact distances to the triangles",
        work="building the field of one scene",
        measurements=measurements,
        note=f"measured on {len(case.few)} of {len(case.scenes)} training scenes; memory is that of all scenes' "
        f"fields{left_out}",
    )


@dataclass(frozen=True, eq=False)
class FieldCase:
    """A few scenes of meshes, with probes and exact values to compare their fields.

    Arguments:
        few: The scenes.
        scenes: All scenes that share a grid with them.
        settings: The settings of the density.
        target: Their p* with the run's own field.
        probes: Probes around their surfaces.
        observed: The scene points of these, shape (N, 3).
        log_transmittance: Their log T, shape (N, columns).
        exact: Their exact distances, shape (N, columns) [m].
    """

    few: list[Scene]
    scenes: list[Scene]
    settings: DensitySettings
    target: Target
    probes: Probes
    observed: np.ndarray
    log_transmittance: np.ndarray
    exact: np.ndarray

    @classmethod
    def of(
        cls, scenes: list[Scene], space: DesignSpace, settings: DensitySettings, seed: int, visibility: str
    ) -> FieldCase | None:
        """A case of training scenes; None where no probe reaches a surface."""
        few = few_columns(scenes, COLUMNS)
        frames = np.array([few[index].frames for index, _ in scene_columns(few)], dtype=np.float64)
        field = fresh(few, scenes, settings.field_resolution, settings)
        surfaces = SceneTable(field, -np.log(frames), build_log_weights(few, field))
        way = NoVisibility() if visibility == "off" else raycast(surfaces, few)
        target = Target(
            tuple(few), surfaces, way, Optics.of(settings), space, settings.surface_tolerance_nats
        ).with_visibility(way)
        probes = draw_probes(target, PROBES, seed, "fields", widening=WIDENING)
        if not len(probes.points):
            return None
        rays = RayBatch.of(probes.points)
        everywhere = np.ones((len(probes.points), len(frames)), dtype=bool)
        passed = target.visibility.transmittance(rays, everywhere, target.optics, differentiable=False)
        exact = exact_distances(few, rays.observed)
        return cls(few, scenes, settings, target, probes, rays.observed, passed.log_values, exact)

    def log_density(self, distances: np.ndarray) -> np.ndarray:
        """log p* at the probes from their distances (N, columns)."""
        terms = self.target.surfaces.terms(self.observed, distances, self.target.optics.sigma_m)
        return logsumexp(terms + self.log_transmittance, axis=1)

    def errors(self, field: Field) -> tuple[float, float, dict[str, float]]:
        """The share of mass in the wrong place, its standard error, and the error of distances near surfaces."""
        distances = np.asarray(field.distances(self.observed), dtype=np.float64)
        near = np.abs(self.exact) < 2.0 * self.target.optics.sigma_m
        apart_m = math.sqrt(np.square((distances - self.exact)[near]).mean()) if near.any() else 0.0
        return (
            *self.probes.misplaced(self.log_density(distances), self.log_density(self.exact)),
            {"distance_error_mm": 1e3 * apart_m},
        )


def _bytes(field: Field, case: FieldCase) -> int:
    """The memory of the fields of all scenes; moving meshes have one each for all scenes."""
    if isinstance(field, TableField):
        return field.table.nbytes // field.columns * len(scene_columns(case.scenes))
    return field.bodies.grids.values.nbytes * _meshes(case.scenes) // max(_meshes(case.few), 1)


def _meshes(scenes: list[Scene]) -> int:
    bodies = [body for scene in scenes for body in scene.bodies if body.is_target]
    return len({body.shape.content_hash for body in bodies if isinstance(body.shape, Mesh)})


def fresh(few: list[Scene], scenes: list[Scene], resolution: int, settings: DensitySettings) -> Field:
    """The field of a few scenes as the run would build it, built without the cache."""
    padding_m = PADDING_SIGMAS * settings.sigma_m
    bodies = [(scene, body) for scene in scenes for body in scene.bodies if body.is_target]
    if all(isinstance(body.shape, Mesh) and scene.frames == 1 for scene, body in bodies):
        return fresh_table(few, scenes, resolution, padding_m)

    def build(mesh: Mesh) -> tuple:
        grid = grid_around(mesh.bounds_m, resolution, padding_m)
        return grid, distance_grid(mesh, grid)

    return BodyField(place_bodies(_targets(few), len(scene_columns(few)), build))


def _targets(scenes: Sequence[Scene]) -> list[tuple[int, Body, int]]:
    """Column, body and frame of every target of all scenes, one column per scene and frame."""
    return [
        (column, body, frame)
        for column, (index, frame) in enumerate(scene_columns(scenes))
        for body in scenes[index].bodies
        if body.is_target
    ]


def exact_distances(scenes: Sequence[Scene], points: np.ndarray) -> np.ndarray:
    """The exact distances of targets at points, (N, 3) to (N, columns) [m]: to meshes by libigl, by their triangles."""
    columns, meshes, others = len(scene_columns(scenes)), [], []
    for entry in _targets(scenes):
        (meshes if isinstance(entry[1].shape, Mesh) else others).append(entry)
    out = np.full((len(points), columns), np.inf)
    if others:
        out = BodyField(place_bodies(others, columns, no_distances)).distances(points)
    for column, body, frame in meshes:
        to_body = inverse_rigid(body.pose(frame))
        local = points @ to_body[:3, :3].T + to_body[:3, 3]
        out[:, column] = np.minimum(out[:, column], mesh_distances(body.shape, local))
    return out


def mesh_distances(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """The exact distances of points (N, 3) from a mesh in its own frame, negative inside where it has one, (N,)."""
    import igl

    # relative to the mesh's corner: squares of coordinates far from the origin would lose every digit
    corner = mesh.bounds_m[0]
    points, vertices, faces = points - corner, mesh.vertices - corner, mesh.faces.astype(np.int64)
    distance = igl.signed_distance(points, vertices, faces, sign_type=igl.SIGNED_DISTANCE_TYPE_UNSIGNED)[0]
    if mesh.sign == "unsigned":
        return distance
    return np.where(np.abs(igl.fast_winding_number(vertices, faces, points)) > 0.5, -distance, distance)


def fresh_table(scenes: Sequence[Scene], around: Sequence[Scene], resolution: int, padding_m: float) -> TableField:
    """The table of scenes whose targets are meshes at rest, built without the cache.

    Arguments:
        scenes: One column each.
        around: All scenes that the run's grid holds.
        resolution, padding_m: See `fields.build_field`.
    """
    bounds = np.concatenate([mesh.bounds_m for scene in around for mesh in target_meshes(scene)])
    grid = grid_around(np.stack([bounds.min(axis=0), bounds.max(axis=0)]), resolution, padding_m)
    columns = [np.min([distance_grid(mesh, grid) for mesh in target_meshes(scene)], axis=0) for scene in scenes]
    unsigned = [any(mesh.sign == "unsigned" for mesh in target_meshes(scene)) for scene in scenes]
    return TableField(np.stack(columns, axis=1), grid, np.where(unsigned, grid.step, 0.0))


def target_meshes(scene: Scene) -> list[Mesh]:
    """The target meshes of a scene at rest, in the world."""
    return [b.shape.transformed(b.pose()) for b in scene.bodies if b.is_target and isinstance(b.shape, Mesh)]


def visibility_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The sweep over kinds of visibility; empty where no ray sees a target."""
    scenes, config = list(request.request.train), request.config
    few = affordable_scenes(scenes)
    case = VisibilityCase.of(few, config.space, config.density, config.seed, config.learning.batch)
    if case.is_blind:
        return []
    # the visibility of the run's probe, and its refined points of quadrature
    default, points = request.decided_visibility or config.density.visibility, config.density.quadrature_points
    if default == "quadrature":
        points = request.target.visibility.one_way.points
    return [visibility_sweep(case, points, default, _part(few, scenes))]


def visibility_sweep(case: VisibilityCase, points: int, default: str, note: str = "") -> Sweep:
    """No visibility, the quadrature with its own points, and ray casting.

    Arguments:
        case: The case to measure on.
        points: Midpoints of the quadrature.
        default: The run's own: off, quadrature or raycast.
        note: A line for readers.
    """
    exact = case.exact
    ways = {
        "off": (case.cast.with_visibility(NoVisibility()), exact),
        "quadrature": (case.quadrature(points), exact[: case.few]),
        "raycast": (case.cast, exact),
    }
    return density_sweep(
        knob="density.visibility",
        against="opaque geometry, by exact first hits",
        work=f"log p* with its gradient at {min(case.batch, len(case.probes.points))} design points",
        measurements=[case.measure(name, *way, default=name == default) for name, way in ways.items()],
        note=note,
    )


def _part(few: list[Scene], scenes: list[Scene]) -> str:
    """The part of the scenes that was measured; "" where it was all of them."""
    if few is scenes:
        return ""
    frames = f", {few[0].frames} frames of each" if scenes[0].frames > few[0].frames else ""
    return f"measured on {len(few)} of {len(scenes)} training scenes{frames}"


def affordable_scenes(scenes: list[Scene]) -> list[Scene]:
    """All scenes where their occluders share a table, else as many as a fine quadrature can evaluate."""
    occluders = [[body for body in scene.bodies if body.is_occluder] for scene in scenes]
    if all(isinstance(body.shape, Mesh) and body.poses.ndim == 2 for bodies in occluders for body in bodies):
        return scenes
    return few_columns(scenes, max(MOST_BODIES // max(1, *map(len, occluders)), 1))


@dataclass(frozen=True, eq=False)
class VisibilityCase:
    """Targets of scenes with probes to measure visibility at.

    Arguments:
        cast, integrated: The target with ray casting and with quadrature.
        probes: Points drawn independently of the flow.
        few: Number of these that a quadrature is evaluated at.
        batch: Number of these that are timed.
    """

    cast: Target
    integrated: Target
    probes: Probes
    few: int
    batch: int

    @classmethod
    def of(
        cls, scenes: list[Scene], space: DesignSpace, settings: DensitySettings, seed: int, batch: int = 1024
    ) -> VisibilityCase:
        """The targets of scenes, and probes.

        Arguments:
            scenes: All are used: see `affordable_scenes`.
            space: The design space.
            settings: Of the density.
            seed: The root of the probes.
            batch: The number of points that is timed, fewer where bodies are evaluated one by one.
        """
        cast = build_target(scenes, space, settings, "raycast")
        integrated = build_target(scenes, space, settings, "quadrature")
        shared = isinstance(integrated.visibility.one_way.field, TableField)
        few, batch = (TABLE_PROBES, batch) if shared else (BODY_PROBES, min(BODY_BATCH, batch))
        return cls(cast, integrated, draw_probes(cast, VISIBILITY_PROBES, seed, "visibility"), few, batch)

    @cached_property
    def exact(self) -> np.ndarray:
        """log p* at the probes where occluders are opaque, shape (N,)."""
        return opaque_target(self.cast).log_density(self.probes.points)

    @property
    def is_blind(self) -> bool:
        """True where no probe reaches a surface, or none sees one."""
        return bool(self.exact.max(initial=LOG_OPAQUE) < LOG_OPAQUE / 2)

    def quadrature(self, points: int) -> Target:
        """The target with so many midpoints."""
        return self.integrated.with_visibility(Quadrature(self.integrated.visibility.one_way.field, points))

    def measure(self, setting: str, target: Target, exact: np.ndarray, *, default: bool) -> Measurement:
        """A target's error at as many probes as there are exact values (N,), and its time for a batch."""
        probes = Probes(self.probes.points[: len(exact)], self.probes.log_proposal[: len(exact)])
        batch = self.probes.points[: self.batch]
        target.log_density_and_gradient(batch[:WARM_UP_PROBES])
        _, seconds, memory = timed(lambda: target.log_density_and_gradient(batch))
        errors = probes.misplaced(target.log_density(probes.points), exact)
        return Measurement(setting, *errors, seconds, memory, default=default)


def opaque_target(target: Target) -> Target:
    """The same target with opaque occluders."""
    return target.with_visibility(Opaque(raycast(target.surfaces, target.scenes)))


class Opaque(Visibility):
    """Exact first hits on opaque scenes."""

    name = "opaque"

    def __init__(self, exact: Visibility) -> None:
        self._exact, self.rows_at_once = exact, exact.rows_at_once

    def transmittance(
        self, rays: RayBatch, columns: Columns, optics: Optics, *, differentiable: bool = True
    ) -> Unmoved:
        """See `Visibility`; its gradient is 0 wherever there is one."""
        exact = self._exact.transmittance(rays, columns, optics, differentiable=False)
        return Unmoved(np.where(exact.log_values < 0, LOG_OPAQUE, 0.0), len(rays.ranges))

    def take(self, columns: np.ndarray) -> Opaque:
        """See `Visibility`."""
        return Opaque(self._exact.take(columns))
