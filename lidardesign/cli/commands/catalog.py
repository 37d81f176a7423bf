"""`lidardesign catalog`: real parts, what is known of them and from where, and designs of them.

What `catalog` prints of parts: one row each, or all their figures with conditions and sources.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.flag import flags_of
from lidardesign.choices.listings import ARRANGEMENTS, NewDesign, PartChoices, PartPlace
from lidardesign.choices.shared import Brief
from lidardesign.cli.terminal.grids import RichConsole, number, text_table
from lidardesign.cli.terminal.options import command_line, parts
from lidardesign.cli.terminal.output import Output
from lidardesign.errors import ConfigError, check_choice
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from lidardesign.parts.part import Part
    from lidardesign.sensors.design import DesignSpec

catalog_app = typer.Typer(help="List real parts, or show one and write a design of it.", invoke_without_command=True)


@catalog_app.callback()
def catalog(context: typer.Context) -> None:
    """List real parts, or show one and write a design of it."""
    if context.invoked_subcommand is None:
        list_()


@catalog_app.command("list")
@command_line(PartChoices, Brief)
def list_(
    output: Output, *, own: Sequence[Path] = (), reflectance: float | None = None, klux: float | None = None
) -> None:
    """List all parts in all their modes. It shows pattern, field of view, range and the cost of reading them out."""
    with phase("libraries"):
        from lidardesign.parts.catalogue import load_library

    every, vouched = load_library(own).every_mode(), []
    for part in every:
        with contextlib.suppress(ConfigError):  # no source states a range under such conditions
            vouched.append(part.under(reflectance_percent=reflectance, illuminance_klux=klux))
    left_out = len(every) - len(vouched)
    output.result(
        {"parts": [part_entry(part) for part in vouched], "left_out": left_out},
        lambda rich: show_parts(vouched, rich),
        show_costs=False,
    )
    if left_out:
        output.note(f"note: {left_out} of {len(every)} parts and modes have no range stated for such conditions")


@catalog_app.command("show")
@command_line(PartChoices, NewDesign, PartPlace, Brief)
def show(
    output: Output,
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="A part's name, NAME:MODE, or a part file.", autocompletion=parts),
    ],
    *,
    own: Sequence[Path] = (),
    reflectance: float | None = None,
    klux: float | None = None,
    out: Path | None = None,
    **place: Any,
) -> None:
    """Show a part, or write a design of it. Every figure has its conditions and its source."""
    with phase("libraries"):
        from lidardesign.parts.catalogue import find_part
        from lidardesign.sensors.design_file import MOST_FILE_RAYS, save_design

    part = find_part(name, own).under(reflectance_percent=reflectance, illuminance_klux=klux)
    document = part_document(part)
    given = {flag.option: place.get(key) for key, flag in flags_of(PartPlace).items()}
    if out is not None:
        design = _placed(part, given, out.stem, output)
        document |= {"design": str(out), "design_rays": design.count, "sensors": len(design.sensors)}
        if (design.count or 0) > MOST_FILE_RAYS:
            raise ConfigError(
                f"{design.count} rays are too many for a design file",
                where=str(out),
                allowed=f"at most {MOST_FILE_RAYS:,}",
                hint="--rays N takes an evenly spread subset",
            )
        with phase("writing"):
            save_design(design, out)
    elif useless := [option for option, value in given.items() if value is not None]:
        raise ConfigError("says how a design is made", where=useless[0], hint="--out FILE.yaml writes one")
    output.result(
        document,
        lambda rich: show_part(part, document, rich),
        files=None if out is None else {f"{part.name}, {document['design_rays']} rays": out},
        show_costs=False,
    )


def _placed(part: Part, given: dict[str, Any], name: str, output: Output) -> DesignSpec:
    import numpy as np

    from lidardesign.limits import MOST_RAYS
    from lidardesign.parts.catalogue import Pose, interleaved, part_design, parts_for, side_by_side
    from lidardesign.run.yaml import plain_number
    from lidardesign.space import FARTHEST_M

    count, number = given["--rays"], given["--parts"]
    arrange = check_choice(given["--arrange"] or ARRANGEMENTS[0], "--arrange", ARRANGEMENTS)
    needed = number or (1 if count is None else parts_for(part, count))
    if needed == 1 and given["--arrange"] is not None:
        raise ConfigError("is for several parts", where="--arrange", hint="--parts N")
    text = given["--at-origin"]
    try:
        origin = np.array([plain_number(item) for item in (text or "0,0,0").split(",")])
    except ValueError:
        origin = np.zeros(0)
    if origin.shape != (3,) or not (np.abs(origin) <= FARTHEST_M).all():
        allowed = f"three numbers, such as 0.5,0,1.8 [m], each at most {FARTHEST_M:g}"
        raise ConfigError(f"found {text!r}", where="--at-origin", allowed=allowed)
    pose = Pose(origin, *(math.radians(given[f"--{angle}-deg"] or 0.0) for angle in ("azimuth", "elevation", "roll")))
    poses = interleaved(part, pose, needed) if arrange == "interleaved" else side_by_side(part, pose, needed)
    if count is None and part.rays * needed > MOST_RAYS:
        raise ConfigError(f"{part.rays * needed} rays", where="--parts", hint="--rays N takes an even subset")
    if needed > 1 and number is None:
        output.note(f"note: {count} rays take {needed} x {part.name}, {arrange}")
    return part_design(part, poses, count, name=name)


FIGURES = ("rays", "field of view\n[deg]", "range [m]", "rate\n[Hz]", "histogram\n[Mbit/s]", "processed\n[Mbit/s]")
COLUMNS = ("part", "kind", *FIGURES[:3], "range holds", *FIGURES[3:])
LONGEST_LIST = 8


def part_entry(part: Part) -> dict[str, Any]:
    """The JSON form of a part's row."""
    from lidardesign.parts.part import conditions_of, disagreements

    (left, right), (bottom, top) = part.view.azimuth, part.view.elevation
    near, far = part.range_m
    horizontal, vertical = part.field_of_view_rad
    columns, rows = part.grid
    return {
        "name": part.name,
        "product": part.product,
        "kind": part.kind,
        "summary": part.summary,
        "mode": part.mode,
        "modes": list(part.modes),
        "pattern": part.pattern.kind,
        "rays": part.rays,
        "columns": columns,
        "rows": rows,
        "field_of_view_rad": {"horizontal": horizontal, "vertical": vertical},
        "field_of_view_deg": {"azimuth": [left, right], "elevation": [bottom, top], "shape": part.view.shape},
        "range_m": {"near": near, "far": far},
        "range_conditions": conditions_of(part.figures["far_m"][0]) or None,
        "rate_hz": part.rate_hz,
        "bandwidth_mbps": {"histogram": part.histogram_mbps, "processed": part.processed_mbps},
        "disagreements": disagreements(part),
        "origin": part.origin,
    }


def part_document(part: Part) -> dict[str, Any]:
    """The JSON form of all that is known of a part."""
    figures = {
        name: [one.model_dump(exclude_none=True) for one in statements] for name, statements in part.figures.items()
    }
    sources = {name: source.model_dump(exclude_none=True) for name, source in part.sources.items()}
    return {**part_entry(part), "figures": figures, "sources": sources}


def show_parts(parts: Sequence[Part], rich: RichConsole) -> None:
    """Print one row per part and mode; a mode stands under its part."""
    table = text_table(COLUMNS, figures=FIGURES, no_wrap=True)
    above = None
    for part in parts:
        widths = [high - low for low, high in (part.view.azimuth, part.view.elevation)]
        is_round = part.view.shape == "ellipse" and widths[0] == widths[1]
        near, far = part.range_m
        stated = part.figures["far_m"][0]
        held = [] if stated.reflectance_percent is None else [f"{stated.reflectance_percent:g} %"]
        if stated.illuminance_klux is not None:
            held.append(f"{stated.illuminance_klux:g} klux" if stated.illuminance_klux else "dark")
        stem = part.name.partition(":")[0]
        table.add_row(
            f"  :{part.mode}" if above == stem else part.name,
            part.kind,
            str(part.rays),
            f"{widths[0]:g} round" if is_round else " x ".join(f"{width:.4g}" for width in widths),
            # no source may say where the range begins
            f"{near:.3g} - {far:.4g}" if "near_m" in part.figures else f"? - {far:.4g}",
            ", ".join(held) or "-",
            number(part.rate_hz),
            number(part.histogram_mbps, 3),
            number(part.processed_mbps, 3),
        )
        above = stem
    rich.print(table)
    rich.print("catalog show NAME, or NAME:MODE, gives every figure with its source")


def show_part(part: Part, document: dict[str, Any], rich: RichConsole) -> None:
    """Print every figure of a part with its conditions and source, and what follows from them."""
    from lidardesign.parts.part import conditions_of

    rich.print(f"{part.name}: {part.product}, {part.kind}")
    rich.print(part.summary)
    if part.modes:
        rich.print(f"mode {part.mode} of {', '.join(part.modes)}")
    table = text_table(("figure", "value", "conditions", "source", "note"))
    for name, statements in part.figures.items():
        label = name + (" (!)" if name in document["disagreements"] else "")
        for statement in statements:
            source, note = statement.source, statement.note or ""
            table.add_row(label, _figure(statement), conditions_of(statement), source, note)
            label = ""
    rich.print(table)
    for key, source in part.sources.items():
        parts = [source.title, source.kind, source.publisher, source.revision and f"revision {source.revision}"]
        rich.print(f"{key}: {', '.join(text for text in parts if text)}", soft_wrap=True)
    histograms, processed = part.histogram_mbps, part.processed_mbps
    costs = [
        "no source says how long its histograms are" if histograms is None else f"histograms {histograms:.3g} Mbit/s",
        "no source says how long its frames are" if processed is None else f"processed {processed:.3g} Mbit/s",
    ]
    rich.print(f"{part.rays} rays at {part.rate_hz:g} Hz; read-out: {', '.join(costs)}", soft_wrap=True)
    if document["disagreements"]:
        names = ", ".join(document["disagreements"])
        rich.print(f"sources disagree about {names}; the first figure is used", soft_wrap=True)


def _figure(statement: Any) -> str:
    further = {"source", "note", "at", "reflectance_percent", "illuminance_klux", "detection_percent"}
    values = statement.model_dump(exclude_none=True, exclude=further)
    if list(values) == ["value"]:
        return number(values["value"], 6)
    if values.get("shape") == "rectangle":
        del values["shape"]
    words = [values.pop("kind")] if values.get("kind") else []
    texts = []
    for key, value in values.items():
        is_long = isinstance(value, list) and len(value) > LONGEST_LIST
        texts.append(
            f"{key} {len(value)} from {value[0]:g} to {value[-1]:g}" if is_long else f"{key} {number(value, 5)}"
        )
    return " ".join([*words, ", ".join(texts)])
