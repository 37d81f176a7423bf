"""How long steps take here, and learning that ends within a time.

Steps of each phase and a measurement are timed on the untrained flow. Under a time budget learning goes on until what
is left is what measuring and writing will take. What that is, is only known once the flow has found the surfaces, so it
is timed anew when the first steps are done. The run is then the one that its number of steps would have given without a
clock; config.yaml has it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from lidardesign.config import RunConfig
from lidardesign.density.learn import TrainingData, make_trainer, on_one_thread
from lidardesign.density.target.target import Target
from lidardesign.density.training.quality import draw_probes
from lidardesign.density.training.sampling import LearnedFlow, draw_samples, log_density_of
from lidardesign.density.training.training import Trainer, least_balancing_steps
from lidardesign.errors import ConfigError
from lidardesign.task import random_generator

Value = TypeVar("Value")

WHERE = "--time-budget"
# The share of the time that is left unplanned: steps of a shared machine repeat no better.
RESERVE = 0.1
TIMED_STEPS = 6
TIMED_POINTS = 2048
WARMING_POINTS = 2
# Drawing has a cost of its own besides that of each probe: up to so many are drawn to be timed, not a share of them.
MOST_PROBES = 8192
# Writing the flow and the samples, printing the result, and ending the process.
WRITING_S = 2.0


@dataclass(frozen=True, eq=False)
class TimedProbes:
    """Probes as the measurement at the end draws them; they do not depend on the flow.

    Arguments:
        points: Those that were drawn, shape (N, 6).
        scale: How many more the configuration asks for.
        seconds: What drawing them all takes [s].
    """

    points: np.ndarray
    scale: float
    seconds: float


@dataclass(frozen=True, eq=False)
class StepTimes:
    """What steps take here, measured on the untrained flow.

    Arguments:
        pathwise_s, balancing_s: One step of each phase.
        finishing_s: Measuring and writing at the end.
        probes: Those that the measurement was timed with.
    """

    pathwise_s: float
    balancing_s: float
    finishing_s: float
    probes: TimedProbes

    @classmethod
    @on_one_thread()
    def measured(cls, data: TrainingData, config: RunConfig, run: Path, device: torch.device) -> StepTimes:
        """Take a few steps of each phase, draw a few samples; nothing is written."""
        trainer = make_trainer(data, config, run, device)
        last = trainer.pathwise_steps - 1
        pathwise = max(_seconds_per_step(trainer, 0), _seconds_per_step(trainer, last)) if last >= 0 else 0
        probes = _timed_probes(data.target, config)
        balancing, finishing = _seconds_per_step(trainer, last + 1), _finishing_s(trainer.learned(), probes, config)
        return cls(pathwise, balancing, finishing, probes)

    def balancing_within(self, seconds: float, pathwise_steps: int) -> int:
        """The balancing steps that fit behind so many path-wise ones."""
        return max(math.floor((seconds - self.of(pathwise_steps, 0)) / self.balancing_s), 0)

    def of(self, pathwise_steps: int, balancing_steps: int) -> float:
        """So many steps of each phase, measured and written [s]."""
        return pathwise_steps * self.pathwise_s + balancing_steps * self.balancing_s + self.finishing_s


@dataclass(eq=False)
class Timekeeper:
    """Says when learning has to end.

    Arguments:
        time_budget_s: From the command's beginning to its end [s].
        elapsed_s: How long the command has been running.
        config: The configuration.
        times: What steps take on the untrained flow, once they are measured.
    """

    time_budget_s: float
    elapsed_s: Callable[[], float]
    config: RunConfig
    times: StepTimes | None = None
    _finishing_s: float | None = None

    @property
    def left_s(self) -> float:
        """What can be planned with."""
        return (self.time_budget_s - self.elapsed_s()) * (1 - RESERVE)

    @property
    def least_steps(self) -> int:
        """Those before which learning does not end."""
        pathwise = self.config.learning.pathwise_steps
        return pathwise + least_balancing_steps(pathwise)

    def check(self, times: StepTimes, done: int = 0) -> None:
        """Take these times.

        Raises:
            ConfigError: Not even what is left of the least steps after those done fits; it says what would be enough.
        """
        self.times, pathwise = times, self.config.learning.pathwise_steps
        needed = times.of(max(pathwise - done, 0), self.least_steps - max(pathwise, done))
        if done < self.least_steps and needed > self.left_s:
            least = self.elapsed_s() + needed / (1 - RESERVE)
            raise ConfigError(
                f"{self.time_budget_s:g} s are too short to learn anything useful",
                where=WHERE,
                allowed=f"at least {math.ceil(least)} s for this task on this machine",
                hint="a smaller learning.samples, or fewer training scenes, also leave more time for steps",
            )

    def is_over(self, trainer: Trainer) -> bool:
        """Whether another step would leave too little time for measuring and writing."""
        if self._finishing_s is None:
            self._finishing_s = _finishing_s(trainer.learned(), self.times.probes, self.config)
        return self.left_s < self._finishing_s + self.times.balancing_s


def _seconds_per_step(trainer: Trainer, step: int) -> float:
    """What a step takes at a step of the schedule; the trainer is left as it was."""
    before, stream = trainer.step, trainer.generator.get_state()
    trainer.step, taken = step, []
    for _ in range(1 + TIMED_STEPS):
        started = time.perf_counter()
        trainer.find_gradient()
        taken.append(time.perf_counter() - started)
    trainer.step = before
    trainer.generator.set_state(stream)
    return float(np.mean(taken[1:]))  # the first one may have to compile


def _timed_probes(target: Target, config: RunConfig) -> TimedProbes:
    asked, generator = config.learning.coverage_proposals, random_generator(config.seed, "time budget")
    count = min(MOST_PROBES, asked)
    drawn, seconds = _timed(lambda: draw_probes(target, count, generator))
    return TimedProbes(drawn.points, asked / count, seconds * asked / count)


def _finishing_s(learned: LearnedFlow, probes: TimedProbes, config: RunConfig) -> float:
    """What measuring and writing will take, from a few points [s]; the stream is left as it was."""
    settings, stream = config.learning, learned.generator.get_state()
    few = probes.points[:TIMED_POINTS]
    # the first calls in double precision may have to compile
    draw_samples(learned, WARMING_POINTS)
    log_density_of(learned, few[:WARMING_POINTS])
    _, sampling = _timed(lambda: draw_samples(learned, TIMED_POINTS))
    _, inverting = _timed(lambda: log_density_of(learned, few))
    learned.generator.set_state(stream)
    inverting *= probes.scale * len(probes.points) / max(len(few), 1)
    return sampling * settings.samples / TIMED_POINTS + probes.seconds + inverting + WRITING_S


def _timed(call: Callable[[], Value]) -> tuple[Value, float]:
    started = time.perf_counter()
    value = call()
    return value, time.perf_counter() - started
