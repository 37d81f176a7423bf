"""`lidardesign show`: print a design for people."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.console import command
from lidardesign.run.clock import phase


def show(
    design: Annotated[Path, typer.Argument(metavar="DESIGN", help="A design file.")],
    at: options.At = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print a design for people (or, with --json, for scripts), all of it or its rays at a condition."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        with phase("libraries"):
            from lidardesign.cli.designs import show_design
            from lidardesign.cli.runs import parse_at, read_design
            from lidardesign.design.track import placed
            from lidardesign.design.track_document import track_document

        condition = parse_at(at)
        loaded = read_design(design, console)
        loaded = placed(loaded, condition) if condition else loaded
        document = {
            "design": str(design),
            "name": loaded.name,
            "layout": loaded.layout,
            "rays": loaded.rays,
            "level": loaded.level,
            "at": dict(loaded.at),
            "sensors": [sensor.as_dict() for sensor in loaded.sensors],
            "track": track_document(loaded.track) if loaded.track is not None else None,
            "constraints": loaded.constraints,
            "provenance": loaded.provenance,
        }
        console.result(document, lambda rich: show_design(loaded, rich), show_costs=False)
