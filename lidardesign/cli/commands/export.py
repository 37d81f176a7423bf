"""`lidardesign export`: write a design for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.output import Output, claim_stdout, command, keep_times, note_new_folders, show_plan, written_file
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.estimates import Estimate


def export(
    design: Annotated[
        Path | None,
        typer.Argument(
            metavar="DESIGN", readable=False, help="A design file, or the file of a rig.", show_default=False
        ),
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option("--format", metavar="NAME", help="Format; --list shows them.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="PATH", help="File to write.", show_default="beside the design"),
    ] = None,
    rays: options.RayCount = None,
    at: options.At = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            "--rate-hz",
            metavar="HZ",
            help="Frames per second, in formats that hold it.",
            show_default="10, as in the read-out model",
        ),
    ] = None,
    list_formats: Annotated[bool, typer.Option("--list", help="List the formats.")] = False,
    dry_run: options.DryRun = False,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write a design in another program's format."""
    with command(json=json, quiet=quiet, debug=debug) as output:
        with phase("libraries"):
            from lidardesign.workflow.export import (
                DesignSource,
                ExportRequest,
                check_frame_rate,
                export_target,
                exporter_of,
            )
            from lidardesign.workflow.run_folder import read_design

        check_frame_rate(rate_hz)
        if list_formats:
            return _list(output)
        claim_stdout(output, dry_run=dry_run, out=out)
        place = options.parse_at(at)
        if design is None:
            raise ConfigError("no design was given", where="DESIGN", hint="lidardesign export --list shows the formats")
        exporter = exporter_of(format_)
        source = DesignSource(read_design(design, output.remark), path=design)
        target = export_target(design, out, exporter)
        request = ExportRequest(source, exporter, target, rays, place, rate_hz, seed or 0)
        note_new_folders([target], output)
        if dry_run:
            return show_plan(request.plan(), output)
        with written_file(target, exporter.suffix) as file:
            exported = request.write(file, output.remark)
        if source.folder is not None:
            keep_times(source.folder, "export", output)
        content = f"{exported.rays} rays" if exported.rays else f"{exported.sensors} sensors"

        def show(rich: RichConsole) -> None:
            rich.print(f"wrote {target} ({content})", soft_wrap=True, markup=False)
            rich.print(_rounding_line(exported.rounding), soft_wrap=True, markup=False)

        output.result({"design": str(design), **exported.as_dict()}, show)


def _list(output: Output) -> None:
    from lidardesign.export.registry import EXPORTERS

    formats = [
        {
            "name": name,
            "suffix": exporter.suffix,
            "summary": exporter.summary,
            "reader": exporter.reader,
            "checked": exporter.checked,
            "folder": exporter.folder,
        }
        for name, exporter in EXPORTERS.items()
    ]

    def show(rich: RichConsole) -> None:
        from rich.markup import escape
        from rich.table import Table

        table = Table("format", "suffix", "what it is", "for", "how that is checked")
        for entry in formats:
            table.add_row(*(escape(str(entry[key])) for key in ("name", "suffix", "summary", "reader", "checked")))
        rich.print(table)

    output.result({"formats": formats}, show, show_costs=False)


def _rounding_line(rounding: Mapping[str, Estimate]) -> str:
    """What reading the file back showed, in one line."""
    lost = [
        f"{name.removesuffix(f'_{estimate.unit}')} {estimate.error:.2g} {estimate.unit}".rstrip()
        for name, estimate in rounding.items()
        if estimate.error
    ]
    return f"read back: off by at most {', '.join(lost)}" if lost else "read back: exact"
