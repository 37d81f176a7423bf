"""What sigma can tell apart: refused where it is finer than distances are, noted where it blurs or flattens.

Trilinear distances to a surface of curvature radius R are off by about step^2 / (8 R), and by nothing to a flat one.
So sigma may be finer than the grid for flat surfaces, with a note; below a hundredth of the step even what bends over
twelve cells is off by more than sigma, and the density would follow the grid instead of the surface.
"""

from __future__ import annotations

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.bodies import Bodies
from lidardesign.density.fields.distance import BodyField, Field, TableField, UnionField
from lidardesign.density.target.target import Target
from lidardesign.errors import ConfigError
from lidardesign.space import RANGE, DesignSpace, observed_point

# Shares of a grid step: sigma below the first blurs curved surfaces, below the second nothing curved is told apart.
BLURRED_SHARE, UNRESOLVED_SHARE = 0.5, 0.01
# Roundings of coordinates that a distance passes through.
ROUNDINGS = 4
# A density that varies by less than this over the whole space prefers hardly anything.
FLAT_NATS = 0.5
FLATNESS_PROBES = 256
# Scenes that large with a sigma that fine are more likely in another unit.
DOUBTFUL_ACROSS_M = 20.0


def resolution_notes(target: Target, settings: DensitySettings) -> list[str]:
    """What sigma blurs.

    Raises:
        ConfigError: Sigma is finer than distances are known.
    """
    sigma_m = settings.sigma_m
    _refuse_below_rounding(target.space, sigma_m)
    steps = _grid_steps_m(target.field)
    if not len(steps) or sigma_m >= BLURRED_SHARE * steps.max():
        return []
    if sigma_m < UNRESOLVED_SHARE * steps.min():
        raise ConfigError(
            f"sigma {sigma_m:g} m is far below the grid step {steps.min():.3g} m of the fields",
            where="density.sigma_m",
            allowed=f"at least {UNRESOLVED_SHARE * steps.min():.3g} m on this grid",
            hint=_finer_hint(float(steps.min()) * settings.field_resolution),
        )
    return [
        f"sigma {sigma_m:g} m is below half the field's grid step {steps.max():.3g} m: "
        "surfaces are blurred more than sigma says; raise density.field_resolution"
    ]


def _finer_hint(across_m: float) -> str:
    """What to do about fields across so many metres that sigma is lost in them."""
    finer = "raise density.field_resolution, or sigma"
    if across_m < DOUBTFUL_ACROSS_M:
        return finer
    return (
        f"are the lengths in metres? the scenes are about {across_m:.2g} m across; files in millimetres need the "
        f"factor 0.001 (task meshes: --set scale=0.001); else {finer}"
    )


def flatness_notes(target: Target, sigma_m: float, generator: np.random.Generator) -> list[str]:
    """Whether a sigma wider than all that the space can observe leaves the density flat, measured by uniform points."""
    if not target.space.free:
        return []
    points = target.space.sample(FLATNESS_PROBES, generator)
    if sigma_m < float(np.linalg.norm(np.ptp(observed_point(points), axis=0))):
        return []
    varies = float(np.ptp(target.log_proximity(points, sigma_m)))
    if varies >= FLAT_NATS:
        return []
    return [
        f"the target density is flat: with sigma {sigma_m:g} m it varies by {varies:.2g} nats over the whole space, "
        "so that no design is better than another; lower density.sigma_m"
    ]


def _refuse_below_rounding(space: DesignSpace, sigma_m: float) -> None:
    farthest = max(np.abs([*space.low[:3], *space.high[:3]]).max(), space.high[RANGE])
    rounding = ROUNDINGS * float(np.spacing(farthest))
    if sigma_m < rounding:
        raise ConfigError(
            f"sigma {sigma_m:g} m is below what coordinates of {farthest:g} m are rounded to, {rounding:.2g} m",
            where="density.sigma_m",
            allowed=f"at least {rounding:.2g} m here",
            hint="move the scene nearer to the origin, or raise sigma",
        )


def _grid_steps_m(field: Field | Bodies) -> np.ndarray:
    """The grid steps of all meshes of a field [m]; none where every distance is exact."""
    if isinstance(field, TableField):
        return np.array([field.grid.step])
    if isinstance(field, UnionField):
        return np.concatenate([_grid_steps_m(field.first), _grid_steps_m(field.second)])
    bodies = field.bodies if isinstance(field, BodyField) else field
    return 1.0 / bodies.grids.inverse_steps[1:] if isinstance(bodies, Bodies) else np.zeros(0)
