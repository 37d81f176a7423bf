"""Laws of the contract of methods, tried in two small worlds: designs are as asked for, repeatable and can be saved.

The worlds need no learning: balls before a sensor at one place, and before sensors anywhere in a box.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from lidardesign.contract.law import BrokenLawError, Law, LawHolds, NotApplicable, Tried
from lidardesign.errors import InfeasibleError
from lidardesign.formats.designs import load_design
from lidardesign.problem.method import DESIGN, Method, fault_of
from lidardesign.problem.problem import DesignResult, Problem
from lidardesign.problem.world import World
from lidardesign.rays.information import surface_information
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.run.content import fingerprint
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.sensors.design_file import save_design
from lidardesign.simulate.plan import Planner
from lidardesign.space import DesignSpace
from lidardesign.task import Information, Metric, Score, random_generator

RADIUS_M, SEED, SCENES = 0.4, 7, 8
PLACE = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
BOX = DesignSpace((-0.3, -0.1, -0.1, -0.5, -0.5, 0.05), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
# Rays, or a bandwidth [Mbit/s], and gates.
ASKED: tuple[dict[str, Any], ...] = (
    {"rays": 1}, {"rays": 12}, {"rays": 12, "gates": "ray"}, {"limit_mbps": 0.5}, {"limit_mbps": 0.0},
)  # fmt: skip


class BallTask:
    """A task that scores the share of rays that miss."""

    name, metric = "balls", Metric("missed", "%", "lower", 100.0, 1.0)

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """The share of rays that miss."""
        if not len(returns[0].outcome):
            return Score(self.metric.worst, failed=True)
        return Score(100.0 - 100.0 * float(np.mean(returns[0].returned)))

    def informs(self, scene: Scene, returns: Sequence[Returns]) -> Information:
        """What returns tell about points of the half of the ball that looks to the sensors."""
        spread = random_generator(SEED, "ball").normal(size=(300, 3))
        spread /= np.linalg.norm(spread, axis=1, keepdims=True)
        points = scene.bodies[0].pose(0)[:3, 3] + RADIUS_M * spread[spread[:, 0] < 0]
        return surface_information([points] * len(returns), returns, [True], 2 * math.pi * RADIUS_M**2 * len(returns))


def ball_scenes(seed: int) -> list[Scene]:
    """Scenes of a ball each, 3 m ahead."""
    shifts = random_generator(seed, "balls").normal(0, 0.05, (SCENES, 3))
    places = [tuple(np.add((3.0, 0.0, 0.0), shift)) for shift in shifts]
    return [Scene((Body(Sphere(RADIUS_M), "ball", "both", rigid(translation_m=place)),)) for place in places]


def ball_world(space: DesignSpace) -> World:
    """A world of balls before a design space."""
    task: Any = BallTask()
    run: Any = SimpleNamespace(
        task=task,
        config=SimpleNamespace(density=SimpleNamespace(sigma_m=0.01)),
        scenes=lambda split, seed: ball_scenes(seed),
    )
    return World(task, None, space, SEED, ball_scenes(SEED), TrainingScenes(run, SEED), Planner())


class MethodSubject(Tried):
    """A method, tried by the laws.

    Arguments:
        method: The plugin.
        conduct: The limit and what else `Tried` takes.
    """

    def __init__(self, method: Method, *conduct: Any) -> None:
        super().__init__("method", method.name, *conduct)
        self.method = method

    def problems(self) -> list[Problem]:
        """All problems, in worlds that nothing was found in yet."""
        return [Problem(world, **asked) for world in map(ball_world, (PLACE, BOX)) for asked in ASKED]

    def design(self, problem: Problem) -> DesignResult | None:
        """The design for a problem; None where the method makes none."""
        with self.calling("refuses"):
            refused = self.method.refuses(problem)
        if refused is not None:
            return None
        with self.calling("design"), suppress(InfeasibleError):
            result = self.method.design(problem)
            if result is None and problem.rays is not None:
                raise BrokenLawError(f"design neither makes nor refuses {asked_text(problem)}")
            return result
        return None


def asked_text(problem: Problem) -> str:
    """What a problem asks for, in words."""
    number = f"{problem.limit_mbps:g} Mbit/s" if problem.rays is None else f"{problem.rays} rays"
    return f"{number}, a gate per {problem.gates}"


def check_made(subject: MethodSubject) -> LawHolds | NotApplicable:
    """Designs are made with as many rays as asked for, in their bandwidth and space."""
    if DESIGN in subject.method.needs:
        return NotApplicable("the method begins with a design")
    made = 0
    for problem in subject.problems():
        result = subject.design(problem)
        if result is None:
            continue
        made += 1
        fault = fault_of(result, problem, is_trusted=False)
        if fault is not None:
            raise BrokenLawError(f"{asked_text(problem)}: its design {fault}")
    if not made:
        raise BrokenLawError("makes no design")
    return LawHolds(f"{made} of {2 * len(ASKED)} designs as asked for", {"made": made})


def check_repeated(subject: MethodSubject) -> LawHolds:
    """The same world and seed give the same design, and another draw another one where they are drawn anew."""
    for first, again in zip(subject.problems(), subject.problems(), strict=True):
        one, same = subject.design(first), subject.design(again)
        if _fingerprint(one) != _fingerprint(same):
            raise BrokenLawError(
                f"{asked_text(first)}: another design the second time", hint="draw from the world's seed"
            )
        other = subject.design(replace(first, draw=1)) if one and subject.method.is_redrawn else None
        if other and _fingerprint(one) == _fingerprint(other):
            raise BrokenLawError(f"{asked_text(first)}: says that it is drawn anew, and is not")
    return LawHolds("the same world gives the same designs")


def check_saved(subject: MethodSubject) -> LawHolds:
    """A design is the same once it was written and read."""
    with tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
        for problem in subject.problems():
            result = subject.design(problem)
            if result is not None:
                path = Path(folder) / "design.yaml"
                save_design(result.design, path)
                if fingerprint(load_design(path).rays()) != _fingerprint(result):
                    raise BrokenLawError(f"{asked_text(problem)}: fires other rays once it is saved")
    return LawHolds("designs can be saved")


def _fingerprint(result: DesignResult | None) -> str:
    return fingerprint(result and result.design.rays())


_AFTER_FIRST = ("designs are made",)
LAWS = (
    Law("designs are made", "designs", "designs are as asked for, or refused", check_made),
    Law("designs repeat", "designs", "the same world gives the same design", check_repeated, needs=_AFTER_FIRST),
    Law("designs are saved", "designs", "a saved design fires the same rays", check_saved, needs=_AFTER_FIRST),
)
