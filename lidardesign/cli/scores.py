"""The tables that `evaluate` prints: scores, differences to the baselines, and equal bandwidth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.cli.designs import number

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

Entry = dict[str, Any]
MILLIMETRES = 1000.0


def show_evaluation(document: dict[str, Any], written: Sequence[Path], rich: RichConsole) -> None:
    """Print an evaluation for people; its JSON form holds more (all pairs, all intervals)."""
    from rich.markup import escape

    metric = document["metric"]
    figure = f"{metric['name']} [{metric['unit']}], {metric['better']} is better"
    _show_rows(document["rows"], escape(f"{figure}, over {document['scenes']} held-out scenes"), rich)
    designs = {row["design"] for row in document["rows"]} - {row["design"] for row in document["equal_bandwidth"]}
    against = [pair for pair in document["paired"] if pair["b"] not in designs]
    unit = escape(metric["unit"])
    title = f"difference to each baseline \\[{unit}], scene by scene, with its 95 % interval"
    _show_grid(against, title, ("a", "rays"), "b", _difference, rich)
    title = f"baselines with as much bandwidth as the design: value \\[{unit}] (rays)"
    _show_grid(document["equal_bandwidth"], title, ("matched_to", "matched_rays"), "design", _value, rich)
    _show_effects(document, rich)
    if "audit" in document:
        _show_audit(document, rich)
    for note in document.get("notes", []):
        rich.print(f"note: {escape(note)}", soft_wrap=True)
    for path in written:
        rich.print(f"wrote {escape(str(path))}", soft_wrap=True)


def _show_rows(rows: Sequence[Entry], title: str, rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    rich.print(f"[italic]{title}[/italic]", soft_wrap=True)
    table = Table()
    detail = next((name for row in rows for name in row["details"]), None)
    further = [] if detail is None else [escape(detail.replace("_", " "))]
    for heading in ("design", "rays", "value", "95 % interval", "failures", *further, "Mbit/s", "seconds"):
        table.add_column(heading, justify="left" if heading == "design" else "right")
    for row in rows:
        interval = f"{number(row['ci_low'])} - {number(row['ci_high'])}"
        extra = [] if detail is None else [row["details"].get(detail)]
        cells = (row["rays"], row["value"], interval, row["failures"], *extra, row["bandwidth_mbps"])
        table.add_row(escape(row["design"]), *(number(cell) for cell in cells), number(row["seconds"], 2))
    rich.print(table)


def _show_grid(
    entries: Sequence[Entry],
    title: str,
    keys: tuple[str, str],
    column: str,
    cell: Callable[[Entry], str],
    rich: RichConsole,
) -> None:
    """One line per design and number of rays, one column per baseline."""
    from rich.markup import escape
    from rich.table import Table

    if not entries:
        return
    columns = list(dict.fromkeys(entry[column] for entry in entries))
    lines: dict[tuple[Any, ...], dict[str, str]] = {}
    for entry in entries:
        lines.setdefault(tuple(entry[key] for key in keys), {})[entry[column]] = cell(entry)
    # a table's own title would wrap at the table's width
    rich.print(f"[italic]{title}[/italic]", soft_wrap=True)
    table = Table("design")
    for heading in ("rays", *columns):
        table.add_column(escape(heading), justify="right")
    for (name, rays), cells in lines.items():
        table.add_row(escape(name), str(rays), *(cells.get(heading, "-") for heading in columns))
    rich.print(table)


def _difference(pair: Entry) -> str:
    return f"{number(pair['difference'], 3)} ({number(pair['ci_low'], 3)} to {number(pair['ci_high'], 3)})"


def _value(row: Entry) -> str:
    return f"{number(row['value'])} ({row['rays']})"


def _show_effects(document: Entry, rich: RichConsole) -> None:
    """What was simulated and why; one line where nothing is called for."""
    from rich.markup import escape
    from rich.table import Table

    detector, effects = escape(document["detector"]), document["effects"]
    if not any(effect["on"] or effect["bound"] or effect["lost"] for effect in effects):
        rich.print(f"effects: none called for with the detector {detector}", soft_wrap=True)
        return
    first = effects[0]
    allowed = f"{MILLIMETRES * first['tolerance']:.3g} mm and {first['lost_tolerance']:.2g} of returns"
    title = f"effects with the detector {detector}; all that are skipped may change {allowed} together"
    rich.print(f"[italic]{title}[/italic]", soft_wrap=True)
    table = Table("effect", "on")
    for heading in ("range \\[mm]", "returns", "cost \\[s]"):
        table.add_column(heading, justify="right")
    table.add_column("reason")
    for effect in effects:
        cells = (f"{MILLIMETRES * effect['bound']:.3g}", f"{effect['lost']:.2g}", f"{effect['seconds']:.2g}")
        table.add_row(effect["name"].replace("_", " "), _where_on(effect), *cells, escape(effect["reason"]))
    rich.print(table)


def _where_on(effect: Entry) -> str:
    if not effect["on"]:
        return "no" if effect["missing"] is None else "missing"
    return "yes" if effect["scenes_on"] == 1 else f"in {effect['scenes_on']:.0%}"


def _show_audit(document: Entry, rich: RichConsole) -> None:
    from rich.markup import escape
    from rich.table import Table

    audit = document["audit"]
    unit = escape(audit["unit"])
    there = {effect["name"] for effect in document["effects"] if effect["bound"] or effect["lost"]}
    skipped = ", ".join(name for name in audit["skipped"] if name in there) or "nothing that is there"
    verdict = "passed" if audit["passed"] else "failed"
    title = f"audit {verdict}: the plan skips {skipped}; rows may move by {audit['tolerance']:g} {unit}"
    rich.print(f"[italic]{title}[/italic]", soft_wrap=True)
    table = Table("design", "matched to")
    for heading in ("rays", f"planned \\[{unit}]", f"all \\[{unit}]", "difference (95 % interval)", "seconds", "all"):
        table.add_column(heading, justify="right")
    for row in audit["rows"]:
        cells = (row["planned"], row["everything"])
        times = (number(row["seconds"], 2), number(row["seconds_everything"], 2))
        matched = escape(row.get("matched_to", "-"))
        table.add_row(
            escape(row["design"]), matched, str(row["rays"]), *map(number, cells), _difference(row), *times
        )
    rich.print(table)
