"""`lidardesign tasks`: which tasks are installed and what they take.

`lidardesign tasks check`: whether a task keeps the contract, law by law, in a process of its own.

`lidardesign tasks new`: the package of a new task, ready to be installed, tested and changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import typer

from lidardesign.cli import options
from lidardesign.cli.output import Output, command
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo
    from rich.console import Console as RichConsole

    from lidardesign.registry import TaskListing
    from lidardesign.task import Task
    from lidardesign.testing.law import Finding


MEBIBYTE = 2**20
SHOWN = {"pass": "[green]pass[/green]", "fail": "[bold red]FAIL[/bold red]", "skip": "[dim]skip[/dim]"}

Seconds = Annotated[
    float, typer.Option("--seconds", metavar="S", min=0.1, max=86_400, help="Longest time of one call of the task.")
]
Memory = Annotated[
    int, typer.Option("--memory-mb", metavar="MB", min=256, max=1_000_000, help="Most memory that it may hold.")
]


def check(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of an installed task.")],
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    seconds: Seconds = 60.0,
    memory_mb: Memory = 4096,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Check that a task keeps the contract: every law, with figures; exit 6 where one does not hold."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        with phase("libraries"):
            from lidardesign.testing.contract import refuse_broken
            from lidardesign.testing.law import Limits
            from lidardesign.testing.process import CheckRequest, check_apart

        limits = Limits(seconds, memory_mb * MEBIBYTE)
        request = CheckRequest(name, config, tuple(overrides or ()), seed, limits)
        findings = _followed(check_apart(request), console)
        document = _as_document(name, findings)
        console.result(document, lambda rich: _show(document, rich))
        refuse_broken(name, findings)


def _followed(findings: Iterable[Finding], console: Output) -> list[Finding]:
    """All findings, with the name of the last one shown as it comes."""
    from lidardesign.testing.contract import LAWS

    found: list[Finding] = []
    with console.progress("law") as bar, phase("contract"):
        shown = bar.add_task("contract", total=len(LAWS) + 1, law="") if bar else None
        for finding in findings:
            found.append(finding)
            if bar is not None and shown is not None:
                bar.update(shown, completed=len(found), law=finding.law)
    return found


def _as_document(name: str, findings: Sequence[Finding]) -> dict[str, Any]:
    counts = {outcome: sum(finding.outcome == outcome for finding in findings) for outcome in SHOWN}
    return {"task": name, "keeps": not counts["fail"], **counts, "laws": [finding.as_dict() for finding in findings]}


def _show(document: dict[str, Any], rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("law", "", "what was found", title=escape(f"task {document['task']}"), title_justify="left")
    group = ""
    for law in document["laws"]:
        if group and law["group"] != group:
            table.add_section()
        group = law["group"]
        table.add_row(escape(law["law"]), SHOWN[law["outcome"]], escape(law["detail"]))
    rich.print(table)
    rich.print(
        f"{document['pass']} laws hold, {document['fail']} do not, {document['skip']} do not apply or were not reached",
        markup=False,
    )


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the task, as `learn` will take it.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where to, a new folder.", show_default="lidardesign-NAME"),
    ] = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write an installable package of a new task, which keeps the contract and passes its own tests as it is."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        with phase("libraries"):
            from lidardesign.testing.scaffold import new_task

        written = new_task(name, out)
        folder = written[0].parent
        document = {"task": name, "folder": folder, "files": written}
        console.result(document, lambda rich: _show_scaffold(name, folder, written, rich), show_costs=False)


def _show_scaffold(name: str, folder: Path, written: list[Path], rich: RichConsole) -> None:
    for path in written:
        rich.print(f"  {path}", markup=False)
    rich.print(
        f"next: pip install --editable '{folder}[test]', then lidardesign tasks check {name}",
        markup=False,
        soft_wrap=True,
    )


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
    from lidardesign.config import DensitySettings, LearningSettings

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
