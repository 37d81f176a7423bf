"""How long to learn follows from how good (a tolerance), or how soon (a time budget)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.config import RunConfig, save_run_config
from lidardesign.errors import BackgroundNote, ConfigError, DataError, ThresholdError, check_number
from lidardesign.run.clock import Clock, outermost_clock, phase
from lidardesign.run.manifest import DAMAGED_HINT, FILE_NAME, read_manifest
from lidardesign.run.manifest import note as note_in_manifest
from lidardesign.run.yaml import leaves, load_yaml
from lidardesign.task import Task

if TYPE_CHECKING:
    from lidardesign.density.learn import LearnProgress, LearnResult

    Train = Callable[..., LearnResult]

TOLERANCE, TIME_BUDGET = "--tolerance", "--time-budget"
# What can be told apart from nothing and from all.
TOLERANCES = (1e-4, 0.9999)
# The program takes longer to start; more than a year is a mistake in the unit, too.
SHORTEST_S, LONGEST_S = 1.0, 366 * 24 * 3600.0
STEPS_KEY, MISPLACED_KEY, FIELDS_KEY = "learning.steps", "learning.misplaced", "density.field_resolution"
# What each goal sets.
SETS = {"tolerance": (MISPLACED_KEY,), "time_budget_s": (MISPLACED_KEY, STEPS_KEY)}
# The manifest's word of a goal, and in it what the target's own distance fields misplace.
GOAL, FIELDS = "goal", "target_misplaced"
# A tolerance may take so many times the steps of the preset, a time budget as many as there is time for.
TOLERANCE_STEPS, MOST_STEPS = 4, 100_000_000
# A tolerance is met where the measured share is at most so many standard errors above it.
STANDARD_ERRORS = 2.0
# What passes before a command's clock runs, where the system does not tell: the program's own imports take 0.3 s.
STARTUP_S = 0.5
# A process that is older than this did something else before.
MOST_STARTUP_S = 30.0
# Where Linux says when a process began, in ticks since the computer was started; the fields after its name in brackets.
_STATUS, _STARTED_FIELD = Path("/proc/self/stat"), 19


@dataclass(frozen=True)
class Goal:
    """What decides the number of steps, where the configuration does not.

    Arguments:
        tolerance: The misplaced share to reach.
        time_budget_s: The time to end within.
        fixed_fields, fixed_steps: Whether the resolution of distance fields and the most steps are the user's choice.
    """

    tolerance: float | None = None
    time_budget_s: float | None = None
    fixed_fields: bool = field(default=False, compare=False)
    fixed_steps: bool = field(default=False, compare=False)

    @property
    def is_none(self) -> bool:
        """Whether the configuration decides."""
        return self.tolerance is None and self.time_budget_s is None

    def as_dict(self) -> dict[str, Any]:
        """What the manifest has of it before anything is learned."""
        return {"time_budget_s": self.time_budget_s} if self.tolerance is None else {"tolerance": self.tolerance}

    def applied(self, config: RunConfig) -> RunConfig:
        """The configuration that a new run towards the goal begins with."""
        update: dict[str, Any] = {}
        if self.time_budget_s is not None:
            update = {"misplaced": 0.0, "steps": MOST_STEPS}
        elif self.tolerance is not None:
            times = 1 if self.fixed_steps else TOLERANCE_STEPS
            update = {"misplaced": self.tolerance, "steps": min(times * config.learning.steps, MOST_STEPS)}
        return replace(config, learning=config.learning.model_copy(update=update))


def checked_goal(tolerance: float | None, time_budget_s: float | None, given: Mapping[str, Any]) -> Goal:
    """The goal of the two options.

    Arguments:
        tolerance, time_budget_s: The options.
        given: The other options of the configuration, as `lidardesign.config.resolve` takes them.

    Raises:
        ConfigError: Both, a value that is none, or beside them a setting that they set.
    """
    if tolerance is not None and time_budget_s is not None:
        raise ConfigError(
            "both set the number of steps", where=f"{TOLERANCE}, {TIME_BUDGET}", allowed="only one of them"
        )
    keys, path = {text.partition("=")[0].strip() for text in given["overrides"]}, given["config_file"]
    if tolerance is None and time_budget_s is None:
        return Goal()
    document = None if path is None else load_yaml(path, empty_sections=True)
    of_file = set() if document is None else {".".join(map(str, key)) for key in dict(leaves(document.value))}
    goal = Goal(tolerance, time_budget_s, path is not None or FIELDS_KEY in keys, STEPS_KEY in keys | of_file)
    where, said, bounds = TOLERANCE, "the tolerance", TOLERANCES
    if tolerance is None:
        where, said, bounds = TIME_BUDGET, "the time budget", (SHORTEST_S, LONGEST_S)
    ((name, value),) = goal.as_dict().items()
    check_number(value, where, *bounds)
    for key in SETS[name]:
        if key in keys:
            raise ConfigError(f"{said} sets {key}", where=where, hint=f"leave out --set {key}")
    if time_budget_s is not None and STEPS_KEY in of_file:
        where = f"{TIME_BUDGET}, {document.locate(tuple(STEPS_KEY.split('.')))}"
        raise ConfigError(f"the time budget sets {STEPS_KEY}", where=where, hint=f"leave out {STEPS_KEY} there")
    return goal


def resumed_goal(asked: Goal, run: Path) -> Goal:
    """The goal that a run was started with.

    Raises:
        ConfigError: Another one is asked for.
        DataError: The manifest's word of it is damaged.
    """
    recorded = read_manifest(run).get(GOAL) or {}
    stored = Goal(recorded.get("tolerance"), recorded.get("time_budget_s"))
    if not all(isinstance(value, float | int | None) for value in (*asdict(stored).values(), recorded.get(FIELDS))):
        raise DataError(f"the manifest's {GOAL!r} is damaged", where=str(run / FILE_NAME), hint=DAMAGED_HINT)
    if asked.is_none or asked == stored:
        return stored
    where = TOLERANCE if asked.tolerance is not None else TIME_BUDGET
    (key, value), begun = next(iter(asked.as_dict().items())), "neither goal"
    if not stored.is_none:
        begun = " = ".join(str(part) for part in next(iter(stored.as_dict().items())))
    raise ConfigError(f"the run was started with {begun}, not {key} = {value:g}", where=where, hint="resume without it")


@dataclass(frozen=True, eq=False)
class Learner:
    """Learns one task in one folder.

    Arguments:
        task: The plugin.
        run: The folder.
        device: auto, cpu or cuda.
        progress: Called about every tenth step.
        clock: By which a time budget is measured.
        remark: Called with what is wrong with lengths, before anything is learned.
    """

    task: Task
    run: Path
    device: str
    progress: Callable[[LearnProgress], None] | None
    clock: Clock
    remark: Callable[[str], None] | None = None

    def learn(self, config: RunConfig, goal: Goal, *, resume: bool) -> LearnResult:
        """Learn a configuration, or to a goal, or go on with it."""
        with phase("libraries"):
            from lidardesign.density.learn import learn as learn_density

        train = partial(learn_density, self.task, run=self.run, device=self.device, progress=self.progress)
        if goal.tolerance is not None:
            return self._to_tolerance(config, goal, resume, train)
        if goal.time_budget_s is not None:
            return self._within(config, goal.time_budget_s, resume, train)
        return train(config, resume=resume, remark=self.remark)

    def _to_tolerance(self, config: RunConfig, goal: Goal, resume: bool, train: Train) -> LearnResult:
        """Learn until the density and the target's own distance fields are within the tolerance: shares add up."""
        of_fields, note = (read_manifest(self.run).get(GOAL) or {}).get(FIELDS), ""
        if of_fields is None:
            config, of_fields, note = self._with_fields(config, goal)
            save_run_config(config, self.run)
            note_in_manifest(self.run, **{GOAL: {**goal.as_dict(), FIELDS: of_fields}})
        result = train(config, resume=resume, remark=self.remark)
        error = result.error_estimates["misplaced"].error or 0.0
        # without coverage nothing knows what the density dropped
        is_within = result.misplaced + of_fields <= goal.tolerance + STANDARD_ERRORS * error
        met = is_within and result.coverage > 0
        reached = {**goal.as_dict(), FIELDS: of_fields, "met": met}
        note_in_manifest(self.run, **{GOAL: reached})
        return self._whole(result, note, reached)

    def _with_fields(self, config: RunConfig, goal: Goal) -> tuple[RunConfig, float, str]:
        """The configuration with fields for the tolerance and what they leave of it to learning."""
        from lidardesign.density.target.prepare import training_scenes
        from lidardesign.evaluate.accuracy.fields import fields_within

        scenes = training_scenes(self.task, config)
        chosen = fields_within(scenes, config, goal.tolerance, fixed=goal.fixed_fields)
        if chosen.misplaced >= goal.tolerance:
            raise ConfigError(
                f"{chosen.note}, which leaves nothing for learning",
                where=TOLERANCE,
                allowed=f"above {chosen.misplaced:.2g}",
                hint=f"a larger {FIELDS_KEY}, or a larger tolerance",
            )
        learning = config.learning.model_copy(update={"misplaced": goal.tolerance - chosen.misplaced})
        return replace(config, density=chosen.density, learning=learning), chosen.misplaced, chosen.note

    def _within(self, config: RunConfig, time_budget_s: float, resume: bool, train: Train) -> LearnResult:
        """Learn until the time is over; config.yaml then has the number of steps."""
        from lidardesign.density.learn import choose_device, prepare_training_data
        from lidardesign.density.training.checkpoint import load_arrays
        from lidardesign.density.training.schedule import StepTimes, Timekeeper
        from lidardesign.density.training.training import CHECKPOINT

        place, startup = choose_device(self.device), self._startup_s()
        keeper = Timekeeper(time_budget_s, lambda: self.clock.seconds + startup, config)
        data = prepare_training_data(self.task, config, self.remark)
        with phase("planning"):
            done = int(load_arrays(self.run, CHECKPOINT)[1]["step"]) if resume else 0
            keeper.check(StepTimes.measured(data, config, self.run, place), done)
        result = train(config, resume=resume, data=data, is_over=keeper.is_over)
        reached = config.learning.model_copy(update={"steps": result.steps})
        save_run_config(replace(config, learning=reached), self.run)
        note = f"{result.steps} steps fit into {time_budget_s:g} s"
        return self._whole(result, note, {"time_budget_s": time_budget_s, "steps": result.steps})

    def _startup_s(self) -> float:
        """What passed before the clock was made, if it is a command's: that counts for whoever waits [s]."""
        if self.clock is not outermost_clock():
            return 0.0
        age = _age_s()
        return STARTUP_S if age is None or age - self.clock.seconds > MOST_STARTUP_S else age - self.clock.seconds

    def _whole(self, result: LearnResult, note: str, goal: dict[str, Any]) -> LearnResult:
        notes = (*result.notes, *([BackgroundNote(note)] if note else []))
        return replace(result, notes=notes, goal=goal, seconds=round(self.clock.seconds, 3))


def _age_s() -> float | None:
    """How long this process has been running [s]; None where the system does not tell."""
    try:
        ticks = int(_STATUS.read_text(encoding="ascii").rpartition(")")[2].split()[_STARTED_FIELD])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def check_met(result: LearnResult, goal: Goal) -> None:
    """Exit 1 where the tolerance was not reached.

    Raises:
        ThresholdError: With what was reached.
    """
    if goal.tolerance is None or result.goal["met"]:
        return
    error, fields = result.error_estimates["misplaced"].error, result.goal[FIELDS]
    doubt = "" if error is None else f" +- {error:.2g}"
    if fields:
        doubt += f", and {fields:.2g} of the target's by its distance fields,"
    raise ThresholdError(
        f"{result.misplaced:.3g}{doubt} of the density's mass is in the wrong place after {result.steps} steps",
        where=TOLERANCE,
        allowed=f"at most {goal.tolerance:g}",
        hint="--preset fine learns a larger flow; the run is finished and can be used as it is",
    )
