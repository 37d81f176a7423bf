"""How long learning will take and how much memory: from its real preparation and a few real steps, without a trace."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from lidardesign.config import RunConfig
from lidardesign.density.learn import TrainingData, choose_device
from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.density.training.schedule import WRITING_S, StepTimes, Timekeeper
from lidardesign.density.training.training import CHECKPOINT, STRETCH, least_balancing_steps
from lidardesign.run.clock import peak_memory_bytes, phase

UNTRAINED = "how long balancing steps and the measurement take on a learned density; an untrained one was timed"
GOOD_ENOUGH = "after how many steps the density is good enough"
FINER = "whether the tolerance asks for finer distance fields"


@dataclass(frozen=True)
class Forecast:
    """What learning will take on this machine, as far as a few steps tell.

    Arguments:
        seconds: The whole command, where learning stops as soon as it may [s].
        longest_seconds: The whole command with all steps [s].
        preparing_s: Scenes, fields and proposals [s].
        pathwise_s, balancing_s: One step of each phase [s].
        finishing_s: Measuring [s].
        steps: The most that are taken.
        peak_memory_bytes: The most that was held until then; None where the system does not tell.
        gpu_memory_bytes: The most that was held on the GPU; None without one.
        unknown: What a few steps do not tell.
    """

    seconds: float
    longest_seconds: float
    preparing_s: float
    pathwise_s: float
    balancing_s: float
    finishing_s: float
    steps: int
    peak_memory_bytes: int | None
    gpu_memory_bytes: int | None
    unknown: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For `--dry-run --json`."""
        values = {key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(self).items()}
        return {**values, "unknown": list(self.unknown)}


@phase("planning")
def forecast(
    data: TrainingData,
    config: RunConfig,
    run: Path,
    device: str,
    elapsed_s: Callable[[], float],
    *,
    resume: bool = False,
    tolerance: float | None = None,
    time_budget_s: float | None = None,
) -> Forecast:
    """What learning will take.

    Arguments:
        data: What was prepared for it.
        config: The configuration.
        run: The folder that it would be learned in.
        device: auto, cpu or cuda.
        elapsed_s: How long the command has been running.
        resume: Whether it goes on from the checkpoint there.
        tolerance, time_budget_s: What decides beside the configuration.

    Raises:
        ConfigError: The time budget is too short to learn anything useful.
    """
    prepared, place, learning = elapsed_s(), choose_device(device), config.learning
    times = StepTimes.measured(data, config, run, place)
    state = load_arrays(run, CHECKPOINT)[1] if resume else {"step": 0}
    done = int(state["step"])
    begun, pathwise = max(done, learning.pathwise_steps), max(learning.pathwise_steps - done, 0)
    # the first time that it is measured how good the density is: behind a whole number of stretches of balancing
    least, balanced = least_balancing_steps(learning.pathwise_steps), begun - learning.pathwise_steps
    stretches = max(math.ceil(least / STRETCH), balanced // STRETCH + 1)
    steps = done if state.get("stopped") else learning.steps
    if time_budget_s is not None and not state.get("stopped"):
        keeper = Timekeeper(time_budget_s, lambda: prepared, config)
        keeper.check(times)
        steps = begun + times.balancing_within(keeper.left_s, pathwise)
    fewest = min(learning.pathwise_steps + STRETCH * stretches, steps) if learning.misplaced else steps
    # what a budget keeps in reserve for writing is more than writing takes
    times = replace(times, finishing_s=times.finishing_s - WRITING_S)
    taken = [times.of(pathwise, max(most - begun, 0)) for most in (fewest, steps)]
    unknown = [UNTRAINED, *([GOOD_ENOUGH] if fewest < steps else []), *([FINER] if tolerance is not None else [])]
    return Forecast(
        prepared + taken[0],
        prepared + taken[1],
        prepared,
        times.pathwise_s,
        times.balancing_s,
        times.finishing_s,
        max(steps - done, 0),
        peak_memory_bytes(),
        torch.cuda.max_memory_allocated(place) if place.type == "cuda" else None,
        tuple(unknown),
    )
