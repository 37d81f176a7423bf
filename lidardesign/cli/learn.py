"""`lidardesign learn`: learn where rays are worth firing for a task."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.console import Console, command
from lidardesign.cli.goals import GOAL, Goal, Learner, TimeBudget, Tolerance, check_met, checked_goal, resumed_goal
from lidardesign.cli.ranks import joined_ranks
from lidardesign.cli.runs import check_choice
from lidardesign.cli.times import keep_times
from lidardesign.errors import ConfigError, DataError, LostRankError
from lidardesign.run.clock import WAIT_S, phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.density.learn import LearnProgress, LearnResult
    from lidardesign.density.parallel import Ranks
    from lidardesign.run.config import RunConfig
    from lidardesign.task import Task

DEVICES = ("auto", "cpu", "cuda")
# Snapshots are of no use without a checkpoint.
STARTED_FILES = {"config.yaml", "manifest.json", "progress.jsonl", "snapshots", ".lock"}
CHECKPOINTS = "checkpoint*"
# Below these a density is too rough for figures that are meant seriously.
LOW_ESS = 0.1
LOW_COVERAGE = 0.9


def learn(
    task: Annotated[str, typer.Argument(metavar="TASK", help="Name of a task; `lidardesign tasks` lists them.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="RUN", help="Run folder to make.", show_default="runs/TASK"),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            "--preset",
            metavar="draft|standard|fine",
            help="Effort: about half a minute, minutes, or tens of minutes.",
            show_default="standard",
        ),
    ] = None,
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
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Learn where rays are worth firing for TASK, into a run folder."""
    with command(json=json, quiet=quiet, debug=debug) as console, joined_ranks(console) as ranks:
        check_choice(device, "--device", DEVICES)
        choices = {"preset": preset, "config_file": config, "overrides": overrides or (), "seed": seed}
        goal = checked_goal(tolerance, time_budget, choices, ranks)
        with phase("libraries"):
            from lidardesign.registry import load_task
            from lidardesign.run.config import load_run_config, resolve

        plugin = load_task(task)
        run = out if out is not None else Path("runs") / task
        if resume:
            _check_can_resume(run)
            plugin, settings = load_run_config(run)
            goal = resumed_goal(goal, run)
            resume = any(run.glob(CHECKPOINTS))
            if not resume:
                console.note("the run has no checkpoint yet; it starts from the beginning")
            _check_same(settings, plugin if plugin.name == task else load_task(task), choices, run)
        else:
            _check_can_start(run)
            settings = resolve(plugin, **choices)
        result = _learn_in_folder(plugin, settings, run, resume, goal, device, console, ranks)
        keep_times(run, "learn", console, wait_s=WAIT_S)
        result = replace(result, notes=(*result.notes, *_advice(result)))
        console.result(_document(result), lambda rich: _show(result, rich))
        check_met(result, goal)


def _check_can_start(run: Path) -> None:
    """Refuse a folder that holds anything, so that no run is ever overwritten."""
    if run.is_file():
        raise ConfigError("is a file", where=f"--out {run}", allowed="a folder that is new or empty")
    if run.is_dir() and any(run.iterdir()):
        hint = "continue it with --resume, or give another --out"
        raise ConfigError("the folder is not empty", where=f"--out {run}", allowed="a new or empty folder", hint=hint)


def _check_can_resume(run: Path) -> None:
    if not run.is_dir():
        raise DataError("there is no run to resume", where=str(run), hint="leave out --resume to start it")


def _check_same(stored: RunConfig, task: Task, choices: dict[str, Any], run: Path) -> None:
    """Refuse to resume a run under another configuration; repeating its own options is fine."""
    from lidardesign.run.config import resolve
    from lidardesign.run.yaml import leaves

    wanted = resolve(
        task,
        preset=choices["preset"] or stored.preset,
        config_file=choices["config_file"] or run / "config.yaml",
        overrides=choices["overrides"],
        seed=stored.seed if choices["seed"] is None else choices["seed"],
    )
    old, new = dict(leaves(stored.as_document())), dict(leaves(wanted.as_document()))
    for path in [*old, *new]:
        if old.get(path) != new.get(path):
            key = ".".join(map(str, path))
            raise ConfigError(
                f"the run was started with {key} = {old.get(path)!r}, not {new.get(path)!r}",
                where=str(run / "config.yaml"),
                hint="resume without options, or start a new run with another --out",
            )


def _learn_in_folder(
    task: Task, settings: RunConfig, run: Path, resume: bool, goal: Goal, device: str, console: Console, ranks: Ranks
) -> LearnResult:
    from lidardesign.run.config import save_run_config
    from lidardesign.run.lock import run_lock
    from lidardesign.run.manifest import note, start_manifest

    with _undone_on_failure(run), run_lock(run):
        if not (run / "manifest.json").exists():
            start_manifest(run, command=["lidardesign", *sys.argv[1:]], seed=settings.seed)
            save_run_config(settings, run)
            if not goal.is_none:
                note(run, **{GOAL: goal.as_dict()})
        console.when_interrupted = lambda: _interruption(task.name, run)
        with _progress(console) as progress:
            learner = Learner(task, run, device, progress, ranks, console)
            try:
                return learner.learn(settings, goal, resume=resume)
            except LostRankError as error:
                hint = f"{error.hint}; {_interruption(task.name, run)}"
                raise LostRankError(error.message, where=error.where, hint=hint) from None


@contextlib.contextmanager
def _undone_on_failure(run: Path) -> Iterator[None]:
    """Make the folder; when nothing was learned before a failure, take away what this command put there."""
    made = [folder for folder in (run, *run.parents) if not folder.exists()]
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot be made: {error.strerror or error}", where=f"--out {run}") from None
    started_empty = not any(run.iterdir())
    try:
        yield
    except BaseException:
        _take_away(run, made, started_empty)
        raise


def _take_away(run: Path, made: list[Path], started_empty: bool) -> None:
    entries = list(run.iterdir())
    nothing_learned = all(entry.name in STARTED_FILES or entry.stat().st_size == 0 for entry in entries)
    if not started_empty or not nothing_learned or _has_stages(run):
        return
    with contextlib.suppress(OSError):
        for entry in entries:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
        for folder in made:
            folder.rmdir()


def _has_stages(run: Path) -> bool:
    """Whether trainings were finished on the way to a tolerance: what they reached is worth going on from."""
    from lidardesign.run.manifest import read_manifest

    try:
        return bool((read_manifest(run).get(GOAL) or {}).get("stages"))
    except DataError:
        return False


def _interruption(task: str, run: Path) -> str | None:
    checkpoints = sorted(path.name for path in run.glob(CHECKPOINTS))
    if checkpoints:
        kept = f"the last checkpoint is {run / checkpoints[-1]}"
    elif _has_stages(run):
        kept = f"{run} keeps what the finished stages reached"
    else:
        return "before the first checkpoint; nothing was kept"
    return f"{kept}\n  continue with: lidardesign learn {task} --out {run} --resume"


@contextlib.contextmanager
def _progress(console: Console) -> Iterator[Callable[[LearnProgress], None]]:
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


def _show(result: LearnResult, rich: RichConsole) -> None:
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
    for note in result.notes:
        rich.print(f"note: {escape(note)}")
    rich.print(f"run: {escape(str(result.run))}", soft_wrap=True)
