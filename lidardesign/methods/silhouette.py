"""The methods `silhouette` and `lloyd`: rays and gates from returns of dense rays in training scenes.

`silhouette` lays a hexagonal lattice over all directions in which at least 1 % of the training scenes and frames return
on a target; its spacing is such that exactly as many rays as asked for fall inside (of a few more those that return
most often). The gate of a ray holds everything that dense rays nearer to it than to any other return, with a margin of
`SILHOUETTE_SIGMAS` times the median standard deviation of ranges along one ray, over scenes.

`lloyd` moves rays to the weighted middles of their Voronoi cells until they rest (S. Lloyd 1982), for the density
P(return)^0.75 area^1.5 with the area of surface that a solid angle covers there. A gate holds 1 to 99 % of the returns
in the ray's cell, with half the margin.

Rays start in the middle of the free origins. Where the density has conditions, both are laid out anew at each of their
values, and as `bounding` over all of them where nothing returns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.methods.bounding import box_crop
from lidardesign.methods.fields import SIXTH, SphereField, even_placement, widened_angles
from lidardesign.methods.laid_out import LaidOut, Layout, Site
from lidardesign.methods.returns import RAY_AXES, ReturnTable, TrainingReturns, dense_rays, returns_of
from lidardesign.numerics import TINY, unit_vectors
from lidardesign.sensors.pattern import low_discrepancy
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, angles, direction

LEAST_SHARE = 0.01
# the central 99 % of returns end inside of where few scenes return
WIDER = 0.15
SILHOUETTE_SIGMAS, LLOYD_SIGMAS = 1.2, 0.6  # 20 and 10 mm on faces
HALVINGS = 24
CLOSER = 0.8  # until a lattice has rays enough
LLOYD_TAIL = 0.01
LLOYD_STEPS = 40
FEWEST_POINTS, POINTS_PER_RAY = 8192, 20
PROBABILITY_POWER, AREA_POWER = 0.75, 1.5


class Survey(NamedTuple):
    """Returns of dense rays from one place, even over a box and directions."""

    low: np.ndarray
    high: np.ndarray
    directions: SphereField | None
    table: ReturnTable

    @property
    def supported(self) -> np.ndarray:
        """Indices of the dense rays that return in at least `LEAST_SHARE` of the views, shape (K,)."""
        return np.flatnonzero(self.table.share >= LEAST_SHARE)


def survey(views: TrainingReturns, space: DesignSpace) -> Survey | None:
    """Returns of dense rays from the middle of a space's origins, over a widened crop of the returns; None without."""
    middle = (np.array(space.low) + np.array(space.high)) / 2
    low, high = np.array(space.low), np.array(space.high)
    low[:AZIMUTH] = high[:AZIMUTH] = middle[:AZIMUTH]
    space = replace(space, low=tuple(low.tolist()), high=tuple(high.tolist()))
    observed = views.observed(space)
    if not len(observed):
        return None
    crop = box_crop(views, space, observed)
    directions = None if crop.directions is None else crop.directions.widened(WIDER, space)
    low, high = crop.low, crop.high
    if directions is None:
        low[AZIMUTH:], high[AZIMUTH:] = widened_angles(low[AZIMUTH:], high[AZIMUTH:], WIDER, space)
    table = views.returns(even_placement(low, high, 2 * dense_rays(int((high > low).sum())), directions))
    return Survey(low, high, directions, table) if (table.share >= LEAST_SHARE).any() else None


PlaceRays = Callable[[Survey, int], np.ndarray]


def _layouts(name: str, views: TrainingReturns, place: PlaceRays, tail: float, sigmas: float) -> list[Layout]:
    survey_at = cache(partial(survey, views))
    everywhere = survey_at(views.space)
    if everywhere is None:
        return []

    def lay_out(count: int, site: Site) -> tuple[np.ndarray, np.ndarray]:
        found = survey_at(site.space) or everywhere
        points = place(found, count)
        gates = found.table.gates(points, tail, sigmas * found.table.sigma_m)
        for axis in (axis for axis in views.space.conditioned if axis < RAY_AXES):
            points[:, axis] = np.clip(points[:, axis], site.space.low[axis], site.space.high[axis])
        return points, gates

    return [Layout(name, lay_out)]


def lattice_rays(found: Survey, count: int) -> np.ndarray:
    """Rays of a lattice over directions with enough returns, shape (count, 5)."""
    table, field = found.table, found.directions
    supported = found.supported
    if not count or field is None or field.area_sr < TINY:
        return _even_rays(found, count)

    def inside(spacing_rad: float) -> tuple[np.ndarray, np.ndarray]:
        looking = field.lattice(spacing_rad)
        points = np.tile(found.low, (len(looking), 1))
        points[:, AZIMUTH:] = looking
        share = table.share[table.nearest(points)] if len(points) else np.zeros(0)
        return points[share >= LEAST_SHARE], share[share >= LEAST_SHARE]

    wide = math.sqrt(field.area_sr * len(supported) / len(table.points) / count / SIXTH)
    narrow = wide
    while len(inside(narrow)[0]) < count:
        narrow *= CLOSER
    for _ in range(HALVINGS):
        middle = math.sqrt(narrow * wide)
        narrow, wide = (middle, wide) if len(inside(middle)[0]) >= count else (narrow, middle)
    points, share = inside(narrow)
    return points[np.sort(np.argsort(-share, kind="stable")[:count])]


def _even_rays(found: Survey, count: int) -> np.ndarray:
    """Rays even over the dense rays that return, where at most one angle is free, shape (count, 5)."""
    dense = found.table.points[found.supported]
    axis = AZIMUTH + int(np.argmax((found.high - found.low)[AZIMUTH:]))
    dense = dense[np.argsort(dense[:, axis], kind="stable")]
    place = (np.arange(count) + 0.5) / max(count, 1) * len(dense)
    points = dense[place.astype(np.int64)]
    points[:, axis] += (np.mod(place, 1.0) - 0.5) * (found.high - found.low)[axis] / len(found.table.points)
    return points


def _lloyd_rays(found: Survey, count: int) -> np.ndarray:
    """Rays in the weighted middles of their cells, shape (count, 5)."""
    points, chance = _fine_points(found, max(FEWEST_POINTS, POINTS_PER_RAY * count))
    nearest = found.table.nearest(points)
    density = found.table.share[nearest] ** PROBABILITY_POWER * found.table.area_m2_sr[nearest] ** AREA_POWER
    points, chance, density = points[density > 0], chance[density > 0], density[density > 0] / density.max()
    # resting points are as dense as the square root of the density in a plane
    first = np.argsort(chance / np.sqrt(density), kind="stable")[:count]
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    middles = looking[first]
    for _ in range(LLOYD_STEPS if count else 0):
        cell = cKDTree(middles).query(looking)[1]
        sums = np.column_stack([np.bincount(cell, density * part, count) for part in looking.T])
        weight = np.bincount(cell, density, count)
        middles = np.where(weight[:, None] > 0, unit_vectors(np.where(weight[:, None] > 0, sums, 1.0)), middles)
    rays = points[first]
    rays[:, AZIMUTH], rays[:, ELEVATION] = angles(middles)
    rays = found.table.space.wrap(np.column_stack([rays, np.full(count, found.table.space.low[RANGE])]))
    astray = ~found.table.space.contains(rays)
    rays = rays[:, :RAY_AXES]
    if astray.any():
        rays[astray] = points[cKDTree(looking).query(middles[astray])[1]]
    return rays


def _fine_points(found: Survey, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Even rays of a survey's box and directions, (count, 5), with an even coordinate in (0, 1), (count,)."""
    if found.directions is not None:
        points = np.tile(found.low, (count, 1))
        spread = found.directions.spread(count, 1)
        points[:, AZIMUTH:] = spread[:, 1:]
        return points, spread[:, 0]
    free = np.flatnonzero(found.high > found.low)
    unit = low_discrepancy(count, len(free) + 1)
    points = np.tile(found.low, (count, 1))
    points[:, free] += unit[:, 1:] * (found.high - found.low)[free]
    return points, unit[:, 0]


def silhouette_layouts(views: TrainingReturns) -> list[Layout]:
    """The layout; none where dense rays return nothing."""
    return _layouts("silhouette", views, lattice_rays, 0.0, SILHOUETTE_SIGMAS)


def lloyd_layouts(views: TrainingReturns) -> list[Layout]:
    """The layout; none where dense rays return nothing."""
    return _layouts("lloyd", views, _lloyd_rays, LLOYD_TAIL, LLOYD_SIGMAS)


SILHOUETTE = LaidOut(
    "silhouette",
    "a lattice over all directions in which training scenes return",
    lambda problem: silhouette_layouts(returns_of(problem.world)),
)
LLOYD = LaidOut(
    "lloyd",
    "like silhouette, denser where returns are frequent and surfaces large",
    lambda problem: lloyd_layouts(returns_of(problem.world)),
)
