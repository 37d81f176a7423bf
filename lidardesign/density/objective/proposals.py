"""Points drawn independently of the flow, with their density: for balancing and for coverage.

- Both angles free: the surfaces of the target draw them (`surfaces`), where they have an end.
- An angle fixed: hardly any surface point can be aimed at from a given origin, but few dimensions are free, so uniform
  points of the space are resampled by the surface proximity, which is then their density; with more free dimensions
  uniform rays are traced (`propose`).
- The range fixed: hardly any surface point is that far from a given origin. Uniform points are resampled, too.

`propose` also shows, without a target, whether anything can be in the way of a ray at all (visibility `auto`). Where
both angles are free its points aim at points that are uniform in area from random admissible origins; where an angle is
fixed random admissible rays are traced through all surfaces within reach and one of these is chosen. A normal range
error is added in both cases; where the range is fixed, the error is what the surface is away from it. The density that
they are drawn from sums over all surfaces of all scenes along a ray, each with its own range error; surfaces more than
`WINDOW_SPREADS` of these away add less than 1e-13 of their share and are not looked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import scene_columns
from lidardesign.density.objective.surfaces import log_peak
from lidardesign.density.objective.target import Target, build_target
from lidardesign.numerics import normalised_weights
from lidardesign.samples import Samples
from lidardesign.scenes.casting import Crossings, SceneCaster, shared_caster
from lidardesign.scenes.scene import Scene
from lidardesign.scenes.surface import sample_body, target_area_m2
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, direction

# Up to so many free dimensions, uniform candidates meet the surfaces often enough to be resampled.
RESAMPLED_DIMENSIONS = 3
CANDIDATES = 131_072
# Surfaces that fill less than a millionth of the space are given up.
CANDIDATE_ROUNDS = 8
FARTHEST_SIGMAS = 6.0
WINDOW_SPREADS = 8.0
# A proposal whose own surface ray casting does not find again within this many range errors (a ray through an edge
# or a vertex, by rounding) is dropped: its density would be far too small and its weight without bounds.
FOUND_SPREADS = 0.5
# Surfaces seen more flatly than this have an unbounded density per solid angle; area sampling hardly meets them.
MINIMUM_COSINE = 1e-3
MAXIMUM_COLUMNS = 128


def independent_points(target: Target, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 6) inside the space, at most `count`, and their log density per chart volume up to a constant.

    Empty where no ray of the space comes near a target.
    """
    space, sigma_m = target.space, target.optics.sigma_m
    if _are_resampled(space):
        return resampled_proposals(target, count, generator)
    if _are_drawn_by_surfaces(target):
        points = target.surfaces.propose(target.scenes, space, count, sigma_m, generator)
        return points, target.surfaces.log_proposal(target.scenes, space, points, sigma_m)
    proposals = propose(target.scenes, space, count, sigma_m, generator)
    return proposals.points, proposals.log_density


def independent_samples(target: Target, count: int, generator: np.random.Generator) -> Samples:
    """`independent_points` with log p* at them; none where no ray of the space comes near a surface."""
    points, log_density = independent_points(target, count, generator)
    return Samples(points, log_density, target.log_density(points), target.space)


def log_proposal(target: Target, points: np.ndarray) -> np.ndarray | None:
    """log of the density of `independent_points` at points of the space, (N, 6) to (N,), up to the same constant.

    None where these are found by tracing rays, which says their density at no other point.
    """
    if _are_resampled(target.space):
        log_proximity = target.log_proximity(points)
        return np.where(_is_near(target, log_proximity), log_proximity, -np.inf)
    if _are_drawn_by_surfaces(target):
        return target.surfaces.log_proposal(target.scenes, target.space, points, target.optics.sigma_m)
    return None


def _are_resampled(space: DesignSpace) -> bool:
    return RANGE not in space.free or (not space.turns and len(space.free) <= RESAMPLED_DIMENSIONS)


def _are_drawn_by_surfaces(target: Target) -> bool:
    return RANGE in target.space.free and target.space.turns and target.surfaces.can_propose


def _is_near(target: Target, log_proximity: np.ndarray) -> np.ndarray:
    """The points that come within `FARTHEST_SIGMAS` of a surface, as a mask (N,)."""
    return log_proximity > log_peak(target.surfaces) - FARTHEST_SIGMAS**2 / 2


def resampled_proposals(target: Target, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Uniform points resampled by surface proximity, (count, 6), and their log density up to a constant, (count,).

    Empty where no candidate comes within `FARTHEST_SIGMAS` of any surface.
    """
    for _ in range(CANDIDATE_ROUNDS):
        candidates = target.space.sample(CANDIDATES, generator)
        log_proximity = target.log_proximity(candidates)
        near = _is_near(target, log_proximity)
        if near.any():
            break
    candidates, log_proximity = candidates[near], log_proximity[near]
    if not len(candidates):
        return candidates, log_proximity
    chosen = generator.choice(len(candidates), size=count, p=normalised_weights(log_proximity))
    return candidates[chosen], log_proximity[chosen]


def samples_without_visibility(
    scenes: Sequence[Scene], space: DesignSpace, settings: DensitySettings, count: int, generator: np.random.Generator
) -> Samples:
    """Weighted samples of the density with T = 1 everywhere, at most `count`; log_prob is known up to a constant.

    No flow has to be trained to show what visibility is worth: the density is known at all these points.

    Arguments:
        scenes: The training scenes.
        space: The design space.
        settings: Sigma and what goes with it.
        count: The number of draws; those that leave the space are dropped.
        generator: Of all draws.
    """
    return independent_samples(build_target(scenes, space, settings, "off"), count, generator)


@dataclass(frozen=True, eq=False)
class ProposedPoints:
    """Design points with the density that they were proposed from.

    Arguments:
        points: Shape (N, 6), inside the space.
        log_density: Per chart volume, up to one constant, shape (N,).
        surface_range_m: The range of the surface that each observes, without the range error, shape (N,) [m].
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
) -> ProposedPoints:
    """Proposals from at most `count` draws; those that leave the space are dropped."""
    columns = scene_columns(scenes)
    if len(columns) > MAXIMUM_COLUMNS:
        columns = [columns[i] for i in sorted(generator.choice(len(columns), MAXIMUM_COLUMNS, replace=False))]
    draw = _from_aimed_rays if space.turns else _from_random_rays
    points, surface_range, column, density = draw(scenes, columns, space, count, spread_m, generator)
    if space.turns and space.measure == "angles":
        density *= np.cos(points[:, ELEVATION])
    usable = np.flatnonzero(space.contains(points) & (density > 0))
    return ProposedPoints(points[usable], np.log(density[usable]), surface_range[usable], column[usable], columns)


def occluded_share(scenes: Sequence[Scene], proposals: ProposedPoints, margin_m: float) -> float:
    """The share of proposals whose surface has an occluder more than the margin in front of it, on any of its ways."""
    origins, azimuth, elevation = proposals.points[:, :3], *proposals.points[:, [AZIMUTH, ELEVATION]].T
    points = origins + proposals.surface_range_m[:, None] * direction(azimuth, elevation)
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
    """Mask of the points (N, 3) with a hit more than the margin in front of them, from places (3,) or (N, 3)."""
    offset = points - places
    reach_m = np.linalg.norm(offset, axis=1)
    seen = np.flatnonzero(reach_m > 0)
    hidden = np.zeros(len(points), dtype=bool)
    hits = caster.first_hit(np.broadcast_to(places, points.shape)[seen], offset[seen])
    hidden[seen] = hits.range_m < reach_m[seen] - margin_m
    return hidden


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

    They lie on rays from uniform origins to area-uniform target points.

    A point of an area A at range s and incidence theta has the density s^2 / (A cos theta) per solid angle.
    """
    column, surface = np.sort(generator.integers(len(columns), size=count)), np.empty((count, 3))
    for number, (index, frame) in enumerate(columns):
        rows = np.flatnonzero(column == number)
        if len(rows):
            targets = [body for body in scenes[index].bodies if body.is_target]
            surface[rows] = generator.permutation(sample_body(targets, space, len(rows), generator, frame).points)
    rays = space.wrap(aim(space.sample(count, generator)[:, :3], surface))
    nearest = rays.copy()
    nearest[:, RANGE] = space.low[RANGE]
    admissible = space.contains(nearest)
    rays, column = rays[admissible], column[admissible]
    points, surface_range, accepted = _with_range_error(rays, space, spread_m, generator)
    directions = direction(points[:, AZIMUTH], points[:, ELEVATION])
    start = np.maximum(points[:, RANGE] - WINDOW_SPREADS * spread_m, 0.0)
    end = points[:, RANGE] + WINDOW_SPREADS * spread_m
    density, found = np.zeros(len(points)), np.zeros(len(points), dtype=bool)
    for number, (index, frame) in enumerate(columns):
        crossed = shared_caster(scenes[index], frame, only="targets").crossings(points[:, :3], directions, start, end)
        area_m2 = target_area_m2(scenes[index], space)
        share = crossed.range_m**2 / (area_m2 * np.maximum(crossed.cosine, MINIMUM_COSINE))
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
        _add_shares(density, found, 1.0 / np.bincount(found.row, minlength=count)[found.row], points, spread_m)
    kept = np.isfinite(chosen) & accepted
    return points[kept], surface_range[kept], column[kept], density[kept]


def _with_range_error(
    rays: np.ndarray, space: DesignSpace, spread_m: float, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 6), the ranges of their surfaces (N,), and which points are to be kept (N,) bool.

    With a fixed range the error is given: a ray is kept with the normal probability of this error.
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
