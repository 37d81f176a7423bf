"""Refining the visibility quadrature until it agrees with exact ray casting, or saying what it can resolve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.density.target.target import Target
from lidardesign.density.visibility.quadrature import Quadrature, RayBatch, Raycast
from lidardesign.density.visibility.receiver import HeardVisibility
from lidardesign.scene import Scene
from lidardesign.space import RANGE

MAXIMUM_POINTS = 1024
# The share of probed rays that quadrature may see through although ray casting finds them opaque.
MISSED_SHARE_TO_CARE = 0.005
OPAQUE, TRANSPARENT = 0.01, 0.1


def refine_quadrature(
    target: Target,
    scenes: Sequence[Scene],
    probes: np.ndarray,
) -> tuple[Target, list[str]]:
    """The target with enough midpoints that probes hidden by an occluder are hidden, and notes about it.

    Arguments:
        target: The target of the scenes.
        scenes: One or more columns each.
        probes: Design points, shape (N, 6).
    """
    rays = RayBatch.of(probes)
    active = np.ones((len(probes), target.field.columns), dtype=bool)
    exact = Raycast(scenes).transmittance(rays, active, target.optics, differentiable=False).log_values
    hidden = exact < np.log(OPAQUE)
    heard = target.visibility if isinstance(target.visibility, HeardVisibility) else None
    visibility, reach = heard.one_way if heard else target.visibility, float(probes[:, RANGE].max(initial=0.0))
    if not hidden.any():
        return target, []
    first, passed = visibility.points, _passed(visibility, rays, hidden, target)
    while visibility.points < MAXIMUM_POINTS:
        finer = Quadrature(visibility.field, 2 * visibility.points, visibility.thickest_m)
        passed_finer = _passed(finer, rays, hidden, target)
        # seen through, or not opaque only because midpoints are too few
        coarse = (passed > TRANSPARENT) | ((passed > OPAQUE) & (passed_finer <= OPAQUE))
        if coarse.mean() <= MISSED_SHARE_TO_CARE:
            break
        visibility, passed = finer, passed_finer
    missed = float((passed > TRANSPARENT).mean())
    notes = []
    if visibility.points != first:
        notes.append(f"visibility quadrature refined from {first} to {visibility.points} points")
    if missed > MISSED_SHARE_TO_CARE:
        opaque_m = -np.log(OPAQUE) / target.optics.attenuation_per_m
        thickness_m = max(reach / visibility.points, _field_step(visibility), opaque_m)
        notes.append(
            f"visibility quadrature still sees through {missed:.1%} of the hidden rays: it resolves occluders "
            f"thicker than {thickness_m:.2g} m; use density.visibility=raycast"
        )
    return replace(target, visibility=HeardVisibility(visibility, heard.receiver) if heard else visibility), notes


def _passed(visibility: Quadrature, rays: RayBatch, hidden: np.ndarray, target: Target) -> np.ndarray:
    """T of the hidden ray-column pairs."""
    return np.exp(visibility.transmittance(rays, hidden, target.optics, differentiable=False).log_values[hidden])


def _field_step(visibility: Quadrature) -> float:
    grid = getattr(visibility.field, "grid", None)
    return grid.step if grid is not None else 0.0
