"""`lidardesign evaluate`: score designs on held-out scenes against baselines."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import words
from lidardesign.cli.terminal.output import claim_outputs, command, keep_times
from lidardesign.cli.terminal.score_tables import show_accuracy, show_evaluation
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_outputs

if TYPE_CHECKING:
    from lidardesign.api.scores import ScoreRequest, Scores
    from lidardesign.api.seeds import SeedsRequest
    from lidardesign.cli.terminal.grids import ProgressDisplay
    from lidardesign.scoring.baselines.cma import Show

BASELINE_HELP = (
    "A baseline in addition to uniform, random, bounding, silhouette and greedy: lloyd (like silhouette, denser where "
    "returns are frequent and surfaces large), occupancy (rays towards cells that targets occupy), no-visibility "
    "(the first design refitted to the density without its occlusion term; takes some seconds), "
    "or cma (direct optimisation of the first design's sensors on training scenes, for --cma-seconds). Repeatable. "
    "none: no baselines at all."
)


def evaluate(
    targets: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN|DESIGN",
            readable=False,
            help="Run folders (all their designs) and design files. For runs that differ only in their seed, "
            "designs of the same name share a row, with intervals over seeds and scenes.",
        ),
    ],
    space_of: options.SpaceOf = None,
    designs: Annotated[
        list[str] | None,
        typer.Option("--designs", metavar="NAME", help="Only designs of this name; repeatable.", show_default="all"),
    ] = None,
    rays: Annotated[
        list[int] | None,
        typer.Option(
            "--rays",
            metavar="N",
            min=1,
            max=1_000_000,
            help="Rays per frame and position; repeatable. Fixed patterns fire their own number, or an even subset "
            "where fewer are asked for.",
            show_default="the task's and the designs'",
        ),
    ] = None,
    baseline: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline",
            metavar="NAME",
            help=BASELINE_HELP,
            show_default=False,
            autocompletion=words("lloyd|occupancy|no-visibility|cma"),
        ),
    ] = None,
    cma_seconds: Annotated[
        float | None,
        typer.Option(
            "--cma-seconds",
            metavar="SECONDS",
            help="Wall time of each search of `--baseline cma`, one per number of rays.",
            show_default="60",
        ),
    ] = None,
    effects: Annotated[
        str,
        typer.Option(
            "--effects",
            metavar="auto|all|none|audit|LIST",
            help="Physical effects: auto for those that matter in each scene, all, none, or names separated by "
            "commas; audit: like auto, and every row under all effects too (exit 1 if a score moves by more than the "
            "metric's tolerance).",
            autocompletion=words("auto|all|none|audit"),
        ),
    ] = "auto",
    detector: options.Detector = "ideal",
    range_tolerance_mm: Annotated[
        float | None,
        typer.Option(
            "--range-tolerance-mm",
            metavar="MM",
            help="How much all skipped effects together may change ranges (rms).",
            show_default="a tenth of a bin, or 1, and at most the metric's tolerance where it is a length",
        ),
    ] = None,
    return_tolerance: Annotated[
        float | None,
        typer.Option(
            "--return-tolerance",
            metavar="SHARE",
            help="Share of returns that all skipped effects together may change.",
            show_default="0.001",
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Score in scenes other than the learned ones: a key of the task, such as illuminance_lux=100000 or "
            "test=10, that does not change the design space; repeatable.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report", metavar="FILE.html", help="Write one HTML page: tables, curves, 3D view.", show_default=False
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write the rows as CSV.", show_default=False)
    ] = None,
    fail_above: Annotated[
        float | None,
        typer.Option(
            "--fail-above",
            metavar="VALUE",
            help="Exit 1 if a design scores worse, in the metric's unit.",
            show_default=False,
        ),
    ] = None,
    fail_unless_better: Annotated[
        str | None,
        typer.Option(
            "--fail-unless-better",
            metavar="NAME",
            help="Exit 1 unless every design is better than this baseline or design at every number of rays, by the "
            "interval of the difference.",
            show_default=False,
        ),
    ] = None,
    workers: options.Workers = "1",
    accuracy: Annotated[
        bool,
        typer.Option(
            "--accuracy",
            help="Also measure what accuracy costs on this machine: errors and seconds of every numerical choice, for "
            "this task and run, and the cheapest setting that is good enough. Takes minutes.",
        ),
    ] = False,
    mount_error: Annotated[
        str | None,
        typer.Option(
            "--mount-error",
            metavar="LENGTH,ANGLE",
            help="Also score all rows with every sensor misplaced at random in every scene, such as 5mm,0.5deg: "
            "standard deviations along and about each axis.",
            show_default=False,
        ),
    ] = None,
    losses: options.Losses = False,
    seed: options.Seed = None,
    scenes_seed: Annotated[
        int | None,
        typer.Option(
            "--scenes-seed",
            metavar="N",
            help="Seed of the held-out scenes.",
            show_default="--seed, or the (first) run's",
        ),
    ] = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Score designs on held-out scenes against baselines."""
    with command(json=json, quiet=quiet, verbose=verbose) as output:
        claim_outputs(output, csv=csv, report=report)
        with phase("libraries"):
            from lidardesign.api.scores import ScoreOptions, ScoreRequest, check_scores
            from lidardesign.api.seeds import SeedsRequest, differing_seeds
            from lidardesign.run_folder import RunFolder

        chosen = ScoreOptions(
            rays=rays,
            baselines=baseline or (),
            seed=seed,
            effects=effects,
            detector=detector,
            range_tolerance_mm=range_tolerance_mm,
            return_tolerance=return_tolerance,
            settings=overrides or (),
            workers=workers,
            cma_seconds=cma_seconds,
            accuracy=accuracy,
            scenes_seed=scenes_seed,
            designs=designs or (),
            mount_error=mount_error,
            losses=losses,
            fail_above=fail_above,
            fail_unless_better=fail_unless_better,
        )
        judge = None if space_of is None else RunFolder.open(space_of)
        runs = differing_seeds(targets, output.remark) if judge is None else []
        request: ScoreRequest | SeedsRequest = (
            SeedsRequest.resolve(runs, chosen, output.remark)
            if runs
            else ScoreRequest.resolve(targets, chosen, judge, output.remark)
        )
        files = {"--report": report, "--csv": csv}
        check_outputs(files, targets)
        with output.progress("evaluating") as progress:
            scores = request.score(
                lambda scene, done, total: progress.show(done, total), search_display(request, progress)
            )
        written: dict[Path, None] = {}

        def show_result() -> None:
            document = {**scores.as_dict(), "files": [str(path) for path in written]}
            notes = [note for note in scores.evaluation.notes if output.says(note)]

            def show(rich: RichConsole) -> None:
                if scores.evaluation.accuracy is not None:
                    show_accuracy(scores.evaluation.accuracy, rich, verbose=output.verbose)
                show_evaluation({**document, "notes": notes}, scores.evaluation, rich, verbose=output.verbose)

            output.result(
                document, show, files={name.removeprefix("--"): path for name, path in files.items() if path in written}
            )

        with ExitStack() as rest:  # the scores are shown whatever becomes of the files and of what is measured further
            rest.callback(show_result)
            run, further = request.run, scores.last_scores()
            rest.callback(keep_times, run.folder, "evaluate", output, created=run.created, further=further)
            # accuracy takes minutes: what was scored by then is written already
            _write_files(scores, written, *files.values())
            if accuracy:
                with output.progress("measuring accuracy") as progress:
                    scores = scores.with_accuracy(lambda sweep, done, total: progress.show(done, total, detail=sweep))
                _write_files(scores, written, *files.values())
        check_scores(scores)


def search_display(request: ScoreRequest | SeedsRequest, progress: ProgressDisplay) -> Show:
    """Shows the best score of each search, in a line of its own."""

    def show(label: str, share: float, best: float) -> None:
        found, left_s = f"best {best:.4g} {request.run.metric.unit}", (1 - share) * request.cma_seconds
        progress.show(share, 1.0, label=label, detail=found, left_s=left_s, line=label)

    return show


@phase("writing")
def _write_files(scores: Scores, written: dict[Path, None], report: Path | None, csv: Path | None) -> None:
    """Write what was asked for, each whatever becomes of the other; what is there then is added to `written`."""
    with ExitStack() as rest:
        if report is not None:
            rest.callback(_write_report, scores, written, report)
        if csv is not None:
            scores.to_csv(csv)
            written[csv] = None


def _write_report(scores: Scores, written: dict[Path, None], path: Path) -> None:
    scores.report(path, ("lidardesign", *sys.argv[1:]))
    written[path] = None
