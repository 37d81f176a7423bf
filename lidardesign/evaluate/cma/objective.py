"""What sets of rays are worth on training scenes, cheap enough to ask for thousands of them.

All candidates of a step see the same few scenes and the same chance (common random numbers), so that what tells them
apart is what they are. Casters, and what a scene calls for, are worked out once per scene and kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lidardesign.evaluate.baselines.candidates import Positions
from lidardesign.evaluate.scene_scores import score_lists
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.scene import Scene
from lidardesign.simulate.physics import Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.simulate import build_casters, simulate_many
from lidardesign.task import Task


class OutOfTimeError(Exception):
    """The budget ended in the middle of a step; what was scored of it is dropped."""


@dataclass(frozen=True, eq=False)
class TrainingObjective:
    """The task's metric on training scenes, turned so that lower is better.

    Arguments:
        task: Whose score is taken.
        scenes: Training scenes; the first ones are asked first.
        planner: The detector, and how effects are chosen.
        seed: Root of the effects' random streams.
    """

    task: Task
    scenes: Sequence[Scene]
    planner: Planner
    seed: int
    _prepared: dict[int, tuple[list[SceneCaster], Physics | None]] = field(default_factory=dict)

    @property
    def sign(self) -> float:
        """What turns the metric so that lower is better."""
        return 1.0 if self.task.metric.better == "lower" else -1.0

    def values(
        self, lists: Sequence[Positions], scenes: Sequence[int], stop: Callable[[], bool] = lambda: False
    ) -> np.ndarray:
        """The score of every set of rays in some scenes, lower is better, shape (sets, scenes).

        Arguments:
            lists: The sets of rays; one without rays has the metric's worst value everywhere.
            scenes: Numbers of the scenes.
            stop: Asked after every scene whether the time is up.

        Raises:
            OutOfTimeError: The time was up before all scenes were asked.
        """
        found = np.empty((len(lists), len(scenes)))
        for column, number in enumerate(scenes):
            casters, physics = self._of_scene(number, lists)
            scored = score_lists(self.task, self.scenes[number], lists, casters, physics)
            found[:, column] = [self.sign * score.value for score, _ in scored]
            if column + 1 < len(scenes) and stop():
                raise OutOfTimeError
        return found

    def returned(self, positions: Positions, scenes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """The sensor (R,) and the range (R,) [m] of every return of a set of rays in some scenes."""
        sensors, ranges_m = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
        for number in scenes:
            casters, physics = self._of_scene(number, [positions])
            repeats = list(range(len(positions)))
            found = simulate_many(self.scenes[number], positions, casters=casters, physics=physics, repeats=repeats)
            for one in (returns for frames in found for returns in frames):
                sensors.append(np.asarray(one.rays.sensor)[one.returned])
                ranges_m.append(one.range_m[one.returned])
        return np.concatenate(sensors), np.concatenate(ranges_m)

    def _of_scene(self, number: int, lists: Sequence[Positions]) -> tuple[list[SceneCaster], Physics | None]:
        """Casters and effects of a scene; the rays that are fired first say which effects it calls for."""
        if number not in self._prepared:
            scene = self.scenes[number]
            casters = build_casters(scene)
            plan = self.planner.plan(scene, [rays for positions in lists for rays in positions], casters)
            self._prepared[number] = casters, self.planner.physics(plan, self.seed)
        return self._prepared[number]
