"""One pass over scenes: many sets of rays, scored in each scene under the effects that it calls for.

A scene is the unit of work: all its rays are planned and traced together, and what comes of it depends on nothing
else. So scenes can be scored one after the other here, or by workers (`lidardesign.evaluate.workers`), to the same
numbers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from lidardesign.evaluate.candidates import Positions
from lidardesign.evaluate.scoring import score_lists
from lidardesign.scene import Scene
from lidardesign.simulate.plan import Plan, Planner
from lidardesign.simulate.simulate import build_casters
from lidardesign.simulate.triangles import SecondCasts
from lidardesign.task import Score, Task

if TYPE_CHECKING:
    from lidardesign.evaluate.request import EvaluationRequest

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class ScenePass:
    """Sets of rays to be scored in all held-out scenes.

    Arguments:
        fired: The sets of rays that are fired in a scene, by its number.
        planner: How their effects are chosen.
        plans: The plan of every scene where it is known already; empty: they are made.
    """

    fired: Callable[[int], Sequence[Positions]]
    planner: Planner
    plans: Sequence[Plan] = ()

    def known(self, number: int) -> Plan | None:
        """The plan of a scene, if it is known."""
        return self.plans[number] if self.plans else None


@dataclass(frozen=True, eq=False)
class SceneScores:
    """What came of a scene.

    Arguments:
        plan: What was simulated.
        planning_seconds: Time to find that out [s].
        scores: Of every set of rays, in their order, each with its share of the time [s].
        second_casts: How often meshes had to be asked twice, in planning too.
    """

    plan: Plan
    planning_seconds: float
    scores: Sequence[tuple[Score, float]]
    second_casts: SecondCasts = field(default_factory=SecondCasts)


class Scorer(Protocol):
    """Scores all held-out scenes of a request, in their order."""

    def __call__(
        self, request: EvaluationRequest, scene_pass: ScenePass, progress: Progress | None
    ) -> Sequence[SceneScores]:
        """As `score_here`."""
        ...


def score_here(request: EvaluationRequest, scene_pass: ScenePass, progress: Progress | None) -> list[SceneScores]:
    """Score scene by scene in this process, so that only one scene's casters are held at a time.

    Arguments:
        request: Whose held-out scenes, task and seed are taken.
        scene_pass: What is fired, and under which effects.
        progress: Called with the scenes done, all scenes, and the name of the scene.
    """
    found = []
    for number, scene in enumerate(request.test):
        if progress:
            progress(number, len(request.test), scene.name)
        lists = scene_pass.fired(number)
        known = scene_pass.known(number)
        found.append(score_in_scene(request.task, scene, lists, scene_pass.planner, known, request.seed))
    if progress:
        progress(len(request.test), len(request.test), "")
    return found


def score_in_scene(
    task: Task, scene: Scene, lists: Sequence[Positions], planner: Planner, known: Plan | None, seed: int
) -> SceneScores:
    """Score sets of rays in one scene.

    Arguments:
        task: Whose score is taken.
        scene: The scene.
        lists: The sets of rays.
        planner: How effects are chosen.
        known: The plan; None makes it for all the rays together.
        seed: Root of the effects' random streams.

    Raises:
        ConfigError: An effect that was named cannot be simulated here, or a gate lies outside the histogram.
        PluginError: The task's score raised, or returned something that is no finite score.
    """
    casters = build_casters(scene)
    started = time.perf_counter()
    plan = known or planner.plan(scene, [rays for positions in lists for rays in positions], casters)
    seconds = time.perf_counter() - started
    scores = list(score_lists(task, scene, lists, casters, planner.physics(plan, seed)))
    second_casts = sum((caster.second_casts for caster in casters), SecondCasts())
    return SceneScores(plan, seconds, scores, second_casts)
