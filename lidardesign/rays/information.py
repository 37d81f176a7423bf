"""Information of returns about surfaces: the `informs` of tasks that reconstruct one, and the check of their answers.

A return informs about all points of the surface near it, the more the nearer they are: the rays with the largest mean
worth are those whose returns are nearest to the points of the surface, as in facility location.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from lidardesign.errors import PluginError
from lidardesign.numerics import SLACK
from lidardesign.plugins import plugin_method
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.adaptive import Features
from lidardesign.task import Information, Task

# Numbers of scenes that rays are chosen on, at first and at most; as many as at first are held back.
FEW_SCENES, MOST_SCENES = 50, 400
# Rays of a design: the information of candidates for more takes long, and gigabytes.
MOST_SELECTED = 5000
MOST_ENTRIES = 10_000_000  # of a table, some 200 MB: scenes of few items may be more
MOST_ITEMS = 100  # of a scene, drawn at random: enough over many scenes
# The share of candidates that is chosen, roughly: it sets the reach of returns, which is no threshold.
CHOSEN_SHARE = 0.2
# The reach of a return in mean spacings of the chosen ones: sqrt(5), so that on a surface it is five of the
# candidates' spacings. Few places of a surface are further than this from all chosen returns.
REACH_SPACINGS = math.sqrt(5.0)


def informs_rays(task: Task) -> bool:
    """True where a task has a method `informs`, so that its rays can be chosen."""
    return callable(getattr(task, "informs", None))


def checked_information(
    task: Task, scene: Scene, returns: Sequence[Returns], share: float = CHOSEN_SHARE
) -> Information:
    """The information of the returns of all candidate rays about a scene, by the task, checked.

    A task whose `informs` takes a keyword `share` gets the share of the candidates that will be chosen, roughly.

    Raises:
        PluginError: The task's code raised, or returned something else or invalid values.
    """
    where = f"task {task.name}, informs, scene {scene.name}"
    with plugin_method(task.name, "informs", where):
        takes_share = "share" in inspect.signature(task.informs).parameters
        answer = task.informs(scene, returns, **({"share": share} if takes_share else {}))
    if not isinstance(answer, Information):
        allowed = "lidardesign.task.Information"
        raise PluginError(f"informs returned {type(answer).__name__}", where=where, allowed=allowed)
    require_valid(answer, len(returns[0].rays) if len(returns) else 0, len(returns), where)
    return answer


def features_of(task: Task) -> Features | None:
    """The features of a frame's returns by a task, checked, (F,); None where it has no method `features`.

    Raises:
        PluginError: When called: the task's code raised, or returned something that is not a list of numbers.
    """
    return partial(_checked_features, task) if callable(getattr(task, "features", None)) else None


def _checked_features(task: Task, scene: Scene, returns: Returns) -> np.ndarray:
    where = f"task {task.name}, features, scene {scene.name}"
    with plugin_method(task.name, "features", where):
        found = task.features(scene, returns)
    try:
        features = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError):
        raise PluginError(f"features returned {found!r}", where=where, allowed="a list of numbers") from None
    if features.ndim != 1 or not len(features):
        raise PluginError(f"features of shape {features.shape}", where=where, allowed="(F,), the numbers of a frame")
    return features


def require_valid(information: Information, rays: int, frames: int, where: str = "task") -> None:
    """Raise `PluginError` for indices out of range, mismatched shapes and invalid numbers."""
    pairs, items = len(information.ray), len(information.frame)
    weight = np.ones(items) if information.weight is None else np.asarray(information.weight)
    harm = np.zeros((frames, rays)) if information.harm is None else np.asarray(information.harm)
    sums = np.zeros(1) if information.sums is None else np.asarray(information.sums)
    most, rises = float(np.max(sums, initial=0.0)), np.diff(sums)
    seen_in = np.zeros(0, dtype=int) if information.seen_in is None else information.seen_in
    indices = {
        "ray": (information.ray, rays),
        "item": (information.item, items),
        "frame": (information.frame, frames),
        "seen_in": (seen_in, frames),
    }
    faults = {
        "ray, item and worth of different lengths": not len(information.item) == len(information.worth) == pairs,
        "seen_in and item of different lengths": information.seen_in is not None and len(seen_in) != pairs,
        "weight and frame of different lengths": weight.shape != (items,),
        f"harm of shape {harm.shape}, not {(frames, rays)}": harm.shape != (frames, rays),
        "a unit that is not text": not isinstance(information.unit, str),
        "weights that are all zero": items > 0 and not weight.sum() > 0,
        f"sums up to {most:g}, above complete, {information.complete:g}": most > (1 + SLACK) * information.complete,
        f"sums {np.array2string(sums)} that are not 0 at 0, or fall, or rise faster than before": (
            (sums[:1] != 0).any() or (rises < 0).any() or (np.diff(rises) > SLACK * rises[:1]).any()
        ),
        **{
            f"{name} outside 0 to {count - 1}": bool(((index < 0) | (index >= count)).any())
            for name, (index, count) in indices.items()
        },
        **{
            f"{name} that is negative or not a number": not (np.isfinite(values) & (values >= 0)).all()
            for name, values in (("worth", information.worth), ("weight", weight), ("harm", harm))
        },
    }
    for fault, found in faults.items():
        if found:
            raise PluginError(f"informs gave {fault}", where=where, allowed="see lidardesign.task.Information")


def surface_information(
    points_m: Sequence[np.ndarray],
    returns: Sequence[Returns],
    is_target: Sequence[bool],
    size: float,
    *,
    weight: Sequence[np.ndarray] | None = None,
    dimensions: int = 2,
    share: float = CHOSEN_SHARE,
) -> Information:
    """Information of returns about a surface: max(0, D - distance) of each of its points, D the reach of a return.

    A return of something else is taken for the surface: its harm is its distance from the surface, at most D, as a
    share of all candidates' returns. That is enough to choose gates that exclude it. As a share of the chosen returns
    it would be overestimated: neighbouring rays hit the same thing, and without rays the place is no better known.

    Arguments:
        points_m: Even points of the surface that each of the returns should show, (U, 3) [m]; few are enough. None at
            all where nothing is to be seen.
        returns: Of all candidate rays, through open gates.
        is_target: Mask of the scene's bodies that form the surface.
        size: The area of the surface [m^2], the length of a curve [m]; over all of the returns.
        weight: Weights of the points, (U,) each; None: all alike.
        dimensions: 2 for a surface, 1 for a curve.
        share: The share of the candidates that will be chosen, as `informs` gets it.
    """
    from scipy.spatial import cKDTree

    targets = np.append(np.asarray(is_target, dtype=bool), False)  # a body of -1 is none
    hits = [one.returned & targets[one.body] for one in returns]
    reach_m = return_reach_m(size, sum(int(hit.sum()) for hit in hits), dimensions, share)
    count = sum(int(one.returned.sum()) for one in returns)
    rays, items, worths, frames, known = [], [], [], [], 0
    harm = np.zeros((len(returns), len(returns[0].rays)))
    for frame, (one, hit, points) in enumerate(zip(returns, hits, points_m, strict=True)):
        frames.append(np.full(len(points), frame))
        first, known = known, known + len(points)
        if not len(points) or not one.returned.any():
            continue
        tree, places = cKDTree(points), one.points_m
        on_target = hit[one.returned]
        pairs = cKDTree(places[on_target]).sparse_distance_matrix(tree, reach_m, output_type="ndarray")
        rays.append(np.flatnonzero(hit)[pairs["i"]])
        items.append(first + pairs["j"])
        worths.append(reach_m - pairs["v"])
        away_m = np.minimum(tree.query(places[~on_target], distance_upper_bound=reach_m)[0], reach_m)
        harm[frame, one.returned & ~hit] = away_m / count
    return Information(
        np.concatenate([np.zeros(0, dtype=np.int64), *rays]),
        np.concatenate([np.zeros(0, dtype=np.int64), *items]),
        np.concatenate([np.zeros(0), *worths]),
        np.concatenate(frames),
        weight=None if weight is None else np.concatenate(weight),
        harm=harm,
        complete=reach_m,
        unit="m",
    )


def return_reach_m(size: float, count: int, dimensions: int = 2, share: float = CHOSEN_SHARE) -> float:
    """The reach D of a return: `REACH_SPACINGS` times the mean spacing of a choice's returns [m]; 0 without returns.

    Arguments:
        size: The area of the surface [m^2], the length of a curve [m].
        count: Number of candidates' returns on it.
        dimensions: 2 for a surface, 1 for a curve.
        share: The share of them that is chosen.
    """
    return REACH_SPACINGS * (size / (share * count)) ** (1 / dimensions) if count else 0.0


def scattered_area_m2(points_m: np.ndarray) -> float:
    """The area that random points (K, 3) [m] are spread over evenly, 0 for less than two.

    Of n points per area the nearest neighbour is 0.5 / sqrt(n) away in the mean.
    """
    from scipy.spatial import cKDTree

    points = np.unique(points_m, axis=0)
    if len(points) < 2:
        return 0.0
    return len(points) * float(2 * cKDTree(points).query(points, k=2)[0][:, 1].mean()) ** 2
