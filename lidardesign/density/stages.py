"""Learning to a tolerance: trainings of doubled length, until the misplaced share of the density is small enough.

Every stage starts anew with a schedule of its own length, because the schedule is what makes few steps good: sigma
falls and the mass is balanced within them. All stages together take less than twice the steps of the last one. The run
is left as if learning had been asked for with the steps of that last one, bit for bit; the manifest keeps what was
tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from lidardesign.density.learn import FLOW, LearnResult
from lidardesign.density.snapshots import clear_snapshots
from lidardesign.density.training import CHECKPOINT, PROGRESS
from lidardesign.design.samples import FILE_NAME as SAMPLES
from lidardesign.errors import DataError
from lidardesign.run.config import RunConfig, save_run_config
from lidardesign.run.manifest import DAMAGED_HINT, FILE_NAME, forget, note, read_manifest, write_manifest

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
        kept = tuple(one for one in self.stages if one.steps != stage.steps)
        return replace(self, stages=(*kept, stage))

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
        goal = TypeAdapter(ToleranceGoal).validate_python({key: found[key] for key in found if key != "met"})
    except ValidationError as error:
        raise DataError(
            f"the manifest's {GOAL!r} is damaged: {error.errors()[0]['msg']}",
            where=str(Path(run) / FILE_NAME),
            hint=DAMAGED_HINT,
        ) from None
    return goal


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
    for steps in _remaining(goal.planned_steps, first):
        staged = with_steps(config, steps)
        if not resume:
            _begin(run, staged, goal)
        result = learn_once(staged, resume)
        resume = False
        error = result.error_estimates["misplaced"].error or 0.0
        goal = goal.with_stage(Stage(steps, result.misplaced, error, result.seconds))
        note(run, **{GOAL: goal.as_dict()})
        if goal.met or goal.hopeless:
            break
    return result, goal


def _remaining(planned: int, first: int) -> Sequence[int]:
    """The stages from one on; a configuration that is none of them is one of its own."""
    return sorted({*(steps for steps in stage_steps(planned) if steps > first), *([first] if first else [])})


def _begin(run: Path, config: RunConfig, goal: ToleranceGoal) -> None:
    """Take away what the stage before left and enter the next one; killed in between, that stage is learned again."""
    forget(run, [CHECKPOINT, PROGRESS, FLOW, SAMPLES])
    clear_snapshots(run)
    manifest = read_manifest(run)
    manifest.pop("learn", None)
    write_manifest(run, {**manifest, GOAL: goal.as_dict()})
    save_run_config(config, run)
