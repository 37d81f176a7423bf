"""Lengths that look as if they were in another unit than metres."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lidardesign.space import RANGE, DesignSpace

# An object that large is more likely in another unit, and so is a way of that length, in extents of what goes it.
DOUBTFUL_EXTENT_M, DOUBTFUL_WAY = 20.0, 50.0
# Robots are recorded many times per second; of few moments, which people write, one may say nothing.
DOUBTFUL_STEP_S, FEW_MOMENTS = 1.0, 10


def doubtful_meshes(extents_m: Mapping[str, float], scale: float) -> list[str]:
    """One line on meshes that are larger than a building while no unit was given.

    Arguments:
        extents_m: How long each mesh is, by its file's name [m].
        scale: The factor to metres that was set.
    """
    large = {name: extent for name, extent in extents_m.items() if extent >= DOUBTFUL_EXTENT_M}
    if scale != 1.0 or not large:
        return []
    name = max(large, key=lambda name: large[name])
    if len(extents_m) == 1:
        return [f"{name}: is {large[name]:.4g} m long; if the file is in millimetres, set scale=0.001"]
    return [
        f"{len(large)} of {len(extents_m)} meshes are {DOUBTFUL_EXTENT_M:g} m long or longer, the longest is {name} "
        f"with {large[name]:.4g} m; if the files are in millimetres, set scale=0.001"
    ]


def doubtful_motion(bounds_m: Mapping[str, np.ndarray], extent_m: float, space: DesignSpace) -> list[str]:
    """One line on ways that are much longer than what goes them, or that no sensor reaches.

    Arguments:
        bounds_m: The corners of a box around the whole way of each body, shape (2, 3) [m].
        extent_m: How long the largest of them is [m].
        space: Where sensors may be, and how far they reach.
    """
    far_m = {name: _gap_m(bounds, space) for name, bounds in bounds_m.items()}
    name = max(far_m, key=lambda name: far_m[name], default=None)
    if name is not None and far_m[name] > space.high[RANGE]:
        return [
            f"motion: {name} comes no nearer than {far_m[name]:.4g} m to where sensors may be, which reach "
            f"{space.high[RANGE]:.4g} m; its lengths are metres: is the CSV in millimetres?"
        ]
    way_m = {name: float(np.ptp(bounds, axis=0).max()) for name, bounds in bounds_m.items()}
    name = max(way_m, key=lambda name: way_m[name], default=None)
    if name is None or way_m[name] < max(DOUBTFUL_EXTENT_M, DOUBTFUL_WAY * extent_m):
        return []
    return [
        f"motion: the way of {name} is {way_m[name]:.4g} m long, of objects that are {extent_m:.3g} m long, so sensors "
        "lie far from them; its lengths are metres: is the CSV in millimetres?"
    ]


def doubtful_times(time_s: Mapping[str, np.ndarray]) -> list[str]:
    """One line on recordings whose moments lie so far apart that their times may be in another unit.

    Arguments:
        time_s: The moments of each recording, by its name, ascending [s].
    """
    steps_s = {name: float(np.median(np.diff(times))) for name, times in time_s.items() if len(times) > FEW_MOMENTS}
    name = max(steps_s, key=lambda name: steps_s[name], default=None)
    if name is None or steps_s[name] < DOUBTFUL_STEP_S:
        return []
    return [
        f"{name}: its moments are {steps_s[name]:.4g} s apart; times are seconds: are they milliseconds or less? "
        "Motion is even in between"
    ]


def _gap_m(bounds_m: np.ndarray, space: DesignSpace) -> float:
    """The distance between a box and the box of origins [m]; 0 where they meet."""
    apart = np.maximum(bounds_m[0] - np.array(space.high[:3]), np.array(space.low[:3]) - bounds_m[1])
    return float(np.linalg.norm(np.maximum(apart, 0.0)))
