"""What float32 costs learning: in the gradients of its steps, and what it would cost densities, always float64."""

from __future__ import annotations

import math
from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np

from lidardesign.density.learn import FLOW
from lidardesign.density.training.losses import Pool
from lidardesign.density.training.quality import misplaced_share
from lidardesign.density.training.snapshot_quality import (
    DTYPES,
    Drawn,
    Loss,
    Steps,
    each_beside_noise,
    gradient,
    in_arithmetic,
    load_flow,
)
from lidardesign.evaluate.accuracy.probes import draw_probes, run_target
from lidardesign.evaluate.accuracy.settings import Ladder, Rung, timed
from lidardesign.evaluate.accuracy.sweeps import AccuracyRequest

LABEL = "arithmetic"
# Errors of a tenth of the noise add a hundredth to its variance.
TOLERANCE = 0.1
BECAUSE = "it adds a hundredth to the variance that gradients have anyway"
BATCHES = 10
POOL = 8192
SAMPLES = 16_384
# Of a normal sample: standard deviation over median deviation, and the median's standard error over the mean's.
MEDIAN_DEVIATION, MEDIAN_ERROR = 1.4826, 1.2533

_STEPS: WeakKeyDictionary[AccuracyRequest, Steps | None] = WeakKeyDictionary()


def ladders(request: AccuracyRequest) -> Sequence[Ladder]:
    """One ladder; empty where no ray meets a target."""
    steps = run_steps(request)
    return [] if steps is None else [steps_ladder(steps, request.config.seed)]


def run_steps(request: AccuracyRequest) -> Steps | None:
    """The steps of a run's learning, at the flow that it learned; None where no probe reaches a surface."""
    if request not in _STEPS:
        _STEPS[request] = _steps(request)
    return _STEPS[request]


def _steps(request: AccuracyRequest) -> Steps | None:
    target, config = run_target(request), request.config
    probes = draw_probes(target, request.request.train, POOL, config.seed, "steps")
    if not len(probes.points):
        return None
    unit = config.space.to_unit(probes.points)
    pool = Pool.of(unit, target.log_density(probes.points), probes.log_proposal)
    flow = load_flow(request.run, FLOW, config, target, config.seed).flow
    return Steps(flow, target, config.learning, pool)


def steps_ladder(steps: Steps, seed: int) -> Ladder:
    """The error of a step's gradient in float32, the larger of both kinds of steps.

    The target is the same in any arithmetic, so only the flow's part of a step is timed.
    """
    kinds = {"pathwise": steps.pathwise(), "balancing": steps.balancing()}
    exact = {name: _gradients("float64", steps, loss, seed) for name, loss in kinds.items()}
    drawn = Drawn.of(steps.flow, SAMPLES, seed)
    return Ladder(
        knob="learning.dtype",
        error_of="error of a step's gradient beside the noise of its batch, median over batches",
        unit="",
        against="float64",
        tolerance=TOLERANCE,
        because=BECAUSE,
        work=f"the flow's part of a path-wise and a balancing step of {steps.settings.batch} design points",
        rungs=[_rung(dtype, steps, kinds, exact, drawn, seed) for dtype in DTYPES],
        note=f"densities are always float64; their figures are those of {SAMPLES} samples in either",
    )


def _gradients(dtype: str, steps: Steps, loss: Loss, seed: int) -> list[np.ndarray]:
    flow = in_arithmetic(steps.flow, dtype)
    return [gradient(flow, loss, number, steps.settings.clip_norm) for number in range(seed, seed + BATCHES)]


def _rung(
    dtype: str, steps: Steps, kinds: dict[str, Loss], exact: dict[str, list[np.ndarray]], drawn: Drawn, seed: int
) -> Rung:
    flow, alone = in_arithmetic(steps.flow, dtype), steps.without_target()
    both, clip_norm = (alone.pathwise(), alone.balancing()), steps.settings.clip_norm
    _, seconds, memory = timed(lambda: [gradient(flow, loss, seed, clip_norm) for loss in both])
    default, values = dtype == steps.settings.dtype, _densities(dtype, steps, drawn)
    if dtype == "float64":
        return Rung(dtype, 0.0, 0.0, seconds, memory, default, reference=True, values=values)
    found = {name: each_beside_noise(_gradients(dtype, steps, loss, seed), exact[name]) for name, loss in kinds.items()}
    for name, shares in found.items():
        # a leaked sample near a silhouette has a gradient without bounds, which any rounding may turn over
        values |= {f"{name}_error": float(np.median(shares)), f"{name}_beyond": float((shares > TOLERANCE).mean())}
    error, uncertainty = max(_median(shares) for shares in found.values())
    return Rung(dtype, error, uncertainty, seconds, memory, default, values=values)


def _median(values: np.ndarray) -> tuple[float, float]:
    """The median, and its standard error from the median deviation as for normal values."""
    middle = float(np.median(values))
    deviation = MEDIAN_DEVIATION * float(np.median(np.abs(values - middle)))
    return middle, MEDIAN_ERROR * deviation / math.sqrt(len(values))


def _densities(dtype: str, steps: Steps, drawn: Drawn) -> dict[str, float]:
    """What densities of the flow's samples would lose and cost in an arithmetic."""
    flow, exact = in_arithmetic(steps.flow, dtype), drawn.log_prob
    found, seconds, _ = timed(lambda: drawn.log_densities(flow))
    usable = np.isfinite(found)
    return {
        "densities_misplaced": misplaced_share(np.where(usable, found, -np.inf), exact, exact)[0],
        "densities_largest_nats": float(np.abs(found - exact)[usable].max(initial=0.0)),
        "densities_not_finite": float(1 - usable.mean()),
        "densities_round_trip_nats": drawn.round_trip_nats(flow),
        "densities_seconds": seconds,
    }
