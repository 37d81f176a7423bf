"""The target of a run's training scenes: visibility decided, quadrature refined, doubts noted. Needs no torch."""

from __future__ import annotations

from collections.abc import Sequence

from lidardesign.config import RunConfig
from lidardesign.density.fields.importance import importance_notes
from lidardesign.density.target.refinement import refine_quadrature
from lidardesign.density.target.resolution import flatness_notes, resolution_notes
from lidardesign.density.target.target import Target, build_target
from lidardesign.density.training.proposals import occluded_share, propose
from lidardesign.density.visibility.quadrature import Optics
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.task import random_generator

PROBES = 4096
OCCLUDED_SHARE_TO_CARE = 1e-3
HIDDEN_SHARE_TO_WARN = 0.99


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
        notes.append(reason)
    target = build_target(scenes, config.space, settings, visibility, compiled=compiled)
    if visibility == "quadrature":
        target, refined = _refine_quadrature(target, scenes, config)
        notes.extend(refined)
    notes.extend(resolution_notes(target, settings))
    notes.extend(flatness_notes(target, settings.sigma_m, random_generator(config.seed, "flatness")))
    notes.extend(importance_notes(scenes))
    notes.extend(dict.fromkeys(line for scene in scenes for line in scene.notes))
    shapes = [body.shape for scene in scenes for body in scene.bodies]
    notes.extend(sorted({line for shape in shapes for line in getattr(shape, "notes", ())}))
    return target, notes


@phase("visibility")
def _choose_visibility(scenes: Sequence[Scene], config: RunConfig) -> tuple[str, str]:
    generator = random_generator(config.seed, "visibility")
    optics = Optics.of(config.density)
    proposals = propose(scenes, config.space, PROBES, optics.sigma_m, generator)
    if not len(proposals.points):
        return "raycast", "visibility by ray casting, to be safe: no probed ray of the space meets a target"
    share = occluded_share(scenes, proposals, optics.margin_m + 3 * optics.sigma_m)
    if share < OCCLUDED_SHARE_TO_CARE:
        return "off", f"visibility off: of {len(proposals.points)} probed rays {share:.2%} had anything in the way"
    reason = f"visibility by ray casting: {share:.1%} of {len(proposals.points)} probed rays were occluded"
    if share > HIDDEN_SHARE_TO_WARN:
        reason += "; hardly anything is ever visible: check the occluders' places and the bodies' roles"
    return "raycast", reason


def _refine_quadrature(target: Target, scenes: Sequence[Scene], config: RunConfig) -> tuple[Target, list[str]]:
    generator = random_generator(config.seed, "quadrature")
    proposals = propose(scenes, config.space, PROBES, config.density.sigma_m, generator)
    return refine_quadrature(target, scenes, proposals.points)
