"""Emitter and receiver at two places: ranges along a ray from the whole path of its light, in closed form.

Light that leaves o along v, meets a surface at range r and goes on to a receiver at x has the path
L = r + |o + r v - x|. With b = x - o: r = (L / 2) (1 - (|b| / L)^2) / (1 - b.v / L). For b = 0 it is L / 2 exactly.
"""

from __future__ import annotations

import numpy as np

from lidardesign.scene import Receiver
from lidardesign.simulate.returns import Rays


def path_of_range(rays: Rays, receiver: Receiver | None, range_m: np.ndarray) -> np.ndarray:
    """Half the whole path of light that meets a surface at ranges (N,) along rays, shape (N,) [m]."""
    if receiver is None:
        return range_m
    points = rays.origin_m + range_m[:, None] * rays.direction
    back_m = np.linalg.norm(points - np.asarray(receiver.origin_m), axis=1)
    together = _at_the_receiver(rays, receiver)
    return np.where(together, range_m, (range_m + back_m) / 2)


def range_of_path(rays: Rays, receiver: Receiver | None, path_m: np.ndarray) -> np.ndarray:
    """Ranges along rays whose light took half paths (N,), shape (N,) [m]; the inverse of `path_of_range`.

    A path shorter than the way from the emitter to the receiver has no range: NaN.
    """
    if receiver is None:
        return path_m
    baseline = np.asarray(receiver.origin_m) - rays.origin_m
    whole = 2 * path_m
    with np.errstate(divide="ignore", invalid="ignore"):
        short = np.linalg.norm(baseline, axis=1) / whole
        along = np.einsum("nk,nk->n", baseline, rays.direction) / whole
        solved = path_m * ((1 - short) * (1 + short)) / (1 - along)
    return np.where(_at_the_receiver(rays, receiver), path_m, np.where(short < 1, solved, np.nan))


def path_windows(rays: Rays, receiver: Receiver | None) -> np.ndarray:
    """The gates of rays as intervals of half paths, shape (N, 2) [m]: a path grows with its range."""
    ends = [path_of_range(rays, receiver, np.ascontiguousarray(rays.gate_m[:, end])) for end in (0, 1)]
    return np.stack(ends, axis=1)


def _at_the_receiver(rays: Rays, receiver: Receiver) -> np.ndarray:
    """Which rays start where the receiver is: there nothing needs to be solved."""
    return (rays.origin_m == np.asarray(receiver.origin_m)).all(axis=1)
