"""The target of a run's training scenes: visibility decided, quadrature refined, doubts noted. Needs no torch.

The quadrature of visibility is refined until it agrees with exact ray casting, or a note says what it can resolve.

Sigma is refused where it is finer than distances are, and noted where it blurs or flattens. Trilinear distances to a
surface of curvature radius R are off by about step^2 / (8 R), and by nothing to a flat one. So sigma may be finer than
the grid for flat surfaces, with a note; below a hundredth of the step even what bends over twelve cells is off by more
than sigma, and the density would follow the grid instead of the surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.config import DensitySettings, RunConfig
from lidardesign.density.fields.distance import TableField
from lidardesign.density.fields.importance import importance_notes
from lidardesign.density.objective.proposals import occluded_share, propose
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.target import Target, build_target
from lidardesign.density.objective.visibility import Optics, RayBatch, Raycast
from lidardesign.errors import BackgroundNote, ConfigError, DataError
from lidardesign.plugins import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.scenes.scene import Scene
from lidardesign.space import RANGE, observed_point
from lidardesign.task import Task, random_generator, scenes_of

PROBES = 4096
OCCLUDED_SHARE_TO_CARE = 1e-3
MAXIMUM_POINTS = 1024
# The share of probed rays that quadrature may see through although ray casting finds them opaque.
MISSED_SHARE_TO_CARE = 0.005
OPAQUE, TRANSPARENT = 0.01, 0.1
# Shares of a grid step: sigma below the first blurs curved surfaces, below the second they are not resolved.
BLURRED_SHARE, UNRESOLVED_SHARE = 0.5, 0.01
# Roundings of coordinates that a distance passes through.
ROUNDINGS = 4
# A density that varies by less than this over the whole space prefers hardly anything.
FLAT_NATS = 0.5
FLATNESS_PROBES = 256
# Scenes that large with a sigma that fine are more likely in another unit.
DOUBTFUL_ACROSS_M = 20.0


@phase("scenes")
def training_scenes(task: Task, config: RunConfig) -> list[Scene]:
    """The scenes that a density is learned from.

    Raises:
        DataError: There are none.
        PluginError: The task's own code failed.
    """
    with plugin_guard(config.task_name):
        scenes = list(scenes_of(task, config.task, "train", config.seed, config.space))
    if not scenes:
        raise DataError(f"the task {config.task_name!r} gave no training scenes", where="task")
    return scenes


@phase("fields")
def prepare_target(
    scenes: Sequence[Scene],
    config: RunConfig,
    *,
    visibility: str | None = None,
    compiled: bool = True,
) -> tuple[Target, list[str]]:
    """The target of training scenes, and notes on what was decided or is doubtful.

    Arguments:
        scenes: The training scenes.
        config: The run's configuration; visibility `auto` is decided here by a probe.
        visibility: What an earlier probe of the same run decided, to take instead.
        compiled: See `build_target`.

    Raises:
        ConfigError: Sigma is finer than distances are known; see `build_target` too.
    """
    settings, notes = config.density, []
    visibility = visibility or settings.visibility
    if visibility == "auto":
        visibility, reason = _choose_visibility(scenes, config)
        notes.append(BackgroundNote(reason))
    target = build_target(scenes, config.space, settings, visibility, compiled=compiled)
    if visibility == "quadrature":
        generator = random_generator(config.seed, "quadrature")
        probes = propose(scenes, config.space, PROBES, settings.sigma_m, generator).points
        target, refined = refine_quadrature(target, probes)
        notes += refined
    shapes = [body.shape for scene in scenes for body in scene.bodies]
    return target, [
        *notes,
        *resolution_notes(target, settings),
        *flatness_notes(target, random_generator(config.seed, "flatness")),
        *importance_notes(scenes),
        *dict.fromkeys(line for scene in scenes for line in scene.notes),
        *sorted({line for shape in shapes for line in getattr(shape, "notes", ())}),
    ]


@phase("visibility")
def _choose_visibility(scenes: Sequence[Scene], config: RunConfig) -> tuple[str, str]:
    generator = random_generator(config.seed, "visibility")
    optics = Optics.of(config.density)
    proposals = propose(scenes, config.space, PROBES, optics.sigma_m, generator)
    if not len(proposals.points):
        return "raycast", "visibility by ray casting, to be safe: no probed ray of the design space meets a target"
    share = occluded_share(scenes, proposals, optics.margin_m + 3 * optics.sigma_m)
    if share < OCCLUDED_SHARE_TO_CARE:
        return "off", f"visibility off: {share:.2%} of {len(proposals.points)} probed rays had anything in the way"
    return "raycast", f"visibility by ray casting: {share:.1%} of {len(proposals.points)} probed rays were occluded"


def refine_quadrature(target: Target, probes: np.ndarray) -> tuple[Target, list[str]]:
    """The target with enough midpoints that probes hidden by an occluder are hidden, and notes about it.

    Arguments:
        target: Seen by quadrature.
        probes: Design points, shape (N, 6).
    """
    rays = RayBatch.of(probes)
    everywhere = np.ones((len(probes), target.columns), dtype=bool)
    exact = Raycast(target.scenes).transmittance(rays, everywhere, target.optics, differentiable=False)
    hidden = exact.log_values < np.log(OPAQUE)
    if not hidden.any():
        return target, []

    def passed_through(visibility: Quadrature) -> np.ndarray:
        """T of the hidden ray-column pairs."""
        return np.exp(visibility.transmittance(rays, hidden, target.optics, differentiable=False).log_values[hidden])

    visibility = target.visibility.one_way
    first, passed = visibility.points, passed_through(visibility)
    while visibility.points < MAXIMUM_POINTS:
        finer = Quadrature(visibility.field, 2 * visibility.points)
        passed_finer = passed_through(finer)
        # seen through, or not opaque only because midpoints are too few
        coarse = (passed > TRANSPARENT) | ((passed > OPAQUE) & (passed_finer <= OPAQUE))
        if coarse.mean() <= MISSED_SHARE_TO_CARE:
            break
        visibility, passed = finer, passed_finer
    missed = float((passed > TRANSPARENT).mean())
    notes = []
    if visibility.points != first:
        notes.append(BackgroundNote(f"visibility quadrature refined from {first} to {visibility.points} points"))
    if missed > MISSED_SHARE_TO_CARE:
        step_m = visibility.field.grid.step if isinstance(visibility.field, TableField) else 0.0
        opaque_m = -np.log(OPAQUE) / target.optics.attenuation_per_m
        thickness_m = max(float(probes[:, RANGE].max(initial=0.0)) / visibility.points, step_m, opaque_m)
        notes.append(
            f"visibility quadrature still sees through {missed:.1%} of the hidden rays: it resolves occluders "
            f"thicker than {thickness_m:.2g} m; use density.visibility=raycast"
        )
    return target.with_visibility(visibility), notes


def resolution_notes(target: Target, settings: DensitySettings) -> list[str]:
    """Notes on surfaces that a sigma below the grid step blurs.

    Raises:
        ConfigError: Sigma is below the accuracy of distances.
    """
    sigma_m, space = settings.sigma_m, target.space
    farthest = max(np.abs([*space.low[:3], *space.high[:3]]).max(), space.high[RANGE])
    rounding = ROUNDINGS * float(np.spacing(farthest))
    if sigma_m < rounding:
        raise ConfigError(
            f"sigma {sigma_m:g} m is below the rounding error of coordinates of {farthest:g} m, {rounding:.2g} m",
            where="density.sigma_m",
            allowed=f"at least {rounding:.2g} m here",
            hint="move the scene nearer to the origin, or raise sigma",
        )
    steps = target.surfaces.grid_steps_m
    if not len(steps) or sigma_m >= BLURRED_SHARE * steps.max():
        return []
    if sigma_m < UNRESOLVED_SHARE * steps.min():
        hint, across_m = "raise density.field_resolution, or sigma", float(steps.min()) * settings.field_resolution
        if across_m >= DOUBTFUL_ACROSS_M:
            hint = (
                f"are the lengths in metres? the scenes are about {across_m:.2g} m across; files in millimetres need "
                f"the factor 0.001 (task meshes: --set scale=0.001); else {hint}"
            )
        raise ConfigError(
            f"sigma {sigma_m:g} m is far below the grid step {steps.min():.3g} m of the fields",
            where="density.sigma_m",
            allowed=f"at least {UNRESOLVED_SHARE * steps.min():.3g} m on this grid",
            hint=hint,
        )
    return [
        f"sigma {sigma_m:g} m is below half the field's grid step {steps.max():.3g} m: "
        "surfaces are blurred more than sigma says; raise density.field_resolution"
    ]


def flatness_notes(target: Target, generator: np.random.Generator) -> list[str]:
    """A note where a sigma wider than the observable region leaves the density flat over uniform points."""
    points, sigma_m = target.space.sample(FLATNESS_PROBES, generator), target.optics.sigma_m
    if not target.space.free or sigma_m < float(np.linalg.norm(np.ptp(observed_point(points), axis=0))):
        return []
    varies = float(np.ptp(target.log_proximity(points)))
    if varies >= FLAT_NATS:
        return []
    return [
        f"the target density is flat: with sigma {sigma_m:g} m it varies by {varies:.2g} nats over the whole space, "
        "so that no design is better than another; lower density.sigma_m"
    ]
