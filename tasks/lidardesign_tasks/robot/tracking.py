"""Paths of what moves, from the returns on it: one place per frame, gaps filled in time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scenes.rays import Returns
from lidardesign.task import Information

# A ball hit evenly over its disc is hit, on average, this share of its radius in front of its centre's plane
MEAN_DEPTH = 2 / 3
FEWEST_FRAMES = 2
# A return tells of the path as far as what is tracked moves in so many frames, in the mean over the path. From 1 to 8
# chosen rays track held-out paths of the arm alike.
REACH_FRAMES = 2.0


def tracked_places(
    returns: Sequence[Returns], taken: Sequence[np.ndarray], depth_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frames with a return on what is tracked and its place in each, (K,) and (K, 3) [m].

    A place is the mean, over the frame's returns on it, of the measured point moved along its ray by the depth at which
    the centre is expected.

    Arguments:
        returns: One per frame.
        taken: Which of the rays' returns are taken for it, shape (N,) each.
        depth_m: From the returns to its middle, in the mean [m].
    """
    frames, places = [], []
    for one, mine in zip(returns, taken, strict=True):
        hit = np.flatnonzero(one.returned & mine)
        if len(hit):
            depth = one.range_m[hit] + depth_m
            frames.append(one.frame)
            places.append((one.rays.origin_m[hit] + depth[:, None] * one.rays.direction[hit]).mean(axis=0))
    return np.array(frames, dtype=np.int64), np.reshape(places, (-1, 3))


def filled_path(frames: np.ndarray, places: np.ndarray, count: int) -> np.ndarray:
    """A place for every frame, shape (count, 3) [m]: a monotone cubic spline in time, held at both ends.

    Arguments:
        frames: Increasing indices of the tracked frames, shape (K,), at least two.
        places: Where it was in them, shape (K, 3) [m].
        count: Frames of the scene; they are equally far apart in time.
    """
    from scipy.interpolate import PchipInterpolator

    when = np.clip(np.arange(count), frames[0], frames[-1])
    return PchipInterpolator(frames, places, axis=0)(when)


def path_information(
    returns: Sequence[Returns],
    bodies: Sequence[np.ndarray],
    places_m: np.ndarray,
    least_m: float = 0.0,
    harm: np.ndarray | None = None,
) -> Information:
    """What returns tell about places in every frame: max(0, D - path), path the way in between.

    Gaps are filled in time, so a return also tells about frames shortly before and after, the less the further its
    body moves until then.

    Arguments:
        returns: One per frame.
        bodies: The indices of each target's bodies in the scene.
        places_m: Where the targets are in each frame, shape (T, F, 3) [m].
        least_m: D is at least this, for what hardly moves [m].
        harm: How far off each return is that is mistaken for a target's, shape (F, N) [m]; at most D counts.
    """
    steps = np.linalg.norm(np.diff(places_m, axis=1), axis=2)
    walked = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    reach_m = max(REACH_FRAMES * float(steps.sum()) / max(steps.size, 1), least_m)
    targets, frames = walked.shape
    rays, items, worths, seen = [], [], [], []
    for target, own in enumerate(bodies):
        left = reach_m - np.abs(walked[target][:, None] - walked[target])
        for one in returns:
            hit, near = np.flatnonzero(one.returned & np.isin(one.body, own)), np.flatnonzero(left[one.frame] > 0)
            rays.append(np.repeat(hit, len(near)))
            items.append(np.tile(target * frames + near, len(hit)))
            worths.append(np.tile(left[one.frame, near], len(hit)))
            seen.append(np.full(len(rays[-1]), one.frame))
    frame = np.tile(np.arange(frames), targets)
    return Information(
        np.concatenate(rays), np.concatenate(items), np.concatenate(worths), frame,
        harm=None if harm is None else np.minimum(harm, reach_m), complete=reach_m, unit="m",
        seen_in=np.concatenate(seen),
    )  # fmt: skip
