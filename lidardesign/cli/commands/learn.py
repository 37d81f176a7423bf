"""`lidardesign learn`: learn where rays are worth firing for a task."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole, duration, text_table
from lidardesign.cli.terminal.options import tasks, words
from lidardesign.cli.terminal.output import command, keep_times
from lidardesign.run.clock import WAIT_S, phase

if TYPE_CHECKING:
    from lidardesign.cli.terminal.grids import ProgressDisplay
    from lidardesign.density.training.learn import LearnProgress, LearnResult

BYTES_PER_MEGABYTE = 1e6
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
            autocompletion=tasks,
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
            "--device",
            metavar="auto|cpu|cuda",
            help="Where to train the flow; auto uses a GPU if there is one.",
            autocompletion=words("auto|cpu|cuda"),
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
            help="Set learning.misplaced: learn until at most this share of the density's mass is in the wrong place; "
            "exit 1 if the steps run out first.",
            show_default=False,
        ),
    ] = None,
    time_budget: Annotated[
        float | None,
        typer.Option(
            "--time-budget",
            metavar="SECONDS",
            help="Learn for this long, however good the density is; measuring it takes extra time.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Check everything, say what would be written and how long it takes, and stop."),
    ] = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Learn where rays are worth firing for TASK, into a run folder."""
    with command(json=json, quiet=quiet, verbose=verbose) as output:
        with phase("libraries"):
            from lidardesign.api.learn import LearnOptions, LearnRequest, check_tolerance, result_document

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
            with output.progress("timing a few steps"):
                document = request.plan(remark)
            return output.result(document, partial(_show_plan, document), show_costs=False)
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
        check_tolerance(result, tolerance)


def _show_plan(document: dict[str, Any], rich: RichConsole) -> None:
    found = document["forecast"]
    lines = [f"{verb}  {path}" for verb in ("reads", "writes") for path in document[verb]]
    each = f"{1e3 * found['pathwise_s']:.0f} and {1e3 * found['balancing_s']:.0f} ms"
    lines.append(f"time   at most about {duration(found['seconds'])}: at most {found['steps']:,} steps of {each}")
    for name, held in (("memory", found["peak_memory_bytes"]), ("memory on the GPU", found["gpu_memory_bytes"])):
        lines += [] if held is None else [f"{name} about {held / BYTES_PER_MEGABYTE:,.0f} MB"]
    rich.print("\n".join((*lines, "nothing was done: leave out --dry-run to do it")), soft_wrap=True)


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
