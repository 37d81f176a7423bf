"""The scenes of a density that sweeps are measured on, and weighted points independent of the flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from lidardesign.config import RunConfig
from lidardesign.density.fields.distance import scene_columns
from lidardesign.density.objective.prepare import prepare_target
from lidardesign.density.objective.proposals import independent_points
from lidardesign.density.objective.target import Target
from lidardesign.density.training.learn import FLOW
from lidardesign.density.training.learned import LearningSteps, load_flow
from lidardesign.density.training.losses import Pool
from lidardesign.density.training.quality import misplaced_share
from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.evaluation.results import Evaluation
from lidardesign.evaluation.sweep import Measurement, Sweep
from lidardesign.run.manifest import read_manifest
from lidardesign.scenes.scene import Scene
from lidardesign.task import random_generator

# Each of a density's choices may misplace a fiftieth of its mass: half of what the best learned flows miss it by.
TOLERANCE = 0.02
BECAUSE = "a fiftieth of the mass is half of what the best learned densities miss"
ERROR_OF = "share of the density's mass in the wrong place"
# Moving scenes are thinned to so many frames each before scenes are left out.
FRAMES_OF_FEW = 4
# Few draws at a time: each call chooses from candidates of its own, which many draws would exhaust.
DRAWN_AT_ONCE = 4096
POOL = 8192  # points that steps of learning draw from


@dataclass(frozen=True, eq=False)
class AccuracyRequest:
    """A run and an evaluation that sweeps are measured on.

    Arguments:
        config: The run's configuration.
        run: The run's folder.
        request: The evaluation's request: task, scenes, designs, samples, layouts, planner, seed.
        evaluation: The result of the evaluation.
    """

    config: RunConfig
    run: Path
    request: EvaluationRequest
    evaluation: Evaluation

    @cached_property
    def target(self) -> Target:
        """The target of all training scenes as the run learned it."""
        return prepare_target(list(self.request.train), self.config, visibility=self.decided_visibility)[0]

    @cached_property
    def steps(self) -> LearningSteps | None:
        """The steps of the run's learning at its learned flow; None where no probe reaches a surface."""
        config, target = self.config, self.target
        probes = draw_probes(target, POOL, config.seed, "steps")
        if not len(probes.points):
            return None
        pool = Pool.of(config.space.to_unit(probes.points), target.log_density(probes.points), probes.log_proposal)
        return LearningSteps(load_flow(self.run, FLOW, config, target, config.seed).flow, target, config.learning, pool)

    @property
    def decided_visibility(self) -> str | None:
        """The visibility that the run's own probe decided on; None where it is not recorded."""
        return read_manifest(self.run).get("visibility")


@dataclass(frozen=True, eq=False)
class Probes:
    """Distinct weighted points of a density.

    Arguments:
        points: Design points inside the space, shape (N, 6).
        log_proposal: log of the density that they were drawn from, up to a constant, shape (N,).
    """

    points: np.ndarray
    log_proposal: np.ndarray

    def misplaced(self, log_target: np.ndarray, log_reference: np.ndarray) -> tuple[float, float]:
        """The share of mass in the wrong place and its standard error, from log p* at the points, shapes (N,)."""
        return misplaced_share(log_target, log_reference, self.log_proposal)


def draw_probes(target: Target, count: int, seed: int, label: str, *, widening: float = 1.0) -> Probes:
    """At most `count` probes of a target, none where no ray of the space comes near a surface.

    Points that were drawn several times are kept once, with the weight of all.

    Arguments:
        target: The target.
        count: The number of draws.
        seed: The run's.
        label: Of the random stream.
        widening: Factor on sigma for the spread of probes, to reach other surfaces too.
    """
    wide = replace(target, optics=target.optics.widened(widening * target.optics.sigma_m))
    generator = random_generator(seed, "accuracy", label)
    drawn = [
        independent_points(wide, min(DRAWN_AT_ONCE, count - start), generator)
        for start in range(0, count, DRAWN_AT_ONCE)
    ]
    points, log_proposal = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    _, first, times = np.unique(points, axis=0, return_index=True, return_counts=True)
    # in the order of drawing, so that a part of them is a fair sample too
    order = np.argsort(first)
    first, times = first[order], times[order]
    return Probes(points[first], log_proposal[first] - np.log(times))


def density_sweep(
    knob: str,
    against: str,
    work: str,
    measurements: Sequence[Measurement],
    note: str,
    *,
    tolerance: float = TOLERANCE,
    because: str = BECAUSE,
) -> Sweep:
    """A sweep whose errors are misplaced shares of a density; see `Sweep`."""
    return Sweep(knob, ERROR_OF, "", against, tolerance, because, work, measurements, note)


def few_columns(scenes: Sequence[Scene], most: int) -> list[Scene]:
    """Scenes with at most `most` columns together, evenly chosen; of moving ones, a few of their frames."""
    if len(scene_columns(scenes)) <= most:
        return list(scenes)
    frames = min(max(scene.frames for scene in scenes), FRAMES_OF_FEW)
    chosen = np.unique(np.linspace(0, len(scenes) - 1, max(most // frames, 1)).round().astype(int))
    return [with_frames(scenes[index], min(frames, most)) for index in chosen]


def with_frames(scene: Scene, most: int) -> Scene:
    """A scene with at most so many of its frames, evenly chosen."""
    if scene.frames <= most:
        return scene
    chosen = np.linspace(0, scene.frames - 1, most).round().astype(int)
    bodies = tuple(body if body.poses.ndim == 2 else replace(body, poses=body.poses[chosen]) for body in scene.bodies)
    return replace(scene, bodies=bodies)
