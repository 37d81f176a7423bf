"""`lidardesign learn`: learn where rays are worth firing for a task."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.output import FIRST_LINE, Output, command, keep_times, show_plan
from lidardesign.cli.tables.grids import RichConsole, text_table
from lidardesign.run.clock import WAIT_S, phase

if TYPE_CHECKING:
    from rich.progress import Progress

    from lidardesign.density.learn import LearnProgress, LearnResult

FIGURES = (
    ("ESS", "ess", "", "share of the samples that count"),
    ("KL", "kl_nats", " nats", "between the learned density and the target"),
    ("log Z", "log_z", "", "of the target density"),
    ("coverage", "coverage", "", "share of the target's mass that the density reaches"),
    ("misplaced", "misplaced", "", "share of the density's mass in the wrong place"),
)


def learn(
    task: Annotated[
        str | None,
        typer.Argument(
            metavar="TASK",
            help="Name of a task; `lidardesign tasks` lists them.",
            show_default="that of --config, or of the run that is resumed",
        ),
    ] = None,
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
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite", help="Replace the run in the folder, and its designs, once the new one is learned."
        ),
    ] = False,
    tolerance: Annotated[
        float | None,
        typer.Option(
            "--tolerance",
            metavar="SHARE",
            help="Learn until at most this share of the density's mass is in the wrong place, in stages of doubled "
            "steps from an eighth to four times those of the preset; exit 1 when none is good enough.",
            show_default=False,
        ),
    ] = None,
    time_budget: Annotated[
        float | None,
        typer.Option(
            "--time-budget",
            metavar="SECONDS",
            help="Learn as many steps as let the command end within this time; they are planned from its own first "
            "steps.",
            show_default=False,
        ),
    ] = None,
    dry_run: options.DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Learn where rays are worth firing for TASK, into a run folder."""
    with command(json=json, quiet=quiet, debug=debug) as output:
        with phase("libraries"):
            from lidardesign.workflow.learn import LearnOptions, LearnRequest, result_document
            from lidardesign.workflow.learning_budget import check_met

        chosen = LearnOptions(
            out=out,
            preset=preset,
            settings=overrides or (),
            config=config,
            seed=seed,
            device=device,
            resume=resume,
            overwrite=overwrite,
            tolerance=tolerance,
            time_budget_s=time_budget,
            command=("lidardesign", *sys.argv[1:]),
        )
        request = LearnRequest.resolve(task, chosen, output.remark)
        said: list[str] = []

        def remark(note: str) -> None:
            said.append(note)
            output.remark(note)

        for note in request.task_notes():
            remark(note)
        if dry_run:
            for note in request.scale_notes():
                remark(note)
            return show_plan(request.plan(), output)
        output.when_interrupted = request.resume_hint
        with output.progress("learning", "loss", "ess", "left") as bar:
            result = request.run(_progress(bar, output), remark)
        keep_times(request.folder, "learn", output, wait_s=WAIT_S)
        further = [] if output.quiet else [note for note in result.notes if note not in said]
        output.result(result_document(result), lambda rich: _show(result, further, request.settings.preset, rich))
        check_met(result, request.goal)


def _progress(bar: Progress | None, output: Output) -> Callable[[LearnProgress], None]:
    begun: list[str] = []

    def show(now: LearnProgress) -> None:
        if bar is not None:
            bar.update(
                FIRST_LINE,
                description=now.phase,
                completed=now.step,
                total=now.steps or None,
                loss=f"loss {now.loss:.3f}" if now.loss is not None else "",
                ess=f"ESS {now.ess:.2f}" if now.ess is not None else "",
                left=f"{now.seconds_left:.0f} s left" if now.seconds_left is not None else "",
            )
        elif begun[-1:] != [now.phase]:
            begun.append(now.phase)
            output.note(f"{now.phase} ...")

    return show


def _show(result: LearnResult, notes: list[str], preset: str, rich: RichConsole) -> None:
    rows = []
    for name, key, unit, what in FIGURES:
        estimate = result.error_estimates[key]
        error = "unknown" if estimate.error is None else f"{estimate.error:.2g}"
        rows.append((name, f"{estimate.value:.3f}{unit}", error, what))
    rows.append(("time", f"{result.seconds:.1f} s", "", f"{result.steps} steps"))
    rich.print(text_table(("", "value", "standard error", ""), rows, f"learned {result.task}"))
    for note in notes:
        rich.print(f"note: {note}")
    rich.print(f"the density is {result.verdict.text(preset)}")
    rich.print(f"run: {result.run}", soft_wrap=True)
