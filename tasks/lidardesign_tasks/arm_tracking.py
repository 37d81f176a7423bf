"""The path of a ball from returns on it: one place per frame, gaps filled in time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.geometry.rays import Returns
from lidardesign.task import Information

# A ball hit evenly over its disc is hit, on average, this share of its radius in front of its centre's plane
MEAN_DEPTH = 2 / 3
FEWEST_FRAMES = 2
# A return tells of the path as far as the ball moves in so many frames, in the mean over the path. From 1 to 8 chosen
# rays track held-out paths alike.
REACH_FRAMES = 2.0


def tracked_places(returns: Sequence[Returns], target: int, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Frames with a return on the ball and the ball's place in each, (K,) and (K, 3) [m].

    A place is the mean, over the frame's returns on the ball, of the measured point moved along its ray by the
    depth at which the centre is expected. A robot knows where its own links are, so their returns are told apart; what
    a detector made of noise is not, and counts as the ball.

    Arguments:
        returns: One per frame.
        target: The index of the ball among the scene's bodies.
        radius_m: Of the ball [m].
    """
    frames, places = [], []
    for frame in returns:
        hit = np.flatnonzero(frame.returned & ((frame.body == target) | (frame.body < 0)))
        if len(hit):
            rays = frame.rays
            depth = frame.range_m[hit] + MEAN_DEPTH * radius_m
            frames.append(frame.frame)
            places.append((rays.origin_m[hit] + depth[:, None] * rays.direction[hit]).mean(axis=0))
    return np.array(frames, dtype=np.int64), np.reshape(places, (-1, 3))


def filled_path(frames: np.ndarray, places: np.ndarray, count: int) -> np.ndarray:
    """A place for every frame, shape (count, 3) [m]: a monotone cubic spline in time, held at both ends.

    Arguments:
        frames: Increasing indices of the tracked frames, shape (K,), at least two.
        places: Where the ball was in them, shape (K, 3) [m].
        count: Frames of the scene; they are equally far apart in time.
    """
    from scipy.interpolate import PchipInterpolator

    when = np.clip(np.arange(count), frames[0], frames[-1])
    return PchipInterpolator(frames, places, axis=0)(when)


def path_information(returns: Sequence[Returns], target: int, ball_m: np.ndarray) -> Information:
    """What returns on a ball tell about its place in every frame: max(0, D - path), path the way in between.

    Gaps are filled in time, so a return also tells about frames shortly before and after, the less the further the
    ball moves until then. What is no return on the ball is told apart, and spoils nothing.

    Arguments:
        returns: One per frame.
        target: The index of the ball among the scene's bodies.
        ball_m: Where it is in each frame, shape (F, 3) [m].
    """
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ball_m, axis=0), axis=1))])
    reach_m = REACH_FRAMES * walked[-1] / (len(ball_m) - 1)
    left = reach_m - np.abs(walked[:, None] - walked)
    hits = [np.flatnonzero(one.returned & (one.body == target)) for one in returns]
    near = [np.flatnonzero(left[one.frame] > 0) for one in returns]
    ray = np.concatenate([np.repeat(hit, len(items)) for hit, items in zip(hits, near, strict=True)])
    item = np.concatenate([np.tile(items, len(hit)) for hit, items in zip(hits, near, strict=True)])
    pairs = [len(hit) * len(items) for hit, items in zip(hits, near, strict=True)]
    seen_in = np.repeat([one.frame for one in returns], pairs)
    frame = np.arange(len(ball_m))
    return Information(ray, item, left[seen_in, item], frame, complete=reach_m, unit="m", seen_in=seen_in)
