"""`lidardesign evaluate`: score designs on held-out scenes against baselines."""

from __future__ import annotations

import math
import shlex
import sys
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.console import Console, command
from lidardesign.cli.designs import number
from lidardesign.cli.dry_run import DryRun, tell_plan
from lidardesign.cli.physics import Detector, Effects, RangeTolerance, ReturnTolerance, planner_of
from lidardesign.cli.runs import open_run, read_design, run_of
from lidardesign.cli.scores import show_evaluation
from lidardesign.cli.searches import CmaSeconds, check_cma_seconds, searching, told
from lidardesign.cli.streams import claim_stdout, is_output, written_file
from lidardesign.cli.times import keep_times, times_so_far
from lidardesign.errors import ConfigError, DataError, ThresholdError
from lidardesign.run.clock import phase
from lidardesign.run.streams import is_there

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.dry_run import Plan
    from lidardesign.cli.runs import Run
    from lidardesign.design.sensor import Design
    from lidardesign.evaluate.score import Evaluation, EvaluationRequest


ALWAYS = ("uniform", "random", "bounding")
BASELINE_HELP = (
    "A further baseline beside uniform, random and bounding: occupancy (rays towards cells that targets occupy) or "
    "no-visibility (the first design fitted anew to the density without its occlusion term, from samples drawn for it: "
    "some seconds), catalog:NAME (a real part of `lidardesign catalog list` where it sees most; at a pose, in metres "
    "and degrees: catalog:NAME@X,Y,Z,AZIMUTH,ELEVATION), cma (direct optimisation of the first design's sensors on "
    "training scenes, for --cma-seconds). Repeatable."
)


@dataclass
class _Entry:
    """One design to evaluate and the run that it came from."""

    design: Design
    path: Path
    run: Run | None


Targets = Annotated[
    list[Path], typer.Argument(metavar="RUN|DESIGN", help="Run folders (all their designs) and design files.")
]
RayCounts = Annotated[
    list[int] | None,
    typer.Option(
        "--rays",
        metavar="N",
        min=1,
        max=1_000_000,
        help="Rays per frame and position; repeatable.",
        show_default="the task's",
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
        claim_stdout(console, dry_run=dry_run, csv=csv, report=report)
        with phase("libraries"):
            import lidardesign.evaluate.score  # noqa: F401
            from lidardesign.cli.rigs import budgets_within
            from lidardesign.run.config import judged_by

        wanted = _checked(workers, baseline or [], cma_seconds, fail_above)
        planner, audit = planner_of(effects, detector, range_tolerance_mm, return_tolerance)
        entries, runs = _collect(targets, console)
        run = learned = _common_run(_named_apart(entries), runs)
        rays = rays or budgets_within([entry.design for entry in entries], run.task.defaults.rays, console)
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
        request = replace(_request(run, entries, rays, baseline or [], seed), planner=planner, audit=audit)
        files = (report, plots, csv)
        evaluation = _evaluate_with(wanted, replace(request, cma=searching(cma_seconds)), console)
        # accuracy takes minutes: what was scored by then is written already
        early = (None if accuracy and is_output(path) else path for path in files)
        written = _write_files(evaluation, request, times_so_far(run.folder, "evaluate", console), *early)
        if accuracy:
            evaluation = _with_accuracy(evaluation, request, learned, console)
            written = _write_files(evaluation, request, times_so_far(run.folder, "evaluate", console), *files)
        document = {**evaluation.as_dict(), "set": overrides or [], "files": [str(path) for path in written]}
        keep_times(run.folder, "evaluate", console)
        console.result(document, lambda rich: _show(evaluation, document, written, rich))
        _check_threshold(evaluation, fail_above)
        _check_audit(evaluation)


def _show(evaluation: Evaluation, document: dict[str, Any], written: list[Path], rich: RichConsole) -> None:
    if evaluation.accuracy is not None:
        from lidardesign.cli.ladders import show_accuracy

        show_accuracy(evaluation.accuracy, rich)
    show_evaluation(document, written, rich)


def _checked(
    workers: str, baselines: list[str], cma_seconds: float | None, fail_above: float | None
) -> int | str | None:
    """What the options of an evaluation say where nothing has to be read for it; returns the workers.

    Raises:
        ConfigError: One of them says nothing that can be done.
    """
    from lidardesign.evaluate.baselines import baseline_of
    from lidardesign.evaluate.workers import check_workers

    if fail_above is not None and not math.isfinite(fail_above):
        raise ConfigError(f"{fail_above}", where="--fail-above", allowed="a finite number")
    wanted = check_workers(workers)
    for name in baselines:
        baseline_of(name, where="--baseline")
    check_cma_seconds(cma_seconds, baselines)
    return wanted


def _plan(
    run: Run,
    entries: list[_Entry],
    rays: list[int] | None,
    baselines: list[str],
    outputs: dict[str, Path | None],
    settings: dict[str, Any],
) -> Plan:
    """What this evaluation would do."""
    from lidardesign.cli.dry_designs import evaluate_plan

    return evaluate_plan(
        run,
        [(entry.design.name, entry.path) for entry in entries],
        rays=sorted(set(rays or run.task.defaults.rays)),
        baselines=tuple(dict.fromkeys([*ALWAYS, *baselines])),
        outputs=outputs,
        settings=settings,
    )


@phase("designs")
def _collect(targets: list[Path], console: Console) -> tuple[list[_Entry], list[Run]]:
    """The designs that were named, and the runs: of folders all designs, of files the file."""
    from lidardesign.cli.rigs import reach_of

    entries: list[_Entry] = []
    opened = {target: open_run(target) for target in targets if target.is_dir()}
    runs = list(opened.values())
    reach_m = reach_of(runs)
    for target in targets:
        if target in opened:
            run = opened[target]
            entries += [_Entry(read_design(path, console), path, run) for path in run.designs()]
        elif not is_there(target):
            raise DataError("no such run or design", where=str(target), hint="give run folders or design files")
        else:
            design = read_design(target, console, reach_m)
            entries.append(_Entry(design, target, run_of(design, target)))
    seen: dict[Path, _Entry] = {}
    for entry in entries:
        seen.setdefault(entry.path.resolve(), entry)
    return list(seen.values()), runs


def _named_apart(entries: list[_Entry]) -> list[_Entry]:
    """Designs of different runs that share a name take their run's name in front."""
    names = [entry.design.name for entry in entries]
    for entry in entries:
        if names.count(entry.design.name) > 1:
            folder = entry.run.folder if entry.run else entry.path.parent
            entry.design = replace(entry.design, name=f"{folder.resolve().name}/{entry.design.name}")
    names = [entry.design.name for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ConfigError(f"two designs are called {twice!r}", hint="rename one of the files")
    return entries


def _common_run(entries: list[_Entry], runs: list[Run]) -> Run:
    """The run whose task and configuration all designs are judged by."""
    candidates = [*runs, *(entry.run for entry in entries if entry.run is not None)]
    if not candidates:
        raise ConfigError(
            "no design names a run that is there, so the task is unknown",
            hint="give the run folder too: lidardesign evaluate RUN DESIGN",
        )
    first = candidates[0]
    for other in candidates[1:]:
        if _judged_by(other) != _judged_by(first):
            raise ConfigError(
                f"{first.folder} and {other.folder} differ in task, configuration or design space",
                hint="evaluate them one by one: scores of different scenes do not compare",
            )
    if not entries:
        raise DataError("the run has no designs yet", where=str(first.folder), hint=f"lidardesign fit {first.folder}")
    return first


def _judged_by(run: Run) -> tuple[Any, ...]:
    """What runs share whose designs are scored in the same scenes."""
    from lidardesign.task import judged_by_keys

    config = run.config
    return config.task_name, judged_by_keys(run.task, config.task), config.space


def _request(
    run: Run, entries: list[_Entry], rays: list[int] | None, baselines: list[str], seed: int | None
) -> EvaluationRequest:
    from lidardesign.cli.layouts import layouts_of, learned_density, may_need_samples, twin_without_visibility
    from lidardesign.cli.weighting import designs_samples
    from lidardesign.design.samples import FILE_NAME
    from lidardesign.evaluate.score import EvaluationRequest

    config, task = run.config, run.task
    seed = config.seed if seed is None else seed
    made = [(entry.design, entry.run) for entry in entries if entry.run is not None]
    layouts = layouts_of(made)
    # designs of one run and weighting share its samples, and what is worked out from them
    laid_out = [
        (design, origin)
        for design, origin in made
        if may_need_samples(design) and (origin.folder / FILE_NAME).exists()
    ]
    samples = designs_samples(laid_out, layouts.targets)
    return EvaluationRequest(
        task=task,
        config=config.task,
        space=config.space,
        seed=seed,
        designs=[entry.design for entry in entries],
        rays=sorted(set(rays or task.defaults.rays)),
        baselines=tuple(dict.fromkeys([*ALWAYS, *baselines])),
        samples=samples,
        train=run.scenes("train", seed),
        test=run.scenes("test", seed),
        lay_out=layouts,
        without_visibility=(lambda: twin_without_visibility(*made[0], layouts)) if made else None,
        density=cache(lambda: learned_density(made[0][1] if made else run)),
    )


def _evaluate_with(wanted: int | str, request: EvaluationRequest, console: Console) -> Evaluation:
    """The evaluation, its scenes scored by the workers that were asked for."""
    from lidardesign.evaluate.workers import workers_of

    with workers_of(wanted, most=len(request.test)) as scorer:
        if scorer is None:
            return _evaluate(request, console)
        scorer.prepare(request)
        return _evaluate(replace(request, scorer=scorer), console)


def _evaluate(request: EvaluationRequest, console: Console) -> Evaluation:
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
        from lidardesign.density.ladder import check_kept

    check_kept(run.folder)


def _with_accuracy(evaluation: Evaluation, request: EvaluationRequest, run: Run, console: Console) -> Evaluation:
    """The evaluation with the ladders of the run, whose density is that of its own scenes, whatever it is judged by."""
    if (request.config, request.seed) != (run.config.task, run.config.seed):
        request = replace(request, train=run.scenes("train", run.config.seed))
    with phase("accuracy"), console.progress("ladder") as bar:
        from lidardesign.evaluate.accuracy import AccuracyRequest, measure_accuracy

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
    times: dict[str, dict[str, float]],
    report: Path | None,
    plots: Path | None,
    csv: Path | None,
) -> list[Path]:
    written: list[Path] = []
    if csv is not None:
        from lidardesign.evaluate.tables import write_csv

        with written_file(csv) as file:
            write_csv(evaluation, file)
        written.append(csv)
    if plots is not None:
        from lidardesign.evaluate.pictured import pictured_of
        from lidardesign.evaluate.plots import write_plots

        written += write_plots(evaluation, plots, pictured_of(request, times))
    if report is not None:
        with written_file(report) as file:
            _write_report(evaluation, request, file)
        written.append(report)
    return written


def _write_report(evaluation: Evaluation, request: EvaluationRequest, path: Path) -> None:
    from lidardesign.design.track import placed
    from lidardesign.evaluate.entries import middle_condition
    from lidardesign.evaluate.report import write_report
    from lidardesign.run.manifest import versions

    at = middle_condition(request)
    rays = {
        design.name: request.lay_out(
            design, design.rays or max(request.rays), request.samples.get(design.name), at=at
        )
        for design in request.designs
    }
    shown = [placed(design, at) for design in request.designs]
    reproduce = {"command": shlex.join(["lidardesign", *sys.argv[1:]]), "seed": request.seed, **versions()}
    write_report(evaluation, shown, rays, request.test[0], path, reproduce=reproduce, at=at)


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
