"""Independent proposals: design points that listen at random surfaces, drawn without the flow.

They find modes that the flow dropped (`coverage`), and show whether anything can be in the way of a ray at all
(visibility `auto`). Where both angles are free they aim at points that are uniform in area from random admissible
origins; where an angle is fixed hardly any surface point can be aimed at, so random admissible rays are traced
through all surfaces and one of these is chosen. A normal range error is added in both cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.density.fields import scene_columns
from lidardesign.scene import Scene
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, direction
from lidardesign.surface import sample_body, surface_area_m2

# Rays pass a surface by this share of the space's range before the next hit is looked for.
STEP_SHARE = 1e-6
MAXIMUM_LAYERS = 16
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
    rays, column = (
        _aimed_rays(scenes, columns, space, count, generator)
        if angles_free
        else (space.sample(count, generator), generator.integers(len(columns), size=count))
    )
    layers = [_layers(scenes[index], frame, rays, space) for index, frame in columns]
    if not angles_free:
        rays, column, layers = _with_surface(rays, column, layers, generator)
    surface_range = rays[:, RANGE].copy()
    points = rays.copy()
    points[:, RANGE] += generator.normal(scale=spread_m, size=len(points))
    density = np.zeros(len(points))
    for (index, _), found in zip(columns, layers, strict=True):
        z = (points[found.row, RANGE] - found.range_m) / spread_m
        area = _target_area(scenes[index], space)
        share = found.range_m**2 / (area * found.cosine) if angles_free else 1.0 / found.per_row(len(points))
        np.add.at(density, found.row, share * np.exp(-(z**2) / 2))
    log_density = np.log(np.maximum(density, np.finfo(float).tiny))
    if angles_free and space.measure == "angles":
        log_density += np.log(np.maximum(np.cos(points[:, ELEVATION]), np.finfo(float).tiny))
    inside = space.contains(points)
    return Proposals(points[inside], log_density[inside], surface_range[inside], column[inside], columns)


def occluded_share(scenes: Sequence[Scene], proposals: Proposals, margin_m: float) -> float:
    """The share of proposals whose surface has an occluder more than the margin in front of it."""
    directions = direction(proposals.points[:, AZIMUTH], proposals.points[:, ELEVATION])
    blocked = 0
    for number, (index, frame) in enumerate(proposals.columns):
        rows = proposals.column == number
        if rows.any():
            caster = SceneCaster(scenes[index], frame, only="occluders")
            hits = caster.first_hit(proposals.points[rows, :3], directions[rows])
            blocked += int((hits.range_m < proposals.surface_range_m[rows] - margin_m).sum())
    return blocked / max(len(directions), 1)


def _chosen_columns(scenes: Sequence[Scene], generator: np.random.Generator) -> list[tuple[int, int]]:
    columns = scene_columns(scenes)
    if len(columns) <= MAXIMUM_COLUMNS:
        return columns
    return [columns[i] for i in sorted(generator.choice(len(columns), MAXIMUM_COLUMNS, replace=False))]


def _target_area(scene: Scene, space: DesignSpace) -> float:
    return sum(surface_area_m2(body, space) for body in scene.bodies if body.is_target)


def _aimed_rays(
    scenes: Sequence[Scene],
    columns: list[tuple[int, int]],
    space: DesignSpace,
    count: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from uniform origins to area-uniform target points, with the points' ranges."""
    column = np.sort(generator.integers(len(columns), size=count))
    surface = np.empty((count, 3))
    for number, (index, frame) in enumerate(columns):
        rows = np.flatnonzero(column == number)
        if len(rows):
            targets = [body for body in scenes[index].bodies if body.is_target]
            drawn = sample_body(targets, space, len(rows), generator, frame).points
            surface[rows] = generator.permutation(drawn)
    rays = space.wrap(aim(space.sample(count, generator)[:, :3], surface))
    admissible = space.contains(np.concatenate([rays[:, :RANGE], np.full((count, 1), space.low[RANGE])], axis=1))
    return rays[admissible], column[admissible]


@dataclass(frozen=True, eq=False)
class _Layers:
    """All surfaces that rays meet in one column, as flat lists."""

    row: np.ndarray
    range_m: np.ndarray
    cosine: np.ndarray

    def per_row(self, count: int) -> np.ndarray:
        """How many surfaces the ray of each entry meets."""
        return np.bincount(self.row, minlength=count)[self.row]

    def of(self, kept: np.ndarray, new_row: np.ndarray) -> _Layers:
        """The entries of kept rays, renumbered."""
        keep = kept[self.row]
        return _Layers(new_row[self.row[keep]], self.range_m[keep], self.cosine[keep])


def _layers(scene: Scene, frame: int, rays: np.ndarray, space: DesignSpace) -> _Layers:
    caster = SceneCaster(scene, frame, only="targets")
    directions = direction(rays[:, AZIMUTH], rays[:, ELEVATION])
    alive, start = np.arange(len(rays)), np.zeros(len(rays))
    rows, ranges, cosines = [], [], []
    for _ in range(MAXIMUM_LAYERS):
        if not len(alive):
            break
        hits = caster.first_hit(rays[alive, :3] + start[alive, None] * directions[alive], directions[alive])
        hit = np.isfinite(hits.range_m)
        alive, normal = alive[hit], hits.normal[hit]
        reached = start[alive] + hits.range_m[hit]
        cosine = np.abs(np.einsum("nk,nk->n", normal, directions[alive]))
        rows.append(alive)
        ranges.append(reached)
        cosines.append(np.maximum(cosine, MINIMUM_COSINE))
        start[alive] = reached + STEP_SHARE * max(space.high[RANGE], 1.0)
    return _Layers(
        np.concatenate([np.empty(0, int), *rows]), np.concatenate([[], *ranges]), np.concatenate([[], *cosines])
    )


def _with_surface(
    rays: np.ndarray, column: np.ndarray, layers: list[_Layers], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, list[_Layers]]:
    """The rays that meet a surface in their column, each at a random one of these."""
    chosen = np.full(len(rays), np.nan)
    for number, found in enumerate(layers):
        order = generator.permutation(len(found.row))
        own = order[column[found.row[order]] == number]
        # of several writes to one row the last one stays, and their order is random
        chosen[found.row[own]] = found.range_m[own]
    kept = np.isfinite(chosen)
    new_row = np.cumsum(kept) - 1
    rays = rays[kept]
    rays[:, RANGE] = chosen[kept]
    return rays, column[kept], [found.of(kept, new_row) for found in layers]
