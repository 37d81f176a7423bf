"""Depth edges between neighbouring rays: how likely a step aside leads to another surface."""

from __future__ import annotations

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.simulate.bounds.sight import Sight

# A step in range counts as an edge where it exceeds the slope of both surfaces this many times over.
STEEPER = 2.0


def edge_probability(sight: Sight, aside_m: np.ndarray) -> np.ndarray:
    """Probability that an edge lies within a distance aside of where a ray ends, shape (N,).

    Two neighbouring rays, a distance d apart, that end on different bodies, or further apart in range than the slope
    of either explains, have an edge somewhere between them: within a <= d of one with the probability a / d, wherever
    it is. The nearest few of each list are asked. An estimate: edges between rays that both end on one
    surface are not seen, in expectation over where rays fall they weigh as much as those that are.

    Arguments:
        sight: What rays meet.
        aside_m: How far aside, shape (N,) [m].
    """
    if not aside_m.any():
        return np.zeros(len(sight))
    range_m, body, tangent = sight.range_m, sight.hits.body, sight.tangent
    met = body >= 0
    chance = np.zeros(len(sight))
    for other in sight.neighbours.T:
        reach_m = np.minimum(sight.hits.range_m, sight.hits.range_m[other])
        apart_m = _apart_m(sight, other, np.where(np.isfinite(reach_m), reach_m, 0.0))
        sloped_m = STEEPER * apart_m * (1 + tangent + tangent[other])
        edge = (body != body[other]) | (met & met[other] & (np.abs(range_m - range_m[other]) > sloped_m))
        further = np.maximum(aside_m, aside_m[other])
        share = np.minimum(safe_divide(further, apart_m, 1.0), 1.0)
        chance = np.maximum(chance, np.where(edge & (further > 0), share, 0.0))
    return chance


def _apart_m(sight: Sight, other: np.ndarray, reach_m: np.ndarray) -> np.ndarray:
    """How far rays are from others (N,) at ranges (N,) along both, shape (N,) [m]."""
    origin, direction = sight.rays.origin_m, sight.rays.direction
    return np.linalg.norm(origin - origin[other] + reach_m[:, None] * (direction - direction[other]), axis=1)
