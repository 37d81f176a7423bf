"""What `catalog` prints of parts: one row each, or all their figures with conditions and sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lidardesign.cli.tables.grids import RichConsole, number, text_table
from lidardesign.parts.part import Part, conditions_of, disagreements

FIGURES = ("rays", "field of view\n[deg]", "range [m]", "rate\n[Hz]", "histogram\n[Mbit/s]", "processed\n[Mbit/s]")
COLUMNS = ("part", "kind", *FIGURES[:3], "range holds", *FIGURES[3:])
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
    from rich.text import Text

    rich.print(Text.assemble((part.name, "bold"), f": {part.product}, {part.kind}"))
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
    if "design" in document:
        sensors = "1 part" if document["sensors"] == 1 else f"{document['sensors']} parts"
        rich.print(f"wrote {document['design']} ({document['design_rays']} rays of {sensors})")


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
