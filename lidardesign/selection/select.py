"""Rays chosen from candidates on as many training scenes as it takes, for several numbers of rays.

Scenes cost a cast each, so choices rest on many more of them than a density is learned from: they are doubled until the
loss on scenes held back gains little. Every number of rays is a choice of its own: swaps leave no prefixes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.errors import DataError, InfeasibleError
from lidardesign.geometry.rays import Rays, Returns
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.selection.candidates import InformedScene, inform
from lidardesign.selection.certificate import certify
from lidardesign.selection.choice import Choice, RayCounts, choose, choose_within
from lidardesign.selection.coverage import Coverage, gather
from lidardesign.selection.curve import gap_among_more, price_curve
from lidardesign.task import Information

FIRST_SCENES, MOST_SCENES, HELD_BACK_SCENES = 50, 400, 50
PROXY = "mean over items of what the returns of the chosen rays leave unknown, by informs of the task"
SMALLEST_GAIN = 0.01  # of the held-back loss: what twice the scenes must gain


@dataclass(frozen=True, eq=False)
class SelectionProblem:
    """What rays are chosen from, and for.

    Arguments:
        rays: Candidates with the widest gates that they may have.
        gates: A few gates for each of some rays, (N, G, 2) [m], of what their returns tell about scenes.
        informs: What a task says of a scene's returns.
        scenes: Training scenes without end for a purpose, `choice` or `held back`.
        bandwidth: What reading out costs.
        limit_mbps: The most that it may cost, inf without a limit.
        name: Of the design, for messages.
        further: As many rays again, which may not be chosen: a certificate says what they would gain.
    """

    rays: Rays
    gates: Callable[[Rays, Sequence[InformedScene]], np.ndarray]
    informs: Callable[[Scene, Sequence[Returns]], Information]
    scenes: Callable[[str], Iterator[Scene]]
    bandwidth: Bandwidth
    limit_mbps: float
    name: str
    further: Rays | None = None

    @phase("what returns tell")
    def inform(self, scenes: Iterator[Scene], count: int) -> list[InformedScene]:
        """What the task says of the next so many scenes; they are not kept."""
        return [inform(scene, self.rays, self.informs) for scene in itertools.islice(scenes, count)]

    def coverage(self, informed: Sequence[InformedScene], gates_m: np.ndarray) -> Coverage:
        """What the candidates tell about scenes, with the cost of their gates."""
        one_bin = self.bandwidth.mbps_of_widths(np.zeros(1))
        return gather(informed, gates_m, one_bin * self.bandwidth.bins(gates_m[..., 1] - gates_m[..., 0]))

    @phase("choice")
    def choice(self, coverage: Coverage, count: int) -> Choice:
        """The choice of so many rays within the bandwidth.

        Raises:
            InfeasibleError: So many rays do not fit.
        """
        counts = RayCounts.of_one(len(self.rays), count)
        limit = self.limit_mbps
        choice = choose(coverage, counts) if np.isinf(limit) else choose_within(coverage, counts, limit)
        if len(choice.rays) < count:
            raise InfeasibleError(
                f"{len(choice.rays)} of {count} rays fit in {limit:g} Mbit/s",
                conflicts=["budget.bandwidth_mbps"],
                hint=f"fewer rays, or a larger bandwidth, for {self.name}",
            )
        return choice


@dataclass(frozen=True, eq=False)
class Selected:
    """Chosen rays, and how far from the best they may be.

    Arguments:
        rays: In the order of their sensors.
        certificate: `value` and `bound` of the loss on the scenes chosen on, `gap`, `held_back_value`, and the numbers
            of `rays`, `candidates`, `gates` and `scenes`; at the middle number of rays `gap_doubled`, the gap with
            candidates doubled, and `curve`, the price curve as pairs of Mbit/s and loss.
    """

    rays: Rays
    certificate: dict[str, Any]


def select(problem: SelectionProblem, counts: Sequence[int]) -> list[Selected]:
    """The rays that are chosen at each number of rays.

    Raises:
        DataError: No candidate tells anything about the scenes.
        InfeasibleError: A bandwidth in which no choice of so many rays fits.
    """
    rays, middle = problem.rays, counts[len(counts) // 2]
    held_back = problem.inform(problem.scenes("held back"), HELD_BACK_SCENES)
    informed: list[InformedScene] = []
    scenes = problem.scenes("choice")
    wanted, loss = FIRST_SCENES, np.inf
    while True:
        informed += problem.inform(scenes, wanted - len(informed))
        gates_m = problem.gates(rays, informed)
        coverage, judged = problem.coverage(informed, gates_m), problem.coverage(held_back, gates_m)
        if not len(coverage.item):
            raise DataError(
                f"none of {len(rays)} candidate rays tells anything about {len(informed)} training scenes",
                where=problem.name,
                hint="let sensors look at the targets: constrain less, or learn longer",
            )
        before, loss = loss, judged.loss_of(problem.choice(coverage, middle).gate)
        if loss > (1 - SMALLEST_GAIN) * before or 2 * wanted > MOST_SCENES:
            break
        wanted *= 2
    selected = []
    for count in counts:
        choice = problem.choice(coverage, count)
        with phase("certificate"):
            limit = None if np.isinf(problem.limit_mbps) else problem.limit_mbps
            certificate = certify(coverage, RayCounts.of_one(len(rays), count), choice, budget_mbps=limit)
        chosen = choice.rays[np.lexsort((choice.rays, rays.sensor[choice.rays]))]
        table = replace(rays.subset(chosen), gate_m=gates_m[chosen, choice.gate[chosen]]).as_angles()
        document = {
            "rays": count,
            "value": float(coverage.complete - certificate.value),
            "bound": float(coverage.complete - certificate.bound),
            "gap": float(certificate.gap(coverage.complete)),
            "held_back_value": float(judged.loss_of(choice.gate)),
            "candidates": len(rays),
            "gates": gates_m.shape[1],
            "scenes": len(informed),
            "proxy": PROXY,
            "unit": informed[0][0].unit,
        }
        if count == middle:
            document["curve"] = price_curve(coverage, RayCounts.of_one(len(rays), count))
            if problem.further is not None:
                document["gap_doubled"] = _gap_doubled(problem, problem.further, count)
        selected.append(Selected(table, document))
    return selected


@phase("certificate")
def _gap_doubled(problem: SelectionProblem, further: Rays, count: int) -> float:
    """The gap of a choice among the candidates on the first scenes, against choices among twice as many."""
    own = len(problem.rays)
    doubled = replace(problem, rays=Rays.joined([problem.rays, further]))
    informed = doubled.inform(doubled.scenes("choice"), FIRST_SCENES)
    coverage = doubled.coverage(informed, doubled.gates(doubled.rays, informed))
    limit = None if np.isinf(problem.limit_mbps) else problem.limit_mbps
    counts = RayCounts.of_one(len(doubled.rays), count)
    return gap_among_more(coverage, counts, np.arange(len(doubled.rays)) < own, limit)
