"""`lidardesign capture`: score designs by what a lab captured."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.files import CaptureCommand
from lidardesign.choices.flag import complete
from lidardesign.choices.shared import Printed
from lidardesign.cli.terminal.grids import RichConsole, number, print_table
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output, claim_outputs, keep_times
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_outputs

if TYPE_CHECKING:
    from lidardesign.evaluation.captures.score import CaptureEvaluation
    from lidardesign.scenes.rays import Rays

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


@command_line(CaptureCommand, Printed)
def capture(
    output: Output,
    file: Annotated[Path, typer.Argument(metavar="CAPTURE", readable=False, help="Captured histograms, .npz or .mat.")],
    designs: Annotated[
        list[Path],
        typer.Argument(metavar="DESIGN", readable=False, help="Design files, or what `export --format galvo` wrote."),
    ],
    **given: Any,
) -> None:
    """Score designs by a captured scan."""
    choices = complete(CaptureCommand, given)
    csv, reference, within_deg = choices["csv"], choices["reference"], choices["within_deg"]
    false_alarm, outlier_mm = choices["false_alarm"], choices["outlier_mm"]
    claim_outputs(output, csv=csv)
    check_outputs({"--csv": csv}, [file, *designs, *([] if reference is None else [reference])])
    if not 0 < false_alarm < 1:
        raise ConfigError(f"{false_alarm}", where="--false-alarm", allowed="above 0 and below 1")
    if within_deg is not None and not (0 < within_deg <= 180):
        raise ConfigError(f"{within_deg}", where="--within-deg", allowed="above 0, at most 180 degrees")
    if not (math.isfinite(outlier_mm) and outlier_mm > 0):
        raise ConfigError(f"{outlier_mm}", where="--outlier-mm", allowed="a finite number above 0")
    with phase("libraries"):
        from lidardesign.evaluation.captures.capture import load_capture
        from lidardesign.evaluation.captures.scan import Estimation, default_within_rad
        from lidardesign.evaluation.captures.score import CaptureSettings, evaluate_capture, write_csv
        from lidardesign.space import condition_values

    place = condition_values(choices["at"])
    scanned = [_rays_and_run(path, choices["rays"], place, output) for path in designs]
    named = list(zip(_distinct_names(designs), (fired for fired, _ in scanned), strict=True))
    with phase("capture"):
        captured = load_capture(file)
    within_rad = default_within_rad(captured) if within_deg is None else math.radians(within_deg)
    settings = CaptureSettings(
        Estimation(choices["estimator"], false_alarm),  # type: ignore[arg-type]
        within_rad,
        outlier_mm / 1000.0,
        reference,
    )
    with phase("scoring"):
        evaluation = evaluate_capture(captured, named, settings)
    for note in evaluation.notes:
        output.remark(note)
    written: dict[str, Path] = {}

    def show_result() -> None:
        document = {"capture": str(file), **evaluation.as_dict(), "files": [str(path) for path in written.values()]}
        output.result(document, lambda rich: _show(document, evaluation, rich, verbose=output.verbose), files=written)

    with ExitStack() as rest:  # the scores are shown whatever becomes of the file
        rest.callback(show_result)
        for folder in dict.fromkeys(folder for _, folder in scanned if folder is not None):
            rest.callback(keep_times, folder, "capture", output)
        if csv is not None:
            with phase("writing"):
                write_csv(evaluation, csv)
            written["csv"] = csv


def _rays_and_run(path: Path, count: int | None, at: dict[str, float], output: Output) -> tuple[Rays, Path | None]:
    """The rays of a design file, or of what was exported of it for a scanner, at least one; and its run's folder."""
    from lidardesign.api.export import DesignSource
    from lidardesign.formats.designs import folder_of, read_design
    from lidardesign.formats.galvo import is_galvo_file, read_galvo

    folder = None
    if not path.exists():
        raise DataError("no such design", where=str(path), hint="give design files or files of export --format galvo")
    if is_galvo_file(path):
        if count is not None or at:
            raise ConfigError(
                "holds its rays already",
                where=str(path),
                allowed="a design file with --rays and --at",
                hint="leave them out",
            )
        rays = read_galvo(path)
    else:
        specification = read_design(path, output.remark)
        rays = DesignSource(specification, path=path).at(count, at, output.remark)[1]
        folder = folder_of(specification, path)
    if not len(rays):
        raise DataError("fires no ray", where=str(path), hint="give --rays N" if not count else None)
    return rays, folder


def _distinct_names(files: list[Path]) -> list[str]:
    """The names of designs by their files; files that share one keep their folders."""
    paths = [path.resolve() for path in files]
    twice = next((path for path in paths if paths.count(path) > 1), None)
    if twice is not None:
        raise ConfigError("is given twice", where=str(twice))
    names = [path.name.removesuffix(".yaml").removesuffix(".csv").removesuffix(".galvo") for path in files]
    return [str(path) if names.count(name) > 1 else name for name, path in zip(names, files, strict=True)]


def _show(document: dict[str, Any], evaluation: CaptureEvaluation, rich: RichConsole, *, verbose: bool) -> None:
    start, end = document["window_m"]
    if verbose:
        rich.print(
            f"{document['pixels']} pixels, {document['bins']} bins of {number(document['bin_ps'])} ps from {start:.4g} "
            f"to {end:.4g} m; estimator {document['estimator']}; pixels within "
            f"{number(document['within_deg'], 3)} degrees",
            soft_wrap=True,
        )
    rich.print(f"outliers: more than {number(document['outlier_mm'])} mm from {evaluation.ranges_from}", soft_wrap=True)
    if verbose and evaluation.surface_from is not None:
        rich.print(f"Chamfer distance: to {evaluation.surface_from}", soft_wrap=True)
    text = ("design", "gate")
    lines = [[row["design"], row["gate"], *(number(row[name]) for name in COLUMNS)] for row in document["rows"]]
    print_table(None, (*text, *COLUMNS.values()), lines, rich, text=text)
    if verbose:
        rich.print(_standard_errors(evaluation), soft_wrap=True)


def _standard_errors(evaluation: CaptureEvaluation) -> str:
    designs = [row.estimates() for row in evaluation.rows if not row.baseline]
    parts = []
    for name, what in (("outliers_percent", "outliers"), ("range_error_mm", "range errors")):
        known = [row[name] for row in designs if name in row]
        if known:
            parts.append(f"{what} up to {number(max(each.error or 0.0 for each in known), 2)} {known[0].unit}")
    return f"standard errors over other rays: {', '.join(parts) or 'none, as no return can be judged'}"
