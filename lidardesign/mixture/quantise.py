"""Weighted Lloyd quantisation: a few centres that stand for many weighted points.

Lloyd's iteration (S. P. Lloyd, Least squares quantization in PCM, 1982) with k-means++ seeding (D. Arthur and
S. Vassilvitskii, 2007). Every step lowers the weighted sum of squared distances, so the iteration ends.

The nearest of some centres for each of many points is asked again and again while the centres move a little. A point
whose centre is nearer than any other can have become, by how far centres moved, is not asked about again (G. Hamerly,
Making k-means even faster, 2010). The answers are those of a search over all points.
"""

from __future__ import annotations

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK, SLACK, SQUARABLE


class Nearest:
    """Points that are asked for their nearest centres.

    Arguments:
        points: Shape (N, F).
    """

    def __init__(self, points: np.ndarray) -> None:
        self._points = points
        self._centres = np.empty((0, points.shape[1]))
        self._labels = np.empty(0, dtype=np.int64)
        # how near any other centre may be
        self._others = np.empty(0)
        # rounding of distances; what is nearer together than this is always asked about
        self._slack = SLACK * float(np.ptp(points, axis=0).max(initial=0.0))

    def of(self, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The distance to the nearest centre, shape (N,), and its index, shape (N,), which may be changed.

        Arguments:
            centres: Shape (K, F).
        """
        if len(centres) == 1 or centres.shape != self._centres.shape:
            found, self._labels = _two_nearest(self._points, centres)
            distance, self._others = found[:, 0].copy(), found[:, 1].copy()
        else:
            moved = np.sqrt(np.square(centres - self._centres).sum(axis=1))
            farthest = int(moved.argmax())
            others = np.full(len(centres), moved[farthest])
            # the centre that moved farthest is not among its own others
            others[farthest] = np.partition(moved, -2)[-2]
            self._others -= others[self._labels]
            distance = np.sqrt(np.square(self._points - centres[self._labels]).sum(axis=1))
            doubtful = np.flatnonzero(distance + self._slack >= self._others)
            if len(doubtful):
                found, self._labels[doubtful] = _two_nearest(self._points[doubtful], centres)
                distance[doubtful], self._others[doubtful] = found.T
        self._centres = centres.copy()
        return distance, self._labels.copy()


# Up to so many centres, looking at all of them costs as little as a tree, and nothing to import.
FEW_CENTRES = 10


def _two_nearest(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances to the nearest centre and to the next, shape (N, 2), and the index of the nearest, shape (N,).

    Where there is one centre alone, it is the next as well.
    """
    if len(centres) > FEW_CENTRES:
        from scipy.spatial import cKDTree

        found, labels = cKDTree(centres).query(points, k=2)
        return found, labels[:, 0].copy()
    squared = np.stack([np.square(points - centre).sum(axis=1) for centre in centres], axis=1)
    next_one = min(1, len(centres) - 1)
    return np.sqrt(np.partition(squared, next_one, axis=1)[:, [0, next_one]]), squared.argmin(axis=1)


# The iteration stops when no centre moves by more than this share of the features' extent: far below the
# spacing of any ray layout, far above rounding.
MOVEMENT_TOLERANCE = COARSE_SLACK
# Seeds are drawn among at most so many points per centre: seeding costs N * K, an iteration only N log K.
SEED_POOL = 16
# Relative weights below this one count as it, so that the mass of a cell never underflows to nothing.
SMALLEST_WEIGHT = SQUARABLE


# Cells need no more samples than this: their centres are then known to a tenth of their width.
SAMPLES_PER_RAY = 64
SMALLEST_SAMPLE = 2000


def samples_for(count: int) -> int:
    """The number of samples beyond which `count` cells do not become better."""
    return max(SAMPLES_PER_RAY * count, SMALLEST_SAMPLE)


def lloyd(
    features: np.ndarray,
    weights: np.ndarray,
    count: int,
    generator: np.random.Generator,
    *,
    iterations: int = 50,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    r"""Centres that minimise $\sum_n w_n \min_k |f_n - c_k|^2$ locally.

    Deterministic for a given generator state. It stops after `iterations` steps, or before, once no centre
    moves by more than 1e-6 of the features' extent. A cell that loses all its points takes the point that is
    worst represented, so with at least `count` distinct points of positive weight no cell is empty; with
    fewer, every distinct point is a centre and the rest repeat them in order of weight, with empty cells.

    Arguments:
        features: Points, shape (N, F), in units that make the Euclidean distance the right one.
        weights: Non-negative, not all zero, shape (N,).
        count: Number of centres K, at least 1.
        generator: Source of the seeding.
        iterations: At most this many steps.
        start: Centres to begin with instead of seeds, shape (K, F); centre k of the result is the one that came
            from centre k.

    Returns:
        Centres, shape (K, F), and the centre of each point, shape (N,).

    Raises:
        ConfigError: No points, shapes that do not fit, values that are not finite, or a count below 1.
    """
    features, weights = _checked(features, weights, count)
    distinct, inverse, merged = _distinct(features, weights)
    if len(distinct) <= count:
        heaviest = np.argsort(-merged, kind="stable")
        return np.concatenate([distinct, distinct[np.resize(heaviest, count - len(distinct))]]), inverse
    offset = distinct.mean(axis=0)
    points = distinct - offset
    tolerance = MOVEMENT_TOLERANCE * np.ptp(points, axis=0).max()
    centres = _seed(points, merged, count, generator) if start is None else _started(start, count, offset)
    nearest = Nearest(points)
    for _ in range(iterations):
        labels, _ = _assign(nearest, merged, centres)
        moved = _centroids(points, merged, labels, count)
        shift = np.abs(moved - centres).max()
        centres = moved
        if shift <= tolerance:
            break
    labels, refilled = _assign(nearest, merged, centres)
    centres[refilled] = _centroids(points, merged, labels, count)[refilled]
    return centres + offset, labels[inverse]


def _checked(features: np.ndarray, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    features = np.asarray(features, dtype=np.float64)
    weights = np.asarray(weights, dtype=np.float64)
    if features.ndim != 2 or not features.size or weights.shape != features.shape[:1]:
        shapes = f"features of shape {features.shape} with weights of shape {weights.shape}"
        raise ConfigError(shapes, where="quantisation", allowed="(N, F) and (N,), at least one point")
    if not (np.isfinite(features).all() and np.isfinite(weights).all()):
        raise ConfigError("features or weights are NaN or infinite", where="quantisation")
    if weights.min() < 0 or weights.max() <= 0:
        raise ConfigError("weights are negative or all zero", where="quantisation", allowed="0 or more")
    if count < 1:
        raise ConfigError(f"{count} centres", where="quantisation", allowed="1 or more")
    return features, weights


def _started(start: np.ndarray, count: int, offset: np.ndarray) -> np.ndarray:
    start = np.asarray(start, dtype=np.float64)
    if start.shape != (count, len(offset)) or not np.isfinite(start).all():
        allowed = f"{(count, len(offset))}, finite"
        raise ConfigError(f"a start of shape {start.shape}", where="quantisation", allowed=allowed)
    return start - offset


def _distinct(features: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct points in order of first appearance, the distinct point of each point, and summed weights.

    That order does not depend on the coordinates, so the quantisation turns and moves with its points.
    Points without weight are kept out; each of them belongs to its nearest point with weight.
    """
    positive = weights > 0
    distinct, first, inner = np.unique(features[positive], axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    distinct, inner = distinct[order], place[inner.reshape(-1)]
    inverse = np.zeros(len(features), dtype=np.int64)
    inverse[positive] = inner
    if not positive.all():
        from scipy.spatial import cKDTree

        inverse[~positive] = cKDTree(distinct).query(features[~positive])[1]
    merged = np.bincount(inner, weights=weights[positive], minlength=len(distinct))
    return distinct, inverse, np.maximum(merged / merged.sum(), SMALLEST_WEIGHT)


def _seed(points: np.ndarray, weights: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """k-means++: each seed is drawn with probability weight times squared distance to the seeds so far."""
    if len(points) > SEED_POOL * count:
        pool = generator.choice(len(points), SEED_POOL * count, replace=False, shuffle=False)
        points, weights = points[pool], weights[pool]
    # sums over a long axis are four times as fast as over a short one
    columns = np.ascontiguousarray(points.T)
    chosen, squared = np.empty(count, dtype=np.int64), np.full(len(points), 1.0)
    for k, draw in enumerate(generator.uniform(size=count)):
        mass = weights * squared
        cumulative = np.cumsum(mass)
        if cumulative[-1] > 0:
            # never one without mass, where the draw rounds to the whole
            index = int(np.searchsorted(cumulative, draw * cumulative[-1], side="right"))
            chosen[k] = index if index < len(mass) else np.flatnonzero(mass)[-1]
        else:
            # every distance underflowed: points that differ by less than the square root of the smallest number
            chosen[k] = int(draw * len(mass))
        away = np.square(columns - columns[:, chosen[k], None]).sum(axis=0)
        squared = np.minimum(squared, away) if k else away
    return points[chosen]


def _centroids(points: np.ndarray, weights: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Weighted means of the cells, shape (K, F)."""
    mass = np.bincount(labels, weights=weights, minlength=count)
    sums = [np.bincount(labels, weights=weights * column, minlength=count) for column in points.T]
    return np.stack(sums, axis=1) / mass[:, None]


def _assign(nearest: Nearest, weights: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest centre of each point, shape (N,), and the cells that had to be refilled.

    A cell without points takes the point with the largest weighted squared distance from its centre that is
    not alone in its cell; this can only lower the cost.
    """
    distance, labels = nearest.of(centres)
    counts = np.bincount(labels, minlength=len(centres))
    empty = np.flatnonzero(counts == 0)
    waiting = list(empty)
    for point in np.argsort(-weights * np.square(distance), kind="stable") if waiting else ():
        if not waiting:
            break
        if counts[labels[point]] > 1:
            counts[labels[point]] -= 1
            labels[point] = waiting.pop(0)
            counts[labels[point]] = 1
    return labels, empty
