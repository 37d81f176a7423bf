"""The path of a ball from returns on it: one place per frame, gaps filled in time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.geometry.rays import Returns

# A ball hit evenly over its disc is hit, on average, this share of its radius in front of its centre's plane
MEAN_DEPTH = 2 / 3
FEWEST_FRAMES = 2


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
