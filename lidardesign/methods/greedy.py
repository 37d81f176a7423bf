"""The method `greedy`: rays and gates chosen on training scenes as a design's are, but without any density.

Candidates are even over where training scenes return: on the lattice of `silhouette`, with free origins in the crops of
`bounding`. Rays and gates are chosen as by `fit`: by the task's information about
the same scenes, as many, and in the bandwidth of the design compared with. Where no design has gates per ray there is
one gate, that of the crops, whatever its bandwidth at equal rays.

Where the density has conditions, rays are chosen at each of their values, all of them at once: the bandwidth is a mean
over the values, and is spent where it gains most information.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lidardesign.methods.bounding import Crop, crop_kinds
from lidardesign.methods.fields import even_placement
from lidardesign.methods.laid_out import even_layout, most_within, rays_at
from lidardesign.methods.returns import RAY_AXES, TrainingReturns, returns_of, whole_range
from lidardesign.methods.silhouette import LEAST_SHARE, lattice_rays, survey
from lidardesign.numerics import COARSE_SLACK
from lidardesign.problem.method import INFORMS, Method
from lidardesign.problem.problem import DesignResult, Fired, Problem, ray_design
from lidardesign.rays.information import informs_rays
from lidardesign.rays.proposals import CANDIDATES_PER_RAY
from lidardesign.rays.training_scenes import CHOICE, SceneInformation, TrainingScenes
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays, fire_times
from lidardesign.scoring.fired import Positions
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import AZIMUTH, DesignSpace

if TYPE_CHECKING:
    from lidardesign.rays.coverage import Coverage
    from lidardesign.rays.selection import Selection

USUAL_SCENES = 200  # that rays are chosen on where no design has a number of its own
# Rays over all values of a condition: choosing more would take longer than all else in an evaluation.
MOST_CHOSEN = 2000
SMALLEST_SHARE = 0.1  # of even rays that return: where fewer do, candidates are those that return most often


class Greedy(Method):
    """The method: see `Method`."""

    name = "greedy"
    summary = "rays and gates chosen on training scenes as a design's are, without a density"
    needs = frozenset({INFORMS})

    def refuses(self, problem: Problem) -> str | None:
        """See `Method`: choosing many rays would take longer than all else in an evaluation."""
        world, most = problem.world, _most_rays(problem)
        if world.training is None:
            return ""
        if not informs_rays(world.task):
            return f"the task {world.task.name} has no method informs"
        return None if problem.asked <= most else f"choosing more than {most} rays takes too long"

    def design(self, problem: Problem) -> DesignResult | None:
        """See `Method`."""
        world, views = problem.world, returns_of(problem.world)
        if not len(views.observed(world.space)):
            found = world.known("even rays", lambda: even_layout(world.space)).within(problem)
            return None if found is None else DesignResult(ray_design(self.name, found, world))
        most = max(problem.asked, *(count for count in problem.compared.counts if count <= _most_rays(problem)), 1)
        choice = world.known((self.name, problem.gates, most), lambda: self._choice(problem, views, most))
        within = problem.rays is None
        lists = choice.positions_within(problem.limit_mbps) if within else choice.positions(problem.asked)
        return DesignResult(ray_design(self.name, lists, world))

    def _choice(self, problem: Problem, views: TrainingReturns, most: int) -> GreedyChoice:
        world, compared = problem.world, problem.compared
        scenes = [one["scenes"] for design in compared.designs for one in design.certificates]
        return GreedyChoice(
            views=views,
            spaces=world.spaces,
            training=world.training,
            scenes=max(scenes, default=USUAL_SCENES),
            gates_per_ray=problem.gates == "ray",
            candidates=CANDIDATES_PER_RAY * most,
            fired=compared.fired,
            bandwidth=problem.readout,
        )


def _most_rays(problem: Problem) -> int:
    return MOST_CHOSEN // len(problem.world.conditions)


GREEDY = Greedy()


class _Table(NamedTuple):
    """Information of all candidates about the training scenes through each of their gates, (N, G, 2) [m]."""

    selection: Selection
    coverage: Coverage
    gates_m: np.ndarray


@dataclass(frozen=True, eq=False)
class GreedyChoice:
    """Rays that are chosen for any number of them.

    Arguments:
        views: The training scenes, for their returns.
        spaces: The design space at each of the condition values.
        training: Scenes to choose on, as designs with chosen rays are chosen on.
        scenes: Number of scenes that rays are chosen on.
        gates_per_ray: Whether each ray has a gate of its own.
        candidates: Number of candidates at each of the values.
        fired: Rays and bandwidth of the designs compared with.
        bandwidth: The read-out model.
    """

    views: TrainingReturns
    spaces: Sequence[DesignSpace]
    training: TrainingScenes
    scenes: int
    gates_per_ray: bool
    candidates: int
    fired: Sequence[Fired]
    bandwidth: Bandwidth

    def positions(self, count: int) -> Positions:
        """So many rays at each value, in no more than the largest bandwidth of a design with as many."""
        limits = [one.mbps for one in self.fired if one.rays == count] if self.gates_per_ray else []
        return self._chosen(count, max(limits, default=np.inf))

    def positions_within(self, limit_mbps: float) -> Positions:
        """As many rays as the design of this bandwidth fires; with one gate as many as fit."""
        if self.gates_per_ray:
            return self._chosen(max(one.rays for one in self.fired if one.mbps == limit_mbps), limit_mbps)
        widths_m = np.concatenate([np.diff(rays.gate_m[:1]) for rays in self._proposed])
        fit = most_within(partial(self.bandwidth.mbps_of_widths, widths_m), limit_mbps * len(widths_m))
        most = min(MOST_CHOSEN // len(widths_m), *(len(rays) for rays in self._proposed))
        return self._chosen(most if fit is None else min(fit, most), np.inf)

    @cached_property
    def _chosen(self) -> Callable[[int, float], Positions]:
        """`_choose`, which is called once for a number and a bandwidth."""
        return cache(self._choose)

    def _choose(self, count: int, limit_mbps: float) -> Positions:
        """The choice of `count` rays at each value, within a bandwidth that is a mean over the values [Mbit/s]."""
        from lidardesign.rays.choice import choose, choose_within

        table, values = self._table, len(self.spaces)
        counts = table.selection.counts(count)
        with phase("choice"):
            choice = choose_within(table.coverage, counts, limit_mbps * values)
            if len(choice.rays) < count * values:
                # the least bandwidth of any design is one bin per ray
                choice = choose(table.coverage, counts, price=1 / COARSE_SLACK)
        gate_m = table.gates_m[choice.rays, choice.gate[choice.rays]]
        angles_rad = np.concatenate([rays.angles_rad for rays in self._proposed])[choice.rays]
        fired = replace(table.selection.rays.subset(choice.rays), gate_m=gate_m, angles_rad=angles_rad)
        time_s = fire_times(count, self.bandwidth.rate_hz)
        # candidates are in the order of the values, and as many are chosen at each
        places = np.arange(count * values).reshape(values, count)
        return tuple(replace(fired.subset(place), time_s=time_s) for place in places)

    @cached_property
    def _proposed(self) -> list[Rays]:
        """Candidates at each of the values, with the widest gates that they may have."""
        return [self._candidates(space) for space in self.spaces]

    def _candidates(self, space: DesignSpace) -> Rays:
        """Even candidates at a value, by its returns, or by those of all values where it has none."""
        views = self.views
        crops = self._crops(space) or self._crops(views.space)
        found = None
        if not any(axis < AZIMUTH for axis in space.free):
            found = survey(views, space) or survey(views, views.space)
        if found is not None:
            points = lattice_rays(found, self.candidates)
        else:
            each = math.ceil(self.candidates / len(crops))
            points = np.concatenate([self._returning(crop, each) for crop in crops])
        for axis in (axis for axis in views.space.conditioned if axis < RAY_AXES):
            points[:, axis] = np.clip(points[:, axis], space.low[axis], space.high[axis])
        ends = np.array([crop.gate_m for crop in crops])
        gate_m = np.array([ends[:, 0].min(), ends[:, 1].max()])
        return rays_at(points, whole_range(space) if self.gates_per_ray else gate_m)

    def _crops(self, space: DesignSpace) -> list[Crop]:
        observed = self.views.observed(space)
        crops = [crop_of(self.views, space, observed) for crop_of in crop_kinds(space).values() if len(observed)]
        return [crop for crop in crops if crop is not None]

    def _returning(self, crop: Crop, count: int) -> np.ndarray:
        """At least `count` even rays in a crop, those with the highest share of returns, (K, 5)."""
        place = partial(even_placement, crop.low, crop.high, field=crop.directions)
        share = float((self.views.returns(place(count)).share >= LEAST_SHARE).mean())
        points = place(math.ceil(count / max(share, SMALLEST_SHARE)))
        found = self.views.returns(points).share
        often = max(count, int((found >= LEAST_SHARE).sum()))
        return points[np.sort(np.argsort(-found, kind="stable")[:often])]

    @cached_property
    def _table(self) -> _Table:
        from lidardesign.rays.selection import Selection

        ends = np.cumsum([0, *map(len, self._proposed)]).tolist()
        visits = [slice(*pair) for pair in itertools.pairwise(ends)]
        selection = Selection(Rays.joined(self._proposed), visits, self._gates, self.bandwidth, name=GREEDY.name)
        informed = self.training.inform(CHOICE, selection.rays, visits, 0, self.scenes)
        gates_m = selection.gates(selection.rays, visits, informed)
        return _Table(selection, selection.coverage(informed, gates_m), gates_m)

    @phase("gates")
    def _gates(self, rays: Rays, visits: Sequence[slice], informed: Sequence[SceneInformation]) -> np.ndarray:
        """The gates of candidates to choose from, (N, G, 2) [m]; the last has one bin, for any design's bandwidth."""
        from lidardesign.rays.gates import gate_choices

        own = rays.gate_m[:, None]
        if not self.gates_per_ray:
            return own
        gates_m = gate_choices(rays, visits, informed, self.training.margin_m)
        middle, half = gates_m[:, -1:].mean(axis=2), self.bandwidth.bin_m / 2
        one_bin = np.stack([np.maximum(middle - half, 0.0), middle + half], axis=2)
        return np.concatenate([gates_m, one_bin], axis=1)
