"""Certificates: an upper bound of F over all choices of the same candidates, by duality.

For thresholds t >= 0 of items and a price lambda >= 0 of bandwidth, every admissible choice S has

    F(S) - harm(S) <= sum_u w_u t_u + lambda B
                      + max_R sum_{r in R} max_g [ sum_u w_u (a(r,g,u) - t_u)+ - lambda b(r,g) - h(r,g) ]

where R holds the best rays of each group of candidates (Cornuejols, Fisher and Nemhauser 1977): whatever the
thresholds, an item counts at most its threshold and what single rays exceed it by. As choices fill their counts, R does
so too, with a ray of every sensor where each has to fire: rays that harm more than they are worth are charged. Where a
budget leaves rays of the choice unfired, R may leave out any.
Subgradients lower the bound, each with a part of the one before, as else they zigzag (Camerini, Fratta and Maffioli
1975). For concave sums phi(z) <= phi(y) + slope(y) (z - y) takes the place of thresholds, and Frank and Wolfe (1956)
choose y.
Without a budget lambda is the price that bandwidth was given, and lambda B is left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidardesign.numerics import COARSE_SLACK, ROUNDING, SLACK
from lidardesign.rays import kernels
from lidardesign.rays.choice import Choice, RayCounts, choose
from lidardesign.rays.coverage import Coverage

# Of subgradients, at most; more of them lower the bound of 361 rays on faces by less than 0.1 % of the loss.
ROUNDS = 80
PRICE_BISECTIONS = 12
PATIENCE = 5  # rounds without a lower bound after which steps are halved
PROGRESS = 0.02  # of what the bound exceeds the value by: a bound that is lower by less is not lower
PROXY = "mean over items of what the returns of the chosen rays leave unknown, by the task's informs"
PRICES = 7  # of the curve, besides 0: each half of the one before, from twice the worth per bit of a free choice
MEMORY = 0.7  # how much of its last direction a step keeps


def certificate_document(
    *,
    rays: int,
    value: float,
    bound: float,
    held_back_value: float,
    candidates: int,
    gates: int,
    scenes: int,
    unit: str,
) -> dict[str, Any]:
    """The certificate of a choice as plain values for design files, JSON and reports.

    Arguments:
        rays: Number of rays that fire.
        value: Loss of the choice on the scenes that it was made on, in the unit.
        bound: Lower bound of the loss of any other choice.
        held_back_value: Its loss on scenes held back.
        candidates, gates, scenes: Their numbers.
        unit: Unit of the losses.
    """
    # losses are not negative but for rounding
    value, bound, held_back_value = (max(float(loss), 0.0) for loss in (value, bound, held_back_value))
    return {
        "rays": rays,
        "value": value,
        "bound": bound,
        "gap": (value - bound) / value if value > 0 else 0.0,
        "held_back_value": held_back_value,
        "candidates": candidates,
        "gates": gates,
        "scenes": scenes,
        "proxy": PROXY,
        "unit": unit,
    }


def certify(
    coverage: Coverage,
    counts: RayCounts,
    choice: Choice,
    *,
    budget_mbps: float | None = None,
    full: bool = True,
    rounds: int = ROUNDS,
) -> tuple[float, float]:
    """The objective of a choice, and a bound for choices of the same candidates, counts, and price or budget.

    Arguments:
        coverage: Information of the candidates.
        counts: Numbers of rays by group.
        choice: The choice; its price is the bound's where there is no budget.
        budget_mbps: Largest bandwidth, if there is a budget [Mbit/s].
        full: Whether counts are filled, as in `choose`.
        rounds: Largest number of steps.

    Returns:
        F - price * bits - harm of the choice, without a price F - harm; and the least upper bound of it over all
        choices that was found, never below it.
    """
    value = choice.worth - choice.harm - (0.0 if budget_mbps is not None else choice.price * choice.bits)
    dual = Thresholds if len(coverage.table) == 0 else Tangents
    search = dual(coverage, _Admissible(coverage, counts, choice, budget_mbps, full=full), choice)
    bound = np.inf
    for _ in range(rounds):
        bound = min(bound, search.step(value))
        if bound - value <= COARSE_SLACK * abs(value):
            break
    return value, max(bound, value)


class _Admissible:
    """Admissible choices: a number of rays per group, at a price or within a budget."""

    def __init__(
        self, coverage: Coverage, counts: RayCounts, choice: Choice, budget_mbps: float | None, *, full: bool
    ) -> None:
        self.coverage, self.counts, self.price = coverage, counts, choice.price
        self.allowed = np.isfinite(coverage.bits)
        self.bits = np.where(self.allowed, coverage.bits, 0.0)
        # a little more than the slack of choices: the cheapest rays fit, however their bits are added up
        self.budget_mbps = None if budget_mbps is None else budget_mbps * (1 + 2 * SLACK)
        fired, there = (
            np.bincount(counts.group[rays], minlength=len(counts.most))
            for rays in (choice.rays, self.allowed.any(axis=1))
        )
        # that counts can be filled within a budget, and every sensor can fire, the choice itself shows
        is_filled = bool((fired >= np.minimum(counts.most, there)).all())
        self.full = full and (self.budget_mbps is None or (is_filled and choice.bits <= self.budget_mbps))
        owner, is_one = counts.owner, len(counts.most) == 1
        is_owned = self.full and is_one and owner is not None and len(np.setdiff1d(owner, owner[choice.rays])) == 0
        self.owner = owner if is_owned else None

    def best(self, excess: np.ndarray) -> tuple[float, np.ndarray]:
        """The largest sum of single gates' excess (N, G), and its gates, -1 for none, (N,).

        With a budget it is the Lagrangian bound, minimised over prices.
        """
        if self.budget_mbps is None:
            return self._at(self.price, excess)
        low, high = 0.0, self.price
        free = self._at(0.0, excess)
        if self._spent(free[1]) <= self.budget_mbps:
            return free
        while self._spent(self._at(high, excess)[1]) > self.budget_mbps:
            low, high = high, max(2 * high, ROUNDING)
        least = min(self._with_budget(low, excess), self._with_budget(high, excess), key=lambda found: found[0])
        for _ in range(PRICE_BISECTIONS):
            middle = (low + high) / 2
            tried = self._with_budget(middle, excess)
            least = min(least, tried, key=lambda found: found[0])
            low, high = (middle, high) if self._spent(tried[1]) > self.budget_mbps else (low, middle)
        self.price = high
        return least

    def _with_budget(self, price: float, excess: np.ndarray) -> tuple[float, np.ndarray]:
        total, gate = self._at(price, excess)
        return total + price * float(self.budget_mbps or 0.0), gate

    def _at(self, price: float, excess: np.ndarray) -> tuple[float, np.ndarray]:
        """The largest sum at a price, within counts."""
        net = np.where(self.allowed, excess - price * self.bits - self.coverage.harm, -np.inf)
        gate = np.argmax(net, axis=1)
        most = net[np.arange(len(gate)), gate]
        taken = np.full(len(gate), -1)
        total, least = 0.0, -np.inf if self.full else 0.0
        for group, count in enumerate(self.counts.most):
            own = np.flatnonzero((self.counts.group == group) & (most > least))
            if len(own) > count:
                cost = -most[own]
                if self.owner is not None:
                    order = np.argsort(cost, kind="stable")
                    cost[order[np.unique(self.owner[own[order]], return_index=True)[1]]] = -np.inf
                own = own[np.argpartition(cost, count)[:count]]
            taken[own] = gate[own]
            total += float(most[own].sum())
        return total, taken

    def _spent(self, gate: np.ndarray) -> float:
        return self.coverage.charge(gate)[0]


class Thresholds:
    """Subgradient descent of the bound for items whose largest worth counts."""

    def __init__(self, coverage: Coverage, admissible: _Admissible, choice: Choice) -> None:
        self.coverage, self.admissible = coverage, admissible
        self.threshold = coverage.known(choice.gate)
        self.excess = np.zeros(coverage.shape)
        self.count = np.zeros(len(coverage.weight))
        self.direction = np.zeros(len(coverage.weight))
        self.scale, self.stale, self.least = 1.0, 0, np.inf

    def step(self, value: float) -> float:
        """The bound at the present thresholds; moves them along its subgradient (Polyak 1969)."""
        coverage = self.coverage
        kernels.weigh_excess(coverage.by_item, coverage.weight, self.threshold, self.excess)
        total, taken = self.admissible.best(self.excess)
        bound = float(coverage.weight @ self.threshold) + total
        self.stale += 1
        if bound < value + (1 - PROGRESS) * (self.least - value):
            self.stale = 0
        self.least = min(self.least, bound)
        if self.stale == PATIENCE:
            self.scale, self.stale = self.scale / 2, 0
        kernels.count_exceeding(coverage.entries, taken, self.threshold, self.count)
        # per unit of an item's weight, so that steps are alike for items of all weights
        self.direction = 1.0 - self.count + MEMORY * self.direction
        slope = np.where((self.threshold <= 0) & (self.direction > 0), 0.0, self.direction)
        length = float(coverage.weight @ slope**2)
        if length > 0:
            self.threshold = np.maximum(self.threshold - self.scale * (bound - value) / length * slope, 0.0)
        return bound


class Tangents:
    """Steps of Frank and Wolfe for concave sums: tangents at the known sums of a mixture of choices."""

    def __init__(self, coverage: Coverage, admissible: _Admissible, choice: Choice) -> None:
        self.coverage, self.admissible = coverage, admissible
        self.known, self.made = coverage.known(choice.gate), 0
        self.rises = np.append(np.diff(coverage.table), 0.0)
        self.excess = np.zeros(coverage.shape)

    def step(self, value: float) -> float:
        """The bound by tangents at the present mixture; moves it towards the best choice of the tangents."""
        coverage = self.coverage
        rise = self.rises[np.minimum(self.known.astype(np.intp), len(self.rises) - 1)]
        kernels.weigh_excess(coverage.by_item, coverage.weight * rise, np.zeros(len(rise)), self.excess)
        total, taken = self.admissible.best(self.excess)
        bound = float(coverage.weight @ (coverage.counted(self.known) - rise * self.known)) + total
        self.made += 1
        self.known += 2 / (self.made + 2) * (coverage.known(taken) - self.known)
        return bound


def price_curve(coverage: Coverage, counts: RayCounts, visits: int = 1) -> list[list[float]]:
    """The loss of choices [in the unit of worth] against their bandwidth [Mbit/s], as pairs by rising bandwidth.

    Choices that cost more and lose no less than others are left out.

    Arguments:
        coverage: Information of the candidates.
        counts: Numbers of rays by group.
        visits: Number of condition values that the bandwidth is a mean over.
    """
    free = choose(coverage, counts, passes=0)
    prices = 2 * free.worth / free.bits * 0.5 ** np.arange(PRICES) if free.bits > 0 else []
    choices = [free, *(choose(coverage, counts, price=float(price), passes=0) for price in prices)]
    points: list[list[float]] = []
    for mbps, loss in sorted((one.bits / visits, coverage.complete - (one.worth - one.harm)) for one in choices):
        if not points or loss < points[-1][1]:
            points.append([float(mbps), float(loss)])
    return points
