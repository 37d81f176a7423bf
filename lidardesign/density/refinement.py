"""Refining the visibility quadrature until it agrees with exact ray casting, or saying what it can resolve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.density.target import Target
from lidardesign.density.visibility import Quadrature, RayBatch, Raycast
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction

MAXIMUM_POINTS = 1024
# Shares of probed rays that quadrature may see through although ray casting finds them opaque.
MISSED_SHARE_TO_CARE = 0.005
OPAQUE, TRANSPARENT = 0.01, 0.5


def refine_quadrature(target: Target, scenes: Sequence[Scene], probes: np.ndarray) -> tuple[Target, list[str]]:
    """The target with enough midpoints that probes (N, 6) hidden by an occluder are hidden, and notes about it."""
    rays = RayBatch(probes[:, :3], direction(probes[:, AZIMUTH], probes[:, ELEVATION]), probes[:, RANGE])
    active = np.ones((len(probes), target.field.columns), dtype=bool)
    exact = Raycast(scenes).transmittance(rays, active, target.optics, differentiable=False).log_values
    hidden = exact < np.log(OPAQUE)
    visibility, reach = target.visibility, float(probes[:, RANGE].max(initial=0.0))
    if not hidden.any():
        return target, []
    first = visibility.points
    missed = _missed_share(visibility, rays, hidden, target)
    while missed > MISSED_SHARE_TO_CARE and visibility.points < MAXIMUM_POINTS:
        visibility = Quadrature(visibility.field, 2 * visibility.points)
        missed = _missed_share(visibility, rays, hidden, target)
    notes = []
    if visibility.points != first:
        notes.append(f"visibility quadrature refined from {first} to {visibility.points} points")
    if missed > MISSED_SHARE_TO_CARE:
        thickness_m = max(reach / visibility.points, _field_step(visibility))
        notes.append(
            f"visibility quadrature still sees through {missed:.1%} of the hidden rays: it resolves occluders "
            f"thicker than {thickness_m:.2g} m; use density.visibility=raycast"
        )
    return replace(target, visibility=visibility), notes


def _missed_share(visibility: Quadrature, rays: RayBatch, hidden: np.ndarray, target: Target) -> float:
    log_values = visibility.transmittance(rays, hidden, target.optics, differentiable=False).log_values
    return float((log_values[hidden] > np.log(TRANSPARENT)).mean())


def _field_step(visibility: Quadrature) -> float:
    grid = getattr(visibility.field, "grid", None)
    return grid.step if grid is not None else 0.0
