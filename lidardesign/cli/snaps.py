"""The table that `constrain --set snap=catalog` prints: what every sensor became, and what it lost."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from lidardesign.cli.designs import number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console as RichConsole

COLUMNS = ("sensor", "part", "loss\n[nats]", "field of view\n[deg]", "gate\n[m]", "rays", "Mbit/s")


def show_snap(snap: Mapping[str, Any], rich: RichConsole) -> None:
    """Print which part every sensor became; of each figure what was fitted, then what the part has."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title="sensors as parts of the catalogue: fitted > part", title_justify="left")
    for heading in COLUMNS:
        justify = "left" if heading in COLUMNS[:2] else "right"
        table.add_column(escape(heading), justify=justify, overflow="fold")
    for row in snap["sensors"]:
        name = "stays a sensor" if row["part"] is None else row["part"] + (", turned" if row["turned"] else "")
        table.add_row(
            escape(row["sensor"]),
            escape(name),
            f"{row['loss_nats']:.3f}",
            _both(row["field_of_view_rad"], _field),
            _both(row["gate_m"], _gate),
            _both(row["rays"], str),
            _both(row["bandwidth_mbps"], number),
        )
    rich.print(table)
    fitted, parts = (snap["log_likelihood"][key] for key in ("fitted", "parts"))
    rich.print(
        f"log-likelihood as fitted {number(fitted)}, as parts {number(parts)} nats; losses are of one sensor alone"
    )


def _both(figures: Mapping[str, Any], text: Any) -> str:
    fitted, part = text(figures["fitted"]), text(figures["part"])
    return fitted if fitted == part else f"{fitted} > {part}"


def _field(angles_rad: list[float]) -> str:
    return " x ".join(f"{math.degrees(angle):.1f}" for angle in angles_rad)


def _gate(gate_m: list[float]) -> str:
    return " - ".join(f"{end:.2f}" for end in gate_m)
