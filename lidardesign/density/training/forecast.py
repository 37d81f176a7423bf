"""Time and memory that learning will take here, from its real preparation and a few steps on the untrained flow."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from lidardesign.config import RunConfig
from lidardesign.density.learn import TrainingData, choose_device, make_trainer, on_one_thread
from lidardesign.density.training.sampling import draw_samples
from lidardesign.density.training.training import Trainer, least_balancing_steps
from lidardesign.run.clock import peak_memory_bytes, phase

TIMED_STEPS = 6
TIMED_POINTS = 2048


@phase("planning")
@on_one_thread()
def forecast(
    data: TrainingData, config: RunConfig, run: Path, device: str, time_budget_s: float | None
) -> dict[str, Any]:
    """Time of single steps, the most that all take with the samples after them [s], and the memory held [bytes].

    Nothing is written. A balancing step on a learned density may take longer than on the untrained one that is timed.
    """
    place, learning = choose_device(device), config.learning
    trainer, pathwise = make_trainer(data, config, run, place), learning.pathwise_steps
    pathwise_s = _seconds(lambda: _try_step(trainer, 0)) if pathwise else 0.0
    balancing_s = _seconds(lambda: _try_step(trainer, pathwise))
    sampling_s = _seconds(lambda: draw_samples(trainer.learned(), TIMED_POINTS)) * learning.samples / TIMED_POINTS
    balanced = learning.steps - pathwise
    if time_budget_s is not None:
        in_time = (time_budget_s - pathwise * pathwise_s) / balancing_s
        balanced = min(balanced, max(math.ceil(in_time), least_balancing_steps(pathwise)))
    return {
        "steps": pathwise + balanced,
        "pathwise_s": pathwise_s,
        "balancing_s": balancing_s,
        "seconds": pathwise * pathwise_s + balanced * balancing_s + sampling_s,
        "peak_memory_bytes": peak_memory_bytes(),
        "gpu_memory_bytes": torch.cuda.max_memory_allocated(place) if place.type == "cuda" else None,
    }


def _try_step(trainer: Trainer, step: int) -> None:
    trainer.step = step
    trainer.find_gradient()


def _seconds(call: Callable[[], object]) -> float:
    """Mean time of a call [s], without the first one, which may have to compile."""
    call()
    started = time.perf_counter()
    for _ in range(TIMED_STEPS):
        call()
    return (time.perf_counter() - started) / TIMED_STEPS
