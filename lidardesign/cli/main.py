"""The `lidardesign` program. Only what a command needs is imported, inside that command."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from lidardesign import __version__
from lidardesign.cli.commands.capture import capture
from lidardesign.cli.commands.catalog import catalog_app
from lidardesign.cli.commands.compare import compare
from lidardesign.cli.commands.completion import answer, completion, is_asked
from lidardesign.cli.commands.config import config_app
from lidardesign.cli.commands.constrain import constrain
from lidardesign.cli.commands.evaluate import evaluate
from lidardesign.cli.commands.export import export
from lidardesign.cli.commands.fit import fit
from lidardesign.cli.commands.learn import learn
from lidardesign.cli.commands.show import show
from lidardesign.cli.commands.tasks import tasks_app
from lidardesign.cli.deprecations import deprecations_told, with_new_names
from lidardesign.cli.environment import make_streams_tolerant, set_cache_default, set_thread_defaults, terminate_cleanly
from lidardesign.cli.manual import PAGES, add_manuals
from lidardesign.cli.mistakes import hint_of
from lidardesign.cli.output import EXIT_BROKEN_PIPE, Console, forget_stdout, print_json, report_error, tell
from lidardesign.cli.stdout_guard import print_aside_from_now_on

EXIT_USAGE = 2
SETTINGS = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    name="lidardesign",
    help="Design LiDARs: learn which rays are worth firing, fit sensors, prove what they are worth.",
    epilog="Exit codes: 0 ok, 1 threshold missed, 2 usage or config, 3 bad input data, "
    "4 infeasible constraints, 5 numerical failure, 6 plugin failure, 70 internal error, 130 interrupted, "
    "141 output closed, 143 terminated. `lidardesign COMMAND --help` has examples; docs/commands.md has all of it.",
    context_settings=SETTINGS,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(tasks_app, name="tasks")
app.add_typer(catalog_app, name="catalog")
app.add_typer(config_app, name="config")
for subcommand in (learn, fit, constrain, evaluate, export, capture, show, compare, completion):
    app.command(context_settings=SETTINGS)(subcommand)
add_manuals({"": app, "tasks": tasks_app, "catalog": catalog_app, "config": config_app}, PAGES)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"lidardesign {__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Declare the options of the program itself; the typer object carries its help."""


def run(arguments: list[str] | None = None) -> None:
    """Run the program on command line arguments and exit; where a shell asks what to complete, answer it."""
    set_thread_defaults()
    if is_asked():
        sys.exit(answer(app))
    set_cache_default()
    make_streams_tolerant()
    terminate_cleanly()
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        with deprecations_told():
            code = _invoke(with_new_names(arguments))
        sys.stdout.flush()
        if "--json" in arguments:
            print_aside_from_now_on()
    except BrokenPipeError:
        forget_stdout()
        code = EXIT_BROKEN_PIPE
    except OSError as error:
        forget_stdout()
        code = report_error(error, Console())
    sys.exit(code)


def _invoke(arguments: list[str]) -> int:
    """Run typer without letting it print or exit for errors."""
    console = Console(json="--json" in arguments, debug="--debug" in arguments)
    try:
        code: Any = app(arguments, prog_name="lidardesign", standalone_mode=False)
    except typer.Exit as error:
        code = error.exit_code
    except typer.Abort:
        return report_error(KeyboardInterrupt(), console)
    except SystemExit as error:
        # neither typer nor rich exits by itself here but for a closed pipe
        raise BrokenPipeError from error
    except BrokenPipeError:
        raise
    except Exception as error:
        if not hasattr(error, "format_message"):
            return report_error(error, console)
        return _report_usage(error, console, arguments)
    return code if isinstance(code, int) else 0


def _report_usage(error: Any, console: Console, arguments: list[str]) -> int:
    """One message for what typer finds wrong with the command line."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context else "lidardesign"
    message, hint = error.format_message().rstrip(), hint_of(arguments, error, typer.main.get_command(app))
    if type(error).__name__ == "NoArgsIsHelpError":
        tell(message)
        message = "no command was given"
    if console.json:
        document = {"kind": "usage", "message": message, "where": path, "hint": hint}
        print_json({"error": document, "exit_code": EXIT_USAGE})
    tell(f"usage error: {path}: {message}\n  try: {hint}")
    return EXIT_USAGE
