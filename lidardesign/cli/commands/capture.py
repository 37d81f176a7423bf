"""`lidardesign capture`: score designs by what a lab captured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.output import Output, command, keep_times
from lidardesign.cli.streams import claim_outputs, written_file
from lidardesign.cli.tables.designs import number
from lidardesign.cli.tables.grids import print_table
from lidardesign.errors import ConfigError, DataError, check_choice
from lidardesign.run.clock import phase
from lidardesign.run.files import is_input, is_there
from lidardesign.workflow.run_folder import folder_of, read_design

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.evaluate.captures.capture import Capture
    from lidardesign.evaluate.captures.score import CaptureEvaluation, CaptureSettings
    from lidardesign.geometry.rays import Rays

ESTIMATORS = ("peak", "matched")
COLUMNS = {
    "rays": "rays",
    "captured": "captured",
    "returns": "returns",
    "outliers": "outliers",
    "outliers_percent": "outliers\n[%]",
    "range_error_mm": "range\nerror [mm]",
    "chamfer_mm": "Chamfer\n[mm]",
    "bins_per_ray": "bins\nper ray",
    "photons_per_ray": "photons\nper ray",
}


EstimatorOption = Annotated[
    str,
    typer.Option(
        "--estimator", metavar="peak|matched", help="Range from the highest bin, or from the log-matched filter."
    ),
]
FalseAlarm = Annotated[
    float, typer.Option("--false-alarm", metavar="P", help="Probability that background alone is taken for a return.")
]
Within = Annotated[
    float | None,
    typer.Option(
        "--within-deg",
        metavar="DEG",
        help="Largest angle between a ray and the pixel that stands for it.",
        show_default="the spacing of the pixels",
    ),
]
Outlier = Annotated[
    float, typer.Option("--outlier-mm", metavar="MM", help="Returns that are off by more are outliers.")
]
Reference = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        metavar="MESH",
        help="The true surface, in metres in the design's frame.",
        show_default="through the capture's true ranges",
    ),
]
CsvFile = Annotated[
    Path | None,
    typer.Option("--csv", metavar="FILE", help="Write every ray's range and point as CSV.", show_default=False),
]


def capture(
    file: Annotated[Path, typer.Argument(metavar="CAPTURE", readable=False, help="Captured histograms, .npz or .mat.")],
    designs: Annotated[
        list[Path],
        typer.Argument(metavar="DESIGN", readable=False, help="Design files, or what `export --format galvo` wrote."),
    ],
    rays: options.RayCount = None,
    at: options.At = None,
    estimator: EstimatorOption = "peak",
    false_alarm: FalseAlarm = 0.01,
    within_deg: Within = None,
    outlier_mm: Outlier = 10.0,
    reference: Reference = None,
    csv: CsvFile = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Score designs by a captured scan: with their gates, without, and beside even rays."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        claim_outputs(console, csv=csv)
        _check_numbers(false_alarm, within_deg, outlier_mm)
        check_choice(estimator, "--estimator", ESTIMATORS)
        with phase("libraries"):
            from lidardesign.evaluate.captures.capture import load_capture
            from lidardesign.evaluate.captures.score import evaluate_capture

        place = options.parse_at(at)
        named = _named_apart([(path, _rays(path, rays, place, seed or 0, console)) for path in designs])
        with phase("capture"):
            captured = load_capture(file)
        settings = _settings(captured, estimator, false_alarm, within_deg, outlier_mm, reference)
        with phase("scoring"):
            found = evaluate_capture(captured, named, settings)
        for note in found.notes:
            console.note(f"note: {note}")
        if csv is not None:
            from lidardesign.evaluate.captures.score import write_csv

            with phase("writing"), written_file(csv) as table:
                write_csv(found, table)
        for folder in _folders(designs):
            keep_times(folder, "capture", console)
        document = {"capture": str(file), **found.as_dict(), "files": [] if csv is None else [str(csv)]}
        console.result(document, lambda rich: _show(document, found, rich))


def _check_numbers(false_alarm: float, within_deg: float | None, outlier_mm: float) -> None:
    if not 0 < false_alarm < 1:
        raise ConfigError(f"{false_alarm}", where="--false-alarm", allowed="above 0 and below 1")
    if within_deg is not None and not (0 < within_deg <= 180):
        raise ConfigError(f"{within_deg}", where="--within-deg", allowed="above 0, at most 180 degrees")
    if not (math.isfinite(outlier_mm) and outlier_mm > 0):
        raise ConfigError(f"{outlier_mm}", where="--outlier-mm", allowed="a finite number above 0")


def _settings(
    captured: Capture,
    estimator: str,
    false_alarm: float,
    within_deg: float | None,
    outlier_mm: float,
    reference: Path | None,
) -> CaptureSettings:
    from lidardesign.evaluate.captures.scan import Estimation, default_within_rad
    from lidardesign.evaluate.captures.score import CaptureSettings

    within = default_within_rad(captured) if within_deg is None else math.radians(within_deg)
    return CaptureSettings(Estimation(estimator, false_alarm), within, outlier_mm / 1000.0, reference)  # type: ignore[arg-type]


def _rays(path: Path, count: int | None, at: dict[str, float], seed: int, console: Output) -> Rays:
    """The rays of a design file, or of what was exported of it for a scanner, at least one."""
    rays = _listed_rays(path, count, at, seed, console)
    if not len(rays):
        raise DataError("fires no ray", where=str(path), hint="give --rays N" if not count else None)
    return rays


def _listed_rays(path: Path, count: int | None, at: dict[str, float], seed: int, console: Output) -> Rays:
    from lidardesign.export.galvo import is_galvo_file, read_galvo
    from lidardesign.workflow.export import DesignSource

    if not is_there(path):
        raise DataError("no such design", where=str(path), hint="give design files or files of export --format galvo")
    if not is_input(path) and is_galvo_file(path):
        if count is not None or at:
            raise ConfigError(
                "holds its rays already",
                where=str(path),
                allowed="a design file with --rays and --at",
                hint="leave them out",
            )
        return read_galvo(path)
    source = DesignSource(read_design(path, console.remark), path=path)
    return source.lay_out(count, at, seed, notes=console.remark)[1]


def _folders(designs: list[Path]) -> list[Path]:
    """The folders of the runs that design files came from; an exported file names none."""
    from lidardesign.design.files import load_design
    from lidardesign.export.galvo import is_galvo_file

    files = [path for path in designs if not (is_input(path) or is_galvo_file(path))]
    found = [folder_of(load_design(path), path) for path in files]
    return list(dict.fromkeys(folder for folder in found if folder is not None))


def _named_apart(found: list[tuple[Path, Rays]]) -> list[tuple[str, Rays]]:
    """Designs by their files' names; files that share one keep their folders."""
    names = [path.name.removesuffix(".yaml").removesuffix(".csv").removesuffix(".galvo") for path, _ in found]
    paths = [path.resolve() for path, _ in found]
    twice = next((path for path in paths if paths.count(path) > 1), None)
    if twice is not None:
        raise ConfigError("is given twice", where=str(twice))
    return [
        (str(path) if names.count(name) > 1 else name, rays) for name, (path, rays) in zip(names, found, strict=True)
    ]


def _show(document: dict[str, Any], found: CaptureEvaluation, rich: RichConsole) -> None:
    from rich.markup import escape

    start, end = document["window_m"]
    rich.print(
        f"{document['pixels']} pixels, {document['bins']} bins of {number(document['bin_ps'])} ps from {start:.4g} to "
        f"{end:.4g} m; estimator {document['estimator']}; pixels within {number(document['within_deg'], 3)} degrees",
        soft_wrap=True,
    )
    rich.print(f"outliers: more than {number(document['outlier_mm'])} mm from {found.ranges_from}", soft_wrap=True)
    if found.surface_from is not None:
        rich.print(escape(f"Chamfer distance: to {found.surface_from}"), soft_wrap=True)
    text = ("design", "gate")
    lines = [[row["design"], row["gate"], *(number(row[name]) for name in COLUMNS)] for row in document["rows"]]
    print_table(None, (*text, *COLUMNS.values()), lines, rich, text=text)
    rich.print(_shown_errors(found), soft_wrap=True)
    for path in document["files"]:
        rich.print(f"wrote {escape(path)}", soft_wrap=True)


def _shown_errors(found: CaptureEvaluation) -> str:
    """The largest standard errors of the designs' figures, in one line."""
    designs = [row.estimates() for row in found.rows if not row.baseline]
    parts = []
    for name, words in (("outliers_percent", "outliers"), ("range_error_mm", "range errors")):
        known = [row[name] for row in designs if name in row]
        if known:
            worst = max(estimate.error or 0.0 for estimate in known)
            parts.append(f"{words} up to {number(worst, 2)} {known[0].unit}")
    return f"standard errors over other rays: {', '.join(parts) or 'none, as no return can be judged'}"
