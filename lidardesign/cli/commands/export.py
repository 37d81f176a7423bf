"""`lidardesign export`: write a design for other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.choices.files import ExportChoices, ExportCommand
from lidardesign.choices.flag import complete
from lidardesign.choices.shared import Printed
from lidardesign.cli.commands.plugins import print_formats
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output, announce, keep_times, written_file
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.run.markup import counted
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
        return print_formats(output)
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
        content = (exported.rays, "ray") if exported.rays else (exported.sensors, "sensor")
        rich.print(f"wrote {target} ({counted(*content)})", soft_wrap=True)

    document = {"design": str(design), **exported.as_dict()}
    output.result(document, show, files={"wrote": target} if output.quiet else None, says_time=True)
