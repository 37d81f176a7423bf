"""Independent proposals: design points that listen at random surfaces, drawn without the flow.

They find modes that the flow dropped (`coverage`), and show whether anything can be in the way of a ray at all
(visibility `auto`). Where both angles are free they aim at points that are uniform in area from random admissible
origins; where an angle is fixed hardly any surface point can be aimed at, so random admissible rays are traced
through all surfaces within reach and one of these is chosen. A normal range error is added in both cases; where the
range is fixed, the error is what the surface is away from it.

The density that they are drawn from sums over all surfaces of all scenes along a ray, each with its own range error;
surfaces more than `WINDOW_SPREADS` of these away add less than 1e-13 of their share and are not looked for.

Proposals from the shell around the surfaces, with their density from the distance field.

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
from dataclasses import dataclass

import numpy as np

from lidardesign.density.fields.distance import Field, scene_columns
from lidardesign.geometry.raycast import Crossings, SceneCaster, shared_caster
from lidardesign.geometry.surface import sample_body, target_area_m2
from lidardesign.numerics import TINY, logsumexp
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, direction, observed_point

WINDOW_SPREADS = 8.0
# A proposal whose own surface ray casting does not find again within this many range errors (a ray through an edge
# or a vertex, by rounding) is dropped: its density would be far too small and its weight without bounds.
FOUND_SPREADS = 0.5
# Surfaces seen more flatly than this have an unbounded density per solid angle; area sampling hardly meets them.
MINIMUM_COSINE = 1e-3
MAXIMUM_COLUMNS = 128


@dataclass(frozen=True, eq=False)
class Proposals:
    """Design points with the density that they were proposed from.

    Arguments:
        points: Shape (N, 6), inside the space.
        log_density: Per chart volume, up to one constant, shape (N,).
        surface_range_m: The range of the surface that each listens at, without the range error, shape (N,).
        column: The column of that surface, an index into `columns`, shape (N,).
        columns: Scene and frame of the columns that were drawn from.
    """

    points: np.ndarray
    log_density: np.ndarray
    surface_range_m: np.ndarray
    column: np.ndarray
    columns: list[tuple[int, int]]


def propose(
    scenes: Sequence[Scene], space: DesignSpace, count: int, spread_m: float, generator: np.random.Generator
) -> Proposals:
    """Proposals from at most `count` draws; those that leave the space are dropped."""
    columns = _chosen_columns(scenes, generator)
    angles_free = AZIMUTH in space.free and ELEVATION in space.free
    draw = _from_aimed_rays if angles_free else _from_random_rays
    points, surface_range, column, density = draw(scenes, columns, space, count, spread_m, generator)
    if angles_free and space.measure == "angles":
        density *= np.cos(points[:, ELEVATION])
    kept = np.flatnonzero(space.contains(points) & (density > 0))
    return Proposals(points[kept], np.log(density[kept]), surface_range[kept], column[kept], columns)


def occluded_share(scenes: Sequence[Scene], proposals: Proposals, margin_m: float) -> float:
    """The share of proposals whose surface has an occluder more than the margin in front of it, on any of its ways."""
    origins = proposals.points[:, :3]
    surface = proposals.surface_range_m[:, None]
    points = origins + surface * direction(proposals.points[:, AZIMUTH], proposals.points[:, ELEVATION])
    blocked = np.zeros(len(points), dtype=bool)
    for number, (index, frame) in enumerate(proposals.columns):
        rows = np.flatnonzero(proposals.column == number)
        if not len(rows):
            continue
        caster, receiver = shared_caster(scenes[index], frame, only="occluders"), scenes[index].receiver
        blocked[rows] = _is_hidden(caster, origins[rows], points[rows], margin_m)
        if receiver is not None:
            blocked[rows] |= _is_hidden(caster, np.asarray(receiver.origin_m), points[rows], margin_m)
    return float(blocked.mean()) if len(blocked) else 0.0


def _is_hidden(caster: SceneCaster, places: np.ndarray, points: np.ndarray, margin_m: float) -> np.ndarray:
    """Which points (N, 3) have something more than the margin in front of them, seen from places (3,) or (N, 3)."""
    offset = points - places
    reach_m = np.linalg.norm(offset, axis=1)
    seen = np.flatnonzero(reach_m > 0)
    hidden = np.zeros(len(points), dtype=bool)
    starts = np.broadcast_to(places, points.shape)[seen]
    hidden[seen] = caster.first_hit(starts, offset[seen]).range_m < reach_m[seen] - margin_m
    return hidden


def _chosen_columns(scenes: Sequence[Scene], generator: np.random.Generator) -> list[tuple[int, int]]:
    columns = scene_columns(scenes)
    if len(columns) <= MAXIMUM_COLUMNS:
        return columns
    return [columns[i] for i in sorted(generator.choice(len(columns), MAXIMUM_COLUMNS, replace=False))]


_Drawn = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _from_aimed_rays(
    scenes: Sequence[Scene],
    columns: list[tuple[int, int]],
    space: DesignSpace,
    count: int,
    spread_m: float,
    generator: np.random.Generator,
) -> _Drawn:
    """Points, the ranges of their surfaces, their columns and their densities per volume and solid angle.

    A point of an area A at range s and incidence theta has the density s^2 / (A cos theta) per solid angle.
    """
    rays, column = _aimed_rays(scenes, columns, space, count, generator)
    points, surface_range, accepted = _with_range_error(rays, space, spread_m, generator)
    directions = direction(points[:, AZIMUTH], points[:, ELEVATION])
    start = np.maximum(points[:, RANGE] - WINDOW_SPREADS * spread_m, 0.0)
    end = points[:, RANGE] + WINDOW_SPREADS * spread_m
    density, found = np.zeros(len(points)), np.zeros(len(points), dtype=bool)
    for number, (index, frame) in enumerate(columns):
        caster = shared_caster(scenes[index], frame, only="targets")
        crossed = caster.crossings(points[:, :3], directions, start, end)
        share = crossed.range_m**2 / (
            target_area_m2(scenes[index], space) * np.maximum(crossed.cosine, MINIMUM_COSINE)
        )
        _add_shares(density, crossed, share, points, spread_m)
        own = np.abs(crossed.range_m - surface_range[crossed.row]) < FOUND_SPREADS * spread_m
        found[crossed.row[own & (column[crossed.row] == number)]] = True
    return points, surface_range, column, np.where(found & accepted, density, 0.0)


def _from_random_rays(
    scenes: Sequence[Scene],
    columns: list[tuple[int, int]],
    space: DesignSpace,
    count: int,
    spread_m: float,
    generator: np.random.Generator,
) -> _Drawn:
    """The same along uniform rays that meet a surface of their column within reach, at one of these each."""
    rays, column = space.sample(count, generator), generator.integers(len(columns), size=count)
    directions = direction(rays[:, AZIMUTH], rays[:, ELEVATION])
    start, end = np.zeros(count), np.full(count, space.high[RANGE] + WINDOW_SPREADS * spread_m)
    crossed = [
        shared_caster(scenes[index], frame, only="targets").crossings(rays[:, :3], directions, start, end)
        for index, frame in columns
    ]
    chosen = np.full(count, np.nan)
    for number, found in enumerate(crossed):
        order = generator.permutation(np.flatnonzero(column[found.row] == number))
        # of several writes to one row the last one stays, and their order is random
        chosen[found.row[order]] = found.range_m[order]
    rays[:, RANGE] = chosen
    points, surface_range, accepted = _with_range_error(rays, space, spread_m, generator)
    density = np.zeros(count)
    for found in crossed:
        share = 1.0 / np.bincount(found.row, minlength=count)[found.row]
        _add_shares(density, found, share, points, spread_m)
    kept = np.isfinite(chosen) & accepted
    return points[kept], surface_range[kept], column[kept], density[kept]


def _with_range_error(
    rays: np.ndarray, space: DesignSpace, spread_m: float, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 6), the ranges of their surfaces (N,), and which points are to be kept (N,) bool.

    A fixed range is an error that is known: a ray is kept with the probability that its surface has this error.
    """
    points, surface_range = rays.copy(), rays[:, RANGE].copy()
    if RANGE in space.free:
        points[:, RANGE] += generator.normal(scale=spread_m, size=len(points))
        return points, surface_range, np.ones(len(points), dtype=bool)
    points[:, RANGE] = space.low[RANGE]
    probability = np.exp(-np.square((points[:, RANGE] - surface_range) / spread_m) / 2)
    return points, surface_range, generator.random(len(points)) < probability


def _add_shares(
    density: np.ndarray, crossed: Crossings, share: np.ndarray, points: np.ndarray, spread_m: float
) -> None:
    """Add every surface's share with its range error, up to the normal's constant."""
    z = (points[crossed.row, RANGE] - crossed.range_m) / spread_m
    np.add.at(density, crossed.row, share * np.exp(-np.square(z) / 2))


def _aimed_rays(
    scenes: Sequence[Scene],
    columns: list[tuple[int, int]],
    space: DesignSpace,
    count: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from uniform origins to area-uniform target points, with the points' ranges, and their columns."""
    column = np.sort(generator.integers(len(columns), size=count))
    surface = np.empty((count, 3))
    for number, (index, frame) in enumerate(columns):
        rows = np.flatnonzero(column == number)
        if len(rows):
            targets = [body for body in scenes[index].bodies if body.is_target]
            drawn = sample_body(targets, space, len(rows), generator, frame).points
            surface[rows] = generator.permutation(drawn)
    rays = space.wrap(aim(space.sample(count, generator)[:, :3], surface))
    angles_only = rays.copy()
    angles_only[:, RANGE] = space.low[RANGE]
    admissible = space.contains(angles_only)
    return rays[admissible], column[admissible]


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
