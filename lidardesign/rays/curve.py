"""What bandwidth buys, and what more candidates would: both are said beside a certificate.

The price curve is for the eye: at each price rays are taken greedily, without swaps. The gap with more candidates says
whether those that were proposed are enough: where it is hardly larger, more of them would hardly help.
"""

from __future__ import annotations

import numpy as np

from lidardesign.rays.certificate import certify
from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.coverage import Coverage

PRICES = 7  # beside none: each half of the one before, from twice what the bits of a free choice are worth


def price_curve(coverage: Coverage, counts: RayCounts, visits: int = 1) -> list[list[float]]:
    """The loss of choices [in the unit of worth] against their bandwidth [Mbit/s], as pairs that rise and fall.

    Choices that cost more and lose no less than others are left out.

    Arguments:
        coverage: What the candidates tell.
        counts: How many rays each sensor fires.
        visits: Over how many values of a condition the bandwidth is a mean.
    """
    free = choose(coverage, counts, passes=0)
    prices = 2 * free.worth / free.bits * 0.5 ** np.arange(PRICES) if free.bits > 0 else []
    choices = [free, *(choose(coverage, counts, price=float(price), passes=0) for price in prices)]
    points: list[list[float]] = []
    for mbps, loss in sorted((one.bits / visits, coverage.complete - (one.worth - one.harm)) for one in choices):
        if not points or loss < points[-1][1]:
            points.append([float(mbps), float(loss)])
    return points


def gap_among_more(coverage: Coverage, counts: RayCounts, own: np.ndarray, budget_mbps: float | None = None) -> float:
    """How much smaller the loss could be, relative, if a choice among some rays were one among all of them.

    Arguments:
        coverage: What all rays tell.
        counts: How many rays each sensor fires.
        own: Which rays the choice is among, (N,).
        budget_mbps: The most that reading out may cost, if there is a budget.
    """
    among = RayCounts(np.where(own, counts.sensor, len(counts.most)), np.append(counts.most, 0))
    choice = choose(coverage, among) if budget_mbps is None else choose_within(coverage, among, budget_mbps)
    return float(certify(coverage, counts, choice, budget_mbps=budget_mbps).gap(coverage.complete))
