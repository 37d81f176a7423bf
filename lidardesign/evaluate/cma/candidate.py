"""The baseline `cma`: what direct optimisation of the metric finds, within a budget of time per number of rays.

It varies the sensors that the first design has, under the design's constraints and with its layout of rays, and asks
the task's metric on training scenes alone (see `lidardesign.evaluate.cma.search`). A scan and a track are followed ray
by ray, every other design with even rays from a point of each sensor in its field of view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.constraints.check import check_design
from lidardesign.design.constraints.document import Constraints, Gate
from lidardesign.design.constraints.origins import mounts_of
from lidardesign.design.files import design_document
from lidardesign.design.layouts.rays import layout_of
from lidardesign.design.sensor import MOST_RAYS, DesignSpec
from lidardesign.errors import BackgroundNote
from lidardesign.evaluate.baselines.candidates import RaysPerCondition, opened_gate, whole_range
from lidardesign.evaluate.baselines.simple import CMA
from lidardesign.evaluate.baselines.views import TrainingViews
from lidardesign.evaluate.cma.model import DesignModel, RayAllowance, SearchRules
from lidardesign.evaluate.cma.search import Progress, Search, SearchBudget, SearchResult, TrainingObjective
from lidardesign.evaluate.cma.starts import starts
from lidardesign.numerics import COARSE_SLACK
from lidardesign.run.clock import phase
from lidardesign.simulate.detector.detector import IDEAL
from lidardesign.space import DesignSpace
from lidardesign.task import Metric, random_generator

# A scan within a bandwidth has at most so many times the rays of the design that it follows.
MOST_RAYS_FACTOR = 4

DEFAULT_SECONDS = 60.0

Show = Callable[[str, Progress], None]


@dataclass(frozen=True)
class CmaSettings:
    """How the baseline `cma` searches.

    Arguments:
        budget: Of each search: every number of rays, and every bandwidth, is one.
        show: Told where each search stands, with what it is for.
    """

    budget: SearchBudget = field(default_factory=lambda: SearchBudget(DEFAULT_SECONDS))
    show: Show | None = None


@dataclass(frozen=True, eq=False)
class SearchRecord:
    """A search and what came of it.

    Arguments:
        rays: The number of rays that it ended with.
        limit_mbps: The bandwidth that it kept to; None: it was asked for this number of rays.
        found: What it found.
        broken: Names of constraints that the independent checker says are broken: none.
        sensors: How many sensors it varied.
    """

    rays: int
    limit_mbps: float | None
    found: SearchResult
    broken: Sequence[str]
    sensors: int

    def note(self, followed: str, metric: Metric) -> str:
        """What people are told of it.

        Arguments:
            followed: The name of the design whose sensors it varied.
            metric: Of the values.
        """
        found = self.found
        limit = "" if self.limit_mbps is None else f" in {self.limit_mbps:.3g} Mbit/s"
        broken = f"; it breaks {', '.join(self.broken)}" if self.broken else ""
        kind = str if self.broken else BackgroundNote
        return kind(
            f"cma at {self.rays} rays{limit}: {found.model.size} numbers of the sensors of {followed} varied for "
            f"{found.seconds:.0f} s, {found.candidates} candidates, {found.start_value:.4g} to {found.value:.4g} "
            f"{metric.unit} on {found.scenes} training scenes{broken}"
        )

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        found = self.found
        return {
            "rays": self.rays,
            "limit_mbps": self.limit_mbps,
            "sensors": self.sensors,
            "parameters": found.model.size,
            "seconds": found.seconds,
            "cpu_seconds": found.cpu_seconds,
            "candidates": found.candidates,
            "evaluations": found.evaluations,
            "restarts": found.restarts,
            "training_scenes": found.scenes,
            "start_value": found.start_value,
            "value": found.value,
            "satisfied": not self.broken,
            "broken": list(self.broken),
        }


@dataclass(eq=False)
class CmaCandidate:
    """The layout of the baseline `cma`; every number of rays and every bandwidth is a search of its own.

    Arguments:
        followed: The design whose sensors, constraints and layout are taken.
        space: The design space.
        conditions: The condition values that rays are laid out at.
        views: The training scenes.
        objective: The metric on them.
        settings: How long each search takes.
        seed: Root of the random numbers.
    """

    followed: DesignSpec
    space: DesignSpace
    conditions: Sequence[Mapping[str, float]]
    views: TrainingViews
    objective: TrainingObjective
    settings: CmaSettings
    seed: int
    name: str = CMA
    drawn_anew: bool = False
    _known: dict[tuple[int | None, float | None], tuple[RaysPerCondition, SearchRecord]] = field(default_factory=dict)

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> RaysPerCondition:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`."""
        return self._searched(RayAllowance(count))

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> RaysPerCondition:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`: the number of rays is part of what is searched."""
        return self._searched(RayAllowance(None, limit_mbps, bandwidth))

    @phase("cma")
    def _searched(self, rays: RayAllowance) -> RaysPerCondition:
        key = rays.count, rays.limit_mbps
        if key not in self._known:
            budget, show_search = self.settings.budget, self.settings.show
            began, models = budget.clock(), self._models(rays)
            generator = random_generator(self.seed, "cma", str(key))
            label = f"cma, {rays.count} rays" if rays.count else f"cma, {rays.limit_mbps:.3g} Mbit/s"
            show = None if show_search is None else (lambda progress: show_search(label, progress))
            found = Search(models, rays, self.objective, budget, generator, show, began).run()
            positions = found.model.positions(found.vector, rays)
            if not self._varies_gates(rays):
                positions = self._cropped(positions, found.scenes)
            self._known[key] = positions, self._record(found, rays)
        return self._known[key][0]

    def record_of(self, positions: RaysPerCondition) -> SearchRecord | None:
        """How these rays were found."""
        return next((record for known, record in self._known.values() if known is positions), None)

    def _varies_gates(self, rays: RayAllowance) -> bool:
        """Whether a wider gate could be worse: where it costs, where it is bounded, or where light is counted."""
        common = self._constraints
        bounded = any(one.gate != Gate() for one in (common, *common.each))
        counted = self.objective.planner.detector != IDEAL
        return counted or bounded or rays.limit_mbps is not None or common.budget.bandwidth_mbps is not None

    def _cropped(self, positions: RaysPerCondition, scenes: int) -> RaysPerCondition:
        """The same rays with gates from the nearest to the furthest return that their sensor had."""
        sensor, range_m = self.objective.returned(positions, range(scenes))
        gates = np.tile(whole_range(self.space), (int(max(rays.sensor.max() for rays in positions)) + 1, 1))
        for index in np.unique(sensor):
            own = range_m[sensor == index]
            # rounding must not cut the outermost returns off
            gates[index] = opened_gate((1 - COARSE_SLACK) * float(own.min()), (1 + COARSE_SLACK) * float(own.max()))
        return tuple(replace(rays, gate_m=gates[rays.sensor]) for rays in positions)

    def _record(self, found: SearchResult, rays: RayAllowance) -> SearchRecord:
        designs, space = found.model.designs(found.vector, rays), self._rules(rays).space
        checks = [
            check for one in designs if one.rays for check in check_design(design_document(one), one.constraints, space)
        ]
        broken = list(dict.fromkeys(check.name for check in checks if not check.satisfied))
        return SearchRecord(designs[0].rays or 0, rays.limit_mbps, found, broken, len(designs[0].sensors))

    @cached_property
    def _document(self) -> dict[str, Any]:
        """The followed design's constraints; the number of rays is that of the comparison."""
        document = dict(self.followed.constraints)
        if "budget" in document:
            document["budget"] = {key: value for key, value in document["budget"].items() if key != "rays"}
        return document

    @cached_property
    def _constraints(self) -> Constraints:
        return Constraints.from_mapping(self._document, where=f"constraints of {self.followed.name}")

    def _rules(self, rays: RayAllowance) -> SearchRules:
        design, space = self.followed, self.space
        if space.conditioned:
            bolted = self.conditions[len(self.conditions) // 2] if design.track is None else {}
            space = space.at({**bolted, **design.at})
        standing = any(mounts_of(one) or one.origin.exclude for one in self._constraints.rules)
        return SearchRules(
            space,
            self._constraints,
            design.level,
            design.track is not None or layout_of(design).one_sensor_per_ray,
            design.at,
            self._varies_gates(rays),
            np.array([sensor.origin_m for sensor in design.sensors]) if standing else None,
        )

    def _models(self, rays: RayAllowance) -> list[DesignModel]:
        """Every start as a model whose vector 0 it is."""
        rules, views, track = self._rules(rays), self.views, self.followed.track
        if rules.space != views.space:
            views = TrainingViews(rules.space, views.train)
        if track is None:
            count = self._scan_rays(rays) if rules.one_sensor_per_ray else len(self.followed.sensors)
            return [DesignModel(rules, start, self.conditions, self._document) for start in starts(rules, views, count)]
        way = track.dimension, float(track.knots[0]), float(track.knots[-1])
        middle = replace(rules, space=rules.space.at({track.dimension: (way[1] + way[2]) / 2}))
        return [
            DesignModel(rules, [*start, *start], self.conditions, self._document, way)
            for start in starts(middle, views, self._scan_rays(rays))
        ]

    def _scan_rays(self, rays: RayAllowance) -> int:
        """The number of rays of a scan: as asked, or what a bandwidth pays for at the followed design's gates."""
        if rays.count is not None:
            return rays.count
        track = self.followed.track
        gates_m = np.array([sensor.gate_m for sensor in self.followed.sensors]) if track is None else track.gate_m
        widths = np.diff(gates_m)[..., 0].reshape(-1, gates_m.shape[-2]).mean(axis=0)
        affordable = math.floor(len(widths) * (rays.limit_mbps or 0.0) / rays.bandwidth.mbps_of_widths(widths))
        return int(np.clip(affordable, 1, min(MOST_RAYS, MOST_RAYS_FACTOR * len(widths))))
