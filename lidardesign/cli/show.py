"""`lidardesign show`: print a design for people."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lidardesign.cli import options
from lidardesign.cli.console import command


def show(
    design: Annotated[Path, typer.Argument(metavar="DESIGN", help="A design file.")],
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print a design for people (or, with --json, for scripts)."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        from lidardesign.cli.designs import show_design
        from lidardesign.design.files import load_design

        loaded = load_design(design)
        document = {
            "design": str(design),
            "name": loaded.name,
            "layout": loaded.layout,
            "rays": loaded.rays,
            "level": loaded.level,
            "sensors": [sensor.as_dict() for sensor in loaded.sensors],
            "constraints": loaded.constraints,
            "provenance": loaded.provenance,
        }
        console.result(document, lambda rich: show_design(loaded, rich))
