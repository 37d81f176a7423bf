"""How long learning goes on where its user gave a goal instead of steps: a tolerance, or a time budget.

To a tolerance: trainings of doubled length, until the misplaced share of the density is small enough. Every stage
starts anew with a schedule of its own length, because the schedule is what makes few steps good: sigma falls and the
mass is balanced within them. All stages together take less than twice the steps of the last one. The run is left as if
learning had been asked for with the steps of that last one, bit for bit; the manifest keeps what was tried.

Within a time budget: as many steps as fit, planned from this run's own first steps. The first plan comes from a few
steps of the untrained flow. What balancing steps and the measurement at the end take is only known once the flow has
found the surfaces, so their number is planned anew when balancing begins. The path-wise phase knows nothing of it: the
run is then the one that the new numbers of steps would have given from the start, and config.yaml has them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from pydantic import TypeAdapter, ValidationError

from lidardesign.config import LearningSettings, RunConfig, save_run_config
from lidardesign.density.learn import FLOW, LearnResult, TrainingData, make_trainer
from lidardesign.density.target.target import Target
from lidardesign.density.training.checkpoint import clear_snapshots
from lidardesign.density.training.quality import draw_probes
from lidardesign.density.training.sampling import draw_samples, log_density_of
from lidardesign.density.training.training import CHECKPOINT, PROGRESS, Trainer
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.manifest import DAMAGED_HINT, FILE_NAME, forget, note, read_manifest, write_manifest
from lidardesign.samples import FILE_NAME as SAMPLES
from lidardesign.task import random_generator

GOAL = "goal"
# Stages take these multiples of the planned steps: an eighth shows what is cheap, and beyond four times of them a
# larger flow (another preset) does more than more steps.
MULTIPLES = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0)
# The fall of the next doublings is foreseen from the last one, read with so many standard errors in its favour.
STANDARD_ERRORS = 2.0


@dataclass(frozen=True)
class Stage:
    """What one length of training reached.

    Arguments:
        steps: Its steps.
        misplaced: The share of the density's mass in the wrong place.
        error: Its standard error.
        seconds: The whole of the stage [s].
    """

    steps: int
    misplaced: float
    error: float
    seconds: float


@dataclass(frozen=True)
class ToleranceGoal:
    """A tolerance that a run is learned to, and how far that is.

    Arguments:
        tolerance: The largest misplaced share that is good enough.
        planned_steps: The steps that the configuration asked for; stages are multiples of them.
        stages: What was reached, in the order of steps.
        target_misplaced: What the target's own distance fields misplace; shares add up at most.
    """

    tolerance: float
    planned_steps: int
    stages: tuple[Stage, ...] = ()
    target_misplaced: float = 0.0

    @property
    def left(self) -> float:
        """What learning may misplace."""
        return self.tolerance - self.target_misplaced

    @property
    def met(self) -> bool:
        """Whether the last stage is within the tolerance."""
        return bool(self.stages) and self.stages[-1].misplaced <= self.left

    @property
    def hopeless(self) -> bool:
        """Whether no further stage would meet it, should all fall as the last doubling did.

        Judged from the planned steps on: shorter trainings fall by another law.
        """
        further = [steps for steps in stage_steps(self.planned_steps) if steps > self.stages[-1].steps]
        if not further:
            return True
        if len(self.stages) < 2 or self.stages[-1].steps < self.planned_steps:
            return False
        before, last = self.stages[-2:]
        low = max(last.misplaced - STANDARD_ERRORS * last.error, 0.0)
        fall = min(low / (before.misplaced + STANDARD_ERRORS * before.error), 1.0) if before.misplaced else 1.0
        return low * fall ** len(further) > self.left

    def with_stage(self, stage: Stage) -> ToleranceGoal:
        """The goal after a stage, in place of an earlier one of the same steps."""
        return replace(self, stages=(*(other for other in self.stages if other.steps != stage.steps), stage))

    def as_dict(self) -> dict[str, Any]:
        """The form that the manifest has."""
        return {**asdict(self), "stages": [asdict(stage) for stage in self.stages], "met": self.met}


def stage_steps(planned: int) -> tuple[int, ...]:
    """The steps of every stage, ascending and distinct."""
    return tuple(dict.fromkeys(max(round(planned * multiple), 1) for multiple in MULTIPLES))


def goal_of(run: Path) -> ToleranceGoal | None:
    """The tolerance that a run was started with, if it was.

    Raises:
        DataError: The manifest's word of it is damaged.
    """
    found = read_manifest(run).get(GOAL) or {}
    if "planned_steps" not in found:
        return None
    try:
        return TypeAdapter(ToleranceGoal).validate_python({key: found[key] for key in found if key != "met"})
    except ValidationError as error:
        raise DataError(
            f"the manifest's {GOAL!r} is damaged: {error.errors()[0]['msg']}",
            where=str(Path(run) / FILE_NAME),
            hint=DAMAGED_HINT,
        ) from None


def with_steps(config: RunConfig, steps: int) -> RunConfig:
    """A configuration with another number of steps."""
    return replace(config, learning=config.learning.model_copy(update={"steps": steps}))


def learn_to_tolerance(
    config: RunConfig,
    run: Path,
    goal: ToleranceGoal,
    learn_once: Callable[[RunConfig, bool], LearnResult],
    *,
    resume: bool = False,
) -> tuple[LearnResult, ToleranceGoal]:
    """Learn in stages until one is within the tolerance, or no further one would be.

    Arguments:
        config: The configuration; that of the stage that was interrupted where there was one.
        run: The run's folder; its config.yaml always has the steps of the stage at work.
        goal: The tolerance, and the stages that were finished before.
        learn_once: Learns a configuration in the run's folder, or continues it.
        resume: Continue the stage of the configuration from its checkpoint.
    """
    first = config.learning.steps if resume or goal.stages else 0
    # the stages from this one on; a configuration that is none of them is one of its own
    for steps in sorted({steps for steps in (first, *stage_steps(goal.planned_steps)) if steps >= max(first, 1)}):
        staged = with_steps(config, steps)
        if not resume:
            # what the stage before left goes; killed in between, the next one is learned again
            forget(run, [CHECKPOINT, PROGRESS, FLOW, SAMPLES])
            clear_snapshots(run)
            manifest = read_manifest(run)
            manifest.pop("learn", None)
            write_manifest(run, {**manifest, GOAL: goal.as_dict()})
            save_run_config(staged, run)
        result = learn_once(staged, resume)
        resume = False
        error = result.error_estimates["misplaced"].error or 0.0
        goal = goal.with_stage(Stage(steps, result.misplaced, error, result.seconds))
        note(run, **{GOAL: goal.as_dict()})
        if goal.met or goal.hopeless:
            break
    return result, goal


Value = TypeVar("Value")

WHERE = "--time-budget"
# Fewer steps than this anneal so fast that the flow cannot follow; the least budget is the one that they take.
LEAST_STEPS = 100
# The share of the time that is left unplanned: steps of a shared machine repeat no better.
RESERVE = 0.1
TIMED_STEPS = 6
TIMED_POINTS = 2048
WARMING_POINTS = 2
# Drawing has a cost of its own besides that of each probe: up to so many are drawn to be timed, not a share of them.
MOST_PROBES = 8192
# Writing the flow and the samples, printing the result, and ending the process.
WRITING_S = 2.0


@dataclass(frozen=True)
class TimePlan:
    """How a time budget is spent.

    Arguments:
        time_budget_s: The whole command's.
        pathwise_s, balancing_s: What one step of each phase was measured to take.
        finishing_s: What is foreseen for measuring and writing.
        pathwise_steps, balancing_steps: What fits.
        settled: Whether balancing steps were planned by the trained flow.
    """

    time_budget_s: float
    pathwise_s: float
    balancing_s: float
    finishing_s: float
    pathwise_steps: int
    balancing_steps: int
    settled: bool = False

    @property
    def steps(self) -> int:
        """Of both phases."""
        return self.pathwise_steps + self.balancing_steps

    def applied(self, settings: LearningSettings) -> LearningSettings:
        """Settings with the planned numbers of steps."""
        return settings.model_copy(update={"steps": self.steps, "balance": self.balancing_steps / self.steps})

    def as_dict(self) -> dict[str, Any]:
        """The form that the manifest has."""
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(self).items()}


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
    def measured(cls, data: TrainingData, config: RunConfig, run: Path, device: torch.device) -> StepTimes:
        """Take a few steps of each phase, draw a few samples; nothing is written."""
        trainer = make_trainer(data, config, run, device)
        last = trainer.pathwise_steps - 1
        pathwise = max(_seconds_per_step(trainer, 0), _seconds_per_step(trainer, last)) if last >= 0 else 0
        balancing = _seconds_per_step(trainer, trainer.pathwise_steps) if config.learning.balance > 0 else 0.0
        probes = _timed_probes(data.target, config)
        return cls(pathwise, balancing, _finishing_s(trainer, probes, config), probes)

    def per_step(self, balance: float) -> float:
        """A step in the mean, where a share of them balances [s]."""
        return (1 - balance) * self.pathwise_s + balance * self.balancing_s

    def of(self, steps: int, balance: float) -> float:
        """So many steps, measured and written [s]."""
        return steps * self.per_step(balance) + self.finishing_s


@dataclass(eq=False)
class Timekeeper:
    """Plans the steps of one command.

    Arguments:
        time_budget_s: From the command's beginning to its end [s].
        elapsed_s: How long the command has been running.
        config: The configuration before it is planned.
        run: The run's folder.
    """

    time_budget_s: float
    elapsed_s: Callable[[], float]
    config: RunConfig
    run: Path
    planned: TimePlan | None = None
    probes: TimedProbes | None = None

    @property
    def left_s(self) -> float:
        """What can be planned with."""
        return (self.time_budget_s - self.elapsed_s()) * (1 - RESERVE)

    def plan(self, data: TrainingData, device: torch.device) -> RunConfig:
        """The configuration with as many steps as fit, which the run's folder then has.

        Raises:
            ConfigError: Not even `LEAST_STEPS` fit; it says what would be enough.
        """
        times = StepTimes.measured(data, self.config, self.run, device)
        self.probes = times.probes
        self.planned = self.fitting(times)
        return self._apply()

    def fitting(self, times: StepTimes) -> TimePlan:
        """How the time that is left would be spent.

        Raises:
            ConfigError: Not even `LEAST_STEPS` fit; it says what would be enough.
        """
        share, left = self.config.learning.balance, self.left_s
        steps = math.floor((left - times.finishing_s) / times.per_step(share))
        if steps < LEAST_STEPS:
            least = self.elapsed_s() + times.of(LEAST_STEPS, share) / (1 - RESERVE)
            raise ConfigError(
                f"{self.time_budget_s:g} s are too short to learn anything useful",
                where=WHERE,
                allowed=f"at least {math.ceil(least)} s for this task on this machine",
                hint="a smaller learning.samples, or fewer training scenes, also leave more time for steps",
            )
        before = round((1 - share) * steps)
        return TimePlan(
            self.time_budget_s, times.pathwise_s, times.balancing_s, times.finishing_s, before, steps - before,
            settled=share == 0,
        )  # fmt: skip

    def replan(self, trainer: Trainer) -> LearningSettings:
        """The settings with as many balancing steps as fit now that the flow is trained; config.yaml follows."""
        balancing, finishing = _seconds_per_step(trainer, trainer.step), _finishing_s(trainer, self.probes, self.config)
        steps = max(math.floor((self.left_s - finishing) / balancing), 1)
        self.planned = replace(
            self.planned, balancing_s=balancing, finishing_s=finishing, balancing_steps=steps, settled=True
        )
        return self._apply().learning

    def _apply(self) -> RunConfig:
        self.config = replace(self.config, learning=self.planned.applied(self.config.learning))
        save_run_config(self.config, self.run)
        note(self.run, **{GOAL: self.planned.as_dict()})
        return self.config


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


def _finishing_s(trainer: Trainer, probes: TimedProbes, config: RunConfig) -> float:
    """What measuring and writing will take, from a few points [s]; the trainer is left as it was."""
    settings, stream = config.learning, trainer.generator.get_state()
    dtype = next(trainer.flow.parameters()).dtype
    trainer.flow.double()
    few = probes.points[:TIMED_POINTS]
    # the first calls in double precision may have to compile
    draw_samples(trainer, WARMING_POINTS)
    log_density_of(trainer, few[:WARMING_POINTS])
    _, sampling = _timed(lambda: draw_samples(trainer, TIMED_POINTS))
    _, inverting = _timed(lambda: log_density_of(trainer, few))
    trainer.flow.to(dtype)
    trainer.generator.set_state(stream)
    inverting *= probes.scale * len(probes.points) / max(len(few), 1)
    return sampling * settings.samples / TIMED_POINTS + probes.seconds + inverting + WRITING_S


def _timed(call: Callable[[], Value]) -> tuple[Value, float]:
    started = time.perf_counter()
    value = call()
    return value, time.perf_counter() - started
