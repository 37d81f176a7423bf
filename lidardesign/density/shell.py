"""Proposals from the shell around the surfaces, with their density from the distance field.

Where both angles are free, a point is drawn uniform in area on a random scene's targets, moved along the normal by a
normal offset of the target's own sigma, and observed from a random admissible origin. Its density per volume is then
q(s) = sum_i N(SDF_i(s); sigma) / A_i over the scenes, and r^2 q(s) per solid angle and range: exact for flat surfaces
and off in first order of sigma times the curvature for others (on a ball of 15 sigma the rim weighs 14 % too little,
which a pool for balancing and a coverage can bear). Weights p* / q are bounded by A / r^2, and unlike range errors
along rays these proposals also reach the rim of silhouettes, where a ray passes a surface within sigma without
meeting it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.density.fields import Field, scene_columns
from lidardesign.numerics import TINY, logsumexp
from lidardesign.scene import Scene
from lidardesign.space import ELEVATION, RANGE, DesignSpace, aim, observed_point
from lidardesign.surface import sample_body, target_area_m2


def shell_proposals(
    field: Field,
    scenes: Sequence[Scene],
    space: DesignSpace,
    count: int,
    sigma_m: float,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 6) inside the space, at most `count`, and their log density per chart volume up to a constant.

    Arguments:
        field: Distances to the targets, one column per scene and frame.
        scenes: The scenes of these columns.
        space: The design space; its origins are proposed uniformly.
        count: The number of draws; those that leave the space are dropped.
        sigma_m: Standard deviation of the offset along the normal [m].
        generator: Of all draws.
    """
    columns = scene_columns(scenes)
    column = np.sort(generator.integers(len(columns), size=count))
    surface = np.empty((count, 3))
    normal = np.empty((count, 3))
    for number in np.unique(column):
        rows = np.flatnonzero(column == number)
        index, frame = columns[number]
        targets = [body for body in scenes[index].bodies if body.is_target]
        drawn = sample_body(targets, space, len(rows), generator, frame)
        surface[rows], normal[rows] = drawn.points, _normals(field, drawn.points, drawn.triangles, number)
    surface += generator.normal(scale=sigma_m, size=(count, 1)) * normal
    points = space.wrap(aim(space.sample(count, generator)[:, :3], surface))
    points = points[space.contains(points) & (points[:, RANGE] > 0)]
    return points, _log_density(field, scenes, columns, space, points, sigma_m)


def _log_proximity(field: Field, points: np.ndarray, sigma_m: float, weights: np.ndarray | None = None) -> np.ndarray:
    """log of the sum over columns of weight * exp(-d^2 / (2 sigma^2)) at the observed points, shape (N,)."""
    distances = field.distances(observed_point(points)).astype(np.float64)
    return logsumexp(-np.square(distances / sigma_m) / 2, axis=1, weights=weights)


def _normals(field: Field, points: np.ndarray, triangles: np.ndarray, column: int) -> np.ndarray:
    """Unit normals of triangles, and of primitives, whose triangles are points, from the field's gradient."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    flat = length[:, 0] == 0
    if flat.any():
        weights = np.zeros((int(flat.sum()), field.columns))
        weights[:, column] = 1.0
        normal[flat] = field.gradient(points[flat], weights)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(length == 0, 1.0, length)


def _log_density(
    field: Field,
    scenes: Sequence[Scene],
    columns: list[tuple[int, int]],
    space: DesignSpace,
    points: np.ndarray,
    sigma_m: float,
) -> np.ndarray:
    area_m2 = np.array([target_area_m2(scene, space) for scene in scenes])[[index for index, _ in columns]]
    log_density = _log_proximity(field, points, sigma_m, 1.0 / area_m2) + 2 * np.log(points[:, RANGE])
    return log_density + log_chart_factor(space, points)


def log_chart_factor(space: DesignSpace, points: np.ndarray) -> np.ndarray | float:
    """log of solid angle per chart area at design points: 0 where the chart measures solid angle."""
    if space.measure == "solid_angle":
        return 0.0
    return np.log(np.maximum(np.cos(points[:, ELEVATION]), TINY))
