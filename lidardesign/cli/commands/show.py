"""`lidardesign show`: print a design for people."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.output import command
from lidardesign.cli.tables.designs import number, show_constraints, show_design
from lidardesign.errors import LidardesignError
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.design.compare import Readout


def show(
    design: Annotated[
        Path, typer.Argument(metavar="DESIGN", readable=False, help="A design file, or the file of a rig.")
    ],
    at: options.At = None,
    space_of: options.SpaceOf = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print a design for people (or, with --json, for scripts): its sensors, rays, bandwidth and constraints."""
    with command(json=json, quiet=quiet, debug=debug) as output:
        with phase("libraries"):
            from lidardesign.design.compare import outside_notes, readout_of
            from lidardesign.design.constraints.check import check_design
            from lidardesign.design.constraints.slack import room_of
            from lidardesign.design.files import design_document, track_document
            from lidardesign.design.layouts.track import placed
            from lidardesign.workflow.run_folder import RunFolder, reach_of, read_design, run_of

        condition = options.parse_at(at)
        run = None if space_of is None else RunFolder.open(space_of)
        specification = read_design(design, output.remark, reach_of([run]) if run else None)
        try:
            run = run or run_of(specification, design)
        except LidardesignError as error:  # its run is not needed to show a design
            if specification.constraints:
                output.remark(f"the design space is not checked: {error}")
        space = None if run is None else run.config.space
        checks = []
        if specification.constraints:
            checks = check_design(design_document(specification), specification.constraints, space)
        for line in () if space is None else outside_notes(specification, space):
            output.remark(line)
        specification = placed(specification, condition) if condition else specification
        readout = readout_of(specification)
        rooms = [room_of(check) for check in checks]
        document = {
            "design": str(design),
            "name": specification.name,
            "layout": specification.layout,
            "rays": specification.rays,
            "level": specification.level,
            "at": dict(specification.at),
            "sensors": [sensor.as_dict() for sensor in specification.sensors],
            "track": track_document(specification.track) if specification.track is not None else None,
            "constraints": specification.constraints,
            "checks": [
                {**check.as_dict(), "room": left.room, "tight": left.is_tight}
                for check, left in zip(checks, rooms, strict=True)
            ],
            "bandwidth": readout.as_dict(),
            "provenance": specification.provenance,
        }

        def show_all(rich: RichConsole) -> None:
            show_design(specification, rich)
            show_constraints(checks, rich)
            _show_readout(readout, rich)

        output.result(document, show_all, show_costs=False)


def _show_readout(readout: Readout, rich: RichConsole) -> None:
    """Print the bandwidth, and the read-out that it is of."""
    model = readout.model
    low, high = number(readout.low_mbps), number(readout.high_mbps)
    span = low if low == high else f"{low} .. {high}"
    rays = "each ray in a frame" if readout.rays is None else f"{readout.rays} rays per frame"
    bins = f"({number(model.bin_ps)} ps bins of {number(model.bits_per_bin)} bits, {number(model.rate_hz)} frames/s)"
    rich.print(f"bandwidth: {span} Mbit/s for {rays}", soft_wrap=True, markup=False)
    rich.print(bins, soft_wrap=True, markup=False)
