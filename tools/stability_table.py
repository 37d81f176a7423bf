"""Write the tables of docs/stability.md: every hard case and what is done.

Usage: python tools/stability_table.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "stability.md"
BEGIN = "<!-- table: tools/stability_table.py -->"
END = "<!-- end of table -->"
HEADINGS = {
    "Design space and density": range(1, 11),
    "Fields and meshes": range(11, 17),
    "Rays and simulation": range(17, 23),
    "Learning the flow": range(23, 28),
    "Mixtures, constraints, designs": range(29, 36),
    "Files, plugins, processes": range(36, 41),
    "Robots (MuJoCo)": ("M1", "M2", "M3", "M4"),
    "Promises": ("P1", "P2", "P3", "P4", "P5", "P6", "P7"),
}


def table(cases: Mapping[str, Any]) -> str:
    """The tables of all layers as Markdown: cases by key, see tests/support/hard_cases.py."""
    return "\n".join(_layer(heading, map(str, keys), cases) for heading, keys in HEADINGS.items())


def _layer(heading: str, keys: Iterable[str], cases: Mapping[str, Any]) -> str:
    lines = [f"## {heading}", "", "| | case | what is done |", "|---|---|---|"]
    lines += [f"| {key} | {_cell(cases[key].title)} | {_cell(cases[key].done)} |" for key in keys]
    return "\n".join([*lines, ""])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def main() -> None:
    """Collect the cases and write the page."""
    sys.path.insert(0, str(ROOT / "tests"))
    from support.hard_cases import hard_cases

    cases = hard_cases()
    page = PAGE.read_text(encoding="utf-8")
    head, _, rest = page.partition(BEGIN)
    _, _, tail = rest.partition(END)
    PAGE.write_text(f"{head}{BEGIN}\n{table(cases)}{END}{tail}", encoding="utf-8")
    print(f"{PAGE.relative_to(ROOT)}: {len(cases)} cases")


if __name__ == "__main__":
    main()
