"""`lidardesign export`: write a design for other programs; `lidardesign formats`: the formats that it can take."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from lidardesign.cli.commands.tasks import Seconds, list_plugins, try_laws
from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole, text_table
from lidardesign.cli.terminal.options import formats
from lidardesign.cli.terminal.output import Output, announce, command, keep_times, written_file
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_outputs

# Where a note begins to explain itself.
EXPLANATION = re.compile(r"[:;] .*", re.DOTALL)


def export(
    design: Annotated[
        Path | None,
        typer.Argument(
            metavar="DESIGN", readable=False, help="A design file, or the file of a rig.", show_default=False
        ),
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="Format; --list shows them.",
            show_default=False,
            autocompletion=formats,
        ),
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
    robot: Annotated[
        Path | None,
        typer.Option(
            "--robot",
            metavar="MODEL",
            help="MuJoCo model to put the sensors on (mjcf).",
            show_default="that of the run of a mounted design",
        ),
    ] = None,
    list_formats: Annotated[bool, typer.Option("--list", help="List the formats.")] = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Write a design in another program's format."""
    with command(json=json, quiet=quiet, verbose=verbose) as output:
        if list_formats:
            return _list(output)
        with phase("libraries"):
            from lidardesign.api.export import DesignSource, ExportRequest, export_target, format_of
            from lidardesign.formats.designs import read_design

        place = options.parse_at(at)
        if design is None:
            raise ConfigError("no design was given", where="DESIGN", hint="lidardesign export --list shows the formats")
        chosen = format_of(format_)
        source = DesignSource(read_design(design, output.remark), path=design)
        target = export_target(design, out, chosen.suffix)
        request = ExportRequest(source, chosen, target, rays, place, rate_hz, robot=robot)
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
def list_(json: options.Json = False, quiet: options.Quiet = False) -> None:
    """List the installed formats; a broken one with its reason."""
    with command(json=json, quiet=quiet) as output:
        _list(output)


def _list(output: Output) -> None:
    from lidardesign.formats import FORMATS

    shown = {"format": "name", "suffix": "suffix", "what it is": "summary", "for": "reader"}
    list_plugins(FORMATS, {**shown, "how that is checked": "checked"}, output)


@formats_app.command("show")
def show(name: FormatName, json: options.Json = False, quiet: options.Quiet = False) -> None:
    """Show a format: what it is, who reads it, and what it holds."""
    with command(json=json, quiet=quiet) as output:
        from lidardesign.formats import FORMATS

        facts = {"name": name, **FORMATS.loaded(name)[1], "distribution": FORMATS.distribution_of(name)}
        rows = [(key, ", ".join(fact) if isinstance(fact, list) else str(fact)) for key, fact in facts.items()]
        output.result(facts, lambda rich: rich.print(text_table(("", ""), rows)), show_costs=False)


@formats_app.command("check")
def check(name: FormatName, seconds: Seconds = 60.0, json: options.Json = False, quiet: options.Quiet = False) -> None:
    """Check that a format keeps the contract. Every law is tried; exit 6 where one does not hold."""
    with command(json=json, quiet=quiet) as output:
        from lidardesign.contract.process import CheckRequest

        try_laws(CheckRequest(name, limit_s=seconds, noun="format"), output)
