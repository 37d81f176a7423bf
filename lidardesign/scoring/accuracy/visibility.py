"""Accuracy and cost of visibility: none, quadrature or ray casting against opaque geometry.

Opaque geometry is the closed form, without a gradient: T = 1 up to the margin in front of the first hit, 0 behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import TableField
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.target import Target, build_target
from lidardesign.density.objective.visibility import (
    Columns,
    NoVisibility,
    Optics,
    RayBatch,
    Unmoved,
    Visibility,
)
from lidardesign.scenes.scene import Mesh, Scene
from lidardesign.scoring.accuracy.probes import (
    AccuracyRequest,
    Probes,
    density_sweep,
    draw_probes,
    few_columns,
)
from lidardesign.scoring.sweep import Measurement, Sweep, timed
from lidardesign.space import DesignSpace

# log T of hidden points: far below anything that counts, and finite
LOG_OPAQUE = -1e4


def opaque_target(target: Target) -> Target:
    """The same target with opaque occluders."""
    return target.with_visibility(Opaque(target.surfaces.raycast(target.scenes)))


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


# Errors of cheap ways, of the quadrature on a common table, and of that over bodies one by one.
PROBES, TABLE_PROBES, BODY_PROBES = 32_768, 8192, 2048
BODY_BATCH = 256
# A quadrature over bodies without a common table evaluates every body at every midpoint of every probe.
MOST_BODIES = 120
# Compiled loops are loaded before anything is timed.
WARM_UP_PROBES = 32


@dataclass(frozen=True, eq=False)
class VisibilityCase:
    """Scenes and what visibility is measured on there.

    Arguments:
        cast, integrated: The target with ray casting and with quadrature.
        probes: Points that know nothing of the flow.
        few: How many of these a quadrature is evaluated at.
        batch: How many of them are timed.
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
        return cls(cast, integrated, draw_probes(cast, PROBES, seed, "visibility"), few, batch)

    @cached_property
    def exact(self) -> np.ndarray:
        """log p* at the probes where occluders are opaque, shape (N,)."""
        return opaque_target(self.cast).log_density(self.probes.points)

    @property
    def is_blind(self) -> bool:
        """Whether no probe reaches a surface, or none sees one."""
        return bool(self.exact.max(initial=LOG_OPAQUE) < LOG_OPAQUE / 2)

    def quadrature(self, points: int) -> Target:
        """The target with so many midpoints."""
        return self.integrated.with_visibility(Quadrature(self.integrated.visibility.one_way.field, points))

    def measure(self, setting: str, target: Target, exact: np.ndarray, *, default: bool) -> Measurement:
        """A target's error at as many probes as there are exact values (N,), and its time for a batch."""
        probes, batch = self.probes.first(len(exact)), self.probes.points[: self.batch]
        target.log_density_and_gradient(batch[:WARM_UP_PROBES])
        _, seconds, memory = timed(lambda: target.log_density_and_gradient(batch))
        errors = probes.misplaced(target.log_density(probes.points), exact)
        return Measurement(setting, *errors, seconds, memory, default=default)

    @property
    def work(self) -> str:
        """What is timed."""
        return f"log p* with its gradient at {min(self.batch, len(self.probes.points))} design points"


def sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """One sweep; empty where no ray sees a target."""
    scenes, config = list(request.request.train), request.config
    few = affordable_scenes(scenes)
    case = VisibilityCase.of(few, config.space, config.density, config.seed, config.learning.batch)
    if case.is_blind:
        return []
    # what the run's probe decided, and the points of its quadrature, refined as they were
    default, points = request.decided_visibility or config.density.visibility, config.density.quadrature_points
    if default == "quadrature":
        points = request.target.visibility.one_way.points
    return [visibility_sweep(case, points, default, _part(few, scenes))]


def visibility_sweep(case: VisibilityCase, points: int, default: str, note: str = "") -> Sweep:
    """No visibility, the quadrature with its own points, and ray casting.

    Arguments:
        case: What they are measured on.
        points: Of the quadrature.
        default: off, quadrature or raycast: what the run uses.
        note: What a reader should know.
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
        work=case.work,
        measurements=[case.measure(name, *way, default=name == default) for name, way in ways.items()],
        note=note,
    )


def _part(few: list[Scene], scenes: list[Scene]) -> str:
    """Which part of the scenes was measured; "" where it was all of them."""
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
