"""The baseline `greedy`: rays and gates chosen on training scenes as a design's are, but without any density.

Candidates are even over where training scenes return: on the lattice of `silhouette`, with free origins in the crops of
`bounding`. Which of them fire, and through which gates, is chosen as by `fit --layout selected`: by what the task says
that returns tell about scenes, of the same scenes, as many, and in the bandwidth of the design beside it. Where no
design has gates per ray there is one gate, that of the crops, and at equal rays it costs what it costs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.errors import InfeasibleError
from lidardesign.evaluate.baselines.bounding import Crop, crop_kinds
from lidardesign.evaluate.baselines.candidates import RaysPerCondition, rays_at, rays_within, whole_range
from lidardesign.evaluate.baselines.even import even_placement
from lidardesign.evaluate.baselines.silhouette import LEAST_SHARE, lattice_rays, survey
from lidardesign.evaluate.baselines.views import TrainingViews
from lidardesign.geometry.rays import Rays, fire_times
from lidardesign.numerics import COARSE_SLACK
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, DesignSpace
from lidardesign.task import Task

if TYPE_CHECKING:
    from lidardesign.selection.coverage import Coverage, InformedScene
    from lidardesign.selection.select import SelectionProblem

GREEDY = "greedy"
USUAL_SCENES = 200  # that rays are chosen on where no design says on how many it was
MOST_CHOSEN = 2000  # rays: choosing more would take longer than all else in an evaluation
SMALLEST_SHARE = 0.1  # of even rays that return: where fewer do, candidates are those that return most often


class GreedySource(NamedTuple):
    """What rays are chosen by, beside the task.

    Arguments:
        scenes: Training scenes without end for a purpose, as designs with chosen rays are chosen on.
        margin_m: By how much gates that hold all of a ray's returns are longer at both ends.
    """

    scenes: Callable[[str], Iterator[Scene]]
    margin_m: float


def greedy_rays(task: Task, space: DesignSpace, counts: Iterable[int]) -> tuple[list[int], list[str]]:
    """The numbers of rays that `greedy` can choose, and why not the others, for people."""
    from lidardesign.selection.information import informs_rays

    if not informs_rays(task):
        return [], [f"{GREEDY} is left out: the task {task.name} does not say what returns tell"]
    if space.conditioned:
        return [], [f"{GREEDY} is left out: it does not go with conditions yet"]
    beyond = any(count > MOST_CHOSEN for count in counts)
    notes = [f"{GREEDY} is left out above {MOST_CHOSEN} rays: choosing them takes too long"] if beyond else []
    return [count for count in counts if count <= MOST_CHOSEN], notes


class Fired(NamedTuple):
    """What a design beside it fires: a number of rays in a bandwidth [Mbit/s]."""

    rays: int
    mbps: float


class _Table(NamedTuple):
    """What all candidates tell about the training scenes through each of their gates, (N, G, 2) [m]."""

    problem: SelectionProblem
    coverage: Coverage
    gates_m: np.ndarray


@dataclass(frozen=True, eq=False)
class GreedyCandidate:
    """Chosen rays as a baseline's layout.

    Arguments:
        task: Says what returns tell.
        views: The training scenes, for where they return.
        source: Scenes to choose on, and the margin of gates.
        scenes: On how many scenes rays are chosen.
        gates_per_ray: Whether each ray has a gate of its own.
        candidates: How many rays are chosen from.
        fired: What the designs beside it fire.
        bandwidth: The read-out model.
    """

    name: ClassVar[str] = GREEDY
    drawn_anew: ClassVar[bool] = False
    task: Task
    views: TrainingViews
    source: GreedySource
    scenes: int
    gates_per_ray: bool
    candidates: int
    fired: Sequence[Fired]
    bandwidth: Bandwidth
    _known: dict[tuple[int, float], Rays] = field(default_factory=dict, repr=False)

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> RaysPerCondition:
        """See `Candidate`; in no more than the largest bandwidth of a design with so many rays."""
        limits = [one.mbps for one in self.fired if one.rays == count] if self.gates_per_ray else []
        return self._chosen(count, max(limits, default=np.inf))

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> RaysPerCondition:
        """As many rays as the design of this bandwidth fires; with one gate as many as fit."""
        if self.gates_per_ray:
            return self._chosen(max(one.rays for one in self.fired if one.mbps == limit_mbps), limit_mbps)
        fit = rays_within(limit_mbps, bandwidth, self._rays.gate_m[0])
        return self._chosen(min(fit, len(self._rays), MOST_CHOSEN), np.inf)

    def _chosen(self, count: int, limit_mbps: float) -> RaysPerCondition:
        """The choice of so many rays in a bandwidth [Mbit/s]."""
        if (count, limit_mbps) not in self._known:
            self._known[count, limit_mbps] = self._choice(count, limit_mbps)
        return (self._known[count, limit_mbps],)

    def _choice(self, count: int, limit_mbps: float) -> Rays:
        from lidardesign.selection.choice import RayCounts, choose

        table = self._table
        try:
            (choice,) = replace(table.problem, limit_mbps=limit_mbps).choices(table.coverage, count)
        except InfeasibleError:
            # no design spends less than one bin per ray
            choice = choose(table.coverage, RayCounts.of_one(len(self._rays), count), price=1 / COARSE_SLACK)
        return replace(
            self._rays.subset(choice.rays),
            gate_m=table.gates_m[choice.rays, choice.gate[choice.rays]],
            time_s=fire_times(count, self.bandwidth.rate_hz),
        )

    @cached_property
    def _rays(self) -> Rays:
        """Even candidates, each with the widest gate that it may have."""
        space = self.views.space
        crops = self._crops
        free_origins = [axis for axis in space.free if axis < AZIMUTH]
        found = None if free_origins else survey(self.views, space)
        if found is not None:
            points = lattice_rays(found, self.candidates)
        else:
            each = math.ceil(self.candidates / len(crops))
            points = np.concatenate([self._returning(crop, each) for crop in crops])
        ends = np.array([crop.gate_m for crop in crops])
        gate_m = np.array([ends[:, 0].min(), ends[:, 1].max()])
        return rays_at(points, whole_range(space) if self.gates_per_ray else gate_m)

    @cached_property
    def _crops(self) -> list[Crop]:
        space, observed = self.views.space, self.views.observed(self.views.space)
        crops = [crop_of(self.views, space, observed) for crop_of in crop_kinds(space).values() if len(observed.points)]
        return [crop for crop in crops if crop is not None]

    def _returning(self, crop: Crop, count: int) -> np.ndarray:
        """At least so many even rays in a crop, those in whose place scenes return most often, (K, 5)."""
        place = partial(even_placement, crop.low, crop.high, field=crop.directions)
        share = float((self.views.returns(place(count)).share >= LEAST_SHARE).mean())
        points = place(math.ceil(count / max(share, SMALLEST_SHARE)))
        found = self.views.returns(points).share
        often = max(count, int((found >= LEAST_SHARE).sum()))
        return points[np.sort(np.argsort(-found, kind="stable")[:often])]

    @cached_property
    def _table(self) -> _Table:
        from lidardesign.selection.information import checked_information
        from lidardesign.selection.select import SelectionProblem

        problem = SelectionProblem(
            rays=self._rays,
            visits=[slice(0, len(self._rays))],
            shares=None,
            gates=self._gates,
            informs=partial(checked_information, self.task),
            scenes=self.source.scenes,
            bandwidth=self.bandwidth,
            limit_mbps=np.inf,
            one_gate=False,
            name=GREEDY,
        )
        informed = problem.inform(problem.scenes("choice"), self.scenes)
        gates_m = problem.gates(self._rays, problem.visits, informed)
        return _Table(problem, problem.coverage(informed, gates_m), gates_m)

    @phase("gates")
    def _gates(self, rays: Rays, visits: Sequence[slice], informed: Sequence[InformedScene]) -> np.ndarray:
        """The gates that candidates may have, (N, G, 2) [m]; the last is of one bin, so that any design's bits do."""
        from lidardesign.selection.candidates import gate_choices

        own = rays.gate_m[:, None]
        if not self.gates_per_ray:
            return own
        gates_m = gate_choices(rays, visits, informed, self.source.margin_m)
        middle, half = gates_m[:, -1:].mean(axis=2), self.bandwidth.bin_m / 2
        one_bin = np.stack([np.maximum(middle - half, 0.0), middle + half], axis=2)
        return np.concatenate([gates_m, one_bin], axis=1)
