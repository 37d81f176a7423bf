"""What `catalog` prints of parts: one row each, or all their figures with conditions and sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lidardesign.cli.tables.designs import number
from lidardesign.design.catalog.part import Part, conditions_of, disagreements

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

COLUMNS = ("part", "kind", "rays", "field of view\n[deg]", "range [m]", "range holds", "rate\n[Hz]")
WORDS = ("part", "kind", "range holds")
READ_OUT = ("histogram\n[Mbit/s]", "processed\n[Mbit/s]")
LONGEST_LIST = 8


def part_entry(part: Part) -> dict[str, Any]:
    """The JSON form of a part's row."""
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


def show_list(parts: Sequence[Part], rich: RichConsole) -> None:
    """Print one row per part and mode; a mode stands under its part."""
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for heading in (*COLUMNS, *READ_OUT):
        table.add_column(escape(heading), justify="left" if heading in WORDS else "right", no_wrap=True)
    above = None
    for part in parts:
        stem = part.name.partition(":")[0]
        name, above = f"  :{part.mode}" if above == stem else part.name, stem
        costs = (number(part.histogram_mbps, 3), number(part.processed_mbps, 3))
        held = _short_conditions(part.figures["far_m"][0]) or "-"
        table.add_row(escape(name), part.kind, str(part.rays), shown_field(part), shown_range(part), escape(held),
                      number(part.rate_hz), *costs)  # fmt: skip
    rich.print(table)
    rich.print("catalog show NAME, or NAME:MODE, gives every figure with its source", markup=False)


def _short_conditions(statement: Any) -> str:
    """Reflectance and ambient light of a statement, as `88 %, dark`."""
    told = [] if statement.reflectance_percent is None else [f"{statement.reflectance_percent:g} %"]
    if statement.illuminance_klux is not None:
        told.append(f"{statement.illuminance_klux:g} klux" if statement.illuminance_klux else "dark")
    return ", ".join(told)


def shown_field(part: Part) -> str:
    """A field of view in degrees, as `45 x 45`; a round one as `38.4 round`."""
    widths = [high - low for low, high in (part.view.azimuth, part.view.elevation)]
    if part.view.shape == "ellipse" and widths[0] == widths[1]:
        return f"{widths[0]:g} round"
    return " x ".join(f"{width:.4g}" for width in widths)


def shown_range(part: Part) -> str:
    """A range in metres, as `0.02 - 4`; `? - 4` where no source says where it begins."""
    near, far = part.range_m
    return f"{near:.3g} - {far:.4g}" if "near_m" in part.figures else f"? - {far:.4g}"


def show_part(part: Part, document: dict[str, Any], rich: RichConsole) -> None:
    """Print every figure of a part with its conditions and source, and what follows from them."""
    from rich.markup import escape

    rich.print(f"[bold]{escape(part.name)}[/bold]: {escape(part.product)}, {part.kind}")
    rich.print(part.summary, markup=False)
    if part.modes:
        rich.print(f"mode {part.mode} of {', '.join(part.modes)}", markup=False)
    rich.print(_figures_table(part, document["disagreements"]))
    for key, source in part.sources.items():
        told = [source.title, source.kind, source.publisher, source.revision and f"revision {source.revision}"]
        rich.print(f"{key}: {', '.join(one for one in told if one)}", markup=False, soft_wrap=True)
    rich.print(_read_out(part), markup=False, soft_wrap=True)
    if document["disagreements"]:
        names = ", ".join(document["disagreements"])
        rich.print(f"sources disagree about {names}; the first figure is used", markup=False, soft_wrap=True)
    if "design" in document:
        count = document["sensors"]
        sensors = "1 part" if count == 1 else f"{count} parts"
        rich.print(f"wrote {document['design']} ({document['design_rays']} rays of {sensors})", markup=False)


def _figures_table(part: Part, disagreeing: Sequence[str]) -> Any:
    from rich.markup import escape
    from rich.table import Table

    table = Table("figure", "value", "conditions", "source", "note")
    for name, statements in part.figures.items():
        for index, one in enumerate(statements):
            label = (name + (" (!)" if name in disagreeing else "")) if index == 0 else ""
            cells = (label, _said(one), conditions_of(one), one.source, one.note or "")
            table.add_row(*(escape(cell) for cell in cells))
    return table


def _said(statement: Any) -> str:
    """What a statement says, without where it comes from."""
    told = statement.model_dump(exclude_none=True)
    for key in ("source", "note", "at", "reflectance_percent", "illuminance_klux", "detection_percent"):
        told.pop(key, None)
    if list(told) == ["value"]:
        return number(told["value"], 6)
    if told.get("shape") == "rectangle":
        del told["shape"]
    kind = told.pop("kind", None)
    words = [kind] if kind else []
    return " ".join([*words, ", ".join(f"{key} {_short(value)}" for key, value in told.items())])


def _short(value: Any) -> str:
    if isinstance(value, list) and len(value) > LONGEST_LIST:
        return f"{len(value)} from {value[0]:g} to {value[-1]:g}"
    return number(value, 5)


def _read_out(part: Part) -> str:
    """What reading the part costs, histograms and processed results apart."""
    histograms, processed = part.histogram_mbps, part.processed_mbps
    told = [
        "no source says how long its histograms are" if histograms is None else f"histograms {histograms:.3g} Mbit/s",
        "no source says how long its frames are" if processed is None else f"processed {processed:.3g} Mbit/s",
    ]
    return f"{part.rays} rays at {part.rate_hz:g} Hz; read-out: {', '.join(told)}"
