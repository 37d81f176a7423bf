"""`lidardesign learn`: learn where rays are worth firing for a task."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.learn import LearnCommand
from lidardesign.choices.shared import Printed
from lidardesign.cli.terminal.grids import RichConsole, duration, text_table
from lidardesign.cli.terminal.options import command_line, tasks
from lidardesign.cli.terminal.output import Output, keep_times
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


@command_line(LearnCommand, Printed)
def learn(
    output: Output,
    task: Annotated[
        str | None,
        typer.Argument(
            metavar="TASK",
            help="Name of a task; `lidardesign tasks` lists them.",
            autocompletion=tasks,
            show_default="that of --config, or of the run that is resumed",
        ),
    ] = None,
    *,
    dry_run: bool = False,
    **choices: Any,
) -> None:
    """Learn where rays are worth firing for TASK, into a run folder."""
    with phase("libraries"):
        from lidardesign.api.learn import LearnRequest, check_tolerance, result_document

    request = LearnRequest.resolve(task, choices, output.remark)
    request = replace(request, command=("lidardesign", *sys.argv[1:]))
    remark = cache(output.remark)  # every note once
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
        remark(note)

    def show(rich: RichConsole) -> None:
        if output.verbose:
            _show_figures(result, rich)
        _show(result, request.settings.preset, rich)

    output.result(result_document(result), show, files={"run": Path(result.run)}, says_time=True)
    check_tolerance(result, request.choices["tolerance"])


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
