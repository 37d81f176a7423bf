"""Options that several subcommands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Seed = Annotated[
    int | None,
    typer.Option("--seed", metavar="N", min=0, help="Root of every random stream.", show_default=False),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no notes.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]

Name = Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the design: RUN/designs/NAME.yaml.")]
Layout = Annotated[
    str | None,
    typer.Option("--layout", metavar="grid|density|scan", help="How rays are laid out.", show_default=False),
]
RayCount = Annotated[int | None, typer.Option("--rays", metavar="N", min=1, help="Rays per frame.", show_default=False)]
Gates = Annotated[str, typer.Option("--gates", metavar="sensor|ray", help="One gate per sensor, or one per ray.")]
Sensors = Annotated[
    str | None,
    typer.Option("--sensors", metavar="N|auto", help="Number of sensors.", show_default="the task's"),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one value by its dotted key; repeatable.", show_default=False),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="YAML with sections task, space, density, learning.",
        show_default=False,
    ),
]
