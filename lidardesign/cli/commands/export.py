"""`lidardesign export`: write a design for other programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.dry_run import DryRun, tell_plan
from lidardesign.cli.output import Output, command, keep_times
from lidardesign.cli.streams import claim_stdout, is_output, note_new_folders, written_file
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.run.files import is_input
from lidardesign.workflow.runs import folder_of, parse_at, read_design

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.dry_run import Plan
    from lidardesign.design.mixture.support import Retarget
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.estimates import Estimate
    from lidardesign.export.registry import Exporter
    from lidardesign.geometry.rays import Rays
    from lidardesign.samples import Samples
    from lidardesign.workflow.runs import Run


# Formats that hold sensors only, so that the number of rays may stay open.
WITHOUT_RAYS = ("sensors-csv", "stl")


@dataclass(frozen=True)
class _Asked:
    """What is exported of a design: how many rays, at which condition, at how many frames per second."""

    rays: int | None
    at: Mapping[str, float]
    rate_hz: float | None
    seed: int


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
    dry_run: DryRun = False,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write a design in another program's format."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        if rate_hz is not None and not (math.isfinite(rate_hz) and rate_hz > 0):
            raise ConfigError(f"{rate_hz}", where="--rate-hz", allowed="a finite number above 0")
        if list_formats:
            _list(console)
        else:
            claim_stdout(console, dry_run=dry_run, out=out)
            _export(design, format_, out, _Asked(rays, parse_at(at), rate_hz, seed or 0), console, dry_run=dry_run)


def _list(console: Output) -> None:
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

    console.result({"formats": formats}, show, show_costs=False)


def _export(
    path: Path | None,
    name: str | None,
    out: Path | None,
    asked: _Asked,
    console: Output,
    *,
    dry_run: bool,
) -> None:
    with phase("libraries"):
        from lidardesign.estimates import as_documents

    if path is None:
        raise ConfigError("no design was given", where="DESIGN", hint="lidardesign export --list shows the formats")
    exporter = _exporter(name)
    design = read_design(path, console)
    if asked.rays is not None and exporter.name in WITHOUT_RAYS and design.layout != "scan":
        # of a scan another number of rays is another number of sensors
        raise ConfigError(f"{exporter.name} holds sensors, not rays", where="--rays", hint="leave it out")
    exporter.check_rate(asked.rate_hz)
    target = _target(path, out, exporter)
    folder = folder_of(design, path)
    note_new_folders([target], console)
    if dry_run:
        return tell_plan(_plan(design, path, target, exporter, asked), console)
    design, laid_out = design_and_rays(design, path, exporter.name, asked.rays, asked.at, asked.seed, console)
    with written_file(target, exporter.suffix) as file:
        with phase("writing"):
            notes = list(exporter.write(design, laid_out, file, asked.rate_hz))
        with phase("reading back"):
            rounding = exporter.rounding(design, laid_out, file)
        size = _bytes_of(file)
    for note in notes:
        console.note(f"note: {note}")
    document = {
        "design": str(path), "format": name, "out": str(target), "rays": len(laid_out), "bytes": size, "notes": notes,
        "error_estimates": as_documents(rounding),
    }  # fmt: skip
    content = f"{len(laid_out)} rays" if len(laid_out) else f"{len(design.sensors)} sensors"

    if folder is not None:
        keep_times(folder, "export", console)

    def show(rich: RichConsole) -> None:
        rich.print(f"wrote {target} ({content})", soft_wrap=True, markup=False)
        rich.print(_shown_rounding(rounding), soft_wrap=True, markup=False)

    console.result(document, show)


def _exporter(name: str | None) -> Exporter:
    from lidardesign.export.registry import EXPORTERS

    if name not in EXPORTERS:
        found = "no format was given" if name is None else f"unknown format {name!r}"
        raise ConfigError(found, where="--format", allowed=", ".join(EXPORTERS))
    return EXPORTERS[name]


def _target(path: Path, out: Path | None, exporter: Exporter) -> Path:
    """Where to write.

    Raises:
        ConfigError: Over the design, to standard output a folder, or nowhere that is known.
    """
    if out is None and is_input(path):
        raise ConfigError(
            "a design from standard input stands beside nothing", where="DESIGN -", hint="give --out PATH"
        )
    target = out if out is not None else path.with_suffix(exporter.suffix)
    if is_output(target) and exporter.folder:
        raise ConfigError(f"{exporter.name} is a folder of files", where="--out -", hint="give --out FOLDER")
    if target.exists() and path.exists() and target.samefile(path):
        raise ConfigError("would overwrite the design itself", where=str(target), hint="give another --out")
    return target


def _plan(design: DesignSpec, path: Path, target: Path, exporter: Exporter, asked: _Asked) -> Plan:
    """What this export would do.

    Raises:
        ConfigError: The design is nowhere at such a condition, or leaves its rays open without a run.
    """
    from lidardesign.cli.dry_run import export_plan
    from lidardesign.design.layouts.rays import own_count
    from lidardesign.design.layouts.track import placed

    if asked.at or design.track is not None:
        placed(design, asked.at)
    count = asked.rays
    if exporter.name in WITHOUT_RAYS:
        count = None
    elif count is None:
        count = _largest_budget(design, path) if _is_open(design) else own_count(design)
    return export_plan(
        path,
        target,
        name=exporter.name,
        summary=exporter.summary,
        count=count,
        at=asked.at,
        folder=folder_of(design, path),
        writes_folder=exporter.folder,
    )


def _largest_budget(design: DesignSpec, path: Path) -> int:
    """The rays of a design that leaves them open: the largest number that its task is evaluated at.

    Raises:
        ConfigError: Its run is not there.
    """
    from lidardesign.workflow.runs import run_of

    run = run_of(design, path)
    if run is None:
        raise ConfigError("the design leaves the number of rays open", where=str(path), hint="give --rays N")
    return max(run.task.defaults.rays)


def _bytes_of(target: Path) -> int | None:
    """What was written [bytes], of a folder all files; None for what is no file, as a pipe."""
    if target.is_dir():
        return sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    return target.stat().st_size if target.is_file() else None


def _shown_rounding(rounding: Mapping[str, Estimate]) -> str:
    """What reading the file back showed, in one line."""
    lost = [
        f"{name.removesuffix(f'_{estimate.unit}')} {estimate.error:.2g} {estimate.unit}".rstrip()
        for name, estimate in rounding.items()
        if estimate.error
    ]
    return f"read back: off by at most {', '.join(lost)}" if lost else "read back: exact"


@phase("rays")
def design_and_rays(
    design: DesignSpec, path: Path, name: str, count: int | None, at: Mapping[str, float], seed: int, console: Output
) -> tuple[DesignSpec, Rays]:
    """A design and its explicit rays at a condition; another number of rays may need the samples of its run.

    A scan of another number of rays has other sensors, so the design that is exported is that one. A design that
    leaves its number of rays open takes the largest budget of its task.
    """
    from lidardesign.design.layouts.rays import gates_of, lay_out, own_count, refitted
    from lidardesign.design.layouts.track import placed
    from lidardesign.workflow.layouts import may_need_samples
    from lidardesign.workflow.runs import run_of

    if at or design.track is not None:
        # refuses a wrong place before anything is fitted
        placed(design, at)
    if count is None and _is_open(design) and name not in WITHOUT_RAYS:
        count = _largest_budget(design, path)
        console.note(f"note: the design leaves the number of rays open; {count} is the task's largest budget")
    samples, retarget = None, None
    if count is not None and may_need_samples(design) and (_is_open(design) or count != own_count(design)):
        run = run_of(design, path)
        if run is not None:
            samples, retarget = _samples(run, design, at)
        if design.layout == "scan":
            design = refitted(design, count, samples, seed)
    count = 0 if name in WITHOUT_RAYS else count
    gates = gates_of(design, samples)
    laid_out = lay_out(design, count, samples, gates=gates, seed=seed, at=at, retarget=retarget)
    return placed(design, at) if at or design.track is not None else design, laid_out


def _samples(run: Run, design: DesignSpec, at: Mapping[str, float]) -> tuple[Samples, Retarget]:
    """The samples that a design follows from: of all conditions for a track, else of the design's own."""
    from lidardesign.design.mixture.conditions import conditioned
    from lidardesign.workflow.layouts import RunTarget
    from lidardesign.workflow.weighting import Weighting, weighted_samples

    weighting = Weighting.of(design)
    retarget = RunTarget(run, weighting=weighting)
    samples = weighted_samples(run, weighting, retarget)
    if design.track is None and samples.space.conditioned:
        samples = conditioned(samples, {**at, **design.at}, retarget)
    return samples, retarget


def _is_open(design: DesignSpec) -> bool:
    """Whether nothing in a design says how many rays it fires."""
    counted = all(sensor.rays is not None for sensor in design.sensors)
    return design.rays is None and design.ray_table is None and not counted and design.layout != "scan"
