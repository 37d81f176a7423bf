"""Origins and their covariances moved to where the constraints admit them: the nearest place, the largest spread."""

from __future__ import annotations

import numpy as np

from lidardesign.design.bounds import Bounds
from lidardesign.design.constraints import Constraints
from lidardesign.design.mounts import Mount, mounts_of
from lidardesign.design.origins import Boxes, box_around, nearest_admitted
from lidardesign.numerics import ROUNDING, SLACK, TINY, clipped_eigenvalues

# A micrometre: less is a point.
LEAST_M2 = ROUNDING
# Origins that are spread out at all are so by this share of the largest box that they may lie in.
LEAST_SHARE = 1e-3


def log_matrix(matrices: np.ndarray) -> np.ndarray:
    """Logarithms of symmetric matrices (..., k, k) whose eigenvalues are variances [m^2], at least `LEAST_M2`."""
    values, vectors = np.linalg.eigh(matrices)
    return _rebuilt(vectors, np.log(np.maximum(values, LEAST_M2)))


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
    options = _mounts(constraints, len(origins))
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


def held_still(constraints: Constraints, bounds: Bounds) -> np.ndarray:
    """Which sensors are at a point: mounted, or fixed by their constraints, shape (G,) bool."""
    fixed = [constraints.of_sensor(sensor).origin.fixed_m is not None for sensor in range(len(constraints.each) + 1)]
    mounted = _mounts(constraints, len(bounds))
    return np.array([bool(mounts) or fixed[min(i, len(constraints.each))] for i, mounts in enumerate(mounted)])


def _mounts(constraints: Constraints, count: int) -> list[list[Mount]]:
    """The mounts that each of the first sensors may take; those beyond `each` share the common ones."""
    last = len(constraints.each)
    distinct = [mounts_of(constraints, sensor) for sensor in range(min(count, last + 1))]
    return [distinct[min(sensor, last)] for sensor in range(count)]


def admitted_covariances(
    origins: np.ndarray, covariances: np.ndarray, axes: tuple[int, ...], bounds: Bounds
) -> np.ndarray:
    """Covariances (G, k, k) along some axes within their bounds [m^2]; their intervals keep out of excluded boxes."""
    most = np.square(bounds.origin_spread), np.square(bounds.origin_thickness)
    # the thinnest direction of the whole space has no spread where an axis is fixed
    thinnest = most[1] if len(axes) == origins.shape[1] else np.full(len(origins), np.inf)
    least = np.square(LEAST_SHARE * np.ptp([bounds.origin_low, bounds.origin_high], axis=0).max(axis=1))
    admitted = clipped_eigenvalues(covariances, np.minimum(least, most[0]), most[0], thinnest)
    for row in range(len(origins)):
        low, high = bounds.free_low[row], bounds.free_high[row]
        if not (np.isfinite(low).any() or np.isfinite(high).any()):
            continue
        reach = np.zeros(origins.shape[1])
        reach[list(axes)] = bounds.interval * np.sqrt(np.diag(admitted[row]))
        slack = SLACK * np.maximum(np.abs(origins[row]), 1.0)
        around = ((low <= origins[row] + slack) & (origins[row] - slack <= high)).all(axis=1)
        box = box_around(origins[row], reach, Boxes(low[around], high[around]))
        room = np.maximum(np.minimum(origins[row] - box[0], box[1] - origins[row]), 0.0)
        shrink = np.minimum(1.0, (1 - SLACK) * room / np.maximum(reach, TINY))[list(axes)]
        admitted[row] *= shrink[:, None] * shrink
    return admitted
