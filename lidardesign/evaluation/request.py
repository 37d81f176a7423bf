"""The request of an evaluation.

Numbers of rays of designs: a fixed pattern fires all its rays, or an even subset where only fewer are asked for.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from lidardesign.errors import ConfigError, PluginError
from lidardesign.evaluation.mounting import MountError
from lidardesign.problem.method import METHODS
from lidardesign.problem.world import World
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.samples import Samples
from lidardesign.scenes.scene import Scene
from lidardesign.scoring.scene_scores import Preparation, TrainingScorer
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.plan import Planner
from lidardesign.space import DesignSpace
from lidardesign.task import Metric, Task, mount_of
from lidardesign.workers import Starmap

# In the place of names: no baselines at all.
NONE = "none"
# What stands beside every design, asked for or not.
ALWAYS = ("uniform", "random", "bounding", "silhouette", "greedy")
# Fixed patterns of more rays are scored without baselines, unless their number is asked for: some have 100,000.
MOST_SHARED = 2000


@dataclass(frozen=True, eq=False)
class EvaluationRequest:
    """A whole request of an evaluation.

    Arguments:
        task: The task that scores.
        config: The task's configuration; its condition values are evaluated at.
        space: The design space that baselines fill.
        seed: Root of the drawn baselines.
        designs: The designs, by distinct names that are no baseline's.
        rays: Numbers of rays per frame; with conditions, per condition value. See `numbers_fired`.
        baselines: Names of baselines.
        bandwidth: The read-out model.
        equal_bandwidth: Whether baselines are also given each design's bandwidth.
        train, test: Training scenes (for baselines) and held-out scenes.
        without_visibility: Fits the design that stands for the baseline `no-visibility`, with so many rays within a
            bandwidth [Mbit/s] or without a limit; None where there is none.
        density: Samples of what was learned, for figures; None where a run has none.
        training: Scenes that the baseline `greedy` chooses on; None: it is left out.
        settings: Settings of methods by their names.
        planner: The detector, and how the effects that are simulated are chosen.
        audit: Whether all rows are scored under all effects too.
        mount_error: Mounting errors of sensors in further rows; None: there are none.
        losses: Whether all designs are scored with each of their sensors lost, not those alone that are made for it.
        starmap: How held-out scenes are scored: in this process, or by workers, to the same numbers.
        scenes_seed: Root of the held-out scenes; None: `seed`.
        alone: Those numbers of rays at which fixed patterns are evaluated without baselines and other designs.
        named: Baselines that were asked for, which summaries show.
    """

    task: Task
    config: Any
    space: DesignSpace
    seed: int
    designs: Sequence[DesignSpec]
    rays: Sequence[int]
    baselines: Sequence[str] = ALWAYS
    bandwidth: Bandwidth = field(default_factory=Bandwidth)
    equal_bandwidth: bool = True
    train: Sequence[Scene] = ()
    test: Sequence[Scene] = ()
    without_visibility: Callable[[int, float | None], DesignSpec] | None = None
    density: Callable[[], Samples | None] = lambda: None
    training: TrainingScenes | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    planner: Planner = field(default_factory=Planner)
    audit: bool = False
    mount_error: MountError | None = None
    losses: bool = False
    starmap: Starmap = itertools.starmap
    scenes_seed: int | None = None
    alone: Sequence[int] = ()
    named: Sequence[str] = ()

    @cached_property
    def world(self) -> World:
        """The training scenes that baselines are made from."""
        return World(self.task, self.config, self.space, self.seed, self.train, self.training, self.planner)

    @cached_property
    def preparation(self) -> Preparation:
        """What the task prepares for the rays of rows."""
        return self.world.new_preparation()

    @property
    def metric(self) -> Metric:
        """The meaning of scores."""
        return self.world.metric

    @property
    def conditions(self) -> list[dict[str, float]]:
        """The condition values that are evaluated at; one empty entry without conditions."""
        return self.world.conditions

    @property
    def sensors_to_lose(self) -> dict[str, int]:
        """The numbers of sensors of designs that are scored with each of them lost, by the designs' names."""
        own = [design for design in self.designs if self.losses or design.constraints.get("survive")]
        return {design.name: len(design.sensors) for design in own}

    def check(self) -> None:
        """Refuse an invalid request.

        Raises:
            ConfigError: No scenes, designs of one name, an unknown baseline, or no rays.
            PluginError: The metric's worst value is not finite.
        """
        where = f"task {self.task.name}"
        if not self.test:
            raise ConfigError("there are no held-out scenes", where=where, allowed="1 or more")
        if not math.isfinite(self.metric.worst):
            raise PluginError(f"the worst value is {self.metric.worst}", where=where, allowed="finite")
        mount = mount_of(self.task, self.config)
        for design in self.designs:
            if design.mount not in (None, mount):
                there = "in the world" if mount is None else f"on {mount!r}"
                raise ConfigError(f"{design.name} is mounted on the body {design.mount!r}", where=where, allowed=there)
        names = [design.name for design in self.designs]
        for name in names:
            if names.count(name) > 1 or name in self.baselines:
                other = "a baseline" if name in self.baselines else "another design"
                raise ConfigError(f"a design has the same name as {other}: {name!r}", hint="rename its file")
        for name in self.baselines:
            check_baseline(name, where="--baseline")
        if any(count < 1 for count in self.rays):
            raise ConfigError(f"{min(self.rays)} rays", where="--rays", allowed="1 or more")

    def scorer(self, scenes: Iterable[Scene]) -> TrainingScorer:
        """A scorer of training scenes, under the effects of the evaluation."""
        return TrainingScorer(self.task, self.metric, self.seed, scenes, self.planner, preparation=self.preparation)


def check_baseline(name: str, *, where: str = "baselines") -> None:
    """Refuse a name that is no method's.

    Raises:
        ConfigError: There is no such method.
    """
    if name not in METHODS.names():
        raise ConfigError(f"unknown baseline {name!r}", where=where, allowed=METHODS.allowed())


def numbers_fired(design: DesignSpec, asked: Iterable[int], alone: Sequence[int] = ()) -> list[int]:
    """The numbers of rays, of those asked for, at which a design is evaluated: a fixed pattern at its own if asked for.

    Real parts fire all their rays; subsets may rank designs of several sizes in another order.
    """
    size, chosen, asked = design.size, design.counts, list(asked)
    if size in asked:
        return [size]
    if chosen is not None:
        return [count for count in asked if count in chosen]
    return [count for count in asked if count not in alone and (size is None or count <= size)]


def counts_without_baselines(counts: Iterable[int], budgets: Iterable[int]) -> list[int]:
    """The usual numbers of rays above the task's and `MOST_SHARED`, for which baselines would take minutes."""
    return [count for count in counts if count > max(MOST_SHARED, *budgets)]


def usual_numbers(designs: Iterable[DesignSpec], budgets: Iterable[int]) -> list[int]:
    """The default numbers of rays: the task's, those of fixed patterns and budgets, and of chosen rays."""
    designs = list(designs)
    sizes = {design.count for design in designs if design.count is not None}
    return fired_numbers(designs, sorted(sizes.union(budgets, *(design.counts or () for design in designs))))


def fired_numbers(designs: Sequence[DesignSpec], counts: Iterable[int]) -> list[int]:
    """The numbers of rays, of those asked for, that any design can fire; all without a design.

    Raises:
        ConfigError: No design can fire any of them.
    """
    asked = list(dict.fromkeys(counts))
    fired = {count for design in designs for count in numbers_fired(design, asked)}
    kept = [count for count in asked if not designs or count in fired]
    if asked and not kept:
        chosen = sorted({count for design in designs for count in design.counts or ()})
        who, pattern = "no design fires", "all are fixed patterns"
        if len(designs) == 1:
            who, pattern = f"{designs[0].name} does not fire", "it is a fixed pattern"
        more = "a design of more parts: lidardesign catalog show NAME --rays N --out FILE"
        raise ConfigError(
            f"{who} {_listed(asked, 'or')} rays: {'rays were chosen at other numbers' if chosen else pattern}",
            where="--rays",
            allowed=_listed(chosen, "or") if chosen else f"at most {max(design.size or 0 for design in designs)}",
            hint="lidardesign fit RUN --rays N" if chosen else more,
        )
    return kept


def missing_row_notes(designs: Sequence[DesignSpec], counts: Iterable[int], alone: Sequence[int] = ()) -> list[str]:
    """Lines for people on numbers of rays at which designs have no row."""
    asked = sorted(set(counts))
    lines = []
    for design in designs:
        size, fired = design.size, numbers_fired(design, asked)
        beyond = [count for count in asked if count not in fired]
        if size is not None and fired and size not in fired:
            some = _listed(fired, "and")
            lines.append(f"{design.name} fires {size} rays, its fixed pattern: at {some} rays an even subset of them")
        if beyond:
            fires = f"{size} rays, its fixed pattern"
            if design.counts is not None:
                fires = f"{_listed(design.counts, 'or')} rays, at which they were chosen"
            lines.append(f"{design.name} fires {fires}: it is left out at {_listed(beyond, 'and')} rays")
    fired = {count for design in designs for count in numbers_fired(design, asked)}
    empty = [count for count in asked if designs and count not in fired]
    if alone:
        lines.append(f"at {_listed(alone, 'and')} rays fixed patterns are scored alone; --rays adds baselines there")
    if empty:
        lines.append(f"no design fires {_listed(empty, 'or')} rays: nothing is evaluated there")
    return lines


def _listed(counts: Sequence[int], last: str) -> str:
    texts = [str(count) for count in counts]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {last} {texts[-1]}"
