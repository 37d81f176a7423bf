"""`--dry-run`: what a command would do, read and write, and how long it took before; nothing is done."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.run.files import STDIO

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.output import Output
    from lidardesign.workflow.plans import RequestPlan

DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Check everything that can be checked at once, say what would be done, read and written, and do nothing.",
    ),
]
BYTES_PER_MEGABYTE = 1e6


def show_plan(plan: RequestPlan, output: Output) -> None:
    """Give a plan as the result of its command.

    Raises:
        DataError: What would be written could not be.
    """
    plan.check_writable()
    document = plan.as_dict()
    output.result(document, lambda rich: _show(document, rich), show_costs=False)


def _show(document: Mapping[str, Any], rich: RichConsole) -> None:
    lines = [f"{document['command']} would", *(f"  {step}" for step in document["steps"])]
    for entry in document["reads"]:
        size = "" if entry["bytes"] is None else f" ({_size(entry['bytes'])})"
        lines.append(f"read   {'standard input' if entry['path'] == STDIO else entry['path']}{size}")
    for entry in document["writes"]:
        replaces = " (replaced)" if entry["replaces"] else ""
        lines.append(f"write  {'standard output' if entry['path'] == STDIO else entry['path']}{replaces}")
    if not document["writes"]:
        lines.append("write  nothing")
    if document["before"]:
        lines.append(f"time   {document['before']['of']} took {document['before']['seconds']:.1f} s")
    lines.append("nothing was done: leave out --dry-run to do it")
    for line in lines:
        rich.print(line, soft_wrap=True, markup=False)


def _size(size: int) -> str:
    return f"{size / BYTES_PER_MEGABYTE:.1f} MB" if size >= BYTES_PER_MEGABYTE else f"{size:,} bytes"
