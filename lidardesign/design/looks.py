"""What rays look at: the coordinates in which rays are alike, however far their samples' scene points are."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.features import Features
from lidardesign.numerics import safe_divide
from lidardesign.space import RANGE, observed_point

# The mean range of like rays is over so many of so many samples: one in three hundred of the density.
NEIGHBOURS = 16
NEIGHBOUR_POOL = 5000


def looks(features: Features) -> np.ndarray:
    """Directions where origins are given, else points of the mean surface, shape (N, F)."""
    aiming = features.embedding
    if features.axes.range:
        aiming = np.delete(aiming, len(features.axes.origin), axis=1)
    if not features.axes.origin:
        return np.ascontiguousarray(aiming)
    pool = slice(0, NEIGHBOUR_POOL)
    near = cKDTree(aiming[pool]).query(aiming, k=min(NEIGHBOURS, len(aiming)))[1].reshape(len(aiming), -1)
    share = features.weights[near]
    points = features.points.copy()
    # far from all of the density neighbours weigh nothing together, and there is no mean
    total = share.sum(axis=1)
    mean = safe_divide((share * points[near, RANGE]).sum(axis=1), total)
    points[:, RANGE] = np.where(total > 0, mean, points[:, RANGE])
    return observed_point(points)
