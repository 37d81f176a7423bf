"""The `lidardesign` program. Only what a command needs is imported, inside that command."""

from __future__ import annotations

import difflib
import os
import shlex
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from lidardesign import __version__
from lidardesign.cli.commands.capture import capture
from lidardesign.cli.commands.catalog import catalog_app
from lidardesign.cli.commands.completion import VARIABLE, answer_shell, completion
from lidardesign.cli.commands.config import config_app
from lidardesign.cli.commands.evaluate import evaluate
from lidardesign.cli.commands.export import export
from lidardesign.cli.commands.fit import constrain, fit
from lidardesign.cli.commands.learn import learn
from lidardesign.cli.commands.show import show
from lidardesign.cli.commands.tasks import tasks_app
from lidardesign.cli.environment import make_streams_tolerant, set_thread_defaults, terminate_cleanly
from lidardesign.cli.help import WIDEST, ManualCommand, ManualGroup
from lidardesign.cli.output import (
    EXIT_BROKEN_PIPE,
    Output,
    close_stdout_guard,
    forget_stdout,
    print_json,
    print_message,
    report_error,
)

PROGRAM = "lidardesign"
EXIT_USAGE = 2
HELP_WORDS = ("help", "man", "usage")
# Options that belong to commands, and are often written before them.
COMMON_OPTIONS = ("--json", "--quiet", "-q", "--verbose", "-v", "--debug", "--seed")
VERSION_HELP = "Print the version; with --json those of Python and the libraries too."
SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": WIDEST}

app = typer.Typer(
    name=PROGRAM,
    cls=ManualGroup,
    help="Design LiDARs: learn which rays are worth firing, fit sensors, prove what they are worth.",
    epilog="Exit codes: 0 ok, 1 threshold missed, 2 usage or config, 3 bad input data, "
    "4 infeasible constraints, 5 numerical failure, 6 plugin failure, 70 internal error, 130 interrupted, "
    "141 output closed, 143 terminated. `lidardesign COMMAND --help` has examples and names pages to read.",
    context_settings=SETTINGS,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(tasks_app, name="tasks")
app.add_typer(catalog_app, name="catalog")
app.add_typer(config_app, name="config")
for subcommand in (learn, fit, constrain, evaluate, export, capture, show, completion):
    app.command(context_settings=SETTINGS)(subcommand)
for group in (tasks_app, catalog_app, config_app):
    group.info.cls, group.info.context_settings = ManualGroup, SETTINGS
for group in (app, tasks_app, catalog_app, config_app):
    for registered in group.registered_commands:
        registered.cls = ManualCommand


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"lidardesign {__version__}")
        raise typer.Exit


def _print_versions() -> int:
    """Answer `--version --json`: the versions of all that a result depends on."""
    from lidardesign.run.manifest import versions

    print_json({"version": __version__, "versions": versions()})
    return 0


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help=VERSION_HELP)
    ] = False,
) -> None:
    """Declare the options of the program itself; the typer object carries its help."""


def run(arguments: list[str] | None = None) -> None:
    """Run the program on command line arguments and exit; where a shell asks what to complete, answer it."""
    set_thread_defaults()
    if VARIABLE in os.environ:
        sys.exit(answer_shell(app))
    make_streams_tolerant()
    terminate_cleanly()
    arguments = sys.argv[1:] if arguments is None else arguments
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
    sys.exit(code)


def _invoke(arguments: list[str]) -> int:
    """Run typer without letting it print or exit for errors."""
    output = Output(json="--json" in arguments, debug="--debug" in arguments)
    if sorted(arguments) == ["--json", "--version"]:
        return _print_versions()
    try:
        code: Any = app(arguments, prog_name=PROGRAM, standalone_mode=False)
    except typer.Exit as error:
        code = error.exit_code
    except typer.Abort:
        return report_error(KeyboardInterrupt(), output)
    except SystemExit as error:
        # neither typer nor rich exits by itself here but for a closed pipe
        raise BrokenPipeError from error
    except BrokenPipeError:
        raise
    except Exception as error:
        if not hasattr(error, "format_message"):
            return report_error(error, output)
        # One message for what typer finds wrong with the command line
        context = getattr(error, "ctx", None)
        path = context.command_path if context else PROGRAM
        message = error.format_message().rstrip()
        hint = _similar_line(arguments, typer.main.get_command(app)) or f"{path} --help"
        if type(error).__name__ == "NoArgsIsHelpError":
            print_message(message)
            message = "no command was given"
        if output.json:
            document = {"kind": "usage", "message": message, "where": path, "hint": hint}
            print_json({"error": document, "exit_code": EXIT_USAGE})
        print_message(f"usage error: {path}: {message}\n  try: {hint}")
        return EXIT_USAGE
    return code if isinstance(code, int) else 0


def _similar_line(words: Sequence[str], root: Any) -> str | None:
    """A command line close to the given one that would be understood, if there is one."""
    commands = root.commands
    first, *rest = words or [""]
    split = first.split()
    similar: list[str] | None = None
    if len(split) > 1 and split[0] in commands:
        similar = [*split, *rest]
    elif first in HELP_WORDS:
        named = [word for word in rest if not word.startswith("-")][:1]
        similar = [*named, "--help"] if not named or named[0] in commands else ["--help"]
    elif first in COMMON_OPTIONS:  # they belong behind the command
        options, behind = [], list(words)
        while behind and behind[0] in COMMON_OPTIONS:
            count = 2 if behind[0] == "--seed" else 1
            options, behind = options + behind[:count], behind[count:]
        similar = [*behind, *options] if behind and behind[0] in commands else None
    elif first in commands:
        similar = _with_known_command(words, 1, getattr(commands[first], "commands", None))
    elif first and not first.startswith("-"):
        similar = _with_known_command(words, 0, commands)
    return None if similar is None else shlex.join([PROGRAM, *similar])


def _with_known_command(words: Sequence[str], index: int, commands: Any) -> list[str] | None:
    """A command line with the word at a place replaced by the command that it is most like."""
    if not commands or len(words) <= index or words[index] in commands:
        return None
    names = [name for name, command in commands.items() if not command.hidden]
    close = difflib.get_close_matches(words[index], names, n=1)
    return [*words[:index], close[0], *words[index + 1 :]] if close else None
