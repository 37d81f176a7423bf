"""Expectation maximisation with restarts: the loop, its seeds, and components that lose their samples.

Seeds are those of weighted Lloyd quantisation, a few centres that stand for many weighted points. Every step of it
lowers the weighted sum of squared distances.

References:
    Least squares quantization in PCM, Lloyd 1982. k-means++: the advantages of careful seeding, Arthur and
    Vassilvitskii 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.constraints.origins import nearest_in_boxes
from lidardesign.errors import BackgroundNote, NumericalError
from lidardesign.mixture.bounds import Bounds, Floors, clip_azimuth
from lidardesign.mixture.components import (
    Features,
    Mixture,
    Statistics,
    expect,
    label_statistics,
    mean_directions,
    responsibilities,
)
from lidardesign.mixture.m_step import SMALLEST_MASS, maximise
from lidardesign.numerics import ROUNDING, SQUARABLE, TINY, effective_count, wrap_angle

# Iterations stop when the mean log-likelihood gains less than this per iteration [nats].
CONVERGENCE_NATS = 1e-5
MOST_ITERATIONS = 200
RESTART_ITERATIONS = 12
# Seeds are first compared on so many samples, and the best few of them on all.
SCREEN_SAMPLES = 5000
FINALISTS = 3
# Falls below this are rounding of a sum over the samples [nats].
ROUNDING_NATS = ROUNDING
SEED_SAMPLES = 2000
SEED_LLOYD_ITERATIONS = 4
# A component that rests on fewer effective samples is no sensor: it begins again where there are more.
LEAST_SAMPLES = 20.0
MOST_REVIVALS = 3
# Shorter boresight steps than this share are as good as none.
SMALLEST_STEP = 0.02
# Mass that stands for an empty cell, so that its mean is finite.
SMALLEST_CELL = TINY
# Up to so many centres a brute-force search is as fast as a tree, and imports nothing.
FEW_CENTRES = 10
# Seeds are drawn among at most so many points per centre: seeding costs N * K, an iteration only N log K.
SEED_POOL = 16
# Relative weights below this one count as it, so that the mass of a cell never underflows to nothing.
SMALLEST_WEIGHT = SQUARABLE


@dataclass(frozen=True, eq=False)
class EMResult:
    """The result of one run of the loop.

    Arguments:
        mixture: The last parameters.
        log_likelihood: Weighted mean log density [nats].
        history: Log-likelihood after every accepted step; it never decreases.
        notes: Lines on restarted components.
    """

    mixture: Mixture
    log_likelihood: float
    history: tuple[float, ...]
    notes: tuple[str, ...] = ()


def run_em(
    mixture: Mixture,
    features: Features,
    bounds: Bounds,
    *,
    iterations: int = MOST_ITERATIONS,
    tolerance_nats: float = CONVERGENCE_NATS,
) -> EMResult:
    """Iterate from admissible parameters; a step that would lower the log-likelihood is replaced.

    The replacement keeps the boresights, for which the M-step is exact and so cannot lose; the share of the
    boresights' step that is tried next is halved.
    """
    floors = Floors.of(features)
    statistics = expect(mixture, features)
    history = [_finite(statistics)]
    step = 1.0
    for _ in range(iterations):
        proposal = maximise(mixture, statistics, features, bounds, floors, step)
        outcome = expect(proposal, features)
        if not outcome.log_likelihood >= history[-1]:
            proposal = maximise(mixture, statistics, features, bounds, floors, 0.0)
            outcome = expect(proposal, features)
            step /= 2
        else:
            step = min(2 * step, 1.0)
        gain = outcome.log_likelihood - history[-1]
        if not gain >= -ROUNDING_NATS * (1 + abs(history[-1])):
            break
        mixture, statistics = proposal, outcome
        history.append(max(_finite(statistics), history[-1]))
        # a shortened boresight step may gain little and the next one more
        if gain < tolerance_nats and (step >= 1.0 or step < SMALLEST_STEP):
            break
    return EMResult(mixture, history[-1], tuple(history))


def _finite(statistics: Statistics) -> float:
    if not math.isfinite(statistics.log_likelihood):
        raise NumericalError(
            "the log-likelihood of the sensors is not finite",
            where="fit",
            hint="check the run's samples: learn it again, or widen the constraints",
        )
    return statistics.log_likelihood


def mixture_of_labels(features: Features, labels: np.ndarray, bounds: Bounds) -> Mixture:
    """Admissible components of a hard assignment, in two passes: boresights, then moments about them.

    A cell whose samples weigh next to nothing repeats the heaviest one.
    """
    count, axes = len(bounds), features.axes
    mass = np.bincount(labels, features.weights, minlength=count)
    source = np.where(mass > SMALLEST_MASS, np.arange(count), mass.argmax())
    azimuth, elevation = mean_directions(features, labels, count)
    placed = Mixture(
        weights=mass[source] / mass[source].sum(),
        origin_m=np.tile(features.points[0, :3], (count, 1)),
        origin_covariance_m2=np.zeros((count, 3, 3)),
        azimuth_rad=azimuth[source],
        elevation_rad=elevation[source],
        roll_rad=np.zeros(count),
        spread_rad=np.full((count, 2), features.angular_scale),
        range_m=np.full(count, features.points[0, 5]),
        spread_range_m=np.zeros(count),
    )
    floors = Floors.of(features)
    for step in (1.0, 0.0) if axes.angular else (0.0,):
        statistics = label_statistics(placed, features, labels)
        rows = Statistics(statistics.log_likelihood, mass[source], statistics.phi[source], statistics.tangent[source])
        placed = maximise(placed, rows, features, bounds, floors, step)
    return placed


def seed_mixture(features: Features, bounds: Bounds, generator: np.random.Generator) -> Mixture:
    """k-means++ seeds, a few Lloyd steps, and components from the cells, each where its bounds admit it."""
    chosen = generator.choice(len(features), min(SEED_SAMPLES, len(features)), replace=False)
    part = features.subset(np.sort(chosen)) if len(chosen) < len(features) else features
    seeds = np.ascontiguousarray(part.embedding)
    labels = lloyd(seeds, part.weights, len(bounds), generator, iterations=SEED_LLOYD_ITERATIONS)
    return mixture_of_labels(part, _match_cells(part, labels, bounds), bounds)


def _match_cells(features: Features, labels: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Labels renumbered to assign cells to components with the least violation of bounds in all."""
    count, unit = len(bounds), features.scale.max() if len(features.scale) else 1.0
    cost = np.zeros((count, count))
    azimuth, elevation = mean_directions(features, labels, count)
    mass = np.maximum(np.bincount(labels, features.weights, minlength=count), SMALLEST_CELL)
    sums = [np.bincount(labels, features.weights * column, minlength=count) for column in features.points.T]
    means = (np.stack(sums) / mass).T
    for component in range(count):
        one = bounds.take(np.full(count, component))
        turned = wrap_angle(clip_azimuth(azimuth, one) - azimuth) / features.angular_scale
        tilted = (np.clip(elevation, one.elevation_low, one.elevation_high) - elevation) / features.angular_scale
        low = np.maximum(bounds.origin_low[component], bounds.free_low[component])
        high = np.maximum(np.minimum(bounds.origin_high[component], bounds.free_high[component]), low)
        moved = nearest_in_boxes(means[:, :3], low, high) - means[:, :3]
        reach = np.clip(means[:, 5], one.start_low, one.end_high) - means[:, 5]
        cost[component] = np.square(turned) + np.square(tilted) + (np.square(moved).sum(1) + np.square(reach)) / unit**2
    if not cost.any() or (cost == cost[0]).all():
        return labels
    # loaded here because most designs have one set of bounds for all sensors
    from scipy.optimize import linear_sum_assignment

    component, cell = linear_sum_assignment(cost)
    renumbered = np.empty(count, dtype=np.int64)
    renumbered[cell] = component
    return renumbered[labels]


def fit_mixture(
    features: Features,
    bounds: Bounds,
    generator: np.random.Generator,
    *,
    restarts: int = 12,
) -> EMResult:
    """The best of several short runs, continued until it converges.

    Arguments:
        features: Weighted samples.
        bounds: One row per component.
        generator: Source of the seeds.
        restarts: Number of seeds that are tried.
    """
    seed = _best_seed(features, bounds, generator, 1 if len(bounds) == 1 else max(restarts, 1))
    result = revive_dead(run_em(seed, features, bounds), features, bounds, generator)
    different = len(np.unique(features.points, axis=0))
    if different >= len(bounds):
        return result
    shared = f"fewer different samples ({different}) than sensors ({len(bounds)}): some sensors share a sample"
    return replace(result, notes=(shared, *result.notes))


def _best_seed(features: Features, bounds: Bounds, generator: np.random.Generator, restarts: int) -> Mixture:
    """The seed of the largest likelihood after short runs: of all on a part of the samples, of the best few on all."""
    seeds = [seed_mixture(features, bounds, generator) for _ in range(restarts)]
    if restarts == 1:
        return seeds[0]
    part = features
    if len(features) > SCREEN_SAMPLES:
        part = features.subset(np.sort(generator.choice(len(features), SCREEN_SAMPLES, replace=False)))
    runs = [run_em(seed, part, bounds, iterations=RESTART_ITERATIONS) for seed in seeds]
    finalists = sorted(runs, key=lambda run: -run.log_likelihood)[:FINALISTS]
    runs = [run_em(run.mixture, features, bounds, iterations=RESTART_ITERATIONS) for run in finalists]
    return max(runs, key=lambda run: run.log_likelihood).mixture


def revive_dead(result: EMResult, features: Features, bounds: Bounds, generator: np.random.Generator) -> EMResult:
    """Restart components with too few samples on half of the heaviest one's, as long as their number falls."""
    notes: list[str] = []
    dead = _dead(result.mixture, features)
    for _ in range(MOST_REVIVALS):
        if not len(dead):
            break
        labels = responsibilities(result.mixture, features).argmax(axis=1)
        for component in dead:
            inside = np.flatnonzero(labels == np.bincount(labels, features.weights).argmax())
            part = features.subset(inside)
            halves = lloyd(np.ascontiguousarray(part.embedding), part.weights, 2, generator, iterations=2)
            labels[inside[halves == 1]] = component
        again = run_em(mixture_of_labels(features, labels, bounds), features, bounds)
        left = _dead(again.mixture, features)
        if len(left) >= len(dead):
            break
        notes.append(BackgroundNote(f"restarted {len(dead)} of {len(bounds)} sensors that had lost their samples"))
        result, dead = again, left
    return replace(result, notes=tuple(notes))


def _dead(mixture: Mixture, features: Features) -> np.ndarray:
    """Components with fewer effective samples than `LEAST_SAMPLES` or an equal share of all."""
    fewest = min(LEAST_SAMPLES, len(features) / len(mixture))
    own = responsibilities(mixture, features) * features.weights[:, None]
    return np.flatnonzero([effective_count(weights) < fewest for weights in own.T])


def lloyd(
    features: np.ndarray, weights: np.ndarray, count: int, generator: np.random.Generator, *, iterations: int
) -> np.ndarray:
    r"""Cells whose centres lower $\sum_n w_n \min_k |f_n - c_k|^2$ at every step.

    Deterministic for a given generator state. A cell that loses all its points takes the point that is worst
    represented, so with at least `count` distinct points of positive weight no cell is empty; with fewer, every
    distinct point has a cell of its own.

    Arguments:
        features: Points, shape (N, F), in units that make the Euclidean distance the right one.
        weights: Non-negative, not all zero, shape (N,).
        count: Number of cells K, at least 1.
        generator: Source of the seeding.
        iterations: The number of steps.

    Returns:
        The cell of each point, shape (N,).
    """
    distinct, inverse, merged = _distinct(features, weights)
    if len(distinct) <= count:
        return inverse
    points = distinct - distinct.mean(axis=0)
    centres = _seed(points, merged, count, generator)
    for _ in range(iterations):
        centres = _centroids(points, merged, _assign(points, merged, centres), count)
    return _assign(points, merged, centres)[inverse]


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
        cumulative = np.cumsum(weights * squared)
        # the last point where the draw rounds to the whole, or where every distance underflowed
        index = np.searchsorted(cumulative, draw * cumulative[-1], side="right")
        chosen[k] = min(index, len(points) - 1)
        away = np.square(columns - columns[:, chosen[k], None]).sum(axis=0)
        squared = np.minimum(squared, away) if k else away
    return points[chosen]


def _centroids(points: np.ndarray, weights: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Weighted means of the cells, shape (K, F)."""
    mass = np.bincount(labels, weights=weights, minlength=count)
    sums = [np.bincount(labels, weights=weights * column, minlength=count) for column in points.T]
    return np.stack(sums, axis=1) / mass[:, None]


def _assign(points: np.ndarray, weights: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The nearest centre of each point, shape (N,).

    A cell without points takes the point with the largest weighted squared distance from its centre that is
    not alone in its cell; this can only lower the cost.
    """
    distance, labels = _nearest(points, centres)
    counts = np.bincount(labels, minlength=len(centres))
    waiting = list(np.flatnonzero(counts == 0))
    for point in np.argsort(-weights * np.square(distance), kind="stable") if waiting else ():
        if not waiting:
            break
        if counts[labels[point]] > 1:
            counts[labels[point]] -= 1
            labels[point] = waiting.pop(0)
            counts[labels[point]] = 1
    return labels


def _nearest(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distance to the nearest centre, shape (N,), and its index, shape (N,)."""
    if len(centres) > FEW_CENTRES:
        from scipy.spatial import cKDTree

        return cKDTree(centres).query(points)
    squared = np.stack([np.square(points - centre).sum(axis=1) for centre in centres], axis=1)
    return np.sqrt(squared.min(axis=1)), squared.argmin(axis=1)
