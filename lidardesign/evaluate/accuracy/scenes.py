"""What each path-wise step needs of many scenes and frames: all of them, or a few that stand for all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.density.training.snapshot_quality import Steps, beside_noise, gradient, in_arithmetic
from lidardesign.evaluate.accuracy.precision import run_steps
from lidardesign.evaluate.accuracy.settings import Ladder, Rung, timed
from lidardesign.evaluate.accuracy.sweeps import AccuracyRequest
from lidardesign.task import random_generator

LABEL = "scenes per step"
# The error of few scenes is noise like that of few design points; half as much adds a quarter to its variance.
TOLERANCE = 0.5
BECAUSE = "it adds a quarter to the variance that gradients have anyway, as a batch a fifth smaller would"
POWERS = (4, 16, 64, 256)
# Batches, and how often scenes are drawn for each. Few batches have most of the error, so many are better than draws.
BATCHES, DRAWS = 32, 1


def ladders(request: AccuracyRequest) -> Sequence[Ladder]:
    """One ladder; empty for a few scenes, or where no ray meets a target."""
    steps = run_steps(request)
    if steps is None or steps.target.columns <= POWERS[0]:
        return []
    return [scenes_ladder(steps, request.config.seed)]


def scenes_ladder(steps: Steps, seed: int) -> Ladder:
    """The error of a path-wise step's gradient when a few scenes and frames, drawn anew each time, stand for all."""
    steps_flow = in_arithmetic(steps.flow, steps.settings.dtype)
    seeds = range(seed, seed + BATCHES)
    exact = [gradient(steps_flow, steps.pathwise(), number, steps.settings.clip_norm) for number in seeds]
    default = min(steps.settings.frames, steps.target.columns)
    rungs = [_rung(count, steps, exact, seeds, default) for count in counts(steps.target.columns, default)]
    return Ladder(
        knob="learning.frames",
        error_of="error of a step's gradient beside the noise of its batch",
        unit="",
        against="all scenes and frames",
        tolerance=TOLERANCE,
        because=BECAUSE,
        work=f"the gradient of a path-wise step of {steps.settings.batch} design points",
        rungs=rungs,
        note=f"at sigma {steps.sigma_m:.3g} m, the middle of the annealing",
    )


def counts(columns: int, default: int) -> list[int]:
    """How many scenes and frames are tried: powers of four up to all of them, and the run's own number."""
    return sorted({*(count for count in POWERS if count < columns), default, columns})


def _rung(count: int, steps: Steps, exact: list[np.ndarray], seeds: Sequence[int], default: int) -> Rung:
    columns, flow = steps.target.columns, in_arithmetic(steps.flow, steps.settings.dtype)
    generator = random_generator(seeds[0], "scenes", count)

    def drawn(number: int) -> np.ndarray:
        chosen = np.sort(generator.permutation(columns)[:count])
        target = steps.target if count == columns else steps.target.drawn(chosen)
        return gradient(flow, steps.pathwise(target), number, steps.settings.clip_norm)

    _, seconds, memory = timed(lambda: drawn(seeds[0]))
    if count == columns:
        return Rung(str(count), 0.0, 0.0, seconds, memory, default == count, reference=True)
    found = [np.stack([drawn(number) for _ in range(DRAWS)]) for number in seeds]
    error, uncertainty = beside_noise(found, exact)
    return Rung(str(count), error, uncertainty, seconds, memory, default == count)
