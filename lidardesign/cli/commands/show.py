"""`lidardesign show`: print a design for people."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.output import command
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.output import Output
    from lidardesign.design.compare import Readout
    from lidardesign.design.constraints.check import ConstraintCheck
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.workflow.run_folder import RunFolder

SpaceOf = Annotated[
    Path | None,
    typer.Option(
        "--in",
        metavar="RUN",
        help="Take the design space and the task of this run.",
        show_default="the run that a design came from",
    ),
]


def show(
    design: Annotated[
        Path, typer.Argument(metavar="DESIGN", readable=False, help="A design file, or the file of a rig.")
    ],
    at: options.At = None,
    space_of: SpaceOf = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print a design for people (or, with --json, for scripts): its sensors, rays, bandwidth and constraints."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        with phase("libraries"):
            from lidardesign.cli.tables.designs import show_constraints, show_design
            from lidardesign.design.compare import readout_of
            from lidardesign.design.layouts.track import placed
            from lidardesign.workflow.run_folder import RunFolder, reach_of, read_design

        condition = options.parse_at(at)
        run = None if space_of is None else RunFolder.open(space_of)
        loaded = read_design(design, console.remark, reach_of([run]) if run else None)
        checks = _checks(loaded, design, run, console)
        _tell_outside(loaded, design, run, console)
        loaded = placed(loaded, condition) if condition else loaded
        readout = readout_of(loaded)

        def print_all(rich: RichConsole) -> None:
            show_design(loaded, rich)
            show_constraints(checks, rich)
            for line in _shown_readout(readout):
                rich.print(line, soft_wrap=True, markup=False)

        console.result(_document(loaded, design, checks, readout), print_all, show_costs=False)


def _tell_outside(design: DesignSpec, path: Path, run: RunFolder | None, console: Output) -> None:
    """Say where a design stands far outside the design space of the run that it is shown in, or came from."""
    from lidardesign.design.compare import outside_notes
    from lidardesign.errors import LidardesignError
    from lidardesign.workflow.run_folder import run_of

    try:
        run = run or run_of(design, path)
    except LidardesignError:
        # a run that cannot be opened is told where the design is checked, and not needed to show it
        return
    for line in outside_notes(design, run.config.space) if run else ():
        console.note(f"note: {line}")


def _document(loaded: DesignSpec, path: Path, checks: list[ConstraintCheck], readout: Readout) -> dict[str, Any]:
    from lidardesign.design.constraints.slack import is_tight, room_left
    from lidardesign.design.files import track_document

    return {
        "design": str(path),
        "name": loaded.name,
        "layout": loaded.layout,
        "rays": loaded.rays,
        "level": loaded.level,
        "at": dict(loaded.at),
        "sensors": [sensor.as_dict() for sensor in loaded.sensors],
        "track": track_document(loaded.track) if loaded.track is not None else None,
        "constraints": loaded.constraints,
        "checks": [{**check.as_dict(), "room": room_left(check), "tight": is_tight(check)} for check in checks],
        "bandwidth": readout.as_dict(),
        "provenance": loaded.provenance,
    }


def _checks(design: DesignSpec, path: Path, run: RunFolder | None, console: Output) -> list[ConstraintCheck]:
    """Every constraint that the design was made under, checked anew; in its run's design space where that is there."""
    from lidardesign.design.constraints.check import check_design
    from lidardesign.design.files import design_document
    from lidardesign.errors import LidardesignError
    from lidardesign.workflow.run_folder import run_of

    if not design.constraints:
        return []
    try:
        run = run or run_of(design, path)
    except LidardesignError as error:
        console.note(f"note: the design space is not checked: {error}")
    return check_design(design_document(design), design.constraints, None if run is None else run.config.space)


def _shown_readout(readout: Readout) -> list[str]:
    """Bandwidth, and the read-out that it is of."""
    from lidardesign.cli.tables.designs import number

    model = readout.model
    of = f"({number(model.bin_ps)} ps bins of {number(model.bits_per_bin)} bits, {number(model.rate_hz)} frames/s)"
    low, high = number(readout.low_mbps), number(readout.high_mbps)
    span = low if low == high else f"{low} .. {high}"
    rays = "each ray in a frame" if readout.rays is None else f"{readout.rays} rays per frame"
    return [f"bandwidth: {span} Mbit/s for {rays}", of]
