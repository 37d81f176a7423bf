"""`lidardesign tasks`: which tasks are installed and what they take."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import typer

from lidardesign.cli import options
from lidardesign.cli.console import command
from lidardesign.cli.tasks_check import check
from lidardesign.cli.tasks_new import new
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo
    from rich.console import Console as RichConsole

    from lidardesign.registry import TaskListing
    from lidardesign.task import Task

KINDS = {int: "whole number", float: "number", str: "text", bool: "true or false", type(None): "null"}

tasks_app = typer.Typer(help="List, show, check or begin tasks.", invoke_without_command=True)


@tasks_app.callback()
def tasks(
    context: typer.Context,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """List, show, check or begin tasks."""
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
        with phase("libraries"):
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
        console.result({"tasks": entries}, lambda rich: _show_list(listings, rich), show_costs=False)


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
        with phase("libraries"):
            from lidardesign.registry import load_task

        task = load_task(name)
        document = _describe(task)
        console.result(document, lambda rich: _show_task(document, rich), show_costs=False)


def _describe(task: Task) -> dict[str, Any]:
    from lidardesign.density.settings import DensitySettings, LearningSettings

    metric, defaults = task.metric, task.defaults
    return {
        "name": task.name,
        "summary": task.summary,
        "metric": {"name": metric.name, "unit": metric.unit, "better": metric.better, "worst": metric.worst},
        "config": _describe_fields(task.Config, {}),
        "density": _describe_fields(DensitySettings, defaults.density),
        "learning": _describe_fields(LearningSettings, defaults.learning.get("standard", {})),
        "space": _default_space(task),
        "defaults": {
            "sensors": defaults.sensors,
            "layout": defaults.layout,
            "level": defaults.level,
            "rays": list(defaults.rays),
        },
    }


def _describe_fields(model: type[BaseModel], suggested: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The keys of a section; what a task suggests stands before the section's own defaults."""
    entries = [_describe_field(name, info) for name, info in model.model_fields.items()]
    return [{**entry, "default": suggested.get(entry["key"], entry["default"])} for entry in entries]


def _describe_field(name: str, info: FieldInfo) -> dict[str, Any]:
    default = None if info.is_required() else info.get_default(call_default_factory=True)
    if hasattr(default, "model_dump"):
        default = default.model_dump(mode="json")
    return {
        "key": name,
        "type": kind_of_value(info.annotation),
        "required": info.is_required(),
        "default": default,
        "description": info.description or "",
    }


def kind_of_value(annotation: Any) -> str:
    """What a key takes, in words: `number`, `3 numbers`, `auto or mm or m`, `path or null`."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return kind_of_value(parts[0])
    if origin is Literal:
        return " or ".join(str(part) for part in parts)
    if origin in (Union, UnionType):
        return " or ".join(kind_of_value(part) for part in parts)
    if origin is tuple and len(set(parts)) == 1:
        return f"{len(parts)} {kind_of_value(parts[0])}s"
    if origin in (list, tuple, set) and parts:
        return f"list of {kind_of_value(parts[0])}s"
    if isinstance(annotation, type) and issubclass(annotation, Path):
        return "path"
    return KINDS.get(annotation) or getattr(annotation, "__name__", str(annotation))


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

    metric = document["metric"]
    rich.print(f"[bold]{escape(document['name'])}[/bold]: {escape(document['summary'])}")
    rich.print(f"metric: {escape(metric['name'])} \\[{escape(metric['unit'])}], {metric['better']} is better")
    rich.print(_shown_defaults(document["defaults"]), markup=False)
    _show_keys(document["config"], "configuration (--set KEY=VALUE)", rich)
    if document["space"]:
        rich.print("design space (--set space.KEY=[LOW,HIGH])", style="italic", markup=False)
        rich.print(_space_table(document["space"]))
    else:
        rich.print("design space: follows from the configuration (--set space.KEY=[LOW,HIGH])", markup=False)
    _show_keys(document["density"], "target density (--set density.KEY=VALUE)", rich)
    _show_keys(document["learning"], "learning, preset standard (--set learning.KEY=VALUE)", rich)


def _shown_defaults(defaults: Mapping[str, Any]) -> str:
    """What `fit` and `evaluate` do where nothing is said; a scan has as many sensors as rays."""
    sensors = "" if defaults["layout"] == "scan" else f"{defaults['sensors']} sensors, "
    rays = ", ".join(map(str, defaults["rays"]))
    return f"defaults: {sensors}layout {defaults['layout']}, level {defaults['level']:g}, evaluated at {rays} rays"


def _space_table(space: Mapping[str, Any]) -> Any:
    """The bounds of every dimension, and whether it is designed, fixed or given."""
    from rich.table import Table

    table = Table("dimension", "from", "to", "")
    for name, bounds in space.items():
        if isinstance(bounds, list) and len(bounds) == 2 and name.endswith(("_m", "_rad")):
            low, high = bounds
            kind = "a condition (--at)" if name in space["condition"] else "fixed" if low == high else "designed"
            table.add_row(name, f"{low:.4g}", f"{high:.4g}", kind)
    return table


def _show_keys(entries: list[dict[str, Any]], title: str, rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("key", "takes", "default", "what it is", title=title, title_justify="left")
    for entry in entries:
        default = "required" if entry["required"] else _shown_default(entry["default"])
        table.add_row(*(escape(text) for text in (entry["key"], entry["type"], default, entry["description"])))
    rich.print(table)


def _shown_default(value: Any) -> str:
    """A default as one would write it in YAML; a dash where it is left empty."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    return "[" + ", ".join(map(str, value)) + "]" if isinstance(value, list | tuple) else str(value)


for subcommand in (check, new):
    tasks_app.command()(subcommand)
