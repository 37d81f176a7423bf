"""Notes on lengths and times that are probably in another unit than metres and seconds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lidardesign import RANGE, DesignSpace

# Larger objects are probably in another unit, and so are longer paths, in extents of the moving object.
DOUBTFUL_EXTENT_M, DOUBTFUL_WAY = 20.0, 50.0
# Meshes of one folder are rarely so many times smaller or larger than most of them.
DOUBTFUL_TIMES, MOST_NAMED = 50.0, 3
# Robots are recorded many times per second; short recordings, which may be handwritten, are not judged.
DOUBTFUL_STEP_S, DOUBTFUL_PAUSE_S, FEW_MOMENTS = 1.0, 3600.0, 10


def doubtful_meshes(
    extents_m: Mapping[str, float], scale: float | Mapping[str, float], around_m: Mapping[str, float] | None = None
) -> list[str]:
    """A note on meshes of quite another size than most, or else on very large ones while no scale is set.

    Arguments:
        extents_m: Largest extent of each mesh, by its file's name [m].
        scale: Configured factor to metres, or factors by name or pattern.
        around_m: The same of occluders, which may have any size.
    """
    usual_m = sorted(extents_m.values())[(len(extents_m) - 1) // 2]
    times = {name: extent / usual_m for name, extent in extents_m.items()}
    odd = [name for name in extents_m if not 1 / DOUBTFUL_TIMES < times[name] < DOUBTFUL_TIMES]
    if odd:
        named = ", ".join(f"{name} {extents_m[name]:.3g} m" for name in odd[:MOST_NAMED])
        more = f" and {len(odd) - MOST_NAMED} more" if odd[MOST_NAMED:] else ""
        known = {"*": scale} if isinstance(scale, float) else scale
        factors = ", ".join([f'"{odd[0]}": FACTOR', *(f'"{pattern}": {factor:g}' for pattern, factor in known.items())])
        return [
            f"the usual mesh is {usual_m:.3g} m long, {named}{more}: in other units? Set factors to metres by name or "
            f"pattern: --set 'scale={{{factors}}}'"
        ]
    extents_m = {**extents_m, **(around_m or {})}
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
    """A note on paths that are much longer than the moving objects, or out of reach of all sensors.

    Arguments:
        bounds_m: Bounding box of the whole path of each body, shape (2, 3) [m].
        extent_m: Extent of the largest object [m].
        space: Design space with the origins and ranges of sensors.
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
        f"motion: the path of {name} is {way_m[name]:.4g} m long, for objects {extent_m:.3g} m long, so sensors "
        "are far from them; lengths are in metres: is the CSV in millimetres?"
    ]


def doubtful_times(time_s: Mapping[str, np.ndarray]) -> list[str]:
    """A note on recordings with time steps, usual ones or one, so long that times may be in another unit.

    Arguments:
        time_s: Ascending times of each recording, by its name [s].
    """
    steps_s = {name: np.diff(times) for name, times in time_s.items() if len(times) > FEW_MOMENTS}
    usual_s = {f"{name}: its rows": float(np.median(steps)) for name, steps in steps_s.items()}
    longest_s = {f"{name}: two of its rows": float(steps.max()) for name, steps in steps_s.items()}
    for found, doubtful_s in ((usual_s, DOUBTFUL_STEP_S), (longest_s, DOUBTFUL_PAUSE_S)):
        rows = max(found, key=lambda rows: found[rows], default=None)
        if rows is not None and found[rows] >= doubtful_s:
            return [
                f"{rows} are {found[rows]:.4g} s apart; times are in seconds: are they milliseconds or less? "
                "Motion is uniform in between"
            ]
    return []


def _gap_m(bounds_m: np.ndarray, space: DesignSpace) -> float:
    """The distance between a box and the box of origins [m]; 0 where they meet."""
    apart = np.maximum(bounds_m[0] - np.array(space.high[:3]), np.array(space.low[:3]) - bounds_m[1])
    return float(np.linalg.norm(np.maximum(apart, 0.0)))
