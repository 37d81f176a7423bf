"""Origins and their covariances moved to where the constraints admit them: the nearest place, the largest spread."""

from __future__ import annotations

import numpy as np

from lidardesign.design.bounds import Bounds
from lidardesign.design.constraints import Constraints
from lidardesign.design.mounts import mounts_of
from lidardesign.design.origins import Boxes, box_around, nearest_admitted
from lidardesign.numerics import SLACK, TINY, clipped_eigenvalues


def log_matrix(matrices: np.ndarray) -> np.ndarray:
    """Logarithms of symmetric positive definite matrices, (..., k, k)."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuilt(vectors, np.log(np.maximum(values, TINY)))


def exp_matrix(matrices: np.ndarray) -> np.ndarray:
    """Exponentials of symmetric matrices, (..., k, k)."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuilt(vectors, np.exp(values))


def _rebuilt(vectors: np.ndarray, values: np.ndarray) -> np.ndarray:
    rebuilt = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return (rebuilt + np.swapaxes(rebuilt, -1, -2)) / 2


def admitted_origins(origins: np.ndarray, bounds: Bounds, constraints: Constraints) -> np.ndarray:
    """The nearest admissible mean origins, (G, 3) to (G, 3) [m]; mounted sensors at distinct mounts."""
    moved = np.clip(origins, bounds.origin_low, bounds.origin_high)
    for row in range(len(moved)):
        free = bounds.free_low[row], bounds.free_high[row]
        if np.isfinite(free[0]).any() or np.isfinite(free[1]).any():
            boxed = nearest_admitted(moved[row : row + 1], *free)
            moved[row] = np.clip(boxed[0], bounds.origin_low[row], bounds.origin_high[row])
    return _mounted(moved, constraints)


def _mounted(origins: np.ndarray, constraints: Constraints) -> np.ndarray:
    """Origins with mounted sensors at mounts of their own, as near as all of them together can be."""
    options = [mounts_of(constraints, sensor) for sensor in range(len(origins))]
    mounted = [sensor for sensor, mounts in enumerate(options) if mounts]
    if not mounted:
        return origins
    # loaded here because few constraint files have mounts
    from scipy.optimize import linear_sum_assignment

    places = sorted({mount for mounts in options for mount in mounts})
    away = np.square(np.array(places)[None] - origins[mounted][:, None]).sum(axis=2)
    # far beyond any distance that is admitted, so that no sensor takes a mount that is none of its own
    barred = 1.0 + len(mounted) * (1.0 + away.max())
    for row, sensor in enumerate(mounted):
        away[row, [place not in options[sensor] for place in places]] += barred
    rows, columns = linear_sum_assignment(away)
    moved = origins.copy()
    moved[np.array(mounted)[rows]] = np.array(places)[columns]
    return moved


def admitted_covariances(
    origins: np.ndarray, covariances: np.ndarray, axes: tuple[int, ...], bounds: Bounds
) -> np.ndarray:
    """Covariances (G, k, k) along some axes within their bounds [m^2]; their intervals keep out of excluded boxes."""
    most = np.square(bounds.origin_spread), np.square(bounds.origin_thickness)
    # the thinnest direction of the whole space has no spread where an axis is fixed
    thinnest = most[1] if len(axes) == origins.shape[1] else np.full(len(origins), np.inf)
    admitted = clipped_eigenvalues(covariances, 0.0, most[0], thinnest)
    for row in range(len(origins)):
        low, high = bounds.free_low[row], bounds.free_high[row]
        if not (np.isfinite(low).any() or np.isfinite(high).any()):
            continue
        reach = np.zeros(origins.shape[1])
        reach[list(axes)] = bounds.interval * np.sqrt(np.diag(admitted[row]))
        box = box_around(origins[row], reach, Boxes(low, high))
        room = np.maximum(np.minimum(origins[row] - box[0], box[1] - origins[row]), 0.0)
        shrink = np.minimum(1.0, (1 - SLACK) * room / np.maximum(reach, TINY))[list(axes)]
        admitted[row] *= shrink[:, None] * shrink
    return admitted
