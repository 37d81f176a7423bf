"""Accuracy and cost of learning: its steps, float32 beside float64, and a few scenes and frames that stand for all."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.density.objective.proposals import independent_samples
from lidardesign.density.training.learned import (
    DTYPES,
    LearningSteps,
    Loss,
    gradient,
    in_arithmetic,
    noise_share,
    noise_shares,
    remeasured,
)
from lidardesign.evaluation.accuracy.probes import AccuracyRequest, density_sweep
from lidardesign.evaluation.sweep import Measurement, Sweep, timed
from lidardesign.task import random_generator

# A misplaced share of a tenth is then known to 5 %.
SAMPLES = 8192
PROBES = 8192
STEPS_TOLERANCE = 0.1
STEPS_BECAUSE = (
    "a tenth of the rays in the wrong place is at worst a tenth fewer rays: 5 % of an error that falls like their root"
)
# Errors of a tenth of the noise add a hundredth to its variance.
DTYPE_TOLERANCE = 0.1
DTYPE_BATCHES = 10
# Of a normal sample: standard deviation over median deviation, and the median's standard error over the mean's.
MEDIAN_DEVIATION, MEDIAN_ERROR = 1.4826, 1.2533
# The error of few scenes is noise like that of few design points; half as much adds a quarter to its variance.
FRAMES_TOLERANCE = 0.5
POWERS = (4, 16, 64, 256)
# Batches, and how often scenes are drawn for each. Few batches have most of the error, so many are better than draws.
FRAMES_BATCHES, DRAWS = 32, 1


def steps_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The misplaced share after a part of the steps: of the run's own snapshots and of the flow that it learned."""
    seed, target = request.config.seed, request.target
    probes = independent_samples(target, PROBES, random_generator(seed, "accuracy", "training"))
    reached = remeasured(request.run, request.config, target, probes, count=SAMPLES, seed=seed)
    measurements = []
    for one in reached:
        misplaced = one.estimates["misplaced"]
        values = {name: one.estimates[name].value for name in ("ess", "kl_nats", "coverage")}
        errors = {f"{name}_error": one.estimates[name].error or 0.0 for name in values}
        measurements.append(
            Measurement(
                str(one.step),
                misplaced.value,
                misplaced.error or 0.0,
                one.seconds,
                default=one is reached[-1],
                values=values | errors,
            )
        )
    several = "fewer steps are what this run had reached on its way; a run of that many does as well"
    return [
        density_sweep(
            knob="learning.steps",
            against="the target density",
            work="learning up to there",
            measurements=measurements,
            note=several if len(reached) > 1 else "this run kept no snapshots; a run that is learned now does",
            tolerance=STEPS_TOLERANCE,
            because=STEPS_BECAUSE,
        )
    ]


def dtype_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The sweep over arithmetic; empty where no ray meets a target."""
    return [] if request.steps is None else [dtype_sweep(request.steps, request.config.seed)]


def dtype_sweep(steps: LearningSteps, seed: int) -> Sweep:
    """The error of a step's gradient in float32, the larger of both kinds of steps.

    The target is the same in any arithmetic, so only the flow's part of a step is timed.
    """
    kinds = {"pathwise": steps.pathwise(), "balancing": steps.balancing()}
    exact = {name: _gradients("float64", steps, loss, seed) for name, loss in kinds.items()}
    return Sweep(
        knob="learning.dtype",
        error_of="error of a step's gradient relative to the noise of its batch, median over batches",
        unit="",
        against="float64",
        tolerance=DTYPE_TOLERANCE,
        because="it adds a hundredth to the variance that gradients have anyway",
        work=f"the flow's part of a path-wise and a balancing step of {steps.settings.batch} design points",
        measurements=[_dtype_measure(dtype, steps, kinds, exact, seed) for dtype in DTYPES],
        note="densities are always float64",
    )


def _gradients(dtype: str, steps: LearningSteps, loss: Loss, seed: int) -> list[np.ndarray]:
    flow = in_arithmetic(steps.flow, dtype)
    return [gradient(flow, loss, number, steps.settings.clip_norm) for number in range(seed, seed + DTYPE_BATCHES)]


def _dtype_measure(
    dtype: str,
    steps: LearningSteps,
    kinds: dict[str, Loss],
    exact: dict[str, list[np.ndarray]],
    seed: int,
) -> Measurement:
    flow, alone = in_arithmetic(steps.flow, dtype), steps.without_target()
    both, clip_norm = (alone.pathwise(), alone.balancing()), steps.settings.clip_norm
    _, seconds, memory = timed(lambda: [gradient(flow, loss, seed, clip_norm) for loss in both])
    default, values = dtype == steps.settings.dtype, {}
    if dtype == "float64":
        return Measurement(dtype, 0.0, 0.0, seconds, memory, default, reference=True)
    found = {name: noise_shares(_gradients(dtype, steps, loss, seed), exact[name]) for name, loss in kinds.items()}
    medians = []
    for name, shares in found.items():
        middle = float(np.median(shares))
        # a leaked sample near a silhouette has a gradient without bounds, which any rounding may turn over
        values |= {f"{name}_error": middle, f"{name}_beyond": float((shares > DTYPE_TOLERANCE).mean())}
        # the standard error from the median deviation, as for normal values
        deviation = MEDIAN_DEVIATION * float(np.median(np.abs(shares - middle)))
        medians.append((middle, MEDIAN_ERROR * deviation / math.sqrt(len(shares))))
    return Measurement(dtype, *max(medians), seconds, memory, default, values=values)


def frames_sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The sweep over numbers of frames; empty for a few scenes, or where no ray meets a target."""
    if request.steps is None or request.steps.target.columns <= POWERS[0]:
        return []
    return [frames_sweep(request.steps, request.config.seed)]


def frames_sweep(steps: LearningSteps, seed: int) -> Sweep:
    """The error of a path-wise step's gradient on random subsets of scenes and frames."""
    flow, columns = in_arithmetic(steps.flow, steps.settings.dtype), steps.target.columns
    seeds, default = range(seed, seed + FRAMES_BATCHES), min(steps.settings.frames, columns)
    exact = [gradient(flow, steps.pathwise(), number, steps.settings.clip_norm) for number in seeds]
    return Sweep(
        knob="learning.frames",
        error_of="error of a step's gradient relative to the noise of its batch",
        unit="",
        against="all scenes and frames",
        tolerance=FRAMES_TOLERANCE,
        because="it adds a quarter to the variance that gradients have anyway, as a batch a fifth smaller would",
        work=f"the gradient of a path-wise step of {steps.settings.batch} design points",
        measurements=[_frames_measure(count, steps, exact, seeds, default) for count in counts(columns, default)],
        note=f"at sigma {steps.sigma_m:.3g} m, the middle of the annealing",
    )


def counts(columns: int, default: int) -> list[int]:
    """Numbers of scenes and frames to try: powers of four up to all of them, and the run's own number."""
    return sorted({*(count for count in POWERS if count < columns), default, columns})


def _frames_measure(
    count: int, steps: LearningSteps, exact: list[np.ndarray], seeds: Sequence[int], default: int
) -> Measurement:
    columns, flow = steps.target.columns, in_arithmetic(steps.flow, steps.settings.dtype)
    generator = random_generator(seeds[0], "scenes", count)

    def drawn(number: int) -> np.ndarray:
        chosen = np.sort(generator.permutation(columns)[:count])
        target = steps.target if count == columns else steps.target.subsample(chosen)
        return gradient(flow, steps.pathwise(target), number, steps.settings.clip_norm)

    _, seconds, memory = timed(lambda: drawn(seeds[0]))
    if count == columns:
        return Measurement(str(count), 0.0, 0.0, seconds, memory, default == count, reference=True)
    found = [np.stack([drawn(number) for _ in range(DRAWS)]) for number in seeds]
    return Measurement(str(count), *noise_share(found, exact), seconds, memory, default == count)
