"""Put what a benchmark measured into docs/benchmarks.md: its tables and conclusions, with the date and the machine.

A benchmark's `--json FILE` is the input; the place is between the two marks `<!-- NAME -->` of the page, and what stood
there goes. Lines that are longer than the page is wide are folded, tables are not.

    python benchmarks/flow.py --json flow.json
    python tools/fill_benchmarks.py flow flow.json [--table CAPTION]
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
WIDTH = 120
SHARED = "benchmarks_common_of_fill"


def markdown(document: dict[str, Any], date: str, chosen: Sequence[str] = ()) -> str:
    """Tables and conclusions of a benchmark.

    Arguments:
        document: What `--json` wrote.
        date: When it was measured.
        chosen: Only tables whose caption has one of these texts in it; all where there are none.

    Raises:
        SystemExit: No table's caption has one of the texts.
    """
    machine = document["machine"]
    threads = f"{machine['threads']} thread{'s' if machine['threads'] != 1 else ''}"
    where = f"{machine['processor']}, {machine['cores']} cores, {threads}, Python {machine['python']}"
    parts = [f"{document['title']}. Measured on {date}: {where}, load {machine['load_at_start']} at the start."]
    captions = [c for c in document["tables"] if not chosen or any(text in c for text in chosen)]
    if not captions:
        sys.exit(f"no table is named like {', '.join(chosen)}; there are: {'; '.join(document['tables'])}")
    for caption in captions:
        rows = document["tables"][caption]
        body = _common().table(list(rows[0]), [list(row.values()) for row in rows]) if rows else "(none)"
        parts += [f"{caption}:", body]
    listed = [_folded(f"- {line}", "  ") for line in document["conclusions"]]
    return "\n\n".join([*(_folded(part) for part in parts), *(["\n".join(listed)] if listed else [])])


def _folded(text: str, indent: str = "") -> str:
    if text.startswith("|"):
        return text
    return textwrap.fill(text, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def _common() -> Any:
    """The benchmarks' shared helpers, which are scripts and no package."""
    if SHARED not in sys.modules:
        spec = importlib.util.spec_from_file_location(SHARED, ROOT / "benchmarks" / "common.py")
        sys.modules[SHARED] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[SHARED])
    return sys.modules[SHARED]


def filled(page: str, name: str, text: str) -> str:
    """The page with a text between the two marks of a name.

    Raises:
        SystemExit: The page does not have the mark exactly twice.
    """
    mark = f"<!-- {name} -->"
    parts = page.split(mark)
    if len(parts) != 3:
        sys.exit(f"the page has the mark {mark} {len(parts) - 1} times, not twice")
    return f"{parts[0]}{mark}\n\n{text}\n\n{mark}{parts[2]}"


def main() -> None:
    """Read, fill and write."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("name", help="of the marks, which is that of the script")
    made.add_argument("file", type=Path, help="what the benchmark wrote with --json")
    made.add_argument("--table", action="append", default=[], help="only tables with this in the caption; repeatable")
    made.add_argument("--page", type=Path, default=PAGE, help="where to put it (default %(default)s)")
    options = made.parse_args()
    document = json.loads(options.file.read_text(encoding="utf-8"))
    date = datetime.date.fromtimestamp(options.file.stat().st_mtime).isoformat()
    text = markdown(document, date, options.table)
    options.page.write_text(filled(options.page.read_text(encoding="utf-8"), options.name, text), encoding="utf-8")


if __name__ == "__main__":
    main()
