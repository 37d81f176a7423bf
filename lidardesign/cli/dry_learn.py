"""What `learn --dry-run` says."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.cli.console import plain_json
from lidardesign.cli.dry_run import Plan, like_time

if TYPE_CHECKING:
    from pydantic import BaseModel

    from lidardesign.cli.goals import Goal
    from lidardesign.cli.starts import Job

WRITTEN = (
    "config.yaml",
    "manifest.json",
    "progress.jsonl",
    "checkpoint.safetensors",
    "flow.safetensors",
    "samples.npz",
    "snapshots/",
)
# The sections that learning takes its time from; a seed changes nothing of that.
ALIKE = ("task_name", "task", "space", "density", "learning")


def learn_plan(job: Job, device: str, config_file: Path | None) -> Plan:
    """The plan of a learning.

    Arguments:
        job: What would be learned where.
        device: Where the flow would be trained.
        config_file: The configuration file that was given.
    """
    settings = plain_json(job.settings.as_document())
    learning = job.settings.learning
    steps = [
        f"{'go on with' if job.has_checkpoint else 'learn'} task {job.task.name}, preset {job.settings.preset}, "
        f"seed {job.settings.seed}, on {device}",
        _length(job.goal, learning.steps, learning.batch),
        f"draw {learning.samples:,} samples for fit and constrain, and measure how good they are",
    ]
    reads = [path for path in (config_file, *_inputs(job.settings.task)) if path is not None]
    if job.begun:
        reads += sorted(path for path in job.run.iterdir() if path.is_file() and not path.name.startswith("."))
    return Plan(
        "learn",
        steps,
        reads,
        [job.run / name if not name.endswith("/") else f"{job.run / name}/" for name in WRITTEN],
        settings,
        None if job.begun else like_time(job.run, {name: settings[name] for name in ALIKE}),
    )


def _length(goal: Goal, steps: int, batch: int) -> str:
    if goal.tolerance is not None:
        return (
            f"until at most {goal.tolerance:g} of its mass is in the wrong place, in stages from {steps // 8:,} steps"
        )
    if goal.time_budget_s is not None:
        return f"as many steps as end within {goal.time_budget_s:g} s"
    return f"{steps:,} steps of {batch:,} points"


def _inputs(config: BaseModel) -> list[Path]:
    """The files and folders that a task's configuration names."""

    def within(value: Any) -> list[Path]:
        if isinstance(value, Path):
            return [value]
        if isinstance(value, dict):
            value = list(value.values())
        if isinstance(value, list | tuple):
            return [path for item in value for path in within(item)]
        return _inputs(value) if hasattr(value, "model_fields_set") else []

    return within([value for _, value in config])
