"""`lidardesign evaluate`: score designs on held-out scenes against baselines."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.evaluate import EvaluateCommand, NamedChoices
from lidardesign.choices.shared import Printed
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output, claim_outputs, keep_times
from lidardesign.cli.terminal.score_tables import show_accuracy, show_evaluation
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_outputs

if TYPE_CHECKING:
    from lidardesign.api.scores import ScoreRequest, Scores
    from lidardesign.api.seeds import SeedsRequest
    from lidardesign.cli.terminal.grids import ProgressDisplay
    from lidardesign.methods.cma import Show


@command_line(EvaluateCommand, NamedChoices, Printed)
def evaluate(
    output: Output,
    targets: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN|DESIGN",
            readable=False,
            help="Run folders (all their designs) and design files. For runs that differ only in their seed, "
            "designs of the same name share a row, with intervals over seeds and scenes.",
        ),
    ],
    *,
    space_of: Path | None = None,
    report: Path | None = None,
    csv: Path | None = None,
    **choices: Any,
) -> None:
    """Score designs on held-out scenes against baselines."""
    claim_outputs(output, csv=csv, report=report)
    with phase("libraries"):
        from lidardesign.api.scores import ScoreRequest, check_scores
        from lidardesign.api.seeds import SeedsRequest, differing_seeds
        from lidardesign.run_folder import RunFolder

    judge = None if space_of is None else RunFolder.open(space_of)
    runs = differing_seeds(targets, output.remark) if judge is None else []
    request: ScoreRequest | SeedsRequest = (
        SeedsRequest.resolve(runs, choices, output.remark)
        if runs
        else ScoreRequest.resolve(targets, choices, judge, output.remark)
    )
    files = {"--report": report, "--csv": csv}
    check_outputs(files, targets)
    with output.progress("evaluating") as progress:
        scores = request.score(lambda scene, done, total: progress.show(done, total), search_display(request, progress))
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
        if choices.get("accuracy"):
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
