"""Scores and information of the task `mujoco`: position, visible surface, or detection of targets.

Returns on known bodies are discarded, as the poses of a robot's own links are known. Returns on other bodies that are
no targets, and false alarms, are taken for the nearest target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from lidardesign import DataError, DesignSpace, Information, Metric, Outcome, Returns, Scene, Score
from lidardesign_tasks.moving_surface import SURFACES, moving_informs, moving_score, with_moving_truth
from lidardesign_tasks.robot.targets import Model
from lidardesign_tasks.robot.tracking import FEWEST_FRAMES, filled_path, path_information, tracked_places
from lidardesign_tasks.surface import MILLIMETRES

Measure = Literal["position", "surface", "seen"]
METRICS: dict[str, Metric] = {
    "position": Metric("position error", "m", "lower", worst=1.0, tolerance=1e-3),
    "surface": Metric("Chamfer distance", "mm", "lower", worst=MILLIMETRES, tolerance=0.4),
    "seen": Metric("targets seen", "%", "higher", worst=0.0, tolerance=0.5, best=100.0),
}
TOLERATED_SHARE = 1e-3  # of the extent in which targets move
TRUTH_POINTS = 2000


def with_truth(scene: Scene, model: Model, poses: np.ndarray, measure: Measure, metric: Metric, space: DesignSpace,
               generator: np.random.Generator) -> Scene:  # fmt: skip
    """The scene with its ground truth."""
    target_of = np.full(len(model.pieces) + 1, -1)  # of the body -1, too
    for number, target in enumerate(model.targets):
        target_of[target.pieces] = number
    places_m = model.places_m(poses[: scene.frames])  # a scene at rest has one frame, however long its motion
    truth = {
        "measure": measure, "metric": metric, "target_of": target_of, "known": np.append(model.known, False),
        "places_m": places_m, "depths_m": np.array([target.depth_m for target in model.targets]),
    }  # fmt: skip
    if measure == "surface":
        return with_moving_truth(scene, space, TRUTH_POINTS, generator, **truth)
    return replace(scene, truth=truth)


def score(scene: Scene, returns: Sequence[Returns]) -> Score:
    """The score of a scene by its own measure."""
    return _SCORES[scene.truth["measure"]](scene, [_told_apart(scene, one) for one in returns])


def informs(scene: Scene, returns: Sequence[Returns], share: float) -> Information:
    """Information of returns by the scene's own measure."""
    return _INFORMS[scene.truth["measure"]](scene, [_told_apart(scene, one) for one in returns], share)


def features(scene: Scene, returns: Returns) -> np.ndarray:
    """The mean place of what is taken for a target in a frame, (3,) [m]; not a number without any."""
    one = _told_apart(scene, returns)
    return one.points_m.mean(axis=0) if one.returned.any() else np.full(3, np.nan)


def _told_apart(scene: Scene, one: Returns) -> Returns:
    """The returns without those on known bodies."""
    gone = one.returned & scene.truth["known"][one.body]
    outcome, range_m = np.where(gone, Outcome.MISS, one.outcome), np.where(gone, np.nan, one.range_m)
    return replace(one, outcome=outcome, range_m=range_m, body=np.where(gone, -1, one.body))


def _taken_for(scene: Scene, one: Returns) -> tuple[np.ndarray, np.ndarray]:
    """Target that each ray's return is taken for, -1 without one, and its distance if mistaken [m], shapes (N,)."""
    target, off_m = np.where(one.returned, scene.truth["target_of"][one.body], -1), np.zeros(len(one.rays))
    mistaken = one.returned & (target < 0)
    points = one.points_m[mistaken[one.returned]]
    away_m = np.linalg.norm(points[:, None] - scene.truth["places_m"][:, one.frame], axis=2)
    target[mistaken], off_m[mistaken] = away_m.argmin(axis=1), away_m.min(axis=1)
    return target, off_m


def _position_score(scene: Scene, returns: Sequence[Returns]) -> Score:
    """Mean position error over targets and frames, of the mean of a target's returns from its centre [m]."""
    metric, places_m = scene.truth["metric"], scene.truth["places_m"]
    taken = [_taken_for(scene, one)[0] for one in returns]
    errors_m, seen = np.full(places_m.shape[:2], metric.worst), []
    for target, depth_m in enumerate(scene.truth["depths_m"]):
        frames, places = tracked_places(returns, [one == target for one in taken], depth_m)
        seen.append(len(frames) / len(returns))
        if len(frames):
            whole = len(frames) >= FEWEST_FRAMES
            path = filled_path(frames, places, scene.frames) if whole else places
            errors_m[target] = np.linalg.norm(path - places_m[target], axis=1)
    value = float(np.minimum(errors_m, metric.worst).mean())
    return Score(value, failed=not any(seen), details={"seen_percent": 100.0 * float(np.mean(seen))})


def _position_informs(scene: Scene, returns: Sequence[Returns], share: float) -> Information:
    count = max(sum(int(one.returned.sum()) for one in returns), 1)
    harm = np.stack([_taken_for(scene, one)[1] for one in returns]) / count
    least_m = float(scene.truth["depths_m"].max())
    return path_information(returns, _bodies(scene), scene.truth["places_m"], least_m, harm)


def _seen(scene: Scene, returns: Sequence[Returns]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rays with a return on a target, and the target's index, for each frame."""
    found = [(one.returned & (scene.truth["target_of"][one.body] >= 0), one.body) for one in returns]
    return [(np.flatnonzero(hit), scene.truth["target_of"][body[hit]]) for hit, body in found]


def _seen_score(scene: Scene, returns: Sequence[Returns]) -> Score:
    """The share of frames and targets with a return [%]."""
    targets = len(scene.truth["places_m"])
    return Score(100.0 * float(np.mean([len(np.unique(target)) / targets for _, target in _seen(scene, returns)])))


def _seen_informs(scene: Scene, returns: Sequence[Returns], share: float) -> Information:
    """Full information of every return on a target about its own frame."""
    targets, hits = len(scene.truth["places_m"]), _seen(scene, returns)
    ray = np.concatenate([ray for ray, _ in hits])
    item = np.concatenate([frame * targets + target for frame, (_, target) in enumerate(hits)])
    return Information(ray, item, np.ones(len(ray)), np.repeat(np.arange(len(returns)), targets))


def _bodies(scene: Scene) -> list[np.ndarray]:
    own = scene.truth["target_of"][:-1]
    return [np.flatnonzero(own == target) for target in range(len(scene.truth["places_m"]))]


def _is_hidden(scene: Scene) -> bool:
    """True if no sensor can see a target in any frame, as behind the robot."""
    try:
        return scene.truth[SURFACES] is None
    except DataError:  # raised by the truth
        return True


def _surface_score(scene: Scene, returns: Sequence[Returns]) -> Score:
    """Score of a moving surface; the worst value where it is hidden."""
    metric = scene.truth["metric"]
    return Score(metric.worst, failed=True) if _is_hidden(scene) else moving_score(metric, scene, returns)


def _surface_informs(scene: Scene, returns: Sequence[Returns], share: float) -> Information:
    if not _is_hidden(scene):
        return moving_informs(scene, returns, share)
    none = np.zeros(0, dtype=np.int64)
    return Information(none, none, np.zeros(0), np.zeros(1, dtype=np.int64), unit="m")


_SCORES = {"position": _position_score, "surface": _surface_score, "seen": _seen_score}
_INFORMS = {"position": _position_informs, "surface": _surface_informs, "seen": _seen_informs}
