"""`lidardesign studio`: a page on which sensors are moved, fitted and scored."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.choices.files import StudioChoices, StudioCommand
from lidardesign.choices.shared import Spoken
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output
from lidardesign.run.clock import phase


@command_line(StudioChoices, StudioCommand, Spoken)
def studio(
    output: Output,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `learn` made.")],
    design: Annotated[
        Path | None,
        typer.Argument(
            metavar="DESIGN", readable=False, help="The design to begin with.", show_default="the last of RUN"
        ),
    ] = None,
    *,
    no_browser: bool = False,
    **choices: Any,
) -> None:
    """Move sensors on a page and see what they are worth.

    Click the ball of a sensor and drag its handle, or type its place and angles: what you move or turn stays so. Fit
    chooses all the rest again, within the limits; a score on training scenes follows every change. Score judges on
    held-out scenes. Ctrl-C ends the page.
    """
    with phase("libraries"):
        from lidardesign.api.run import load_design, open_run
        from lidardesign.studio import open_page

    opened = open_run(run)
    chosen = None if design is None else load_design(design, opened, output.remark)
    if chosen is None and not opened.design_paths():
        output.remark("the run has no design yet: one is fitted first")
    with output.progress("opening"):
        page = open_page(opened, chosen, **choices)
    with page:
        print(page.address, flush=True)
        if not no_browser:
            import webbrowser

            webbrowser.open(page.address)
        page.wait()
