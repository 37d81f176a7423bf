"""`lidardesign tasks`: installed tasks, their keys, checks of the contract, and packages of new ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.flag import complete
from lidardesign.choices.listings import CheckCommand, NewCommand
from lidardesign.choices.shared import Brief
from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole, text_table
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output
from lidardesign.errors import pasted
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from lidardesign.contract.process import CheckRequest
    from lidardesign.plugins import PluginKind

OUTCOMES = {"pass": ("pass", "green"), "fail": ("FAIL", "bold red"), "skip": ("skip", "dim")}

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


def list_plugins(kind: PluginKind[Any], shown: Mapping[str, str], output: Output) -> None:
    """Print all plugins of a kind; of a broken one its reason. A table shows some facts below headings."""
    from rich.text import Text

    entries: list[dict[str, Any]] = [
        {"name": one.name, "summary": "", **one.facts, "distribution": one.distribution, "error": one.error}
        for one in kind.listings()
    ]
    rows = []
    for one in entries:
        summary = Text.assemble(("broken:", "red"), f" {one['error']}") if one["error"] else one["summary"]
        rows.append([{**one, "summary": summary}.get(key, "") for key in shown.values()])
    output.result({f"{kind.noun}s": entries}, lambda rich: rich.print(text_table([*shown], rows)), show_costs=False)


def show_plugin(kind: PluginKind[Any], name: str, output: Output) -> None:
    """Print what a plugin's contract says of it."""
    facts = {"name": name, **kind.loaded(name)[1], "distribution": kind.distribution_of(name)}
    rows = [(key, ", ".join(fact) if isinstance(fact, list) else str(fact)) for key, fact in facts.items()]
    output.result(facts, lambda rich: rich.print(text_table(("", ""), rows)), show_costs=False)


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


def try_laws(request: CheckRequest, output: Output) -> None:
    """Try a plugin's contract and print the findings; raises BrokenLawError where a law does not hold."""
    with phase("libraries"):
        from lidardesign.contract.contract import refuse_broken
        from lidardesign.contract.process import check_in_process, statements_of

    findings, where = [], f"{request.noun} {request.name}"
    with output.progress("contract") as progress, phase("contract"):
        for finding in check_in_process(request):
            findings.append(finding)
            progress.show(len(findings), len(statements_of(request.noun)), detail=finding.law)
    counts = {outcome: sum(finding.outcome == outcome for finding in findings) for outcome in OUTCOMES}
    laws = [finding.as_dict() for finding in findings]
    document = {request.noun: request.name, "keeps": not counts["fail"], **counts, "laws": laws}
    output.result(document, lambda rich: _show_laws(where, document, rich))
    refuse_broken(where, findings)


def _show_laws(title: str, document: Mapping[str, Any], rich: RichConsole) -> None:
    from rich.text import Text

    table = text_table(("law", "", "what was found"), title=title)
    group = ""
    for law in document["laws"]:
        if group and law["group"] != group:
            table.add_section()
        group = law["group"]
        table.add_row(law["law"], Text(*OUTCOMES[law["outcome"]]), law["detail"])
    rich.print(table)
    rich.print(
        f"laws that hold: {document['pass']}, broken: {document['fail']}, "
        f"not applicable or not reached: {document['skip']}"
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
