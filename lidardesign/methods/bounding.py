"""The method `bounding`: what an engineer would build in five minutes from the training returns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from lidardesign.methods.fields import SphereField, central_field, central_interval, even_placement
from lidardesign.methods.laid_out import LaidOut, Layout, Site
from lidardesign.methods.returns import RAY_AXES, ReturnTable, TrainingReturns, dense_rays, opened_gate, returns_of
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction, observed_point

# An origin axis within 45 degrees of parallel rays only moves them along themselves.
ALIGNED = math.cos(math.pi / 4)
TAIL = 0.005  # of the returns are left out at either end of a gate


def bounding_layouts(views: TrainingReturns, *, gates_per_ray: bool = False) -> list[Layout]:
    """The layouts: what an engineer would build in five minutes from the training returns.

    One even layout, cropped to the central 99 % of the returns in direction and range. Where both angles are free, the
    crop is the smallest rectangle about their mean direction, else an interval of the angle. With free origins it is
    the better of two, on training scenes: parallel rays (vertical where the space allows it) from an even grid over the
    returns' box, and a low-discrepancy set in the central 99 % of origins and directions. Where the density has
    conditions, it is cropped anew at each of their values; at one where nothing returns, the crop over all of them
    stands. No layout where dense rays return nothing.

    All rays of a value have one gate. Where any design beside it has gates per ray, each layout stands to choice a
    second time, with the central 99 % of what dense rays return that are nearer to each ray than to any other.

    Arguments:
        views: The training scenes.
        gates_per_ray: Whether there is a layout of each kind whose rays have gates of their own, too.
    """
    kinds = crop_kinds(views.space)
    return [layout for name, crop_of in kinds.items() for layout in _cropped(name, views, crop_of, gates_per_ray)]


@dataclass(frozen=True, eq=False)
class Crop:
    """The part of a design space from which training scenes return at a condition value.

    Arguments:
        low, high: A box of rays (x, y, z, azimuth, elevation), shape (5,).
        directions: The directions, where they are not those of the box.
        gate_m: The gate of all rays, shape (2,).
        table: Gives returns of dense rays in the crop, for gates per ray.
    """

    low: np.ndarray
    high: np.ndarray
    directions: SphereField | None
    gate_m: np.ndarray
    table: Callable[[], ReturnTable]


CropOf = Callable[[TrainingReturns, DesignSpace, np.ndarray], Crop | None]


def crop_kinds(space: DesignSpace) -> dict[str, CropOf]:
    """Ways to crop a design space to the returns, by name: two with free origins, else one."""
    origins = [axis for axis in space.free if axis < AZIMUTH and axis not in space.conditioned]
    return {"parallel": _parallel_crop, "cropped": box_crop} if origins else {"cropped": box_crop}


def _cropped(name: str, views: TrainingReturns, crop_of: CropOf, gates_per_ray: bool) -> list[Layout]:
    """The layouts of a kind of crop; empty without returns."""

    @cache
    def crop_at(space: DesignSpace) -> Crop | None:
        observed = views.observed(space)
        return crop_of(views, space, observed) if len(observed) else None

    everywhere = crop_at(views.space)
    if everywhere is None:
        return []

    def lay_out(count: int, site: Site, per_ray: bool = False) -> tuple[np.ndarray, np.ndarray]:
        crop = crop_at(site.space) or everywhere
        conditions = [axis for axis in views.space.conditioned if axis < RAY_AXES]
        low, high = crop.low.copy(), crop.high.copy()
        low[conditions], high[conditions] = (np.array(end)[conditions] for end in (site.space.low, site.space.high))
        points = even_placement(low, high, count, crop.directions)
        return points, crop.table().gates(points, TAIL, 0.0) if per_ray else np.tile(crop.gate_m, (count, 1))

    gated = [Layout(f"{name}, a gate per ray", partial(lay_out, per_ray=True))] if gates_per_ray else []
    return [Layout(name, lay_out), *gated]


def box_crop(views: TrainingReturns, space: DesignSpace, observed: np.ndarray) -> Crop:
    """The central 99 % of returns in origin, direction and range."""
    low, high = central_interval(observed)
    directions = None
    if {AZIMUTH, ELEVATION} <= set(space.free) - set(space.conditioned):
        directions = central_field(space, observed[:, AZIMUTH], observed[:, ELEVATION])
    gate_m = opened_gate(low[RANGE], high[RANGE])
    low, high = low[:RAY_AXES], high[:RAY_AXES]
    return Crop(low, high, directions, gate_m, _dense_table(views, low, high, directions))


def _parallel_crop(views: TrainingReturns, space: DesignSpace, observed: np.ndarray) -> Crop | None:
    """Parallel rays from an even grid over the returns' box, within the admissible origins.

    An origin axis that runs along the rays stays at the bound behind the scene. None where such rays return nothing.
    """
    azimuth, elevation = parallel_angles(space, observed)
    looking = direction(azimuth, elevation)
    low, high = (np.clip(end, space.low[:3], space.high[:3]) for end in central_interval(observed_point(observed)))
    for axis in np.flatnonzero(np.abs(looking) > ALIGNED):
        low[axis] = high[axis] = space.low[axis] if looking[axis] > 0 else space.high[axis]
    low, high = np.append(low, [azimuth, elevation]), np.append(high, [azimuth, elevation])
    table = _dense_table(views, low, high, None)
    ranges = table().range_m[table().returned]
    if not len(ranges):
        return None
    return Crop(low, high, None, opened_gate(*central_interval(ranges)), table)


def parallel_angles(space: DesignSpace, observed: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation of parallel rays: straight down if admitted, else up, else the returns' median [rad]."""
    middle = np.median(observed[:, AZIMUTH])
    vertical = [end for end in (-math.pi / 2, math.pi / 2) if space.low[ELEVATION] <= end <= space.high[ELEVATION]]
    return float(middle), vertical[0] if vertical else float(np.median(observed[:, ELEVATION]))


def _dense_table(
    views: TrainingReturns, low: np.ndarray, high: np.ndarray, directions: SphereField | None
) -> Callable[[], ReturnTable]:
    """Returns of dense rays in a crop, traced when they are first asked for."""
    count = dense_rays(int((high > low).sum()))
    return cache(lambda: views.returns(even_placement(low, high, count, directions)))


BOUNDING = LaidOut(
    "bounding",
    "one even layout over where training scenes return",
    lambda problem: bounding_layouts(returns_of(problem.world), gates_per_ray=problem.gates == "ray"),
)
