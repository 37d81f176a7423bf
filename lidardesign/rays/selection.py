"""Rays chosen from candidates, for several numbers of rays: the fourth step from a density to rays.

Every number of rays is a choice of its own: after swaps, smaller choices are no prefixes of larger ones. The number of
scenes is doubled until the loss of a choice is little more on scenes held back than on its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK
from lidardesign.rays.certificate import certificate_document, certify, price_curve
from lidardesign.rays.choice import MOST_PASSES, Choice, RayCounts, choose, choose_within
from lidardesign.rays.coverage import Coverage, gather
from lidardesign.rays.information import CHOSEN_SHARE, FEW_SCENES, MOST_ENTRIES, MOST_SCENES
from lidardesign.rays.training_scenes import CHOICE, HELD_BACK, SceneInformation, TrainingScenes, are_enough
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import Bandwidth, split_budget

# Where bandwidth has no limit, ten percent more of it must bring two percent less loss or more worth.
SHARE_PER_BANDWIDTH = 0.2


@dataclass(frozen=True, eq=False)
class Selection:
    """A choice of rays to be made: candidates, their gates, and limits.

    Arguments:
        rays: Candidates with the widest gates that they may have.
        visits: Slices of them that fire at each value of a condition; one slice of all without a condition.
        gates: A few gates for each of some rays, (N, G, 2) [m], from their information about scenes.
        bandwidth: The read-out model.
        limit_mbps: The largest bandwidth; inf without a limit, where bits have a price [Mbit/s].
        shares: The share of the rays that each sensor fires, (S,); None leaves it to the choice.
        is_shared: Whether all rays of a sensor have one gate.
        each_fires: Whether every sensor has to fire a ray.
        may_fail: Whether the mean over the loss of each sensor counts as much as what all of them see together.
        share: The share of the candidates that is chosen, at the largest number of rays.
        name: Of the design, for messages.
    """

    rays: Rays
    visits: Sequence[slice]
    gates: Callable[[Rays, Sequence[slice], Sequence[SceneInformation]], np.ndarray]
    bandwidth: Bandwidth
    limit_mbps: float = np.inf
    shares: np.ndarray | None = None
    is_shared: bool = False
    each_fires: bool = False
    may_fail: bool = False
    share: float = CHOSEN_SHARE
    name: str = "rays"

    def counts(self, count: int, visit: slice = slice(None)) -> RayCounts:
        """Numbers of candidates, or of a slice of them, to choose at each value of a condition."""
        place = np.repeat(np.arange(len(self.visits)), [one.stop - one.start for one in self.visits])[visit]
        if self.shares is None:
            owner = self.rays.sensor[visit] if self.each_fires else None
            return RayCounts(place, np.full(len(self.visits), count), owner)
        most = np.tile(split_budget(self.shares, count, each=self.each_fires), len(self.visits))
        return RayCounts(place * len(self.shares) + self.rays.sensor[visit], most)

    def coverage(self, informed: Sequence[SceneInformation], gates_m: np.ndarray) -> Coverage:
        """Information of the candidates about scenes, with the bandwidth of their gates."""
        one_bin = self.bandwidth.mbps_of_widths(np.zeros(1))
        whole = gather(informed, gates_m, one_bin * self.bandwidth.bins(gates_m[..., 1] - gates_m[..., 0]))
        return whole.with_losses(self.rays.sensor, int(self.rays.sensor.max()) + 1) if self.may_fail else whole

    def check_informative(self, coverage: Coverage, scenes: int) -> None:
        """Refuse candidates without any information.

        Raises:
            InfeasibleError: None informs about any item.
        """
        if not len(coverage.item):
            raise InfeasibleError(
                f"none of {len(self.rays)} candidate rays has information about {scenes} training scenes",
                where=self.name,
                hint="let sensors look at the targets: from another place, constrained less, or learn longer",
            )

    @phase("choice")
    def choices(self, coverage: Coverage, count: int, passes: int = MOST_PASSES) -> list[Choice]:
        """The choice of `count` rays within the bandwidth, at each value of a condition.

        Arguments:
            coverage: Information of the candidates.
            count: Number of rays.
            passes: Largest number of swaps of each ray.

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
        """The price of bandwidth, from a share of the remaining loss or of the net worth, whichever is less.

        The net worth is that of a choice without a price, less its harm. Where little can be known, nearly all loss
        remains, and a share of it would price out informative rays; at a share of the worth the best choice gives up no
        more than this share.
        """
        free = choose(coverage, self.counts(count), passes=0)
        gained = free.worth - free.harm
        smaller = max(min(coverage.complete - gained, gained), 0.0)
        return SHARE_PER_BANDWIDTH * smaller / free.bits if free.bits > 0 else 0.0

    @phase("certificate")
    def certified(self, coverage: Coverage, choices: Sequence[Choice]) -> tuple[float, float]:
        """The loss of choices, and a lower bound of the loss of any others of no more bandwidth.

        Values of a condition share no items, so their losses sum.
        """
        limit, worth, gap = None if np.isinf(self.limit_mbps) else self.limit_mbps, 0.0, 0.0
        for visit, choice in zip(self.visits, choices, strict=True):
            own, counts = coverage.of_rays(visit), self.counts(len(choice.rays), visit)
            value, bound = certify(own, counts, choice, budget_mbps=limit)
            worth, gap = worth + choice.worth - choice.harm, gap + bound - value
        loss = coverage.complete - worth
        return loss, min(max(loss - gap, 0.0), loss)  # losses are not negative


def _shared_gates(coverage: Coverage, choice: Choice, sensor: np.ndarray, limit_mbps: float) -> np.ndarray:
    """The best common gate of each sensor's chosen rays, (S,), by coordinate ascent over sensors.

    Arguments:
        coverage: Information of the candidates through their sensors' gates, from wide to narrow.
        choice: A choice of rays with gates of their own, and the price of bandwidth.
        sensor: The sensor of each candidate, (N,).
        limit_mbps: The largest bandwidth; gates are narrowed until they keep it [Mbit/s].
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
    """Chosen rays with their certificate.

    Arguments:
        rays: The rays of each value of a condition, in the order of their sensors.
        certificate: `value` and `bound` of the loss on the scenes chosen on, `gap`, `held_back_value`, the numbers of
            `rays`, `candidates`, `gates` and `scenes`, and `curve`, the price curve as pairs of Mbit/s and loss; None
            where it was not asked for.
        silent: The share of scenes held back about which the rays have no information.
        choice: The choice of all candidates, with its price of bandwidth.
        gates_m: The gates of candidates that it chooses from, (N, G, 2) [m].
    """

    rays: Sequence[Rays]
    certificate: dict[str, Any] | None
    silent: float
    choice: Choice
    gates_m: np.ndarray


def select(
    selection: Selection,
    informed: Sequence[SceneInformation],
    held_back: Sequence[SceneInformation],
    counts: Sequence[int],
    certified: Sequence[int] = (),
    progress: Callable[[str], None] = lambda step: None,
) -> list[Selected]:
    """The rays that are chosen at each of some numbers of rays, ascending.

    Arguments:
        selection: The candidates and limits.
        informed: Information about the scenes that they are chosen on.
        held_back: Information about scenes that are held back.
        counts: Numbers of rays.
        certified: Those of them for which a bound is found.
        progress: Called with every step.

    Raises:
        InfeasibleError: No candidate has information about the scenes, or no choice of so many rays fits within the
            bandwidth.
    """
    gates_m = selection.gates(selection.rays, selection.visits, informed)
    coverage, judged = selection.coverage(informed, gates_m), selection.coverage(held_back, gates_m)
    selection.check_informative(coverage, len(informed))
    rays = selection.rays
    if selection.is_shared:
        # swaps hardly change the best common gates
        choices = selection.choices(coverage, counts[len(counts) // 2], passes=0)
        choice = replace(choices[0], gate=_gate_of(choices))
        own = _shared_gates(coverage, choice, rays.sensor, selection.limit_mbps)[rays.sensor]
        coverage, judged = coverage.through(own), judged.through(own)
        gates_m = gates_m[np.arange(len(rays)), own][:, None]
    selected = []
    for count in counts:
        progress(f"choosing {count} rays")
        choices = selection.choices(coverage, count)
        gate = _gate_of(choices)
        tables = []
        for visit, choice in zip(selection.visits, choices, strict=True):
            chosen = visit.start + choice.rays
            chosen = chosen[np.lexsort((chosen, rays.sensor[chosen]))]
            tables.append(replace(rays.subset(chosen), gate_m=gates_m[chosen, gate[chosen]]).as_angles())
        document = None
        if count in certified:
            value, bound = selection.certified(coverage, choices)
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
            document["curve"] = price_curve(coverage, selection.counts(count), len(selection.visits))
        fired = np.where(gate[:, None] >= 0, gates_m[np.arange(len(rays)), gate], 0.0)
        silent = silent_share(held_back, fired)
        selected.append(Selected(tables, document, silent, replace(choices[0], gate=gate), gates_m))
    return selected


def silent_share(scenes: Sequence[SceneInformation], gate_m: np.ndarray) -> float:
    """The share of scenes without an informative return inside its ray's gate, 0 without scenes.

    Arguments:
        scenes: Information of all rays through open gates.
        gate_m: The gate of each ray, closed where it does not fire, (N, 2) [m].
    """
    heard = [(gate_m[one.ray, 0] <= one.range_m) & (one.range_m < gate_m[one.ray, 1]) for one in scenes]
    return float(np.mean([not through.any() for through in heard])) if heard else 0.0


def inform_enough(
    selection: Selection, training: TrainingScenes, count: int, progress: Callable[[str], None]
) -> tuple[list[SceneInformation], list[SceneInformation]]:
    """Information of candidates about as many scenes as a choice of `count` rays needs, and about scenes held back.

    Arguments:
        selection: The candidates.
        training: The scenes.
        count: Number of rays that will fire.
        progress: Called with every step.

    Raises:
        InfeasibleError: No candidate has information about the scenes.
    """
    rays, visits = selection.rays, selection.visits
    # with several values of a condition each sees little of a scene
    most_scenes = MOST_SCENES * (1 + (len(visits) > 1))
    # the scenes needed hardly depend on gates, bits and sensors: the cached information serves other choices too
    selection = Selection(rays, visits, selection.gates, Bandwidth(), share=selection.share, name=selection.name)
    open_gates = rays.gate_m[:, None]
    held_back = training.inform(HELD_BACK, rays, visits, 0, FEW_SCENES, selection.share)
    judged = selection.coverage(held_back, open_gates)
    informed: list[SceneInformation] = []
    wanted, loss = 2 * FEW_SCENES, np.inf
    while True:
        progress(f"finding out what {len(rays)} rays tell about {wanted} training scenes")
        informed += training.inform(CHOICE, rays, visits, len(informed), wanted, selection.share)
        coverage = selection.coverage(informed, open_gates)
        selection.check_informative(coverage, wanted)
        gate = _gate_of(selection.choices(coverage, count, passes=0))
        before, loss = loss, judged.loss_of(gate)
        is_large = 2 * wanted > most_scenes or 2 * len(coverage.item) > MOST_ENTRIES
        if is_large or are_enough(before, loss, coverage.loss_of(gate)):
            return informed, held_back
        wanted *= 2
