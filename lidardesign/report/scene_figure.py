"""Designs in a scene and what becomes of their rays, for the 3D view.

As many rays, positions and frames are kept as a page can hold; `SceneFigure` says which are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.constraints.check import check_design
from lidardesign.constraints.slack import SPACE_MARK, ConstraintSlack, constraint_slack
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, gate_outcomes
from lidardesign.scenes.scene import Scene
from lidardesign.scoring.evaluation.entries import ordered_conditions
from lidardesign.scoring.evaluation.request import EvaluationRequest, numbers_fired
from lidardesign.scoring.evaluation.results import Evaluation
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.simulate.returns import build_casters, simulate_many
from lidardesign.space import DesignSpace

if TYPE_CHECKING:
    from lidardesign.simulate.plan import Planner


MOST_STEPS = 25  # positions, and frames, that a slider goes through
MOST_RAYS = 2000  # drawn per design
MOST_PLACED_RAYS = 30_000  # rays of all designs at all positions: 24 bytes each
MOST_RAY_STEPS = 120_000  # the same at all frames: 5 bytes each
FEWEST_RAYS = 300  # of a design, for which frames are given up

Conditions = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class DrawnDesign:
    """A design with its rays at each of P positions and T frames; N rays are drawn.

    Arguments:
        design: As it is in its file.
        placed: The design at each position.
        rays: The drawn rays at each position, N each.
        length_m: How far each ray is drawn: to its return, the first hit, or the end of its gate, shape (P, T, N).
        outcome: Values of `Outcome`, shape (P, T, N).
        fired: The number of its rays.
    """

    design: DesignSpec
    placed: tuple[DesignSpec, ...]
    rays: tuple[Rays, ...]
    length_m: np.ndarray
    outcome: np.ndarray
    fired: int

    @property
    def ends_m(self) -> np.ndarray:
        """Ends of the drawn rays at every position and frame, shape (P, T, N, 3) [m]."""
        origin = np.stack([rays.origin_m for rays in self.rays])
        direction = np.stack([rays.direction for rays in self.rays])
        return origin[:, None] + self.length_m[..., None] * direction[:, None]


@dataclass(frozen=True, eq=False)
class SceneFigure:
    """A scene with designs in it.

    Arguments:
        scene: The scene.
        frames: The frames of it that are shown, ascending.
        places: The condition values that are shown, ascending; one empty entry without conditions.
        designs: The designs, with their rays there.
        physics: Whether a detector's effects decide what becomes of rays, or geometry alone.
        all_places: How many condition values there are.
    """

    scene: Scene
    frames: tuple[int, ...]
    places: tuple[Conditions, ...]
    designs: tuple[DrawnDesign, ...]
    physics: bool = False
    all_places: int = 1

    @cached_property
    def directions(self) -> np.ndarray:
        """All rays' directions, shape (K, 3)."""
        return np.concatenate([np.zeros((0, 3)), *(rays.direction for one in self.designs for rays in one.rays)])


def scene_figure(
    scene: Scene,
    designs: Sequence[DesignSpec],
    places: Sequence[Conditions],
    laid_out: Callable[[DesignSpec, Conditions], Rays],
    *,
    planner: Planner | None = None,
    seed: int = 0,
) -> SceneFigure:
    """Put designs into a scene.

    Arguments:
        scene: The scene.
        designs: The designs.
        places: The condition values that they are evaluated at, ascending.
        laid_out: A design's rays at a condition value; at every one as many.
        planner: How effects are chosen; None: geometry alone.
        seed: Of the effects' random numbers.
    """
    chosen = tuple(places[index] for index in _spread(len(places), MOST_STEPS))
    every = [[laid_out(design, at) for at in chosen] for design in designs]
    # as many frames, and as many rays of each placed design, as can be drawn
    count = max(len(designs) * len(chosen), 1)
    frames = _spread(scene.frames, min(MOST_STEPS, max(5, MOST_RAY_STEPS // (count * FEWEST_RAYS))))
    share = min(MOST_PLACED_RAYS / count, MOST_RAY_STEPS / (count * len(frames)))
    budget = max(min(MOST_RAYS, math.floor(share)), 1)
    outcomes = _outcomes(scene, every, frames, planner, seed)
    drawn = []
    for design, rays, (length_m, outcome) in zip(designs, every, outcomes, strict=True):
        keep = np.array(_spread(len(rays[0]), budget), dtype=np.int64)
        at, some = tuple(design.at_condition(where) for where in chosen), tuple(one.subset(keep) for one in rays)
        drawn.append(DrawnDesign(design, at, some, length_m[..., keep], outcome[..., keep], len(rays[0])))
    return SceneFigure(scene, frames, chosen, tuple(drawn), planner is not None, len(places))


def _spread(count: int, most: int) -> tuple[int, ...]:
    """At most `most` of `count` indices, evenly from the first to the last."""
    return tuple(np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()) if count else ()


def _outcomes(
    scene: Scene, every: Sequence[Sequence[Rays]], frames: Sequence[int], planner: Planner | None, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Drawn lengths and outcomes of each design's rays, shape (P, T, N) each."""
    casters = build_casters(scene) if planner is not None else {frame: SceneCaster(scene, frame) for frame in frames}
    found = [_first_hits(rays, [casters[frame] for frame in frames]) for rays in every]
    if planner is None:
        return found
    lists = [rays for one in every for rays in one]
    physics = planner.physics(planner.plan(scene, lists, casters), seed)
    if physics is None:
        return found
    repeats = [place for one in every for place in range(len(one))]
    measured = iter(simulate_many(scene, lists, casters=casters, physics=physics, repeats=repeats))
    for rays, (length_m, outcome) in zip(every, found, strict=True):
        for place in range(len(rays)):
            returns = next(measured)
            for step, seen in enumerate(returns[frame] for frame in frames):
                outcome[place, step] = seen.outcome
                length_m[place, step][seen.returned] = seen.range_m[seen.returned]
    return found


def _first_hits(rays: Sequence[Rays], casters: Sequence[SceneCaster]) -> tuple[np.ndarray, np.ndarray]:
    """Lengths to the first hit or the gate's end, and outcomes by geometry alone, shape (P, T, N) each."""
    shape = (len(rays), len(casters), len(rays[0]))
    length_m, outcome = np.zeros(shape, dtype=np.float32), np.full(shape, Outcome.MISS, dtype=np.uint8)
    for place, one in enumerate(rays):
        for step, caster in enumerate(casters):
            range_m = caster.first_hit(one.origin_m, one.direction).range_m
            length_m[place, step] = np.minimum(range_m, one.gate_m[:, 1])
            outcome[place, step] = gate_outcomes(range_m, one.gate_m)
    return length_m, outcome


def evaluated_scene(evaluation: Evaluation, request: EvaluationRequest) -> SceneFigure:
    """An evaluation's designs in its first held-out scene, with the effects that the scenes call for."""

    def laid_out(design: DesignSpec, at: Conditions) -> Rays:
        count = design.count or max(numbers_fired(design, request.rays, request.alone))
        return design.rays(count, at=at or None)

    planner = request.planner if any(effect.on for effect in evaluation.effects) else None
    places = ordered_conditions(request)
    return scene_figure(request.test[0], request.designs, places, laid_out, planner=planner, seed=request.seed)


def constraint_slack_of(design: DesignSpec, space: DesignSpace) -> list[ConstraintSlack]:
    """The slack of each constraint of a design, by the independent checker; the bounds of its space last."""
    checks = check_design(design_document(design), design.constraints, space)
    slacks = constraint_slack(checks, [sensor.name for sensor in design.sensors])
    return sorted(slacks, key=lambda one: one.name.startswith(SPACE_MARK))
