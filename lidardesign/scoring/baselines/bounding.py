"""The baseline `bounding`: what an engineer would build in five minutes from where the training returns are.

One even layout, cropped to the central 99 % of the training returns in direction and range. Where both angles are
free, the crop is the smallest rectangle about their mean direction (see `lidardesign.scoring.baselines.even`), else an
interval of the angle. With free origins it is the better of two, on training scenes: parallel rays (vertical where the
space allows it) from an even grid over the returns' box, and a low-discrepancy set in the central 99 % of origins and
directions. Where the density has conditions, it is cropped anew at each of their values; at one where nothing
returns, the crop over all of them stands.

All rays of a value have one gate. Where any design beside it has gates per ray, each layout stands to choice a second
time, with the central 99 % of what dense rays return that are nearer to each ray than to any other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from lidardesign.scoring.baselines.candidates import GatedLayout, LayoutSite, opened_gate
from lidardesign.scoring.baselines.even import SphereField, central, central_field, even_placement
from lidardesign.scoring.baselines.views import (
    RAY_AXES,
    Observed,
    ReturnTable,
    TrainingViews,
    dense_rays,
)
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction

# an origin axis within 45 degrees of parallel rays only moves them along themselves
ALIGNED = math.cos(math.pi / 4)
TAIL = 0.005  # of the returns are left out at either end of a gate


@dataclass(frozen=True, eq=False)
class Crop:
    """Where the training returns are at a condition value.

    Arguments:
        low, high: A box of rays (x, y, z, azimuth, elevation), shape (5,).
        directions: The directions, where they are not those of the box.
        gate_m: The gate of all rays, shape (2,).
        table: What dense rays in the crop return, for gates per ray.
    """

    low: np.ndarray
    high: np.ndarray
    directions: SphereField | None
    gate_m: np.ndarray
    table: Callable[[], ReturnTable]


def bounding(views: TrainingViews, *, gates_per_ray: bool = False) -> list[GatedLayout]:
    """The layouts to choose from; none where dense rays return nothing.

    Arguments:
        views: The training scenes.
        gates_per_ray: Whether there is a layout of each kind whose rays have gates of their own, too.
    """
    kinds = crop_kinds(views.space)
    return [layout for name, crop_of in kinds.items() for layout in _cropped(name, views, crop_of, gates_per_ray)]


CropOf = Callable[[TrainingViews, DesignSpace, Observed], Crop | None]


def crop_kinds(space: DesignSpace) -> dict[str, CropOf]:
    """How a design space can be cropped to what returns; with free origins there are two ways."""
    origins = [axis for axis in space.free if axis < AZIMUTH and axis not in space.conditioned]
    return {"parallel": _parallel_crop, "cropped": box_crop} if origins else {"cropped": box_crop}


def _cropped(name: str, views: TrainingViews, crop_of: CropOf, gates_per_ray: bool) -> list[GatedLayout]:
    """The layouts of a kind of crop; none where there is nothing to crop to."""

    @cache
    def crop_at(space: DesignSpace) -> Crop | None:
        observed = views.observed(space)
        return crop_of(views, space, observed) if len(observed.points) else None

    everywhere = crop_at(views.space)
    if everywhere is None:
        return []

    def lay_out(count: int, site: LayoutSite, per_ray: bool = False) -> tuple[np.ndarray, np.ndarray]:
        crop = crop_at(site.space) or everywhere
        conditions = [axis for axis in views.space.conditioned if axis < RAY_AXES]
        low, high = crop.low.copy(), crop.high.copy()
        low[conditions], high[conditions] = (np.array(end)[conditions] for end in (site.space.low, site.space.high))
        points = even_placement(low, high, count, crop.directions)
        return points, crop.table().gates(points, TAIL, 0.0) if per_ray else np.tile(crop.gate_m, (count, 1))

    gated = [GatedLayout(f"{name}, a gate per ray", partial(lay_out, per_ray=True))] if gates_per_ray else []
    return [GatedLayout(name, lay_out), *gated]


def box_crop(views: TrainingViews, space: DesignSpace, observed: Observed) -> Crop:
    """The central 99 % of returns in origin, direction and range."""
    low, high = central(observed.points)
    directions = None
    if {AZIMUTH, ELEVATION} <= set(space.free) - set(space.conditioned):
        directions = central_field(space, observed.points[:, AZIMUTH], observed.points[:, ELEVATION])
    gate_m = opened_gate(low[RANGE], high[RANGE])
    low, high = low[:RAY_AXES], high[:RAY_AXES]
    return Crop(low, high, directions, gate_m, _dense_table(views, low, high, directions))


def _parallel_crop(views: TrainingViews, space: DesignSpace, observed: Observed) -> Crop | None:
    """Parallel rays from an even grid over the returns' box, within the admissible origins.

    An origin axis that runs along the rays stays at the bound behind the scene. None where such rays return nothing.
    """
    azimuth, elevation = parallel_angles(space, observed)
    looking = direction(azimuth, elevation)
    low, high = (np.clip(end, space.low[:3], space.high[:3]) for end in central(observed.hits_m))
    for axis in np.flatnonzero(np.abs(looking) > ALIGNED):
        low[axis] = high[axis] = space.low[axis] if looking[axis] > 0 else space.high[axis]
    low, high = np.append(low, [azimuth, elevation]), np.append(high, [azimuth, elevation])
    table = _dense_table(views, low, high, None)
    ranges = table().range_m[table().returned]
    if not len(ranges):
        return None
    return Crop(low, high, None, opened_gate(*central(ranges)), table)


def _dense_table(
    views: TrainingViews, low: np.ndarray, high: np.ndarray, directions: SphereField | None
) -> Callable[[], ReturnTable]:
    """What dense rays in a crop return, traced when that is first asked for."""
    count = dense_rays(int((high > low).sum()))
    return cache(lambda: views.returns(even_placement(low, high, count, directions)))


def parallel_angles(space: DesignSpace, observed: Observed) -> tuple[float, float]:
    """Straight down where the space allows it, else straight up, else the median direction of the returns."""
    middle = np.median(observed.points[:, AZIMUTH])
    vertical = [end for end in (-math.pi / 2, math.pi / 2) if space.low[ELEVATION] <= end <= space.high[ELEVATION]]
    return float(middle), vertical[0] if vertical else float(np.median(observed.points[:, ELEVATION]))
