"""`lidardesign evaluate`: score designs on held-out scenes against baselines."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.dry_run import DryRun, tell_plan
from lidardesign.cli.output import Output, command, keep_times
from lidardesign.cli.physics import Detector, Effects, RangeTolerance, ReturnTolerance, planner_of
from lidardesign.cli.searches import CmaSeconds, check_cma_seconds, searching, told
from lidardesign.cli.streams import claim_outputs, is_output, written_file
from lidardesign.cli.tables.designs import number
from lidardesign.cli.tables.scores import show_evaluation
from lidardesign.errors import ConfigError, ThresholdError
from lidardesign.run.clock import phase
from lidardesign.workflow.evaluation_report import times_so_far
from lidardesign.workflow.evaluation_request import ALWAYS, JudgedDesign, collect, common_run, named_apart, request_of

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.dry_run import Plan
    from lidardesign.evaluate.score import Evaluation, EvaluationRequest
    from lidardesign.workflow.runs import Run


BASELINE_HELP = (
    "A further baseline beside uniform, random and bounding: occupancy (rays towards cells that targets occupy) or "
    "no-visibility (the first design fitted anew to the density without its occlusion term, from samples drawn for it: "
    "some seconds), catalog:NAME (a real part of `lidardesign catalog list` where it sees most; at a pose, in metres "
    "and degrees: catalog:NAME@X,Y,Z,AZIMUTH,ELEVATION), cma (direct optimisation of the first design's sensors on "
    "training scenes, for --cma-seconds). Repeatable."
)


Targets = Annotated[
    list[Path],
    typer.Argument(metavar="RUN|DESIGN", readable=False, help="Run folders (all their designs) and design files."),
]
RayCounts = Annotated[
    list[int] | None,
    typer.Option(
        "--rays",
        metavar="N",
        min=1,
        max=1_000_000,
        help="Rays per frame and position; repeatable. A fixed pattern is left out beyond its own number.",
        show_default="the task's and those of smaller fixed patterns",
    ),
]
Baseline = Annotated[
    list[str] | None, typer.Option("--baseline", metavar="NAME", help=BASELINE_HELP, show_default=False)
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="FILE.html", help="Write one HTML page: tables, curves, 3D view.", show_default=False
    ),
]
Plots = Annotated[
    Path | None,
    typer.Option(
        "--plots",
        metavar="DIR",
        help="Write pictures for papers into this folder, as PNG and SVG: scene, density, scores, differences, "
        "constraints, effects, accuracy, times.",
        show_default=False,
    ),
]
Csv = Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write the rows as CSV.", show_default=False)]
Surroundings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Judge by other scenes than were learned: a key of the task, as illuminance_lux=100000 or test=10, that "
        "leaves the design space as it is; repeatable.",
        show_default=False,
    ),
]
FailAbove = Annotated[
    float | None,
    typer.Option(
        "--fail-above",
        metavar="VALUE",
        help="Exit 1 if a design scores worse, in the metric's unit.",
        show_default=False,
    ),
]
WithAccuracy = Annotated[
    bool,
    typer.Option(
        "--accuracy",
        help="Also measure what accuracy costs in time here: errors and seconds of every numerical choice, for this "
        "task and run, and the cheapest setting that is good enough. Takes minutes.",
    ),
]
Workers = Annotated[
    str,
    typer.Option(
        "--workers",
        metavar="N|tcp://HOST:PORT",
        help="What scores held-out scenes: so many processes of this machine, or the workers of a dask scheduler "
        "(extra: cluster). The scores are the same.",
    ),
]


def evaluate(
    targets: Targets,
    rays: RayCounts = None,
    baseline: Baseline = None,
    cma_seconds: CmaSeconds = None,
    effects: Effects = "auto",
    detector: Detector = "ideal",
    range_tolerance_mm: RangeTolerance = None,
    return_tolerance: ReturnTolerance = None,
    overrides: Surroundings = None,
    report: Report = None,
    plots: Plots = None,
    csv: Csv = None,
    fail_above: FailAbove = None,
    workers: Workers = "1",
    accuracy: WithAccuracy = False,
    dry_run: DryRun = False,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Score designs on held-out scenes against the baselines uniform, random and bounding."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        claim_outputs(console, dry_run=dry_run, csv=csv, report=report, plots=plots)
        with phase("libraries"):
            import lidardesign.evaluate.score  # noqa: F401
            from lidardesign.config import judged_by
            from lidardesign.evaluate.request import usual_numbers

        wanted = _checked(workers, baseline or [], cma_seconds, fail_above)
        planner, audit = planner_of(effects, detector, range_tolerance_mm, return_tolerance)
        entries, runs = collect(targets, console)
        run = learned = common_run(named_apart(entries), runs)
        rays = rays or usual_numbers([entry.design for entry in entries], run.task.defaults.rays)
        if accuracy:
            _check_measurable(learned)
        if overrides:
            run = replace(run, config=judged_by(run.task, run.config, overrides))
        if range_tolerance_mm is None:
            planner = replace(planner, tolerance=planner.tolerated.within(run.task.metric))
        if dry_run:
            outputs = {"--report": report, "--plots": plots, "--csv": csv}
            further = {"--effects": effects, "--detector": detector, "--set": overrides, "--accuracy": accuracy}
            return tell_plan(_plan(run, entries, rays, baseline or [], outputs, further), console)
        request = request_of(run, entries, rays, [*ALWAYS, *(baseline or [])], seed)
        request, files = replace(request, planner=planner, audit=audit), (report, plots, csv)
        evaluation = _evaluate_with(wanted, replace(request, cma=searching(cma_seconds)), console)
        # accuracy takes minutes: what was scored by then is written already
        early = (None if accuracy and is_output(path) else path for path in files)
        written = _write_files(evaluation, request, learned, times_so_far(run.folder, console.clock), *early)
        if accuracy:
            evaluation = _with_accuracy(evaluation, request, learned, console)
            written = _write_files(evaluation, request, learned, times_so_far(run.folder, console.clock), *files)
        document = {**evaluation.as_dict(), "set": overrides or [], "files": [str(path) for path in written]}
        keep_times(run.folder, "evaluate", console)
        shown = {**document, "notes": []} if console.quiet else document
        console.result(document, lambda rich: _show(evaluation, shown, written, rich))
        _check_threshold(evaluation, fail_above)
        _check_audit(evaluation)


def _show(evaluation: Evaluation, document: dict[str, Any], written: list[Path], rich: RichConsole) -> None:
    if evaluation.accuracy is not None:
        from lidardesign.cli.tables.times import show_accuracy

        show_accuracy(evaluation.accuracy, rich)
    show_evaluation(document, written, rich)


def _checked(
    workers: str, baselines: list[str], cma_seconds: float | None, fail_above: float | None
) -> int | str | None:
    """What the options of an evaluation say where nothing has to be read for it; returns the workers.

    Raises:
        ConfigError: One of them says nothing that can be done.
    """
    from lidardesign.evaluate.baselines.simple import baseline_of
    from lidardesign.evaluate.workers.pool import check_workers

    if fail_above is not None and not math.isfinite(fail_above):
        raise ConfigError(f"{fail_above}", where="--fail-above", allowed="a finite number")
    wanted = check_workers(workers)
    for name in baselines:
        baseline_of(name, where="--baseline")
    check_cma_seconds(cma_seconds, baselines)
    return wanted


def _plan(
    run: Run,
    entries: list[JudgedDesign],
    rays: list[int],
    baselines: list[str],
    outputs: dict[str, Path | None],
    settings: dict[str, Any],
) -> Plan:
    """What this evaluation would do."""
    from lidardesign.cli.dry_run import evaluate_plan

    return evaluate_plan(
        run,
        [(entry.design, entry.path) for entry in entries],
        rays=sorted(set(rays)),
        baselines=tuple(dict.fromkeys([*ALWAYS, *baselines])),
        outputs=outputs,
        settings=settings,
    )


def _evaluate_with(wanted: int | str, request: EvaluationRequest, console: Output) -> Evaluation:
    """The evaluation, its scenes scored by the workers that were asked for."""
    from lidardesign.evaluate.workers.pool import workers_of

    with workers_of(wanted, most=len(request.test)) as scorer:
        if scorer is None:
            return _evaluate(request, console)
        scorer.prepare(request)
        return _evaluate(replace(request, scorer=scorer), console)


def _evaluate(request: EvaluationRequest, console: Output) -> Evaluation:
    from lidardesign.evaluate.score import evaluate as score

    with console.progress("row") as bar:
        line = bar.add_task("evaluating", total=None, row="") if bar else None

        def show(done: int, total: int, row: str = "") -> None:
            if bar is not None and line is not None:
                bar.update(line, completed=done, total=total, row=row)

        return score(replace(request, cma=told(request.cma, request.task.metric, console, bar)), progress=show)


def _check_measurable(run: Run) -> None:
    """Refuse a run that is unfinished or damaged before it is evaluated, which may take minutes."""
    with phase("libraries"):
        from lidardesign.density.training.snapshot_quality import check_kept

    check_kept(run.folder)


def _with_accuracy(evaluation: Evaluation, request: EvaluationRequest, run: Run, console: Output) -> Evaluation:
    """The evaluation with the ladders of the run, whose density is that of its own scenes, whatever it is judged by."""
    if (request.config, request.seed) != (run.config.task, run.config.seed):
        request = replace(request, train=run.scenes("train", run.config.seed))
    with phase("accuracy"), console.progress("ladder") as bar:
        from lidardesign.evaluate.accuracy.sweeps import AccuracyRequest, measure_accuracy

        line = bar.add_task("measuring accuracy", total=None, ladder="") if bar else None

        def show(done: int, total: int, ladder: str) -> None:
            if bar is not None and line is not None:
                bar.update(line, completed=done, total=total, ladder=ladder)
            elif ladder:
                console.note(f"accuracy: {ladder} ...")

        asked = AccuracyRequest(run.config, run.folder, request, evaluation)
        return replace(evaluation, accuracy=measure_accuracy(asked, progress=show))


@phase("writing")
def _write_files(
    evaluation: Evaluation,
    request: EvaluationRequest,
    run: Run,
    times: dict[str, dict[str, float]],
    report: Path | None,
    plots: Path | None,
    csv: Path | None,
) -> list[Path]:
    written: list[Path] = []
    if csv is not None:
        from lidardesign.evaluate.results import write_csv

        with written_file(csv) as file:
            write_csv(evaluation, file)
        written.append(csv)
    return written + _write_drawn(evaluation, request, run, times, report, plots) if report or plots else written


def _write_drawn(
    evaluation: Evaluation,
    request: EvaluationRequest,
    run: Run,
    times: dict[str, dict[str, float]],
    report: Path | None,
    plots: Path | None,
) -> list[Path]:
    """Pictures and report, of one drawing's material."""
    from lidardesign.evaluate.figures.figure_data import pictured_of

    written: list[Path] = []
    pictured = pictured_of(evaluation, request, times)
    if plots is not None:
        from lidardesign.evaluate.figures.plots import write_plots

        written += write_plots(evaluation, plots, pictured)
    if report is not None:
        from lidardesign.evaluate.report.report import write_report
        from lidardesign.workflow.evaluation_report import evaluation_report

        command_line = ["lidardesign", *sys.argv[1:]]
        with written_file(report) as file:
            write_report(evaluation_report(evaluation, request, run, pictured, command_line), file)
        written.append(report)
    return written


def _check_threshold(evaluation: Evaluation, limit: float | None) -> None:
    """Exit 1 where a design is worse than the limit; baselines do not count."""
    if limit is None:
        return
    from lidardesign.evaluate.results import worse_than_threshold

    missed = worse_than_threshold(evaluation, limit)
    if missed:
        unit = evaluation.metric.unit
        bound = "at most" if evaluation.metric.better == "lower" else "at least"
        rows = ", ".join(f"{row.design} with {row.rays} rays: {number(row.value)} {unit}" for row in missed)
        raise ThresholdError(rows, where="--fail-above", allowed=f"{bound} {limit:g} {unit}")


def _check_audit(evaluation: Evaluation) -> None:
    """Exit 1 where skipped effects change a row by more than the metric's tolerance."""
    audit = evaluation.audit
    if audit is None or not audit.failed:
        return
    rows = ", ".join(f"{row.design} with {row.rays} rays by {number(abs(row.difference))}" for row in audit.failed)
    there = {effect.name for effect in evaluation.effects if effect.range_m or effect.lost}
    raise ThresholdError(
        f"skipped effects move {rows} {audit.unit}",
        where="--effects audit",
        allowed=f"at most {audit.tolerance:g} {audit.unit}, the metric's tolerance",
        hint="--effects all, or a smaller --range-tolerance-mm or --return-tolerance; skipped: "
        + ", ".join(name for name in audit.skipped if name in there),
    )
