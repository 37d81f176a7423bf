"""A few candidates out of many, where every set is small: real parts at poses, not rays by the hundred.

Sets are filled greedily, then one or two members leave and the best come in, until that gains nothing. The bound is
that of `certificate`. It also excludes candidates that are in no better set: with thresholds t, a set that holds c has

    F(S) <= sum_u w_u t_u + excess(c) + the largest excesses of the others.

The rest is bounded anew and, once few sets are left, searched by branch and bound: branches end where what is known and
the largest gains together do no better than the best set (Nemhauser, Wolsey and Fisher 1978).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.numerics import SLACK
from lidardesign.rays.certificate import ROUNDS, Tangents, Thresholds
from lidardesign.rays.choice import Choice
from lidardesign.rays.coverage import Coverage

FEW_SETS = 100_000  # are searched through, whatever it takes
MOST_WORK = 1e9  # entries of the table that a search of more sets may read: some seconds
STARTS = (8, 4, 2)  # a set is begun at the last candidate of the best eighth of its kind, ...
MOST_KINDS = 6  # that further sets are sought of, those that tell most by themselves
MOST_LEAVING = 2  # members of a set that are exchanged at once


@dataclass(frozen=True, eq=False)
class SetLimits:
    """The admissible sets of candidates.

    Arguments:
        count: Largest number of candidates in a set.
        kinds: Pairs of the kind of each candidate, (M,), and the largest number of each kind, (K,).
        budgets: Pairs of the cost of each candidate, (M,), and the largest cost of a set.
    """

    count: int
    kinds: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    budgets: Sequence[tuple[np.ndarray, float]] = ()

    def may_join(self, chosen: Sequence[int], candidates: int) -> np.ndarray:
        """Mask of the candidates that may be added to a set, bool (M,)."""
        members = np.array(chosen, dtype=np.intp)
        may = np.full(candidates, len(members) < self.count)
        may[members] = False
        for kind, most in self.kinds:
            may &= (np.bincount(kind[members], minlength=len(most)) < most)[kind]
        for cost, limit in self.budgets:
            may &= cost[members].sum() + cost <= limit * (1 + SLACK)
        return may

    def of(self, rows: np.ndarray) -> SetLimits:
        """The limits of some of the candidates."""
        kinds = [(kind[rows], most) for kind, most in self.kinds]
        return SetLimits(self.count, kinds, [(cost[rows], limit) for cost, limit in self.budgets])


@dataclass(frozen=True, eq=False)
class ChosenSet:
    """A set, and how far from the best it may be.

    Arguments:
        members: In the order in which they were taken.
        value: F of the set.
        bound: An upper bound of F over all sets.
    """

    members: tuple[int, ...]
    value: float
    bound: float


def choose_set(coverage: Coverage, limits: SetLimits) -> ChosenSet:
    """The best set found, with its bound; the best there is where few sets could be better.

    Arguments:
        coverage: The information of each candidate, through one gate.
        limits: The admissible sets.
    """
    rows = np.arange(coverage.shape[0])
    best = _improved(coverage, limits)
    value, bound = value_of(coverage, best), np.inf
    while len(rows):
        left, allowed = _restrict(coverage, rows), limits.of(rows)
        if math.comb(len(rows), min(limits.count, len(rows))) > FEW_SETS:
            least, reached = _bounds(left, allowed, np.flatnonzero(np.isin(rows, best)), value)
            bound = min(bound, max(least, value))
            kept = reached > value * (1 + SLACK)
            if kept.sum() < len(rows) / 2:
                rows = rows[kept]
                continue
            rows, left, allowed = rows[kept], _restrict(left, np.flatnonzero(kept)), allowed.of(np.flatnonzero(kept))
        found, is_complete = _searched(left, allowed, value)
        if found:
            best, value = tuple(int(row) for row in rows[list(found)]), value_of(left, found)
        return ChosenSet(best, value, value if is_complete else max(bound, value))
    return ChosenSet(best, value, value)


def further_sets(coverage: Coverage, limits: SetLimits, chosen: Sequence[int], most: int) -> list[tuple[int, ...]]:
    """A set and the best others of each way to fill one greedily, distinct, those of one kind first.

    The ways: one kind alone, a kind in the place of a member's, and from several candidates of each kind and place.

    Arguments:
        coverage: The information of each candidate.
        limits: The admissible sets; the first of their kinds is kept, one by one.
        chosen: The set.
        most: The largest number of sets.
    """
    (kind, allowed), *others = limits.kinds
    single = np.where(limits.may_join((), len(kind)), coverage.gains(np.zeros(len(coverage.weight)))[:, 0], 0.0)
    order = np.argsort(-single, kind="stable")
    order = order[single[order] > 0]
    _, first = np.unique(kind[order], return_index=True)
    present = kind[order[np.sort(first)]][:MOST_KINDS]

    def filled(counts: np.ndarray) -> tuple[int, ...]:
        own = SetLimits(limits.count, [(kind, np.minimum(counts, allowed)), *others], limits.budgets)
        return _filled(coverage, own, ())

    alone = [filled(limits.count * np.eye(len(allowed), dtype=np.intp)[one]) for one in present]
    used = np.bincount(kind[list(chosen)], minlength=len(allowed))
    swaps = itertools.product(np.flatnonzero(used), present)
    exchanged = [
        filled(used - np.eye(len(used), dtype=np.intp)[out] + np.eye(len(used), dtype=np.intp)[into])
        for out, into in swaps
        if out != into
    ]
    of_kinds = [order[kind[order] == one] for one in present]
    firsts = [
        *(int(rows[len(rows) // part]) for rows in of_kinds for part in (len(rows) + 1, *STARTS)),
        *(int(order[first]) for own, _ in others for first in np.unique(own[order], return_index=True)[1]),
    ]
    started = [_filled(coverage, limits, (first,)) for first in firsts]
    found = {tuple(sorted(chosen)): tuple(chosen)}
    for group, room in ((alone, (most + 1) // 2), (exchanged + started, most)):
        for one in sorted(group, key=lambda members: -value_of(coverage, members)):
            if len(found) < min(room, most):
                found.setdefault(tuple(sorted(one)), one)
    return list(found.values())


def _restrict(coverage: Coverage, rows: np.ndarray) -> Coverage:
    """The table of some candidates."""
    return coverage if len(rows) == coverage.shape[0] else coverage.grouped(rows[:, None])


def _gate(coverage: Coverage, chosen: Sequence[int]) -> np.ndarray:
    """A set as a choice of gates: 0 of its members, -1 of others, (M,)."""
    gate = np.full(coverage.shape[0], -1)
    gate[list(chosen)] = 0
    return gate


def value_of(coverage: Coverage, chosen: Sequence[int]) -> float:
    """F of a set."""
    return coverage.value_of(_gate(coverage, chosen))


def _filled(coverage: Coverage, limits: SetLimits, chosen: Sequence[int]) -> tuple[int, ...]:
    """A set filled greedily with the candidate of the largest gain, until none gains."""
    chosen = tuple(chosen)
    while len(chosen) < limits.count:
        gains = np.where(
            limits.may_join(chosen, coverage.shape[0]), coverage.gains(coverage.known(_gate(coverage, chosen)))[:, 0], 0
        )
        best = int(gains.argmax())
        if gains[best] <= 0:
            break
        chosen = (*chosen, best)
    return chosen


def _improved(coverage: Coverage, limits: SetLimits) -> tuple[int, ...]:
    """The greedy set, members exchanged until no exchange gains."""
    better = _filled(coverage, limits, ())
    while better is not None:
        best, least = better, value_of(coverage, better) * (1 + SLACK)
        sizes = (max(len(best) - leaving, 0) for leaving in range(1, MOST_LEAVING + 1))
        rests = itertools.chain.from_iterable(itertools.combinations(best, size) for size in sizes)
        tried = (_filled(coverage, limits, rest) for rest in rests)
        better = next((one for one in tried if value_of(coverage, one) > least), None)
    return best


class _Sets:
    """Bounds on sums over admissible sets for the steps of a certificate, from the count and one kind at a time."""

    def __init__(self, limits: SetLimits, candidates: int) -> None:
        self.count = limits.count
        self.kinds = limits.kinds or [(np.zeros(candidates, dtype=np.intp), np.array([limits.count]))]
        self.total = 0.0

    def best(self, excess: np.ndarray) -> tuple[float, np.ndarray]:
        """The least over kinds of the largest sum of excess, and its candidates as gates 0, else -1, (M,)."""
        net = excess[:, 0]
        order = np.argsort(-net, kind="stable")
        order, sets = order[net[order] > 0], []
        for kind, most in self.kinds:
            own = kind[order]
            by_kind = np.argsort(own, kind="stable")
            place = np.empty(len(own), dtype=np.intp)  # of a candidate among those of its kind
            place[by_kind] = np.arange(len(own)) - np.searchsorted(own[by_kind], own[by_kind])
            sets.append(order[place < most[own]][: self.count])
        kept = min(sets, key=lambda rows: net[rows].sum())
        taken = np.full(len(net), -1)
        taken[kept] = 0
        self.total = float(net[kept].sum())
        return self.total, taken


def _bounds(coverage: Coverage, limits: SetLimits, chosen: np.ndarray, value: float) -> tuple[float, np.ndarray]:
    """Upper bounds of F over all sets, and over the sets with each of the candidates, (M,)."""
    gate = _gate(coverage, chosen)
    sets = _Sets(limits, len(gate))
    steps = Tangents if len(coverage.table) else Thresholds
    search = steps(coverage, sets, Choice(gate, value, 0.0, 0.0, 0.0))
    least, reached = np.inf, np.full(len(gate), np.inf)
    for _ in range(ROUNDS):
        bound = search.step(value)
        excess = search.excess[:, 0]
        others = np.sort(excess)[::-1][: limits.count - 1].sum()
        reached = np.minimum(reached, bound - sets.total + excess + others)
        least = min(least, bound)
    return least, reached


def _searched(coverage: Coverage, limits: SetLimits, value: float) -> tuple[tuple[int, ...], bool]:
    """The best set above a value, empty if there is none, and True where the search was complete."""
    candidates, best = coverage.shape[0], ()
    few = math.comb(candidates, min(limits.count, candidates)) <= FEW_SETS
    visits = FEW_SETS if few else MOST_WORK / max(len(coverage.item), 1)
    open_sets: list[tuple[tuple[int, ...], int]] = [((), 0)]
    order = np.argsort(-coverage.gains(np.zeros(len(coverage.weight)))[:, 0], kind="stable")
    while open_sets:
        chosen, first = open_sets.pop()
        visits -= 1
        if visits < 0:
            return best, False
        known = coverage.known(_gate(coverage, chosen))
        gains = np.where(limits.may_join(chosen, candidates), coverage.gains(known)[:, 0], 0.0)[order]
        gains[:first] = 0.0
        reached, left = float(coverage.weight @ coverage.counted(known)), limits.count - len(chosen)
        if reached > value * (1 + SLACK):
            value, best = reached, chosen
        if left == 1:
            place = int(gains.argmax())
            if gains[place] > 0 and reached + gains[place] > value * (1 + SLACK):
                value, best = reached + float(gains[place]), (*chosen, int(order[place]))
            continue
        # the sum of the largest gains of later candidates bounds the branch
        for place in np.flatnonzero(gains)[::-1]:
            further = np.sort(gains[place + 1 :])[::-1][: left - 1].sum()
            if reached + gains[place] + further > value * (1 + SLACK):
                open_sets.append(((*chosen, int(order[place])), int(place) + 1))
    return best, True
