"""Distances between a reconstruction and the truth, and the surface that a sensor could have seen."""

from __future__ import annotations

import numpy as np


def chamfer_m(first: np.ndarray, second: np.ndarray) -> float:
    """The sum of the two mean nearest distances between point sets, shapes (N, D) and (M, D) [m]."""
    from scipy.spatial import cKDTree

    forth, _ = cKDTree(second).query(first)
    back, _ = cKDTree(first).query(second)
    return float(forth.mean() + back.mean())
