"""`lidardesign tasks check`: whether a task keeps the contract, law by law, in a process of its own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.console import Console, command
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

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
            from lidardesign.testing.limits import Limits
            from lidardesign.testing.process import CheckRequest, check_apart

        limits = Limits(seconds, memory_mb * MEBIBYTE)
        request = CheckRequest(name, config, tuple(overrides or ()), seed, limits)
        findings = _followed(check_apart(request), console)
        document = _as_document(name, findings)
        console.result(document, lambda rich: _show(document, rich))
        refuse_broken(name, findings)


def _followed(findings: Iterable[Finding], console: Console) -> list[Finding]:
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
