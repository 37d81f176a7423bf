"""`lidardesign catalog`: real parts, what is known of them and from where, and designs of them."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli.terminal import completion, options
from lidardesign.cli.terminal.output import Output, command
from lidardesign.errors import ConfigError, check_choice
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from lidardesign.parts.part import Part
    from lidardesign.sensors.design import DesignSpec

# How several parts at one place are turned against each other.
ARRANGEMENTS = ("interleaved", "beside")
Own = Annotated[
    list[Path] | None,
    typer.Option(
        "--catalog",
        metavar="PATH",
        help="A part file of your own, or a folder of them; repeatable.",
        show_default=False,
    ),
]
Reflectance = Annotated[
    float | None,
    typer.Option(
        "--reflectance",
        metavar="PERCENT",
        help="Ranges that sources state for targets of this reflectance.",
        show_default=False,
    ),
]
Klux = Annotated[
    float | None,
    typer.Option(
        "--klux", metavar="KLUX", help="Ranges that sources state for this ambient light.", show_default=False
    ),
]


catalog_app = typer.Typer(help="List real parts, or show one and write a design of it.", invoke_without_command=True)


@catalog_app.callback()
def catalog(context: typer.Context) -> None:
    """List real parts, or show one and write a design of it."""
    if context.invoked_subcommand is None:
        list_()


@catalog_app.command("list")
def list_(
    own: Own = None,
    reflectance: Reflectance = None,
    klux: Klux = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """List all parts in all their modes. Pattern, field of view, range and what reading them costs are shown."""
    with command(json=json, quiet=quiet) as output:
        with phase("libraries"):
            from lidardesign.cli.tables.parts import part_entry, show_parts
            from lidardesign.parts.catalogue import load_library

        _check_conditions(reflectance, klux)
        parts, vouched = load_library(own or ()).every_mode(), []
        for part in parts:
            with contextlib.suppress(ConfigError):  # no source states a range under such conditions
                vouched.append(_under(part, reflectance, klux))
        left_out = len(parts) - len(vouched)
        entries = {"parts": [part_entry(part) for part in vouched], "left_out": left_out}
        output.result(entries, lambda rich: show_parts(vouched, rich), show_costs=False)
        if left_out:
            output.note(f"note: {left_out} of {len(parts)} parts and modes have no range stated for such conditions")


@catalog_app.command("show")
def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="A part's name, NAME:MODE, or a part file.", autocompletion=completion.parts
        ),
    ],
    own: Own = None,
    reflectance: Reflectance = None,
    klux: Klux = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.yaml", help="Write a design of the part.", show_default=False)
    ] = None,
    at_origin: Annotated[
        str | None,
        typer.Option("--at-origin", metavar="X,Y,Z", help="Where it stands, in metres.", show_default="0,0,0"),
    ] = None,
    azimuth: Annotated[
        float | None,
        typer.Option("--azimuth-deg", metavar="DEG", help="Azimuth of its forward axis.", show_default="0"),
    ] = None,
    elevation: Annotated[
        float | None,
        typer.Option("--elevation-deg", metavar="DEG", help="Elevation of its forward axis.", show_default="0"),
    ] = None,
    roll: Annotated[
        float | None, typer.Option("--roll-deg", metavar="DEG", help="Roll about its forward axis.", show_default="0")
    ] = None,
    rays: Annotated[
        int | None,
        typer.Option(
            "--rays", metavar="N", min=1, max=1_000_000, help="Rays per frame.", show_default="all that it has"
        ),
    ] = None,
    parts: Annotated[
        int | None,
        typer.Option("--parts", metavar="N", min=1, max=1000, help="Parts.", show_default="as many as the rays need"),
    ] = None,
    arrange: Annotated[
        str | None,
        typer.Option(
            "--arrange",
            metavar="interleaved|beside",
            help="Several parts see the same, with interleaved rays, or have fields of view side by side.",
            show_default="interleaved",
            autocompletion=completion.words("interleaved|beside"),
        ),
    ] = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Show a part, or write a design of it. Every figure has its conditions and its source."""
    with command(json=json, quiet=quiet) as output:
        with phase("libraries"):
            from lidardesign.cli.tables.parts import part_document, show_part
            from lidardesign.parts.catalogue import find_part
            from lidardesign.sensors.design_file import MOST_TABLE_RAYS, save_design

        _check_conditions(reflectance, klux)
        part = _under(find_part(name, own or ()), reflectance, klux)
        document = part_document(part)
        given = {
            "--at-origin": at_origin, "--azimuth-deg": azimuth, "--elevation-deg": elevation, "--roll-deg": roll,
            "--rays": rays, "--parts": parts, "--arrange": arrange,
        }  # fmt: skip
        if out is not None:
            design = _placed(part, given, out.stem, output)
            document |= {"design": str(out), "design_rays": design.rays, "sensors": len(design.sensors)}
            if (design.rays or 0) > MOST_TABLE_RAYS:
                raise ConfigError(
                    f"{design.rays} rays are too many for a design file",
                    where=str(out),
                    allowed=f"at most {MOST_TABLE_RAYS:,}",
                    hint="--rays N takes an evenly spread subset",
                )
            with phase("writing"):
                save_design(design, out)
        elif useless := [option for option, value in given.items() if value is not None]:
            raise ConfigError("says how a design is made", where=useless[0], hint="--out FILE.yaml writes one")
        output.result(document, lambda rich: show_part(part, document, rich), show_costs=False)


def _check_conditions(reflectance: float | None, klux: float | None) -> None:
    if reflectance is not None and not 0 < reflectance <= 100:
        raise ConfigError(f"found {reflectance:g}", where="--reflectance", allowed="a percentage above 0, at most 100")
    if klux is not None and not 0 <= klux <= 1000:
        raise ConfigError(f"found {klux:g}", where="--klux", allowed="0 (darkness) to 1000; sunlight is about 100")


def _under(part: Part, reflectance: float | None, klux: float | None) -> Part:
    """The part with its range under the conditions that are given.

    Raises:
        ConfigError: No source states one.
    """
    if reflectance is None and klux is None:
        return part
    return part.under(reflectance_percent=reflectance, illuminance_klux=klux)


def _placed(part: Part, given: dict[str, Any], name: str, output: Output) -> DesignSpec:
    import numpy as np

    from lidardesign.parts.catalogue import Pose, interleaved, part_design, parts_for, side_by_side
    from lidardesign.run.yaml import plain_number
    from lidardesign.sensors.sensor import MOST_RAYS
    from lidardesign.space import FARTHEST_M

    count, number = given["--rays"], given["--parts"]
    arrange = check_choice(given["--arrange"] or ARRANGEMENTS[0], "--arrange", ARRANGEMENTS)
    needed = number or (1 if count is None else parts_for(part, count))
    if needed == 1 and given["--arrange"] is not None:
        raise ConfigError("is for several parts", where="--arrange", hint="--parts N")
    degrees = {option: given[option] or 0.0 for option in ("--azimuth-deg", "--elevation-deg", "--roll-deg")}
    for option, value in degrees.items():
        most = 90 if option == "--elevation-deg" else 360
        if not abs(value) <= most:
            raise ConfigError(f"found {value:g}", where=option, allowed=f"-{most} to {most} degrees")
    text = given["--at-origin"]
    try:
        origin = np.array([plain_number(item) for item in (text or "0,0,0").split(",")])
    except ValueError:
        origin = np.zeros(0)
    if origin.shape != (3,) or not (np.abs(origin) <= FARTHEST_M).all():
        allowed = f"three numbers, such as 0.5,0,1.8 [m], each at most {FARTHEST_M:g}"
        raise ConfigError(f"found {text!r}", where="--at-origin", allowed=allowed)
    pose = Pose(origin, *(math.radians(value) for value in degrees.values()))
    poses = interleaved(part, pose, needed) if arrange == "interleaved" else side_by_side(part, pose, needed)
    if count is None and part.rays * needed > MOST_RAYS:
        raise ConfigError(f"{part.rays * needed} rays", where="--parts", hint="--rays N takes an even subset")
    if needed > 1 and number is None:
        output.note(f"note: {count} rays take {needed} x {part.name}, {arrange}")
    return part_design(part, poses, count, name=name)
