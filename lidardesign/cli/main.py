"""The `lidardesign` program. Only what a command needs is imported, inside that command."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Any

import typer

from lidardesign import __version__
from lidardesign.choices.flag import Flag
from lidardesign.cli.commands.capture import capture
from lidardesign.cli.commands.catalog import catalog_app
from lidardesign.cli.commands.config import config_app
from lidardesign.cli.commands.evaluate import evaluate
from lidardesign.cli.commands.export import export
from lidardesign.cli.commands.fit import constrain, fit
from lidardesign.cli.commands.learn import learn
from lidardesign.cli.commands.plugins import formats_app, methods_app
from lidardesign.cli.commands.show import show
from lidardesign.cli.commands.simulate import simulate
from lidardesign.cli.commands.studio import studio
from lidardesign.cli.commands.tasks import tasks_app
from lidardesign.cli.terminal.options import StrictCommand, typer_option
from lidardesign.cli.terminal.output import (
    EXIT_BROKEN_PIPE,
    Output,
    close_stdout_guard,
    forget_stdout,
    make_streams_tolerant,
    print_json,
    print_message,
    report_error,
    set_defaults,
)
from lidardesign.errors import page
from lidardesign.run.processes import ENDING

PROGRAM = "lidardesign"
COMPLETION = "_LIDARDESIGN_COMPLETE"
EXIT_USAGE = 2
VERSION = Flag("--version", "", "Print the version; with --json those of Python and the libraries too.", default=False)
SETTINGS = {"help_option_names": ["-h", "--help"]}

# What `--help` of a command ends with: every example is parsed by the tests.
EXAMPLES: dict[str, tuple[str, ...]] = {
    "learn": (
        "lidardesign learn face --preset draft --out runs/face",
        "lidardesign learn meshes --set folder=scans --set scale=0.001",
        "lidardesign learn --config face.yaml --tolerance 0.1",
        "lidardesign learn face --time-budget 60 --out runs/minute",
        "lidardesign learn face --out runs/face --resume",
        "lidardesign learn face --out runs/face --dry-run",
    ),
    "fit": (
        "lidardesign fit runs/face",
        "lidardesign fit runs/face --sensors 4 --layout even --name even",
        "lidardesign fit runs/face --gates ray --rays 576 --name beams",
        "lidardesign fit runs/face --parts vl53l8cx,tmf8828 --sensors 2",
        "lidardesign fit runs/face --like robot.sdf --name instead",
        "lidardesign fit runs/warehouse --rays 12 --at x_m=0.37",
    ),
    "constrain": (
        "lidardesign constrain runs/face --set gate.width_m.max=0.1",
        "lidardesign constrain runs/face --constraints buyable.yaml",
    ),
    "evaluate": (
        "lidardesign evaluate runs/face --report report.html --csv rows.csv",
        "lidardesign evaluate runs/face/designs/free.yaml --fail-above 8",
        "lidardesign evaluate runs/face --detector single-photon",
        "lidardesign evaluate rig.csv other.csv --in runs/face --baseline none",
        "lidardesign evaluate runs/arm --baseline occupancy --workers 8",
    ),
    "studio": (
        "lidardesign studio runs/face",
        "lidardesign studio runs/arm --port 8080 --no-browser",
    ),
    "simulate": (
        "lidardesign simulate runs/face --scenes 20 --format mcap --out faces.mcap",
        "lidardesign simulate free.yaml --scene cup.stl --scale 0.001 --out cup",
    ),
    "export": (
        "lidardesign export --list",
        "lidardesign export runs/face/designs/free.yaml --format csv --rays 576",
    ),
    "capture": ("lidardesign capture scan.npz runs/face/designs/free.yaml --rays 576",),
    "show": (
        "lidardesign show runs/face",
        "lidardesign show runs/warehouse/designs/track.yaml --at x_m=3.91",
        "lidardesign show rig.csv runs/face/designs/one.yaml",
    ),
    "catalog list": ("lidardesign catalog list --reflectance 10 --klux 100",),
    "catalog show": (
        "lidardesign catalog show vl53l5cx:4x4",
        "lidardesign catalog show vl53l8cx --out bought.yaml --rays 196",
    ),
    "tasks list": ("lidardesign tasks list",),
    "tasks show": ("lidardesign tasks show face",),
    "tasks check": ("lidardesign tasks check meshes --set folder=scans --json",),
    "tasks new": ("lidardesign tasks new landmark --out work/landmark",),
    "formats list": ("lidardesign formats list",),
    "formats show": ("lidardesign formats show mjcf",),
    "formats check": ("lidardesign formats check csv --json",),
    "methods list": ("lidardesign methods list",),
    "methods show": ("lidardesign methods show greedy",),
    "methods check": ("lidardesign methods check greedy --json",),
    "config init": ("lidardesign config init meshes --set folder=scans --out scans.yaml",),
    "config schema": ("lidardesign config schema config --task face --out face.json",),
}
PAGES = {
    "learn": "run-folder.md, accuracy.md",
    "fit": "design-file.md, selection.md, parts.md, importance.md",
    "constrain": "constraints.md, catalog.md",
    "evaluate": "evaluate.md, baselines.md, detectors.md, shell.md",
    "studio": "studio.md, constraints.md",
    "simulate": "formats.md, detectors.md",
    "export": "formats.md, design-file.md",
    "capture": "captures.md",
    "show": "design-file.md, rigs.md, formats.md",
    "catalog": "catalog.md",
    "tasks": "writing-tasks.md",
    "formats": "formats.md, writing-methods.md",
    "methods": "baselines.md, writing-methods.md",
    "config": "run-folder.md, shell.md",
}


def epilog_of(command: str) -> str:
    """The end of a command's help: examples, one a line, and pages of the documentation."""
    pages = PAGES[command if command in PAGES else command.split()[0]]
    # \b keeps the lines as they are
    examples = "\n".join(["\b", "Examples:", *(f"  {example}" for example in EXAMPLES[command])])
    return f"{examples}\n\n\b\nSee also: {pages}\n  in {page('commands.md').parent}"


app = typer.Typer(
    name=PROGRAM,
    help="Design LiDARs: learn which rays are worth firing, fit sensors, prove what they are worth.",
    epilog="Exit codes: 0 ok, 1 threshold missed, 2 usage or config, 3 bad input data, "
    "4 infeasible constraints, 5 numerical failure or no memory left, 6 plugin failure, 70 internal error, "
    "130 interrupted, 141 output closed, 143 terminated.",
    context_settings=SETTINGS,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # panels take half as long again, and fold at 80 columns
)
for subcommand in (learn, fit, constrain, evaluate, studio, simulate, export, capture, show):
    app.command()(subcommand)
groups = {
    "tasks": tasks_app,
    "formats": formats_app,
    "methods": methods_app,
    "catalog": catalog_app,
    "config": config_app,
}
for name, group in {"": app, **groups}.items():
    if name:
        app.add_typer(group, name=name, context_settings=SETTINGS)
    for registered in group.registered_commands:
        registered.cls, registered.context_settings = StrictCommand, SETTINGS
        registered.epilog = epilog_of(f"{name} {registered.name or registered.callback.__name__}".strip())


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"lidardesign {__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: typer_option(VERSION, callback=_print_version, is_eager=True) = False,
) -> None:
    """Declare the options of the program itself; the typer object carries its help."""


def run(arguments: list[str] | None = None) -> None:
    """Run the program on command line arguments and exit; where a shell asks what to complete, answer it."""
    set_defaults()
    if COMPLETION in os.environ:
        with contextlib.suppress(Exception):  # nobody can be told at a prompt
            app(prog_name=PROGRAM)
        sys.exit(1)
    make_streams_tolerant()
    if arguments is None:
        ENDING.begin(print_message)
        arguments = sys.argv[1:]
    try:
        code = _invoke(arguments)
        sys.stdout.flush()
        if "--json" in arguments:
            close_stdout_guard()
    except BrokenPipeError:
        forget_stdout()
        code = EXIT_BROKEN_PIPE
    except OSError as error:
        forget_stdout()
        code = report_error(error, Output())
    ENDING.end(code)


def _invoke(arguments: list[str]) -> int:
    """Run typer without letting it print or exit for errors."""
    output = Output(json="--json" in arguments)
    if sorted(arguments) == ["--json", "--version"]:
        # the versions of all that a result depends on
        from lidardesign.run.manifest import versions

        print_json({"version": __version__, "versions": versions()})
        return 0
    try:
        code: Any = app(arguments, prog_name=PROGRAM, standalone_mode=False)
    except typer.Exit as error:
        code = error.exit_code
    except SystemExit as error:
        # typer ends like this once completion is shown or installed, rich where nobody reads any more
        if error.code:
            raise BrokenPipeError from error
        return 0
    except BrokenPipeError:
        raise
    except BaseException as error:
        if not hasattr(error, "format_message"):
            return report_error(error, output)
        # One message for what typer finds wrong with the command line
        context = getattr(error, "ctx", None)
        path = context.command_path if context else PROGRAM
        message, hint = error.format_message().rstrip(), f"{path} --help"
        if type(error).__name__ == "NoArgsIsHelpError":
            print_message(message)
            message = "no command was given"
        if output.json:
            document = {"kind": "usage", "message": message, "where": path, "hint": hint}
            print_json({"error": document, "exit_code": EXIT_USAGE})
        print_message(f"usage error: {path}: {message}\n  try: {hint}")
        return EXIT_USAGE
    return code if isinstance(code, int) else 0
