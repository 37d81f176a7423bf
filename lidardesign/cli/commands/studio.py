"""`lidardesign studio`: a page on which sensors are moved, fitted and scored."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.output import command
from lidardesign.run.clock import phase


def studio(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `learn` made.")],
    design: Annotated[
        Path | None,
        typer.Argument(
            metavar="DESIGN", readable=False, help="The design to begin with.", show_default="the last of RUN"
        ),
    ] = None,
    port: Annotated[
        int | None, typer.Option("--port", metavar="N", help="Port to listen on.", show_default="any that is free")
    ] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address alone.")] = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Move sensors on a page and see what they are worth.

    Click the ball of a sensor and drag its handle, or type its place and angles: what you move or turn stays so. Fit
    chooses all the rest again, within the limits; a score on training scenes follows every change. Score judges on
    held-out scenes. Ctrl-C ends the page.
    """
    with command(json=False, quiet=quiet, verbose=verbose) as output:
        with phase("libraries"):
            from lidardesign.api.run import load_design, open_run

        opened = open_run(run)
        chosen = None if design is None else load_design(design, opened, output.remark)
        if chosen is None and not opened.design_paths():
            output.remark("the run has no design yet: one is fitted first")
        with output.progress("opening"):
            page = opened.studio(chosen, port=port)
        with page:
            print(page.address, flush=True)
            if not no_browser:
                import webbrowser

                webbrowser.open(page.address)
            page.wait()
