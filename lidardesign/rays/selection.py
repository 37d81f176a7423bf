"""Rays chosen from candidates on as many training scenes as it takes, for several numbers of rays.

Scenes cost a cast each, so choices rest on many more of them than a density is learned from: they are doubled until a
choice loses little more on scenes held back than on its own. Every number of rays is a choice of its own: swaps leave
no prefixes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.errors import DataError, InfeasibleError
from lidardesign.numerics import SLACK
from lidardesign.rays import information
from lidardesign.rays.certificate import certificate_document, certify
from lidardesign.rays.choice import MOST_PASSES, Choice, RayCounts, choose, choose_within
from lidardesign.rays.coverage import Coverage, InformedScene, gather
from lidardesign.rays.curve import gap_among_more, price_curve
from lidardesign.rays.gates import inform
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.bandwidth import Bandwidth, split_budget
from lidardesign.task import Information

# Where bandwidth has no limit ten percent more of it must bring two percent less loss, or so much more worth
SHARE_PER_BANDWIDTH = 0.2
# Of the loss on scenes held back: what twice the scenes must have gained, or a choice lose less on its own scenes, for
# twice as many again to gain about a hundredth.
SMALLEST_GAIN, SMALLEST_GAP = 0.02, 0.05
MOST_ENTRIES = 10_000_000  # of the table, some 200 MB: scenes of few items may be more


@dataclass(frozen=True, eq=False)
class SelectionProblem:
    """What rays are chosen from, and for.

    Arguments:
        rays: Candidates with the widest gates that they may have.
        visits: Which of them fire at each of the values of a condition, one after the other; all at once without.
        shares: The share of the rays that each sensor fires, (S,); None leaves it to the choice.
        gates: A few gates for each of some rays, (N, G, 2) [m], of what their returns tell about scenes.
        informs: What a task says of a scene's returns.
        scenes: Training scenes without end for a purpose, `choice` or `held back`.
        bandwidth: What reading out costs.
        limit_mbps: The most that it may cost; inf without a limit, where bits have a price.
        one_gate: Whether all rays of a sensor have one gate.
        most_scenes: On how many scenes rays are chosen at most.
        name: Of the design, for messages.
        further: As many rays again, which may not be chosen: a certificate says what they would gain.
        is_trial: Whether rays alone are wanted, of the first scenes and without certificates.
        progress: Called with every step.
    """

    rays: Rays
    visits: Sequence[slice]
    shares: np.ndarray | None
    gates: Callable[[Rays, Sequence[slice], Sequence[InformedScene]], np.ndarray]
    informs: Callable[[Scene, Sequence[Returns]], Information]
    scenes: Callable[[str], Iterator[Scene]]
    bandwidth: Bandwidth
    limit_mbps: float
    one_gate: bool
    most_scenes: int
    name: str
    further: Rays | None = None
    is_trial: bool = False
    progress: Callable[[str], None] = lambda step: None

    @phase("what returns tell")
    def inform(self, scenes: Iterator[Scene], count: int) -> list[InformedScene]:
        """What the task says of the next so many scenes; they are not kept."""
        return [inform(scene, self.rays, self.visits, self.informs) for scene in itertools.islice(scenes, count)]

    def counts(self, count: int, visit: slice = slice(None)) -> RayCounts:
        """How many of the candidates, or of some, each sensor fires at each value of a condition."""
        place = np.repeat(np.arange(len(self.visits)), [one.stop - one.start for one in self.visits])[visit]
        if self.shares is None:
            return RayCounts(place, np.full(len(self.visits), count))
        most = np.tile(split_budget(self.shares, count), len(self.visits))
        return RayCounts(place * len(self.shares) + self.rays.sensor[visit], most)

    def coverage(self, informed: Sequence[InformedScene], gates_m: np.ndarray) -> Coverage:
        """What the candidates tell about scenes, with the cost of their gates."""
        one_bin = self.bandwidth.mbps_of_widths(np.zeros(1))
        return gather(informed, gates_m, one_bin * self.bandwidth.bins(gates_m[..., 1] - gates_m[..., 0]))

    @phase("choice")
    def choices(self, coverage: Coverage, count: int, passes: int = MOST_PASSES) -> list[Choice]:
        """The choice of so many rays within the bandwidth, at each value of a condition.

        Arguments:
            coverage: What the candidates tell.
            count: How many fire.
            passes: How often each ray may be swapped.

        Raises:
            InfeasibleError: So many rays do not fit.
        """
        limit, price = self.limit_mbps, 0.0
        if np.isinf(limit):
            price = self._price(coverage, count)
        elif len(self.visits) > 1:
            # between two values gates are linear, and every ray may cost one bin more than at the dearer of them
            limit -= self.bandwidth.mbps_of_widths(np.zeros(count))
        choices = []
        for visit in self.visits:
            own, counts = coverage.of_rays(visit), self.counts(count, visit)
            if np.isinf(limit):
                choice = choose(own, counts, price=price, passes=passes)
            else:
                choice = choose_within(own, counts, limit, passes=passes)
            if len(choice.rays) < count:
                raise InfeasibleError(
                    f"{len(choice.rays)} of {count} rays fit in {limit:g} Mbit/s",
                    conflicts=["budget.bandwidth_mbps"],
                    hint=f"fewer rays, or a larger bandwidth, for {self.name}",
                )
            choices.append(choice)
        return choices

    def _price(self, coverage: Coverage, count: int) -> float:
        """The price at which more bandwidth has to bring so much of the loss left, or of the worth gained if less.

        Worth is what the rays of a free choice gain, less their harm: all that there is to pay with. Where little can
        be known, nearly everything is left to lose, and a share of that would price out the rays that see something;
        at a share of the worth no best choice gives up more than this share.
        """
        free = choose(coverage, self.counts(count), passes=0)
        gained = free.worth - free.harm
        smaller = max(min(coverage.complete - gained, gained), 0.0)
        return SHARE_PER_BANDWIDTH * smaller / free.bits if free.bits > 0 else 0.0

    @phase("certificate")
    def certified(self, coverage: Coverage, choices: Sequence[Choice]) -> tuple[float, float]:
        """What choices lose, and what any others of no more bandwidth lose at least.

        Values of a condition share no items, so their losses sum.
        """
        limit, worth, gap = None if np.isinf(self.limit_mbps) else self.limit_mbps, 0.0, 0.0
        for visit, choice in zip(self.visits, choices, strict=True):
            found = certify(coverage.of_rays(visit), self.counts(len(choice.rays), visit), choice, budget_mbps=limit)
            worth, gap = worth + choice.worth - choice.harm, gap + found.bound - found.value
        loss = coverage.complete - worth
        return loss, min(max(loss - gap, 0.0), loss)  # nothing loses less than nothing


def _shared_gates(coverage: Coverage, choice: Choice, sensor: np.ndarray, limit_mbps: float) -> np.ndarray:
    """For each sensor the gate that its chosen rays share best, (S,): one sensor's after the other, until none gains.

    Arguments:
        coverage: What the candidates tell through their sensors' gates, from wide to narrow.
        choice: Of rays with gates of their own, and the price of bandwidth.
        sensor: The sensor of each candidate, (N,).
        limit_mbps: What all rays may cost; narrower gates are taken where they cost more.
    """
    gates, fires = coverage.shape[1], choice.gate >= 0
    shared = np.zeros(int(sensor.max()) + 1, dtype=np.intp)

    def worth(shared: np.ndarray) -> float:
        gate = np.where(fires, shared[sensor], -1)
        bits, harm = coverage.charge(gate)
        return coverage.value_of(gate) - harm - choice.price * bits

    best, is_better = worth(shared), True
    while is_better:
        is_better = False
        for index in np.unique(sensor[fires]):
            for gate in range(gates):
                tried = shared.copy()
                tried[index] = gate
                found = worth(tried)
                if found > best + SLACK * abs(best):
                    shared, best, is_better = tried, found, True
    rays = np.bincount(sensor[fires], minlength=len(shared))
    first = np.array([np.argmax(sensor == index) for index in range(len(shared))])
    limit_mbps *= 1 + SLACK
    while (cost := coverage.bits[first, shared] * rays).sum() > limit_mbps and (shared[rays > 0] < gates - 1).any():
        shared[np.where(shared < gates - 1, cost, -1.0).argmax()] += 1
    return shared


def _gate_of(choices: Sequence[Choice]) -> np.ndarray:
    """The gate of each candidate, -1 for those that do not fire, (N,)."""
    return np.concatenate([choice.gate for choice in choices])


@dataclass(frozen=True, eq=False)
class Selected:
    """Chosen rays, and how far from the best they may be.

    Arguments:
        rays: Those of each value of a condition, in the order of their sensors.
        certificate: `value` and `bound` of the loss on the scenes chosen on, `gap`, `held_back_value`, and the numbers
            of `rays`, `candidates`, `gates` and `scenes`; at the middle number of rays `gap_doubled`, the gap with
            candidates doubled, and `curve`, the price curve as pairs of Mbit/s and loss. A trial has none of it.
    """

    rays: Sequence[Rays]
    certificate: dict[str, Any]


def select(problem: SelectionProblem, counts: Sequence[int]) -> list[Selected]:
    """The rays that are chosen at each of some numbers of rays, ascending.

    Raises:
        DataError: No candidate tells anything about the scenes.
        InfeasibleError: A bandwidth in which no choice of so many rays fits.
    """
    middle = counts[len(counts) // 2]
    held_back = [] if problem.is_trial else problem.inform(problem.scenes("held back"), information.FEW_SCENES)
    informed: list[InformedScene] = []
    scenes, wanted, loss = problem.scenes("choice"), information.FEW_SCENES * (1 if problem.is_trial else 2), np.inf
    while True:
        problem.progress(f"choosing rays on {wanted} training scenes")
        informed += problem.inform(scenes, wanted - len(informed))
        gates_m = problem.gates(problem.rays, problem.visits, informed)
        coverage = problem.coverage(informed, gates_m)
        if not len(coverage.item):
            raise DataError(
                f"none of {len(problem.rays)} candidate rays tells anything about {len(informed)} training scenes",
                where=problem.name,
                hint="let sensors look at the targets: constrain less, or learn longer",
            )
        # how many scenes are enough, and which gate sensors share, swaps hardly change
        choices = problem.choices(coverage, middle, passes=0)
        judged = coverage if problem.is_trial else problem.coverage(held_back, gates_m)
        before, loss = loss, judged.loss_of(_gate_of(choices))
        is_large = 2 * wanted > problem.most_scenes or 2 * len(coverage.item) > MOST_ENTRIES
        if problem.is_trial or is_large or are_enough(before, loss, coverage.loss_of(_gate_of(choices))):
            break
        wanted *= 2
    rays, shared = problem.rays, None
    if problem.one_gate:
        shared = _shared_gates(coverage, replace(choices[0], gate=_gate_of(choices)), rays.sensor, problem.limit_mbps)
        own = shared[rays.sensor]
        coverage, judged = coverage.through(own), judged.through(own)
        gates_m = gates_m[np.arange(len(rays)), own][:, None]
    selected = []
    for count in counts:
        problem.progress(f"choosing {count} rays")
        choices = problem.choices(coverage, count)
        gate = _gate_of(choices)
        tables = []
        for visit, choice in zip(problem.visits, choices, strict=True):
            chosen = visit.start + choice.rays
            chosen = chosen[np.lexsort((chosen, rays.sensor[chosen]))]
            tables.append(replace(rays.subset(chosen), gate_m=gates_m[chosen, gate[chosen]]).as_angles())
        selected.append(Selected(tables, {}))
        if problem.is_trial:
            continue
        value, bound = problem.certified(coverage, choices)
        document = certificate_document(
            rays=count,
            value=value,
            bound=bound,
            held_back_value=judged.loss_of(gate),
            candidates=len(rays),
            gates=gates_m.shape[1],
            scenes=len(informed),
            unit=informed[0].unit,
        )
        if count == middle:
            document["curve"] = price_curve(coverage, problem.counts(count), len(problem.visits))
            if problem.further is not None:
                document["gap_doubled"] = _gap_doubled(problem, problem.further, count, shared)
        selected[-1] = Selected(tables, document)
    return selected


def are_enough(before: float, loss: float, own: float) -> bool:
    """Whether a choice on twice the scenes would lose hardly less on others.

    Arguments:
        before: What the choice on half the scenes loses on scenes held back.
        loss: What this one loses there.
        own: What it loses on the scenes that it was chosen on.
    """
    return loss >= (1 - SMALLEST_GAIN) * before and loss - own <= SMALLEST_GAP * loss


@phase("certificate")
def _gap_doubled(problem: SelectionProblem, further: Rays, count: int, shared: np.ndarray | None) -> float:
    """The gap of a choice among the candidates on the first scenes, against choices among twice as many."""
    own, rays = len(problem.rays), Rays.joined([problem.rays, further])
    doubled = replace(problem, rays=rays, visits=[slice(0, len(rays))])
    informed = doubled.inform(doubled.scenes("choice"), information.FEW_SCENES)
    coverage = doubled.coverage(informed, doubled.gates(rays, doubled.visits, informed))
    coverage = coverage if shared is None else coverage.through(shared[rays.sensor])
    limit = None if np.isinf(problem.limit_mbps) else problem.limit_mbps
    return gap_among_more(coverage, doubled.counts(count), np.arange(len(rays)) < own, limit)
