"""The folder of a run around its learning: started, resumed, and taken away where nothing was learned."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.cli.output import Output
from lidardesign.errors import ConfigError, DataError
from lidardesign.workflow.learning_budget import GOAL, Goal, resumed_goal

if TYPE_CHECKING:
    from lidardesign.config import RunConfig
    from lidardesign.task import Task

# A run has begun once it has this file; it is written last of those of a start.
CONFIGURATION = "config.yaml"
LOCK = ".lock"
# Snapshots are of no use without a checkpoint.
STARTED_FILES = {CONFIGURATION, "manifest.json", "progress.jsonl", "snapshots"}
CHECKPOINTS = "checkpoint*"
STEPS = ("learning", "steps")


@dataclass(frozen=True)
class Job:
    """What is learned where; `begun` tells a run that is gone on with from a new one."""

    task: Task
    run: Path
    settings: RunConfig
    goal: Goal
    begun: bool = False

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is one to go on from."""
        return self.begun and any(self.run.glob(CHECKPOINTS))


def started(task: Task, run: Path, goal: Goal, choices: dict[str, Any]) -> Job:
    """A run that is new."""
    from lidardesign.config import resolve

    check_can_start(run)
    return Job(task, run, resolve(task, **choices), goal)


def resumed(task: Task, run: Path, goal: Goal, choices: dict[str, Any], console: Output) -> Job:
    """A run that was interrupted, or killed before it had begun: that one is started anew."""
    from lidardesign.config import load_run_config
    from lidardesign.registry import load_task

    _check_can_resume(run)
    if _was_killed_before_it_began(run):
        console.note("nothing of the run was kept yet; it starts from the beginning")
        return started(task, run, goal, choices)
    stored, settings = load_run_config(run)
    job = Job(stored, run, settings, resumed_goal(goal, run), begun=True)
    if not job.has_checkpoint:
        console.note("the run has no checkpoint yet; it starts from the beginning")
    _check_same(settings, stored if stored.name == task.name else load_task(task.name), choices, run)
    return job


def _was_killed_before_it_began(run: Path) -> bool:
    """Whether a folder holds nothing but what a start that was killed leaves; an empty one does."""
    from lidardesign.run.files import is_temporary

    names = {entry.name for entry in run.iterdir()}
    return CONFIGURATION not in names and all(
        name in STARTED_FILES or name == LOCK or is_temporary(name) for name in names
    )


def check_can_start(run: Path) -> None:
    """Refuse a folder that holds anything, so that no run is ever overwritten."""
    if run.is_file():
        raise ConfigError("is a file", where=f"--out {run}", allowed="a folder that is new or empty")
    if run.is_dir() and not _was_killed_before_it_began(run):
        hint = "continue it with --resume, or give another --out"
        raise ConfigError("the folder is not empty", where=f"--out {run}", allowed="a new or empty folder", hint=hint)


def _check_can_resume(run: Path) -> None:
    if not run.is_dir():
        raise DataError("there is no run to resume", where=str(run), hint="leave out --resume to start it")


def _check_same(stored: RunConfig, task: Task, choices: dict[str, Any], run: Path) -> None:
    """Refuse to resume a run under another configuration; repeating its own options is fine."""
    from lidardesign.config import resolve
    from lidardesign.run.yaml import leaves

    wanted = resolve(
        task,
        preset=choices["preset"] or stored.preset,
        config_file=choices["config_file"] or run / "config.yaml",
        overrides=choices["overrides"],
        seed=stored.seed if choices["seed"] is None else choices["seed"],
    )
    old, new = dict(leaves(stored.as_document())), dict(leaves(wanted.as_document()))
    if new[STEPS] == _planned_steps(run):  # the stage at work towards a tolerance has its own number of them
        new[STEPS] = old[STEPS]
    for path in [*old, *new]:
        if old.get(path) != new.get(path):
            key = ".".join(map(str, path))
            raise ConfigError(
                f"the run was started with {key} = {old.get(path)!r}, not {new.get(path)!r}",
                where=str(run / "config.yaml"),
                hint="resume without options, or start a new run with another --out",
            )


def _planned_steps(run: Path) -> Any:
    from lidardesign.run.manifest import read_manifest

    return (read_manifest(run).get(GOAL) or {}).get("planned_steps")


def begin(job: Job) -> None:
    """Write what a run is before anything is learned; the configuration last."""
    from lidardesign.config import save_run_config
    from lidardesign.run.manifest import note, start_manifest

    start_manifest(job.run, command=["lidardesign", *sys.argv[1:]], seed=job.settings.seed)
    if not job.goal.is_none:
        note(job.run, **{GOAL: job.goal.as_dict()})
    save_run_config(job.settings, job.run)


@contextlib.contextmanager
def made(run: Path) -> Iterator[None]:
    """Make the folder; after a failure take it away again where it is empty."""
    new = [folder for folder in (run, *run.parents) if not folder.exists()]
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot be made: {error.strerror or error}", where=f"--out {run}") from None
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in new:
                folder.rmdir()
        raise


@contextlib.contextmanager
def undone_on_failure(job: Job) -> Iterator[None]:
    """When a new run fails before anything was learned, take away what this command put there."""
    try:
        yield
    except BaseException:
        if not job.begun:
            _take_away(job.run)
        raise


def _take_away(run: Path) -> None:
    entries = [entry for entry in run.iterdir() if entry.name != LOCK]
    nothing_learned = all(entry.name in STARTED_FILES or entry.stat().st_size == 0 for entry in entries)
    if not nothing_learned or has_stages(run):
        return
    with contextlib.suppress(OSError):
        # without its configuration a run has not begun, whatever else is left of it
        (run / CONFIGURATION).unlink(missing_ok=True)
        for entry in entries:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink(missing_ok=True)


def has_stages(run: Path) -> bool:
    """Whether trainings were finished on the way to a tolerance: what they reached is worth going on from."""
    from lidardesign.run.manifest import read_manifest

    try:
        return bool((read_manifest(run).get(GOAL) or {}).get("stages"))
    except DataError:
        return False
