"""`lidardesign learn`: learn where rays are worth firing for a task."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.output import command, keep_times, show_plan
from lidardesign.cli.tables.grids import RichConsole, duration, text_table
from lidardesign.run.clock import WAIT_S, phase

if TYPE_CHECKING:
    from lidardesign.cli.progress import ProgressDisplay
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
            help="Learn until at most this share of the density's mass is in the wrong place, with at most four times "
            "the steps of the preset; exit 1 if that is not enough.",
            show_default=False,
        ),
    ] = None,
    time_budget: Annotated[
        float | None,
        typer.Option(
            "--time-budget",
            metavar="SECONDS",
            help="Learn as long as lets the command end within this time, however good the density is.",
            show_default=False,
        ),
    ] = None,
    dry_run: options.DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    debug: options.Debug = False,
) -> None:
    """Learn where rays are worth firing for TASK, into a run folder."""
    with command(json=json, quiet=quiet, verbose=verbose, debug=debug) as output:
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
            plan = request.plan()
            plan.check_writable()
            with output.progress("timing a few steps"):
                plan = replace(plan, forecast=request.forecast(remark))
            return show_plan(plan, output)
        output.when_interrupted = request.resume_hint
        with output.progress("learning") as progress:
            result = request.run(partial(_show_progress, progress), remark)
        keep_times(request.folder, "learn", output, wait_s=WAIT_S)
        for note in result.notes:
            if note not in said:
                output.remark(note)

        def show(rich: RichConsole) -> None:
            if output.verbose:
                _show_figures(result, rich)
            _show(result, request.settings.preset, rich)

        output.result(result_document(result), show, files={"run": Path(result.run)}, says_time=True)
        check_met(result, request.goal)


def _show_progress(progress: ProgressDisplay, now: LearnProgress) -> None:
    figures = (("loss {:.3f}", now.loss), ("ESS {:.2f}", now.ess))
    detail = ", ".join(text.format(value) for text, value in figures if value is not None)
    progress.show(now.step, now.steps or 0, label="learning", detail=detail, left_s=now.seconds_left)


def _show(result: LearnResult, preset: str, rich: RichConsole) -> None:
    verdict = result.verdict
    rich.print(
        f"learned {result.task} in {duration(result.seconds)} ({result.steps} steps); the density is {verdict.word}: "
        f"{100 * result.misplaced:.2g} % misplaced, KL {result.kl_nats:.2g} nats, ESS {result.ess:.2f}",
        soft_wrap=True,
    )
    if verdict.why:
        rich.print(verdict.advice(preset), soft_wrap=True)


def _show_figures(result: LearnResult, rich: RichConsole) -> None:
    rows = []
    for name, key, unit, what in FIGURES:
        estimate = result.error_estimates[key]
        error = "unknown" if estimate.error is None else f"{estimate.error:.2g}"
        rows.append((name, f"{estimate.value:.3f}{unit}", error, what))
    rich.print(text_table(("", "value", "standard error", ""), rows))
