"""The baseline `bounding`: what an engineer would build in five minutes from where the training returns are.

One even layout, cropped per axis to the central 99 % of the training returns in angle and range. With free
origins the better of two, on training scenes: parallel rays (vertical where the space allows it) from an even grid
over the returns' box, and an even or low-discrepancy set in the central 99 % box of origins and angles. Where the
density has conditions, one box is cropped over all of their values, and stands at each value as it is.
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.evaluate.candidates import Layout, Spot, central
from lidardesign.evaluate.observed import DENSE_RAYS, Observed, TrainingViews, dense_points
from lidardesign.evaluate.placement import RAY_AXES, even_placement, opened_gate
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace, direction

# an origin axis within 45 degrees of parallel rays only moves them along themselves
ALIGNED = math.cos(math.pi / 4)


def bounding(views: TrainingViews) -> list[Layout]:
    """The layouts to choose from; none where dense rays return nothing."""
    space = views.space
    observed = views.hits(dense_points(space))
    if not len(observed.points):
        return []
    low, high = central(observed.points)
    cropped = _boxed("cropped", space, low, high, opened_gate(low[RANGE], high[RANGE]))
    if not [axis for axis in space.free if axis < AZIMUTH and axis not in space.conditioned]:
        return [cropped]
    parallel = _parallel(views, observed)
    return [cropped] if parallel is None else [parallel, cropped]


def _boxed(name: str, space: DesignSpace, low: np.ndarray, high: np.ndarray, gate_m: np.ndarray) -> Layout:
    """Even rays in a box whose conditions take the values of the spot."""
    conditions = [DIMENSIONS.index(one) for one in space.condition]
    conditions = [axis for axis in conditions if axis < RAY_AXES]

    def place(count: int, spot: Spot) -> np.ndarray:
        lowest, highest = np.array(low[:RAY_AXES]), np.array(high[:RAY_AXES])
        lowest[conditions] = np.array(spot.space.low)[conditions]
        highest[conditions] = np.array(spot.space.high)[conditions]
        return even_placement(lowest, highest, count)

    return Layout(name, place, gate_m)


def _parallel(views: TrainingViews, observed: Observed) -> Layout | None:
    """Parallel rays from an even grid over the returns' box, within the admissible origins.

    An origin axis that runs along the rays stays at the bound behind the scene. None where such rays
    return nothing.
    """
    space = views.space
    azimuth, elevation = parallel_angles(space, observed)
    looking = direction(azimuth, elevation)
    low, high = central(observed.hits_m)
    low, high = (np.clip(end, space.low[:3], space.high[:3]) for end in (low, high))
    for axis in np.flatnonzero(np.abs(looking) > ALIGNED):
        low[axis] = high[axis] = space.low[axis] if looking[axis] > 0 else space.high[axis]
    low, high = np.append(low, [azimuth, elevation]), np.append(high, [azimuth, elevation])
    seen = views.hits(even_placement(low, high, DENSE_RAYS))
    if not len(seen.points):
        return None
    nearest, furthest = central(seen.points[:, RANGE])
    return _boxed("parallel", space, low, high, opened_gate(float(nearest), float(furthest)))


def parallel_angles(space: DesignSpace, observed: Observed) -> tuple[float, float]:
    """Straight down where the space allows it, else straight up, else the median direction of the returns."""
    middle = np.median(observed.points[:, AZIMUTH])
    pole = math.pi / 2
    for elevation in (-pole, pole):
        if space.low[ELEVATION] <= elevation <= space.high[ELEVATION]:
            return float(middle), elevation
    return float(middle), float(np.median(observed.points[:, ELEVATION]))
