"""What distance fields of meshes cost: grid points along their longest side, and how one reads between them.

Bodies that are primitives are exact at any cost and need no field.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.density.compared_fields import ExactField, InterpolatedField, fresh_bodies, fresh_table
from lidardesign.density.fields import Field, TableField, scene_columns
from lidardesign.density.importance import build_log_weights
from lidardesign.density.receiver import HeardVisibility, common_receiver
from lidardesign.density.settings import DensitySettings
from lidardesign.density.target import PADDING_SIGMAS, Target
from lidardesign.density.visibility import NoVisibility, Optics, RayBatch, Raycast
from lidardesign.evaluate.accuracy import AccuracyRequest
from lidardesign.evaluate.ladders.probes import (
    BECAUSE,
    ERROR_OF,
    TOLERANCE,
    Probes,
    draw_probes,
    few_columns,
    run_visibility,
)
from lidardesign.evaluate.rungs import Ladder, Rung, timed
from lidardesign.numerics import logsumexp
from lidardesign.scene import Mesh, Scene
from lidardesign.space import DesignSpace

LABEL = "distance fields"
RESOLUTIONS = (16, 24, 32, 48, 64, 96, 128)
# The more scenes, the more their errors average out; so many can be built anew at every resolution.
COLUMNS = 12
PROBES = 16_384
# Resolutions beyond the run's own are measured where building them for all these scenes takes at most so long.
LONGEST_SECONDS = 20.0
# A coarse field has its surfaces elsewhere: probes must meet them there too.
WIDENING = 3.0
NEAR_SIGMAS = 2.0
TIMED_POINTS = 1024
ORDERS = {"nearest": 0, "trilinear": 1, "tricubic": 3}
DEFAULT_ORDER = "trilinear"


@dataclass(frozen=True, eq=False)
class Case:
    """A few scenes of meshes, and what their fields are compared by.

    Arguments:
        few: These scenes.
        scenes: All scenes that share a grid with them.
        settings: Of the density.
        target: Their p* with the run's own field.
        probes: Around their surfaces.
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
    ) -> Case | None:
        """A case of training scenes; None where no probe reaches a surface."""
        few = few_columns(scenes, COLUMNS)
        receiver, way = common_receiver(few), NoVisibility() if visibility == "off" else Raycast(few)
        frames = np.array([few[index].frames for index, _ in scene_columns(few)], dtype=np.float64)
        field = fresh(few, scenes, settings.field_resolution, settings)
        target = Target(
            field=field,
            visibility=way if receiver is None else HeardVisibility(way, receiver),
            log_column_weights=-np.log(frames),
            optics=Optics.of(settings),
            space=space,
            surface_tolerance_nats=settings.surface_tolerance_nats,
            importance=build_log_weights(few, field, around=scenes),
        )
        probes = draw_probes(target, few, PROBES, seed, "fields", widening=WIDENING)
        if not len(probes.points):
            return None
        rays = RayBatch.of(probes.points)
        everywhere = np.ones((len(probes.points), len(frames)), dtype=bool)
        passed = target.visibility.transmittance(rays, everywhere, target.optics, differentiable=False)
        exact = ExactField(few, lambda body: body.is_target).distances(rays.observed)
        return cls(few, scenes, settings, target, probes, rays.observed, passed.log_values, exact)

    def log_density(self, distances: np.ndarray) -> np.ndarray:
        """log p* at the probes from their distances (N, columns)."""
        surface = self.target.surface_terms(self.observed, distances, self.target.optics.sigma_m)
        return logsumexp(surface + self.log_transmittance, axis=1)

    def errors(self, field: Field) -> tuple[float, float, dict[str, float]]:
        """The share of mass in the wrong place, its standard error, and the error of distances near surfaces."""
        distances = np.asarray(field.distances(self.observed), dtype=np.float64)
        near = np.abs(self.exact) < NEAR_SIGMAS * self.target.optics.sigma_m
        apart_m = math.sqrt(np.square((distances - self.exact)[near]).mean()) if near.any() else 0.0
        return (
            *self.probes.misplaced(self.log_density(distances), self.log_density(self.exact)),
            {"distance_error_mm": 1e3 * apart_m},
        )


def ladders(request: AccuracyRequest) -> Sequence[Ladder]:
    """Resolution and interpolation; empty where no target is a mesh, or no ray meets one."""
    scenes, config = list(request.request.train), request.config
    if not any(isinstance(body.shape, Mesh) for scene in scenes for body in scene.bodies if body.is_target):
        return []
    visibility = run_visibility(request) or config.density.visibility
    case = Case.of(scenes, config.space, config.density, config.seed, visibility)
    if case is None:
        return []
    found = [resolution_ladder(case)]
    return [*found, interpolation_ladder(case)] if isinstance(case.target.field, TableField) else found


def resolution_ladder(case: Case) -> Ladder:
    """Grid points along the longest side of a field, against exact distances."""
    rungs, left_out = _resolution_rungs(case)
    return Ladder(
        knob="density.field_resolution",
        error_of=ERROR_OF,
        unit="",
        against="exact distances to the triangles",
        tolerance=TOLERANCE,
        because=BECAUSE,
        work="building the field of one scene",
        rungs=rungs,
        note=_part(case, f"memory is that of all scenes' fields{left_out}"),
    )


def _resolution_rungs(case: Case) -> tuple[list[Rung], str]:
    """The rungs that do not take too long beyond the run's own, and what the first one that would is called."""
    rungs: list[Rung] = []
    for count in sorted({*RESOLUTIONS, case.settings.field_resolution}):
        if count > case.settings.field_resolution and _predicted_s(case, rungs[-1], count) > LONGEST_SECONDS:
            return rungs, f"; {count} and more points would take long to measure"
        rungs.append(_resolution_rung(case, count))
    return rungs, ""


def _predicted_s(case: Case, last: Rung, resolution: int) -> float:
    """What building the fields at a resolution will take, growing like their volume [s]."""
    return last.seconds * (resolution / int(last.setting)) ** 3 * len(case.few)


def _resolution_rung(case: Case, resolution: int) -> Rung:
    started = time.perf_counter()
    field = fresh(case.few, case.scenes, resolution, case.settings)
    seconds = (time.perf_counter() - started) / len(case.few)
    error, uncertainty, values = case.errors(field)
    default = resolution == case.settings.field_resolution
    return Rung(str(resolution), error, uncertainty, seconds, _bytes(field, case), default, values=values)


def _bytes(field: Field, case: Case) -> int:
    """The memory of the fields of all scenes; moving meshes have one each, however many scenes they are in."""
    if isinstance(field, TableField):
        return field.table.nbytes // field.columns * len(scene_columns(case.scenes))
    return field.bodies.grids.values.nbytes * _meshes(case.scenes) // max(_meshes(case.few), 1)


def _meshes(scenes: list[Scene]) -> int:
    """How many different target meshes scenes have."""
    shapes = (body.shape for scene in scenes for body in scene.bodies if body.is_target)
    return len({shape.content_hash for shape in shapes if isinstance(shape, Mesh)})


def interpolation_ladder(case: Case) -> Ladder:
    """How distances between grid points are found, at the run's own resolution."""
    table, points = case.target.field, case.observed[:TIMED_POINTS]
    exact = ExactField(case.few, lambda body: body.is_target)
    _, seconds, memory = timed(lambda: exact.distances(points))
    ways = {
        name: table if name == DEFAULT_ORDER else InterpolatedField.of(table, order) for name, order in ORDERS.items()
    }
    return Ladder(
        knob="interpolation of fields",
        error_of=ERROR_OF,
        unit="",
        against="exact distances to the triangles",
        tolerance=TOLERANCE,
        because=BECAUSE,
        work=f"distances of {len(points)} points in {table.columns} scenes",
        rungs=[
            *(_way_rung(case, name, field, points) for name, field in ways.items()),
            Rung("exact", 0.0, 0.0, seconds, memory, reference=True, values={"distance_error_mm": 0.0}),
        ],
        note=_part(case, f"with {case.settings.field_resolution} grid points along the longest side"),
    )


def _way_rung(case: Case, name: str, field: Field, points: np.ndarray) -> Rung:
    _, seconds, memory = timed(lambda: field.distances(points))
    error, uncertainty, values = case.errors(field)
    return Rung(name, error, uncertainty, seconds, memory, name == DEFAULT_ORDER, values=values)


def fresh(few: list[Scene], scenes: list[Scene], resolution: int, settings: DensitySettings) -> Field:
    """The field of a few scenes as the run would build it, whatever is cached."""
    padding_m = PADDING_SIGMAS * settings.sigma_m
    bodies = [(scene, body) for scene in scenes for body in scene.bodies if body.is_target]
    if all(isinstance(body.shape, Mesh) and scene.frames == 1 for scene, body in bodies):
        return fresh_table(few, scenes, resolution, padding_m)
    return fresh_bodies(few, resolution, padding_m)


def _part(case: Case, note: str) -> str:
    return f"measured on {len(case.few)} of {len(case.scenes)} training scenes; {note}"
