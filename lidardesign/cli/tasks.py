"""`lidardesign tasks`: which tasks are installed and what they take."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.console import command

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.registry import TaskListing
    from lidardesign.task import Task

tasks_app = typer.Typer(help="List the installed tasks, or show one.", invoke_without_command=True)


@tasks_app.callback()
def tasks(
    context: typer.Context,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """List the installed tasks, or show one."""
    if context.invoked_subcommand is None:
        list_(seed=seed, json=json, quiet=quiet, debug=debug)
    context.obj = json


@tasks_app.command("list")
def list_(
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """List the installed tasks; a broken one with its reason."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        from lidardesign.registry import list_tasks

        listings = list_tasks()
        entries = [
            {
                "name": item.name,
                "summary": item.summary,
                "distribution": item.distribution,
                "error": item.error,
            }
            for item in listings
        ]
        console.result({"tasks": entries}, lambda rich: _show_list(listings, rich))


def _show_list(listings: list[TaskListing], rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("task", "what it is", "from")
    for item in listings:
        text = f"[red]broken:[/red] {escape(item.error)}" if item.error else escape(item.summary)
        table.add_row(escape(item.name), text, escape(item.distribution))
    rich.print(table)


@tasks_app.command("show")
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a task.")],
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Show a task: its metric, its design space and the keys of its configuration."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        from lidardesign.registry import load_task

        task = load_task(name)
        document = _describe(task)
        console.result(document, lambda rich: _show_task(document, rich))


def _describe(task: Task) -> dict[str, Any]:
    metric, defaults = task.metric, task.defaults
    return {
        "name": task.name,
        "summary": task.summary,
        "metric": {"name": metric.name, "unit": metric.unit, "better": metric.better, "worst": metric.worst},
        "config": [_describe_field(name, info) for name, info in task.Config.model_fields.items()],
        "space": _default_space(task),
        "defaults": {"sensors": defaults.sensors, "rays": list(defaults.rays)},
    }


def _describe_field(name: str, info: Any) -> dict[str, Any]:
    kind = getattr(info.annotation, "__name__", None) if not hasattr(info.annotation, "__args__") else None
    default = None if info.is_required() else info.get_default(call_default_factory=True)
    if hasattr(default, "model_dump"):
        default = default.model_dump(mode="json")
    return {
        "key": name,
        "type": kind or str(info.annotation).replace("typing.", "").replace("pathlib.", ""),
        "required": info.is_required(),
        "default": default,
        "description": info.description or "",
    }


def _default_space(task: Task) -> dict[str, Any] | None:
    """The design space of the default configuration; None where the user must set something first."""
    from lidardesign.errors import ConfigError
    from lidardesign.registry import plugin_guard

    if any(info.is_required() for info in task.Config.model_fields.values()):
        return None
    try:
        with plugin_guard(task.name):
            return task.space(task.Config()).as_dict()
    except ConfigError:
        return None


def _show_task(document: dict[str, Any], rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    metric = document["metric"]
    rich.print(f"[bold]{escape(document['name'])}[/bold]: {escape(document['summary'])}")
    rich.print(f"metric: {escape(metric['name'])} \\[{escape(metric['unit'])}], {metric['better']} is better")
    rich.print(
        f"defaults: {document['defaults']['sensors']} sensors, rays {document['defaults']['rays']}",
        markup=False,
    )
    table = Table("key", "type", "default", "what it is", title="configuration (--set KEY=VALUE)", title_justify="left")
    for entry in document["config"]:
        default = "required" if entry["required"] else str(entry["default"])
        table.add_row(*(escape(text) for text in (entry["key"], entry["type"], default, entry["description"])))
    rich.print(table)
    if document["space"]:
        rich.print("design space (--set space.KEY=[LOW,HIGH])", markup=False)
        space = Table("dimension", "from", "to")
        for name, bounds in document["space"].items():
            if isinstance(bounds, list) and len(bounds) == 2 and name.endswith(("_m", "_rad")):
                space.add_row(name, f"{bounds[0]:.4g}", f"{bounds[1]:.4g}")
        rich.print(space)
