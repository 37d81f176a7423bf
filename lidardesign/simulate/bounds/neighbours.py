"""Depth edges between neighbouring rays: how likely a step aside leads to another surface."""

from __future__ import annotations

import numpy as np

from lidardesign.simulate.bounds.sight import Sight

NEIGHBOURS = 4
# A step in range counts as an edge where it exceeds the slope of both surfaces this many times over.
STEEPER = 2.0


def edge_probability(sight: Sight, aside_m: np.ndarray) -> np.ndarray:
    """Probability that an edge lies within a distance aside of where a ray ends, shape (N,).

    Two neighbouring rays, a distance d apart, that end on different bodies, or further apart in range than the slope
    of either explains, have an edge somewhere between them: within a <= d of one with the probability a / d, wherever
    it is. The nearest `NEIGHBOURS` of each list are asked. An estimate: edges between rays that both end on one
    surface are not seen, in expectation over where rays fall they weigh as much as those that are.

    Arguments:
        sight: What rays meet.
        aside_m: How far aside, shape (N,) [m].
    """
    chance = np.zeros(len(sight))
    if not aside_m.any():
        return chance
    for start, end in _slices(sight.row):
        if end - start > 1:
            chance[start:end] = _within_list(sight, slice(start, end), aside_m[start:end])
    return chance


def _slices(row: np.ndarray) -> list[tuple[int, int]]:
    ends = np.flatnonzero(np.diff(row)) + 1
    return list(zip([0, *ends], [*ends, len(row)], strict=True)) if len(row) else []


def _within_list(sight: Sight, rows: slice, aside_m: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    range_m, body, tangent = sight.range_m[rows], sight.hits.body[rows], sight.tangent[rows]
    origin, direction = sight.rays.origin_m[rows], sight.rays.direction[rows]
    met = body >= 0
    scale_m = float(np.median(range_m[met])) if met.any() else 1.0
    spots = np.concatenate([origin, origin + scale_m * direction], axis=1)
    count = min(NEIGHBOURS, len(range_m) - 1)
    _, near = cKDTree(spots).query(spots, k=count + 1)
    chance = np.zeros(len(range_m))
    for other in near[:, 1:].T:
        reach_m = np.minimum(np.where(met, range_m, np.inf), np.where(met[other], range_m[other], np.inf))
        reach_m = np.where(np.isfinite(reach_m), reach_m, 0.0)[:, None]
        apart = origin + reach_m * direction - origin[other] - reach_m * direction[other]
        apart_m = np.linalg.norm(apart, axis=1)
        sloped_m = STEEPER * apart_m * (1 + tangent + tangent[other])
        edge = (body != body[other]) | (met & met[other] & (np.abs(range_m - range_m[other]) > sloped_m))
        further = np.maximum(aside_m, aside_m[other])
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(apart_m > 0, np.minimum(further / apart_m, 1.0), 1.0)
        chance = np.maximum(chance, np.where(edge & (further > 0), share, 0.0))
    return chance
