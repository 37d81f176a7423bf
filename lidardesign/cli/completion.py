"""`lidardesign completion`: the script that makes a shell complete command lines, and the answers to it."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.completion_scripts import SCRIPTS, VARIABLE
from lidardesign.cli.console import command
from lidardesign.cli.runs import check_choice

# Nobody waits longer at a prompt: plugins that hang while they are imported are left out.
MOST_SECONDS = 5.0


def completion(
    shell: Annotated[str, typer.Argument(metavar="|".join(SCRIPTS), help="The shell.")],
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print the script that completes commands, options, tasks, keys, formats, parts, runs and designs in a shell."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        check_choice(shell, "SHELL", tuple(SCRIPTS))
        script = SCRIPTS[shell]
        shown = {"shell": shell, "script": script}
        console.result(shown, lambda rich: print(script, end="", file=console.output), show_costs=False)


def is_asked() -> bool:
    """Whether a shell asks what may stand at its cursor."""
    return VARIABLE in os.environ


def answer(app: Any) -> int:
    """Answer a shell; where that fails nobody can be told, and nothing is completed."""
    from lidardesign.cli.completing import print_response

    with contextlib.suppress(ValueError, AttributeError):
        # by its default the signal ends the process, whatever a plugin does
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    try:
        print_response(os.environ[VARIABLE], typer.main.get_command(app))
    except Exception:
        return 1
    return 0
