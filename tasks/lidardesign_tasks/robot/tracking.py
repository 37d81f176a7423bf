"""Paths of moving targets from returns: one position per frame, with gaps interpolated in time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign import Information, Returns

# A ball hit evenly over its disc is hit, on average, this share of its radius in front of its centre's plane
MEAN_DEPTH = 2 / 3
FEWEST_FRAMES = 2
# Reach of a return's information along the path, in mean steps per frame. Values from 1 to 8 give equally good tracks
# of held-out paths of the arm.
REACH_FRAMES = 2.0


def tracked_places(
    returns: Sequence[Returns], taken: Sequence[np.ndarray], depth_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frames with a return on a target, and its position in each, (K,) and (K, 3) [m].

    A position is the mean, over the frame's returns on it, of the measured point moved along its ray by the expected
    depth of the centre.

    Arguments:
        returns: One per frame.
        taken: Mask of rays whose returns are taken for the target, shape (N,) each.
        depth_m: Mean depth of its centre behind the returns [m].
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
    """Position in every frame, shape (count, 3) [m]: a monotone cubic spline in time, constant beyond both ends.

    Arguments:
        frames: Increasing indices of the tracked frames, shape (K,), at least two.
        places: Positions in these frames, shape (K, 3) [m].
        count: Number of frames of the scene, equally spaced in time.
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
    """Information of returns about positions in every frame: max(0, D - path), path the length in between.

    Gaps are interpolated in time, so a return also informs about frames shortly before and after, less the further its
    body moves in between.

    Arguments:
        returns: One per frame.
        bodies: Indices of each target's bodies in the scene.
        places_m: Positions of the targets in each frame, shape (T, F, 3) [m].
        least_m: Lower limit of D, for targets that hardly move [m].
        harm: Error of each return that is mistaken for a target's, shape (F, N) [m]; limited to D.
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
