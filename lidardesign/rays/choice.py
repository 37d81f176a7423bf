"""Rays and gates chosen out of many: greedily, then by swaps, within a count per sensor and a bandwidth.

Greedy on F - price * bits - harm takes the ray and gate that add most (Nemhauser, Wolsey and Fisher 1978). The gains
of all gates are updated as rays come and go: few items change their known worth, and few rays inform about an item.
Then one ray at a time leaves and the best of the others comes in, until no swap gains. No approximation factor is
guaranteed: `certificate` bounds the loss.

Where all that can be known of the training scenes is known, further rays are chosen in another layer, as if none fired
yet: of other scenes they see what the first ones just miss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.numerics import SLACK
from lidardesign.rays import kernels
from lidardesign.rays.coverage import Coverage

SMALLEST_GAIN = SLACK  # of F, relative: what a swap must gain, so that rounding cannot make two rays take turns
BISECTIONS = 12  # of the price of bandwidth
NEAR_BUDGET = 0.98  # what spends this share of a budget is near enough: swaps within the budget spend the rest
MOST_PASSES = 10  # of swaps
LEAST_SHARE = 0.01  # of what a ray of a layer adds on average: where the best, net, adds no more, another layer begins


@dataclass(frozen=True, eq=False)
class Choice:
    """A choice of rays that fire, with a gate each.

    Arguments:
        gate: The gate of each candidate ray, -1 for those that do not fire, (N,).
        worth: F of the choice.
        bits: Its bandwidth [Mbit/s].
        harm: Its harm, in the unit of worth.
        price: The price of one Mbit/s, in the unit of worth.
    """

    gate: np.ndarray
    worth: float
    bits: float
    harm: float
    price: float

    @property
    def rays(self) -> np.ndarray:
        """Indices of the candidates that fire, ascending."""
        return np.flatnonzero(self.gate >= 0)


@dataclass(frozen=True, eq=False)
class RayCounts:
    """Numbers of rays to choose, by groups of candidates.

    Arguments:
        group: The group of each candidate ray, (N,): a sensor, or a value of a condition.
        most: The number of rays of each group.
        owner: The sensor of each candidate, (N,), where every sensor has to fire a ray; else None.
    """

    group: np.ndarray
    most: np.ndarray
    owner: np.ndarray | None = None

    @staticmethod
    def of_one(rays: int, count: int) -> RayCounts:
        """A single group with `count` rays to choose."""
        return RayCounts(np.zeros(rays, dtype=np.intp), np.array([count]))


class _Search:
    """The state of a search: known worth of items, gains of all gates, and rays left of each group."""

    def __init__(self, coverage: Coverage, counts: RayCounts) -> None:
        self.coverage, self.group, self.left = coverage, counts.group, counts.most.copy()
        self.table = coverage.entries, coverage.by_item
        self.owner = counts.owner
        self.kept = np.zeros(coverage.shape[0], dtype=bool)
        self.cost = coverage.harm
        self.limit_mbps, self.spent_mbps = np.inf, 0.0
        self.gate = np.full(coverage.shape[0], -1)
        self.earlier = self.gate  # gates of the layers before
        self.known, self.worth = np.zeros(len(coverage.weight)), 0.0
        self.gains = coverage.first_gains.copy()

    def improve(self, price: float, limit_mbps: float, *, full: bool, passes: int) -> None:
        """Take rays at a price and within a bandwidth, then swap them."""
        coverage = self.coverage
        self.cost = coverage.harm + price * np.where(np.isfinite(coverage.bits), coverage.bits, 0.0)
        self.limit_mbps = limit_mbps
        if self.owner is not None:
            self.take_one_of_each(self.owner)
        self.fill(full)
        for _ in range(passes):
            changed = self.swap(full, SMALLEST_GAIN * self.worth)
            self.fill(full)
            if not changed:
                return

    def keep(self, gate: np.ndarray) -> None:
        """Take rays that fire in any case, with their gates, -1 for others, (N,)."""
        for ray in np.flatnonzero(gate >= 0):
            self.take(int(ray), int(gate[ray]))
        self.kept = gate >= 0

    def choice(self, price: float) -> Choice:
        """The choice so far."""
        gate = np.maximum(self.gate, self.earlier)
        return Choice(gate, self.coverage.value_of(gate), *self.coverage.charge(gate), price)

    def begin_layer(self) -> None:
        """Keep the rays that fire, and forget what they inform about."""
        self.earlier = np.maximum(self.gate, self.earlier)
        self.gate = np.full_like(self.gate, -1)
        self.known, self.worth, self.gains = np.zeros_like(self.known), 0.0, self.coverage.first_gains.copy()
        self.owner = None

    def best(self, among: np.ndarray | None = None) -> tuple[int, int, float]:
        """The ray and gate of the largest net gain, of all or of some, and that gain; -inf where none may be taken."""
        may_fire = (self.gate < 0) & (self.earlier < 0) & (self.left[self.group] > 0)
        may_fire = may_fire if among is None else may_fire & among
        room_mbps = self.limit_mbps - self.spent_mbps
        return kernels.best_gate(self.gains, self.cost, self.coverage.bits, may_fire, room_mbps)

    def take(self, ray: int, gate: int) -> None:
        """Add a ray with a gate."""
        gain = self.gains[ray, gate]
        kernels.change_choice(ray, gate, True, *self.table, self.gate, self.known, self.gains)
        self._count(ray, gate, gain)

    def _count(self, ray: int, gate: int, gain: float) -> None:
        self.worth += gain
        self.gate[ray] = gate
        self.left[self.group[ray]] -= 1
        self.spent_mbps += self.coverage.bits[ray, gate]

    def drop(self, ray: int) -> None:
        """Remove a ray."""
        gate = int(self.gate[ray])
        self.gate[ray] = -1
        kernels.change_choice(ray, gate, False, *self.table, self.gate, self.known, self.gains)
        self.worth -= self.gains[ray, gate]
        self.left[self.group[ray]] += 1
        self.spent_mbps -= self.coverage.bits[ray, gate]

    def take_one_of_each(self, owner: np.ndarray) -> None:
        """Take the best ray of every sensor that fires none."""
        for sensor in np.setdiff1d(owner, owner[self.gate >= 0]):
            ray, gate, net = self.best(owner == sensor)
            if net > -np.inf:
                self.take(ray, gate)

    def fill(self, full: bool) -> None:
        """Take rays greedily until counts or bandwidth are used up, or none gains: net or, where `full`, hardly."""
        while True:
            ray, gate, net = self.best()
            least = LEAST_SHARE * self.worth / max(int(np.count_nonzero(self.gate >= 0)), 1)
            if net == -np.inf or (self.gains[ray, gate] <= least if full else net <= 0):
                return
            self.take(ray, gate)

    def fill_up(self) -> None:
        """Take whatever rays fit, until counts or bandwidth are used up."""
        while (found := self.best())[2] > -np.inf:
            self.take(*found[:2])

    def swap(self, full: bool, smallest: float) -> bool:
        """Swap each chosen ray for the best other one where that gains; return whether anything changed."""
        changed, entries = False, self.coverage.entries
        for ray in np.flatnonzero((self.gate >= 0) & ~self.kept):
            gate = int(self.gate[ray])
            if self.owner is not None and np.count_nonzero(self.gate[self.owner == self.owner[ray]] >= 0) == 1:
                continue  # the only ray of its sensor
            items = entries.item[entries.start[ray] : entries.start[ray + 1]]
            known, gains = self.known[items], self.gains.copy()
            self.drop(int(ray))
            own = float(self.gains[ray, gate] - self.cost[ray, gate])
            other, new_gate, net = self.best()
            if net > own + smallest:
                self.take(other, new_gate)
                changed = True
            elif full or own >= 0:
                self._count(int(ray), gate, self.gains[ray, gate])
                self.known[items], self.gains = known, gains
            else:
                changed = True
        return changed


def choose(
    coverage: Coverage,
    counts: RayCounts,
    *,
    price: float = 0.0,
    full: bool = True,
    passes: int = MOST_PASSES,
    kept: np.ndarray | None = None,
) -> Choice:
    """Rays and gates of large F - price * bits - harm.

    Arguments:
        coverage: Information of the candidates.
        counts: Numbers of rays to choose.
        price: Price of 1 Mbit/s, in the unit of worth.
        full: Whether counts are filled even with rays that gain nothing.
        passes: Largest number of swaps of each ray.
        kept: Gates of rays that fire in any case, -1 for others, (N,).
    """
    return _choose_layers(coverage, counts, (price,), np.inf, full=full, passes=passes, kept=kept)


def _choose_layers(
    coverage: Coverage,
    counts: RayCounts,
    prices: Sequence[float],
    limit_mbps: float,
    *,
    full: bool,
    passes: int,
    layered: bool = True,
    kept: np.ndarray | None = None,
) -> Choice:
    """Layers of rays at the first price, or all rays in one; the last layer is improved at the other prices too."""
    search = _Search(coverage, counts)
    if kept is not None:
        search.keep(kept)
    search.improve(prices[0], limit_mbps, full=full, passes=passes * layered)
    # while this layer has rays and more may fire
    while layered and full and (search.gate >= 0).any() and (search.left > 0).any():
        search.begin_layer()
        search.improve(prices[0], limit_mbps, full=full, passes=passes)
    if full:
        search.fill_up()
    for price in prices[layered:]:
        search.improve(price, limit_mbps, full=full, passes=passes)
    return search.choice(prices[0])


def choose_within(
    coverage: Coverage,
    counts: RayCounts,
    budget_mbps: float,
    *,
    full: bool = True,
    passes: int = MOST_PASSES,
    kept: np.ndarray | None = None,
) -> Choice:
    """The best choice found within a bandwidth; as `choose`, with a budget [Mbit/s] instead of a price.

    A price reaches only the convex hull of bandwidth and worth. So the price is bisected, and the bandwidth left by the
    least price within the budget is spent at the next lower price, then at none.
    """
    budget_mbps *= 1 + SLACK  # the same bits added up in another order
    free = choose(coverage, counts, full=full, passes=passes, kept=kept)
    if free.bits <= budget_mbps:
        return free
    low, high = 0.0, (free.worth or 1.0) / free.bits  # a price has to rise from above 0
    for _ in range(BISECTIONS):
        tried = choose(coverage, counts, price=high, full=full, passes=0, kept=kept).bits
        if tried <= budget_mbps:
            break
        low, high = high, 4 * high
    for _ in range(BISECTIONS):
        if tried >= NEAR_BUDGET * budget_mbps and tried <= budget_mbps:
            break
        middle = (low + high) / 2
        bits = choose(coverage, counts, price=middle, full=full, passes=0, kept=kept).bits
        if bits <= budget_mbps:
            high, tried = middle, bits
        else:
            low = middle
    found = _choose_layers(coverage, counts, (high, low, 0.0), budget_mbps, full=full, passes=passes, kept=kept)
    if full and len(found.rays) < len(free.rays):
        # swaps spent what further layers need
        return _choose_layers(
            coverage, counts, (high, low, 0.0), budget_mbps, full=True, passes=passes, layered=False, kept=kept
        )
    return found
