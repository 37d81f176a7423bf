"""`lidardesign formats` and `lidardesign methods`: installed plugins, and checks of their contracts."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.listings import LawChoices
from lidardesign.choices.shared import Brief
from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole, text_table
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from lidardesign.contract.process import CheckRequest
    from lidardesign.plugins import PluginKind

OUTCOMES = {"pass": ("pass", "green"), "fail": ("FAIL", "bold red"), "skip": ("skip", "dim")}


def list_plugins(kind: "PluginKind[Any]", shown: Mapping[str, str], output: Output) -> None:
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


def show_plugin(kind: "PluginKind[Any]", name: str, output: Output) -> None:
    """Print what a plugin's contract says of it."""
    facts = {"name": name, **kind.loaded(name)[1], "distribution": kind.distribution_of(name)}
    rows = [(key, ", ".join(fact) if isinstance(fact, list) else str(fact)) for key, fact in facts.items()]
    output.result(facts, lambda rich: rich.print(text_table(("", ""), rows)), show_costs=False)


def try_laws(request: "CheckRequest", output: Output) -> None:
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


SHOWN_FORMATS = {
    "format": "name", "suffix": "suffix", "what it is": "summary", "for": "reader", "how that is checked": "checked",
}  # fmt: skip
SHOWN_METHODS = {"method": "name", "what it makes": "summary", "from": "distribution"}


def print_formats(output: Output) -> None:
    """Print all formats of exports."""
    list_plugins(_formats(), SHOWN_FORMATS, output)


def _formats() -> "PluginKind[Any]":
    from lidardesign.formats import FORMATS

    return FORMATS


def _methods() -> "PluginKind[Any]":
    from lidardesign.problem.method import METHODS

    return METHODS


def _plugin_app(
    kind: Callable[[], "PluginKind[Any]"],
    shown: Mapping[str, str],
    named: Callable[[], list[str]],
    *,
    noun: str,
    what: str,
    told: str,
) -> typer.Typer:
    """The commands on plugins of a kind.

    Arguments:
        kind: Loads the kind.
        shown: The facts that a table of all has, by their headings.
        named: Completes a name.
        noun: One of them in messages.
        what: All of them in the help.
        told: What is shown of one.
    """
    app = typer.Typer(help=f"List, show or check {what}.", no_args_is_help=True)
    name_argument = typer.Argument(metavar="NAME", help=f"Name of a {noun}.", autocompletion=named)

    @app.command("list", help=f"List the installed {noun}s; a broken one with its reason.")
    @command_line(Brief)
    def list_(output: Output) -> None:
        list_plugins(kind(), shown, output)

    @app.command("show", help=f"Show a {noun}: {told}.")
    @command_line(Brief)
    def show(output: Output, name: Annotated[str, name_argument]) -> None:
        show_plugin(kind(), name, output)

    @app.command(
        "check", help=f"Check that a {noun} keeps the contract. Every law is tried; exit 6 where one does not hold."
    )
    @command_line(LawChoices, Brief)
    def check(output: Output, name: Annotated[str, name_argument], *, seconds: float) -> None:
        from lidardesign.contract.process import CheckRequest

        try_laws(CheckRequest(name, limit_s=seconds, noun=noun), output)

    return app


formats_app = _plugin_app(
    _formats,
    SHOWN_FORMATS,
    options.formats,
    noun="format",
    what="formats of exports",
    told="what it is, who reads it, and what it holds",
)
methods_app = _plugin_app(
    _methods,
    SHOWN_METHODS,
    options.methods,
    noun="method",
    what="methods that make designs",
    told="what it makes, what it needs, and whether it is drawn anew in every scene",
)
