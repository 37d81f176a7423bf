"""Write the tables of docs/stability.md: every hard case and what is done.

Usage: python tools/stability_table.py
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CASES_FOLDER = ROOT / "tests" / "hard_cases"
PAGE = ROOT / "docs" / "stability.md"
BEGIN = "<!-- table: tools/stability_table.py -->"
END = "<!-- end of table -->"
HEADINGS = (
    ("Design space and density", range(1, 11)),
    ("Fields and meshes", range(11, 17)),
    ("Rays and simulation", range(17, 23)),
    ("Learning the flow", range(23, 28)),
    ("Mixtures, constraints, designs", range(29, 36)),
    ("Files, plugins, processes", range(36, 41)),
)


def table(cases: Mapping[str, Any]) -> str:
    """The tables of all layers as Markdown: cases by key, see tests/support/hard_cases.py."""
    parts = [_layer(heading, [cases[str(number)] for number in numbers]) for heading, numbers in HEADINGS]
    robots = [case for key, case in cases.items() if key.startswith("M")]
    promises = [case for key, case in cases.items() if key.startswith("P")]
    parts.append(_layer("Robots (MuJoCo)", sorted(robots, key=lambda case: case.key)))
    parts.append(_layer("Promises", sorted(promises, key=lambda case: case.key)))
    return "\n".join(parts)


def _layer(heading: str, cases: list[Any]) -> str:
    lines = [f"## {heading}", "", "| | case | what is done |", "|---|---|---|"]
    # what follows a semicolon are details, which the tests show
    lines += [f"| {case.key} | {_cell(case.title)} | {_cell(case.done.partition(';')[0])} |" for case in cases]
    return "\n".join([*lines, ""])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def main() -> None:
    """Collect the cases and write the page."""
    sys.path[:0] = [str(ROOT), str(CASES_FOLDER.parent)]
    import conftest  # noqa: F401  one thread, as in the tests

    cases = importlib.import_module("support.hard_cases").CASES
    for path in [*sorted(CASES_FOLDER.glob("test_cases_of_*.py")), CASES_FOLDER / "test_promises.py"]:
        importlib.import_module(f"hard_cases.{path.stem}")
    written = table(cases)
    page = PAGE.read_text(encoding="utf-8")
    head, _, rest = page.partition(BEGIN)
    _, _, tail = rest.partition(END)
    PAGE.write_text(f"{head}{BEGIN}\n{written}{END}{tail}", encoding="utf-8")
    print(f"{PAGE.relative_to(ROOT)}: {len(cases)} cases")


if __name__ == "__main__":
    main()
