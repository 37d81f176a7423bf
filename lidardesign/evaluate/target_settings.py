"""Settings of a target from its quick ladder: the coarsest distance fields that misplace little enough of its mass.

What is visible is found exactly (by ray casting, or not at all where nothing is in the way), and primitives have exact
distances: fields of meshes are what a target's accuracy costs time and memory for.
"""

from __future__ import annotations

from dataclasses import dataclass

from lidardesign.density.settings import DensitySettings
from lidardesign.evaluate.ladders.fields import RESOLUTIONS, Case, fresh
from lidardesign.run.clock import phase
from lidardesign.run.config import RunConfig
from lidardesign.scene import Mesh, Scene

# Of the whole tolerance: the rest is for learning, whose every halving costs more than that of the fields.
FIELD_SHARE = 0.2


@dataclass(frozen=True)
class FieldChoice:
    """Fields for a tolerance.

    Arguments:
        density: Settings with their resolution.
        misplaced: The share of the target's mass that they misplace; 0 where distances are exact.
        note: What was chosen and why, or "".
    """

    density: DensitySettings
    misplaced: float
    note: str = ""


@phase("fields")
def fields_within(scenes: list[Scene], config: RunConfig, tolerance: float, *, fixed: bool) -> FieldChoice:
    """The coarsest fields that misplace at most a fifth of a tolerance, the finest of the ladder where none does.

    Arguments:
        scenes: The training scenes.
        config: The run's configuration.
        tolerance: The whole tolerance of the density.
        fixed: Only measure the configuration's own resolution.
    """
    density = config.density
    if not any(isinstance(body.shape, Mesh) for scene in scenes for body in scene.bodies if body.is_target):
        return FieldChoice(density, 0.0)
    visibility = "off" if density.visibility == "off" else "raycast"
    case = Case.of(scenes, config.space, density, config.seed, visibility)
    if case is None:
        return FieldChoice(density, 0.0)
    misplaced = 0.0
    for resolution in (density.field_resolution,) if fixed else RESOLUTIONS:
        density = density.model_copy(update={"field_resolution": resolution})
        misplaced, _, _ = case.errors(fresh(case.few, case.scenes, resolution, density))
        if misplaced <= FIELD_SHARE * tolerance:
            break
    note = f"fields of {density.field_resolution} grid points misplace {misplaced:.2g} of the target's mass"
    return FieldChoice(density, misplaced, note)
