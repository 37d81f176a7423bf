"""How large reports are, and how soon a browser has drawn them.

python benchmarks/report.py [--rounds N] [PAGE.html ...]

Without pages, a draft run of the task face is learned, and reports of one design and of twenty are written. The browser
is headless Chromium (playwright must be installed, see benchmarks/requirements.txt), which draws in software: with a
graphics card it is faster. Times count from asking for the page.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import fitted, installed, learned, parser, report, run_options, without_traceback

DESIGNS = 20
WIDTHS = {"1440": (1440, 900), "390": (390, 844)}
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
DRAWN = "html[data-drawn]"
WAIT_MS = 300_000
MEGABYTE = 1e6
LIMIT_MB, LIMIT_S = 8.0, 3.0
# One step of a slider, or one switch, until it is on the screen.
STEP = """async () => {
  const started = performance.now();
  await drawScene();
  await new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
  return (performance.now() - started) / 1000;
}"""


def made_pages(options: Any, folder: Path) -> list[Path]:
    """Reports of one design and of many on a draft run."""
    from lidardesign import open_run

    options.preset = options.preset or "draft"
    run = learned("face", folder, options, {})
    designs = [fitted(run, f"benchmark-{index}", sensors=2 + index % 9, layout="even").path for index in range(DESIGNS)]
    pages = []
    for count in (1, DESIGNS):
        page = folder / f"designs-{count}.html"
        open_run(run).evaluate(designs[:count], settings={"test": 2}, rays=[400]).report(page)
        pages.append(page)
    return pages


def timed(browser: Any, page: Path, size: tuple[int, int], rounds: int) -> list[float]:
    """Medians [s]: until the 3D view stands, until all figures stand, and of one step of a slider."""
    found = []
    for _ in range(rounds):
        opened = browser.new_page(viewport={"width": size[0], "height": size[1]})
        opened.goto(page.absolute().as_uri(), wait_until="commit", timeout=WAIT_MS)
        opened.wait_for_selector(DRAWN, state="attached", timeout=WAIT_MS)
        marks = opened.evaluate(
            "Object.fromEntries(performance.getEntriesByType('mark').map(m => [m.name, m.startTime]))"
        )
        found.append((marks["scene"] / 1000, marks["drawn"] / 1000, opened.evaluate(STEP)))
        opened.close()
    return [statistics.median(values) for values in zip(*found, strict=True)]


def rows_of(pages: Sequence[Path], rounds: int) -> list[list[Any]]:
    """A row per page and width: its size, and the times of `timed`."""
    from playwright.sync_api import sync_playwright

    rows = []
    with sync_playwright() as player:
        browser = player.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        for page in pages:
            for width, size in WIDTHS.items():
                rows.append([page.stem, width, page.stat().st_size / MEGABYTE, *timed(browser, page, size, rounds)])
        browser.close()
    return rows


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    run_options(made)
    made.add_argument("pages", nargs="*", type=Path, metavar="PAGE.html", help="reports that there are already")
    options = made.parse_args()
    if not installed("playwright") or shutil.which("chromium") is None:
        sys.exit("playwright and chromium are needed")
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        rows = rows_of(options.pages or made_pages(options, Path(folder)), options.rounds)
    lines = [
        f"the largest page has {max(row[2] for row in rows):.2f} MB (at most {LIMIT_MB:g}), the slowest 3D view stands "
        f"after {max(row[3] for row in rows):.2f} s (at most {LIMIT_S:g} on a quiet machine)",
        f"all of it took {time.perf_counter() - started:.0f} s",
    ]
    columns = ["page", "width px", "MB", "3D view s", "all figures s", "a step s"]
    report("Reports in a browser", {"Drawn in software": (columns, rows)}, lines, options.json)


if __name__ == "__main__":
    without_traceback(main)
