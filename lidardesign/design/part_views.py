"""Which way the rays of a part look: what comes near to any of them, and which of them look at something."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.catalog.part import Part
from lidardesign.design.catalog.pattern import to_angles
from lidardesign.design.catalog.placing import Pose
from lidardesign.space import observed_point

# A ray counts as coming near what is this close to it: a line scanner's beam is as high.
LEAST_REACH_RAD = 0.005
# Rays are worth firing that see this share of what the part could see: the rest are strays.
SEEN_SHARE = 0.99
# Of so many things in view the nearest says how far from them a ray looks.
NEAR_POINTS = 400


def in_view(part: Part, directions: np.ndarray) -> np.ndarray:
    """Which unit vectors in a part's frame its rays come near to, (N, 3) to bool (N,).

    Its field of view and half a cell around it: the field of a line scanner has no height.
    """
    columns, rows = part.grid
    horizontal, vertical = part.field_of_view_rad
    reach = np.maximum(np.array([horizontal / columns, vertical / rows]) / 2, LEAST_REACH_RAD)
    offset = to_angles(part.projection, directions) - np.array(part.centre_rad)
    half = np.array([horizontal, vertical]) / 2 + reach
    if part.view.shape == "ellipse":
        return np.square(offset / half).sum(axis=1) <= 1
    return (np.abs(offset) <= half).all(axis=1)


def worth_firing(
    part: Part, pose: Pose, points: np.ndarray, weights: np.ndarray, *, least: int = 0
) -> Callable[[np.ndarray], np.ndarray]:
    """Which rays of a part at a pose look where scene points are: unit vectors (N, 3) of the world to bool (N,).

    The fewest that are nearest to 99 % of the weight that the part has in view; none where nothing is.

    Arguments:
        part: The part.
        pose: Where it stands.
        points: Design points that observe the scene points, shape (M, 6).
        weights: Non-negative, shape (M,).
        least: So many rays in any case, where something is in view: then those that look nearest to it, too.
    """
    offset = observed_point(points) - pose.origin_m
    range_m = np.linalg.norm(offset, axis=1)
    kept = (range_m > 0) & (weights > 0)
    looking = offset[kept] / range_m[kept, None]
    seen = in_view(part, looking @ pose.frame.T)
    looking, mass = looking[seen], weights[kept][seen]

    def wanted(directions: np.ndarray) -> np.ndarray:
        mask = np.zeros(len(directions), dtype=bool)
        if len(looking):
            share = np.bincount(cKDTree(directions).query(looking)[1], mass, minlength=len(directions))
            order = np.argsort(-share, kind="stable")
            enough = int(np.searchsorted(np.cumsum(share[order]), SEEN_SHARE * mass.sum())) + 1
            mask[order[:enough]] = True
            mask &= share > 0
            lacking = min(least, len(directions)) - int(mask.sum())
            if lacking > 0:
                others = np.flatnonzero(~mask)
                away = cKDTree(looking[:: -(-len(looking) // NEAR_POINTS)]).query(directions[others])[0]
                mask[others[np.argsort(away, kind="stable")[:lacking]]] = True
        return mask

    return wanted
