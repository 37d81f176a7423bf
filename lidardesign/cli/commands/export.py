"""`lidardesign export`: write a design for other programs; `lidardesign formats`: the formats that it can take."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.choices.files import ExportChoices, ExportCommand
from lidardesign.choices.flag import complete
from lidardesign.choices.listings import LawChoices
from lidardesign.choices.shared import Brief, Printed
from lidardesign.cli.commands.tasks import list_plugins, show_plugin, try_laws
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import command_line, formats
from lidardesign.cli.terminal.output import Output, announce, keep_times, written_file
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_outputs

# Where a note begins to explain itself.
EXPLANATION = re.compile(r"[:;] .*", re.DOTALL)


@command_line(ExportCommand, ExportChoices, Printed)
def export(
    output: Output,
    design: Annotated[
        Path | None,
        typer.Argument(
            metavar="DESIGN", readable=False, help="A design file, or the file of a rig.", show_default=False
        ),
    ] = None,
    *,
    format: str | None = None,
    out: Path | None = None,
    list_formats: bool = False,
    **given: Any,
) -> None:
    """Write a design in another program's format."""
    if list_formats:
        return _list(output)
    with phase("libraries"):
        from lidardesign.api.export import DesignSource, ExportRequest, export_target, format_of
        from lidardesign.formats.designs import read_design

    if design is None:
        raise ConfigError("no design was given", where="DESIGN", hint="lidardesign export --list shows the formats")
    choices, chosen = complete(ExportChoices, given), format_of(format)
    source = DesignSource(read_design(design, output.remark), path=design)
    target, robot = export_target(design, out, chosen.suffix), choices["robot"]
    request = ExportRequest(source, chosen, target, choices["rays"], choices["at"], choices["rate_hz"], robot)
    announce([target], output)
    check_outputs({"--out": target}, [robot] if robot else [], ("--out",) if chosen.is_folder else ())
    notes: list[str] = []
    with written_file(target, chosen.suffix) as file:
        exported = request.write(file, notes.append)
    for note in notes:
        if output.verbose or note not in exported.notes:
            output.remark(note)
    if exported.notes and not output.verbose:
        heads = [EXPLANATION.sub("", note) for note in exported.notes]
        output.remark("; ".join(heads) + (" (-v says more)" if heads != list(exported.notes) else ""))
    if source.folder is not None:
        keep_times(source.folder, "export", output)

    def show(rich: RichConsole) -> None:
        count, noun = (exported.rays, "ray") if exported.rays else (exported.sensors, "sensor")
        content = f"{count} {noun}{'s' * (count != 1)}"
        rich.print(f"wrote {target} ({content})", soft_wrap=True)

    document = {"design": str(design), **exported.as_dict()}
    output.result(document, show, files={"wrote": target} if output.quiet else None, says_time=True)


formats_app = typer.Typer(help="List, show or check formats of exports.", no_args_is_help=True)
FormatName = Annotated[str, typer.Argument(metavar="NAME", help="Name of a format.", autocompletion=formats)]


@formats_app.command("list")
@command_line(Brief)
def list_(output: Output) -> None:
    """List the installed formats; a broken one with its reason."""
    _list(output)


def _list(output: Output) -> None:
    from lidardesign.formats import FORMATS

    shown = {"format": "name", "suffix": "suffix", "what it is": "summary", "for": "reader"}
    list_plugins(FORMATS, {**shown, "how that is checked": "checked"}, output)


@formats_app.command("show")
@command_line(Brief)
def show(output: Output, name: FormatName) -> None:
    """Show a format: what it is, who reads it, and what it holds."""
    from lidardesign.formats import FORMATS

    show_plugin(FORMATS, name, output)


@formats_app.command("check")
@command_line(LawChoices, Brief)
def check(output: Output, name: FormatName, *, seconds: float) -> None:
    """Check that a format keeps the contract. Every law is tried; exit 6 where one does not hold."""
    from lidardesign.contract.process import CheckRequest

    try_laws(CheckRequest(name, limit_s=seconds, noun="format"), output)
