"""The world that designs are made and tried in: the training scenes of a run; held-out scenes are out of reach."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar, cast

from lidardesign.plugins import plugin_guard
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.scenes.scene import Scene
from lidardesign.scoring.fired import ONE_DEVICE, Devices, Positions, assign_devices
from lidardesign.scoring.scene_scores import PREPARE, Preparation, TrainingScorer
from lidardesign.simulate.plan import Planner
from lidardesign.space import DesignSpace
from lidardesign.task import Metric, Task, conditions_of, metric_of

Found = TypeVar("Found")
LEARNED = "learned"  # the purpose of the scenes that the density is learned from


@dataclass(frozen=True, eq=False)
class World:
    """A task with its training scenes.

    Arguments:
        task: The task.
        config: Its configuration.
        space: The design space.
        seed: Root of the random streams.
        learned: The scenes that the density is learned from.
        training: Endless streams of further scenes; None: there are none.
        planner: The detector, and how effects are chosen; None: geometry alone.
    """

    task: Task
    config: Any
    space: DesignSpace
    seed: int
    learned: Sequence[Scene] = ()
    training: TrainingScenes | None = None
    planner: Planner | None = None
    _known: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def metric(self) -> Metric:
        """The meaning of scores."""
        with plugin_guard(self.task.name):
            return metric_of(self.task, self.config)

    @cached_property
    def conditions(self) -> list[dict[str, float]]:
        """The condition values that designs are evaluated at; one empty entry without conditions."""
        with plugin_guard(self.task.name):
            return conditions_of(self.task, self.config, self.space)

    @cached_property
    def spaces(self) -> list[DesignSpace]:
        """What is left of the design space at each condition value."""
        return [self.space.at(condition) for condition in self.conditions]

    def scenes(self, purpose: str = LEARNED, start: int = 0) -> Iterator[Scene]:
        """The scenes that were learned from, or an endless stream for a purpose of your own, from number `start`."""
        if purpose == LEARNED or self.training is None:
            return iter(self.learned[start:])
        return self.training.scenes(purpose, start)

    def known(self, key: Hashable, make: Callable[[], Found]) -> Found:
        """What a method found once, for all problems of this world."""
        if key not in self._known:
            self._known[key] = make()
        return cast(Found, self._known[key])

    def forget(self, but: Sequence[str] = ()) -> None:
        """Forget what was found, but for methods by their names: casters of all scenes fill memory."""
        for key in [one for one in self._known if not (isinstance(one, tuple) and one[0] in but)]:
            del self._known[key]

    @property
    def preparation(self) -> Preparation:
        """What the task prepares for the sets of rays that methods try, on scenes of their own."""
        return self.known(PREPARE, self.new_preparation)

    def new_preparation(self) -> Preparation:
        """What the task prepares for other sets of rays, which say together what effects training scenes call for."""
        return Preparation(self.task, self.seed, self.scenes(PREPARE), self.planner)

    def scorer(self, *, keeps_casters: bool = False) -> TrainingScorer:
        """A scorer of the scenes that were learned from."""
        return TrainingScorer(
            self.task,
            self.metric,
            self.seed,
            self.learned,
            self.planner,
            keeps_casters=keeps_casters,
            preparation=self.preparation,
        )

    def losses(self, lists: Sequence[Positions], count: int, devices: Devices = ONE_DEVICE) -> list[float]:
        """The mean score of sets of rays on the first learned scenes, turned so that lower is better."""
        if not self.learned:
            return [0.0] * len(lists)
        assigned = [assign_devices(positions, devices) for positions in lists]
        return (self.metric.sign * self.scorer().scores(assigned, count).mean(axis=0)).tolist()
