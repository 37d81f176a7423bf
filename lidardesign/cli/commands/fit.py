"""`lidardesign fit` and `constrain`: sensors for the density of a run, free or under constraints; neither trains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.fit import ConstrainOptions, FitChoices
from lidardesign.choices.shared import Printed
from lidardesign.cli.terminal.design_tables import show_fit
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output, keep_times
from lidardesign.errors import LidardesignError
from lidardesign.run.clock import WAIT_S, phase
from lidardesign.run.files import check_lock
from lidardesign.run.outputs import check_writable

if TYPE_CHECKING:
    from lidardesign.api.problems import MethodRequest
    from lidardesign.fitting.request import FitRequest


@command_line(FitChoices, Printed)
def fit(
    output: Output,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `learn` made.")],
    **choices: Any,
) -> None:
    """Fit sensors to the density of RUN."""
    with phase("libraries"):
        from lidardesign.api.problems import problem_of
        from lidardesign.run_folder import RunFolder

    run_fit(problem_of(RunFolder.open(run), choices, notes=output.remark), output, choices)


def run_fit(request: FitRequest | MethodRequest, output: Output, choices: FitChoices) -> None:
    """Fit the design of a request, save it, and give the result."""
    from lidardesign.api.design import Design
    from lidardesign.sensors.design_file import design_text

    path = request.run.design_path(request.name)
    label = "design (replaced)" if path.exists() else "design"
    check_writable(path)
    check_lock(request.run.folder)
    with output.progress("fitting") as progress:
        shown = lambda step, *_: progress.show(label=step)  # noqa: E731
        design = Design.fitted(request, workers=choices.get("workers", 1), notes=output.remark, progress=shown)
    try:
        design.save()
    except LidardesignError:
        output.keep(design_text(design.specification, Path(design.name)), ".yaml")
        raise
    document = design.as_dict()
    keep_times(request.run.folder, request.command, output, wait_s=WAIT_S, created=request.run.created)

    def show(rich: RichConsole) -> None:
        checks = design.result.constraints if design.result else ()
        show_fit(document, design.specification, checks, rich, verbose=output.verbose)

    output.result(document, show, files={label: Path(document["design"])})


@command_line(ConstrainOptions, FitChoices, Printed)
def constrain(
    output: Output,
    target: Annotated[
        Path, typer.Argument(metavar="RUN|DESIGN", readable=False, help="A run folder, or a design that came from one.")
    ],
    **choices: Any,
) -> None:
    """Fit sensors again under constraints; nothing is learned again."""
    with phase("libraries"):
        from lidardesign.api.problems import problem_of
        from lidardesign.constraints.document import Constraints, load_constraints, split_settings
        from lidardesign.formats.designs import need_run, open_target

    opened, design = open_target(target, output.remark)
    run = need_run(opened, target)
    bounds, choices["settings"] = split_settings(choices.get("settings", ()), run.task)
    choices["constraints"] = load_constraints(choices.get("constraints"), bounds, output.remark) or Constraints()
    run_fit(problem_of(run, choices, design, notes=output.remark), output, choices)
