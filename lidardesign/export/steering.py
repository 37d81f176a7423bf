"""The order in which a steering mirror reaches all its angles with little travel: a short round trip.

Both mirrors turn at once, so a step takes as long as the one that turns further: the length of a step is the larger of
its two angles. A frame follows the next, so the trip leads back to where it began. Tours start from the nearest
neighbour and from rows to and fro, and are improved by turning stretches round (2-opt, Croes 1958) and by moving
stretches of up to three stops elsewhere (Or 1976) until neither helps. Nothing in it is random.
"""

from __future__ import annotations

import numpy as np

from lidardesign.numerics import ROUNDING, TINY

NEIGHBOURS = 6
LONGEST_MOVED = 3
# So many stops are improved from both starts, for some percent of the way; more from one, to save time.
MOST_TWICE = 2000
# Nearest-neighbour tours cost time with the square of their stops; larger ones start from rows.
MOST_NEAREST = 20_000
# Rounds of improvement: 576 stops take 40, 5000 take 200; bounds the time of ever larger tours.
MOST_ROUNDS = 500
# Gains below this share of the tour's extent are rounding noise, and could be taken back and forth for ever.
LEAST_GAIN = ROUNDING


def short_tour(points: np.ndarray) -> np.ndarray:
    """The order of stops (N, 2) along a short round trip, indices of shape (N,).

    It begins behind the longest step, which the way back then is.
    """
    count = len(points)
    if count < 4:
        return np.arange(count)
    near = _neighbours(points)
    starts = [_nearest] if count <= MOST_NEAREST else []
    if count <= MOST_TWICE or not starts:
        starts.append(_rows)
    tours = [_improved(points, near, start(points)) for start in starts]
    best = min(tours, key=lambda tour: travel(points[tour]))
    longest = int(_lengths(points[best], points[np.roll(best, -1)]).argmax())
    return np.roll(best, -(longest + 1))


def travel(stops: np.ndarray) -> float:
    """The length of the round trip over stops (N, 2) in their order, with the way back to the first."""
    return float(_lengths(stops, np.roll(stops, -1, axis=0)).sum())


def _lengths(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs(first - second).max(axis=-1)


def _neighbours(points: np.ndarray) -> np.ndarray:
    """The nearest other stops of each, shape (N, K)."""
    from scipy.spatial import cKDTree

    found = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)), p=np.inf)[1]
    # where many stops are at one place, a stop need not be the first of its own neighbours
    own = found == np.arange(len(points))[:, None]
    own[~own.any(axis=1), -1] = True
    return found[~own].reshape(len(points), -1)


def _rows(points: np.ndarray) -> np.ndarray:
    """Rows to and fro, as many as make their stops as far apart as the rows are."""
    low, extent = points.min(axis=0), np.maximum(np.ptp(points, axis=0), TINY)
    # a column of stops has no extent to divide by
    steepness = len(points) if extent[1] >= len(points) * extent[0] else float(extent[1] / extent[0])
    rows = max(1, round(float(np.sqrt(len(points) * steepness))))
    row = np.minimum((points[:, 1] - low[1]) / extent[1] * rows, rows - 1).astype(np.int64)
    along = np.where(row % 2 == 0, points[:, 0], -points[:, 0])
    return np.lexsort((along, row))


def _nearest(points: np.ndarray) -> np.ndarray:
    """From the lowest corner always on to the nearest stop that is left."""
    left, here = np.arange(len(points)), int((points - points.min(axis=0)).sum(axis=1).argmin())
    order = []
    while len(left):
        order.append(left[here])
        place = points[left[here]]
        left[here:-1] = left[here + 1 :]
        left = left[:-1]
        if len(left):
            here = int(_lengths(points[left], place).argmin())
    return np.array(order)


def _improved(points: np.ndarray, near: np.ndarray, tour: np.ndarray) -> np.ndarray:
    """The tour after all moves that shorten it, as far as `MOST_ROUNDS` go."""
    least = LEAST_GAIN * float(np.ptp(points, axis=0).max())
    rounds = 0
    while rounds < MOST_ROUNDS:
        changed = False
        for step in (_turned, _moved):
            while rounds < MOST_ROUNDS and step(points, near, tour, least):
                changed, rounds = True, rounds + 1
        if not changed:
            break
        # stretches are not moved across the array's ends: let others be its ends
        tour = np.roll(tour, len(tour) // 2)
    return tour


def _turned(points: np.ndarray, near: np.ndarray, tour: np.ndarray, least: float) -> bool:
    """One round of 2-opt, in place: stretches that do not overlap are turned round, the best first."""
    count, place = len(tour), np.argsort(tour)
    here, there = np.repeat(place, near.shape[1]), place[near.ravel()]
    # an edge is named by the place of its first end; a stop is the first end of one edge and the last of another
    edges = np.concatenate([np.stack([here, there]), np.stack([here - 1, there - 1]) % count], axis=1)
    first, last = edges.min(axis=0), edges.max(axis=0)
    stops = points[tour]
    a, b, c, d = stops[first], stops[(first + 1) % count], stops[last], stops[(last + 1) % count]
    gain = _lengths(a, b) + _lengths(c, d) - _lengths(a, c) - _lengths(b, d)
    helpful = np.flatnonzero((gain > least) & (last > first + 1))
    free = np.ones(count + 1, dtype=bool)
    for move in helpful[np.argsort(-gain[helpful], kind="stable")]:
        low, high = int(first[move]), int(last[move])
        if free[low] and free[high + 1] and free[low : high + 2].all():
            free[low : high + 2] = False
            tour[low + 1 : high + 1] = tour[low + 1 : high + 1][::-1].copy()
    return bool(len(helpful))


def _moved(points: np.ndarray, near: np.ndarray, tour: np.ndarray, least: float) -> bool:
    """One round of Or's moves, in place: short stretches go between two stops elsewhere, the best first."""
    moves = [_stretch_moves(points, near, tour, length, least) for length in range(1, LONGEST_MOVED + 1)]
    gain, start, length, after, turned = (np.concatenate(columns) for columns in zip(*moves, strict=True))
    free = np.ones(len(tour), dtype=bool)
    for move in np.argsort(-gain, kind="stable"):
        begin, end, behind = int(start[move]), int(start[move] + length[move]), int(after[move])
        low, high = min(begin - 1, behind), max(end, behind + 1)
        if not free[low : high + 1].all():
            continue
        free[low : high + 1] = False
        stretch = tour[begin:end][:: -1 if turned[move] else 1].copy()
        if behind < begin:
            tour[behind + 1 : end] = np.concatenate([stretch, tour[behind + 1 : begin]])
        else:
            tour[begin : behind + 1] = np.concatenate([tour[end : behind + 1], stretch])
    return bool(len(gain))


def _stretch_moves(
    points: np.ndarray, near: np.ndarray, tour: np.ndarray, length: int, least: float
) -> tuple[np.ndarray, ...]:
    """Moves of stretches of a length that help: gain, start, length, the place they go behind, turned round or not."""
    count, place, stops = len(tour), np.argsort(tour), points[tour]
    starts = np.arange(1, count - length)
    ends = starts + length - 1
    # next to a neighbour of the stretch's first or last stop, before or behind it
    beside = np.concatenate([place[near[tour[starts]]], place[near[tour[ends]]]], axis=1)
    behind = np.concatenate([beside, beside - 1], axis=1)
    start = np.repeat(starts, behind.shape[1])
    behind = behind.ravel()
    apart = (behind >= 0) & (behind < count - 1) & ((behind < start - 1) | (behind > start + length - 1))
    start, behind = start[apart], behind[apart]
    before, first, last, after = (stops[start + offset] for offset in (-1, 0, length - 1, length))
    here, there = stops[behind], stops[behind + 1]
    saved = _lengths(before, first) + _lengths(last, after) - _lengths(before, after) + _lengths(here, there)
    straight = _lengths(here, first) + _lengths(last, there)
    round_ = _lengths(here, last) + _lengths(first, there)
    gain = saved - np.minimum(straight, round_)
    kept = gain > least
    return gain[kept], start[kept], np.full(int(kept.sum()), length), behind[kept], (round_ < straight)[kept]
