"""`lidardesign tasks new`: the package of a new task, ready to be installed, tested and changed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.console import command
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole


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
        console.result(document, lambda rich: _show(name, folder, written, rich), show_costs=False)


def _show(name: str, folder: Path, written: list[Path], rich: RichConsole) -> None:
    for path in written:
        rich.print(f"  {path}", markup=False)
    rich.print(
        f"next: pip install --editable '{folder}[test]', then lidardesign tasks check {name}",
        markup=False,
        soft_wrap=True,
    )
