"""`lidardesign methods`: installed methods that make designs, and checks of their contract."""

from __future__ import annotations

from typing import Annotated

import typer

from lidardesign.choices.listings import LawChoices
from lidardesign.choices.shared import Brief
from lidardesign.cli.commands.tasks import list_plugins, show_plugin, try_laws
from lidardesign.cli.terminal.options import command_line, methods
from lidardesign.cli.terminal.output import Output

methods_app = typer.Typer(help="List, show or check methods that make designs.", no_args_is_help=True)
MethodName = Annotated[str, typer.Argument(metavar="NAME", help="Name of a method.", autocompletion=methods)]


@methods_app.command("list")
@command_line(Brief)
def list_(output: Output) -> None:
    """List the installed methods; a broken one with its reason."""
    from lidardesign.problem.method import METHODS

    list_plugins(METHODS, {"method": "name", "what it makes": "summary", "from": "distribution"}, output)


@methods_app.command("show")
@command_line(Brief)
def show(output: Output, name: MethodName) -> None:
    """Show a method: what it makes, what it needs, and whether it is drawn anew in every scene."""
    from lidardesign.problem.method import METHODS

    show_plugin(METHODS, name, output)


@methods_app.command("check")
@command_line(LawChoices, Brief)
def check(output: Output, name: MethodName, *, seconds: float) -> None:
    """Check that a method keeps the contract. Every law is tried; exit 6 where one does not hold."""
    from lidardesign.contract.process import CheckRequest

    try_laws(CheckRequest(name, limit_s=seconds, noun="method"), output)
