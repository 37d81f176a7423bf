"""`lidardesign learn`: learn where rays are worth firing for a task."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.dry_run import DryRun, tell_plan
from lidardesign.cli.output import Output, command, keep_times
from lidardesign.errors import DataError
from lidardesign.run.clock import WAIT_S, phase
from lidardesign.workflow.learning_budget import Learner, TimeBudget, Tolerance, check_met, checked_goal
from lidardesign.workflow.run_lifecycle import (
    CHECKPOINTS,
    Job,
    begin,
    check_can_start,
    has_stages,
    made,
    resumed,
    started,
    undone_on_failure,
)
from lidardesign.workflow.runs import check_choice

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.density.learn import LearnProgress, LearnResult

DEVICES = ("auto", "cpu", "cuda")
# Below these a density is too rough for figures that are meant seriously.
LOW_ESS = 0.1
LOW_COVERAGE = 0.9


def learn(
    task: Annotated[str, typer.Argument(metavar="TASK", help="Name of a task; `lidardesign tasks` lists them.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="RUN", help="Run folder to make.", show_default="runs/TASK"),
    ] = None,
    preset: options.Preset = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seed: options.Seed = None,
    device: Annotated[
        str,
        typer.Option(
            "--device", metavar="auto|cpu|cuda", help="Where the flow is trained; auto takes a GPU when there is one."
        ),
    ] = "auto",
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run from its last checkpoint.")
    ] = False,
    tolerance: Tolerance = None,
    time_budget: TimeBudget = None,
    dry_run: DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Learn where rays are worth firing for TASK, into a run folder."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        check_choice(device, "--device", DEVICES)
        choices = {"preset": preset, "config_file": config, "overrides": overrides or (), "seed": seed}
        goal = checked_goal(tolerance, time_budget, choices)
        with phase("libraries"):
            import lidardesign.config  # noqa: F401
            from lidardesign.registry import load_task

        plugin = load_task(task)
        run = out if out is not None else Path("runs") / task
        job = resumed(plugin, run, goal, choices, console) if resume else started(plugin, run, goal, choices)
        told = _tell_task_notes(job, console)
        if dry_run:
            from lidardesign.cli.dry_run import learn_plan

            tell_plan(learn_plan(job, device, config), console)
            return
        result = _learn_in_folder(job, device, console)
        keep_times(run, "learn", console, wait_s=WAIT_S)
        result = replace(result, notes=(*result.notes, *_advice(result)))
        untold = [] if console.quiet else [note for note in result.notes if note not in told]
        console.result(_document(result), lambda rich: _show(result, untold, rich))
        check_met(result, goal)


def _tell_task_notes(job: Job, console: Output) -> list[str]:
    """Say what the task has to say of its configuration before anything takes time; returns what was said."""
    from lidardesign.registry import plugin_guard
    from lidardesign.task import notes_of

    with phase("scenes"), plugin_guard(job.task.name):
        found = notes_of(job.task, job.settings.task, job.settings.space)
    for line in found:
        console.note(f"note: {line}")
    return found


def _learn_in_folder(job: Job, device: str, console: Output) -> LearnResult:
    from lidardesign.run.lock import run_lock

    task, run = job.task.name, job.run
    with made(run), run_lock(run):
        if not job.begun:
            check_can_start(run)  # another process may have been faster
        with undone_on_failure(job):
            if not job.begun:
                begin(job)
            console.when_interrupted = lambda: _interruption(task, run)
            with _progress(console) as progress:
                learner = Learner(job.task, run, device, progress, console)
                try:
                    return learner.learn(job.settings, job.goal, resume=job.has_checkpoint)
                except DataError as error:
                    # only what ended the writing, as a full disk does
                    if not isinstance(error.__cause__, OSError):
                        raise
                    hint = f"{error.hint}; {_interruption(task, run)}"
                    raise DataError(error.message, where=error.where, hint=hint) from error.__cause__


def _interruption(task: str, run: Path) -> str | None:
    checkpoints = sorted(path.name for path in run.glob(CHECKPOINTS))
    if checkpoints:
        kept = f"the last checkpoint is {run / checkpoints[-1]}"
    elif has_stages(run):
        kept = f"{run} keeps what the finished stages reached"
    else:
        return "before the first checkpoint; nothing was kept"
    return f"{kept}\n  continue with: lidardesign learn {task} --out {run} --resume"


@contextlib.contextmanager
def _progress(console: Output) -> Iterator[Callable[[LearnProgress], None]]:
    """A function that shows the progress: a bar on a terminal, else one note per phase."""
    with console.progress("loss", "ess", "left") as bar:
        line = bar.add_task("learning", total=None, loss="", ess="", left="") if bar else None
        phase = ""

        def show(now: Any) -> None:
            nonlocal phase
            if bar is None or line is None:
                if now.phase != phase:
                    console.note(f"{now.phase} ...")
            else:
                bar.update(
                    line,
                    description=now.phase,
                    completed=now.step,
                    total=now.steps or None,
                    loss=f"loss {now.loss:.3f}" if now.loss is not None else "",
                    ess=f"ESS {now.ess:.2f}" if now.ess is not None else "",
                    left=f"{now.seconds_left:.0f} s left" if now.seconds_left is not None else "",
                )
            phase = now.phase

        yield show


def _advice(result: LearnResult) -> list[str]:
    """What to do about a density that was learned badly."""
    advice = []
    if result.ess < LOW_ESS:
        advice.append(f"ESS below {LOW_ESS:g}: the density is rough; --preset standard or fine learns longer")
    if result.coverage < LOW_COVERAGE:
        advice.append(
            f"coverage below {LOW_COVERAGE:g}: a part of the scenes was missed; learn longer or another --seed"
        )
    return advice


def _document(result: LearnResult) -> dict[str, Any]:
    return {
        "run": str(result.run),
        "task": result.task,
        "seconds": result.seconds,
        "steps": result.steps,
        "ess": result.ess,
        "kl_nats": result.kl_nats,
        "log_z": result.log_z,
        "coverage": result.coverage,
        "misplaced": result.misplaced,
        "goal": result.goal,
        "notes": list(result.notes),
        "error_estimates": result.as_dict()["error_estimates"],
    }


def _show(result: LearnResult, notes: list[str], rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    def row(name: str, key: str, unit: str, what: str) -> None:
        estimate = result.error_estimates[key]
        error = "unknown" if estimate.error is None else f"{estimate.error:.2g}"
        table.add_row(name, f"{estimate.value:.3f}{unit}", error, what)

    title = f"learned {escape(str(result.task))}"
    table = Table("", "value", "standard error", "", title=title, title_justify="left")
    row("ESS", "ess", "", "share of the samples that count")
    row("KL", "kl_nats", " nats", "from the learned density to the target")
    row("log Z", "log_z", "", "of the target density")
    row("coverage", "coverage", "", "share of the target's mass that the density reaches")
    row("misplaced", "misplaced", "", "share of the density's mass in the wrong place")
    table.add_row("time", f"{result.seconds:.1f} s", "", f"{result.steps} steps")
    rich.print(table)
    for note in notes:
        rich.print(f"note: {escape(note)}")
    rich.print(f"run: {escape(str(result.run))}", soft_wrap=True)
