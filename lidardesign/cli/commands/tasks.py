"""`lidardesign tasks`: installed tasks, their keys, checks of the contract, and packages of new ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.choices.flag import complete
from lidardesign.choices.listings import CheckCommand, NewCommand
from lidardesign.choices.shared import Brief
from lidardesign.cli.commands.plugins import list_plugins, try_laws
from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole, text_table
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output
from lidardesign.errors import pasted
from lidardesign.run.clock import phase

tasks_app = typer.Typer(help="List, show, check or start tasks.", invoke_without_command=True)


@tasks_app.callback()
def tasks(context: typer.Context) -> None:
    """List, show, check or start tasks."""
    if context.invoked_subcommand is None:
        list_()


@tasks_app.command("list")
@command_line(Brief)
def list_(
    output: Output,
) -> None:
    """List the installed tasks; a broken one with its reason."""
    with phase("libraries"):
        from lidardesign.task import TASKS

    list_plugins(TASKS, {"task": "name", "what it is": "summary", "from": "distribution"}, output)


@tasks_app.command("show")
@command_line(Brief)
def show(
    output: Output,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a task.", autocompletion=options.tasks)],
) -> None:
    """Show a task. It has a metric, a design space and keys of its configuration."""
    with phase("libraries"):
        from lidardesign.api.config_reference import describe_task
        from lidardesign.task import load_task

    document = describe_task(load_task(name))
    output.result(document, lambda rich: _show_task(document, rich), show_costs=False)


def _show_task(document: Mapping[str, Any], rich: RichConsole) -> None:
    metric, defaults, space = document["metric"], document["defaults"], document["space"]
    rich.print(f"{document['name']}: {document['summary']}")
    rich.print(f"metric: {metric['name']} [{metric['unit']}], {metric['better']} is better")
    rich.print(f"defaults: level {defaults['level']:g}, evaluated at {', '.join(map(str, defaults['rays']))} rays")
    _show_keys(document["config"], "configuration (--set KEY=VALUE)", rich)
    if space:
        rich.print("design space (--set space.KEY=[LOW,HIGH])", style="italic")
        rows = []
        for name, bounds in space.items():
            if isinstance(bounds, list) and len(bounds) == 2 and name.endswith(("_m", "_rad")):
                low, high = bounds
                kind = "a condition (--at)" if name in space["condition"] else "fixed" if low == high else "designed"
                rows.append((name, f"{low:.4g}", f"{high:.4g}", kind))
        rich.print(text_table(("dimension", "from", "to", ""), rows))
    else:
        rich.print("design space: follows from the configuration (--set space.KEY=[LOW,HIGH])")
    _show_keys(document["density"], "target density (--set density.KEY=VALUE)", rich)
    _show_keys(document["learning"], "learning, preset standard (--set learning.KEY=VALUE)", rich)


def _show_keys(entries: list[dict[str, Any]], title: str, rich: RichConsole) -> None:
    rows = [
        (
            entry["key"],
            entry["type"],
            "required" if entry["required"] else _yaml_value(entry["default"]),
            entry["description"],
        )
        for entry in entries
    ]
    rich.print(text_table(("key", "takes", "default", "what it is"), rows, title))


def _yaml_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(str, value)) + "]"
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


@tasks_app.command("check")
@command_line(CheckCommand, Brief)
def check(
    output: Output,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of an installed task.", autocompletion=options.tasks)
    ],
    **given: Any,
) -> None:
    """Check that a task keeps the contract. Every law is tried; exit 6 where one does not hold."""
    with phase("libraries"):
        from lidardesign.contract.process import CheckRequest

    choices = complete(CheckCommand, given)
    try_laws(
        CheckRequest(name, choices["config"], tuple(choices["settings"]), choices["seed"], choices["seconds"]), output
    )


@tasks_app.command("new")
@command_line(NewCommand, Brief)
def new(
    output: Output,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the task, as `learn` will take it.")],
    *,
    out: Path | None = None,
) -> None:
    """Write an installable package of a new task. It keeps the contract and passes its own tests as it is."""
    with phase("libraries"):
        from lidardesign.contract.scaffold import new_task

    written = new_task(name, out)
    folder = written[0].parent

    def show_files(rich: RichConsole) -> None:
        for path in written:
            rich.print(f"  {path}")
        advice = f"next: pip install --editable {pasted(f'{folder}[test]')}, then lidardesign tasks check {name}"
        rich.print(advice, soft_wrap=True)

    output.result({"task": name, "folder": folder, "files": written}, show_files, show_costs=False)
