"""Long runs as tests marked `long`: what is done is kept, what hangs is ended, and a dated page says what came of it.

A plugin of pytest, for `-p benchmarks.soak.long_runs` (see the Makefile). xdist goes on behind a process that crashed.
Every finished piece is a file in `build/long`, in a folder of the program that it is of: the commit, and what was
changed since. LONG_RUNS in the environment names another folder.
"""

from __future__ import annotations

import ast
import contextlib
import datetime
import faulthandler
import hashlib
import json
import os
import platform
import statistics
import subprocess
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(os.environ.get("LONG_RUNS", ROOT / "build" / "long"))
SOURCES = ("lidardesign", "tasks", "tests", "tools", "benchmarks")
WIDTH = 120


def program() -> str:
    """The commit, and a digest of what was changed since."""
    changed = b"".join(_git(*words, "--", *SOURCES) for words in (("diff", "HEAD"), ("status", "--porcelain")))
    commit = _git("rev-parse", "--short", "HEAD").decode().strip() or "unknown"
    return f"{commit} with changes {hashlib.sha256(changed).hexdigest()[:8]}" if changed else commit


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=False).stdout


PROGRAM = program()
# Where what is done of this program is kept.
OURS = FOLDER / PROGRAM.replace(" ", "-")


def kept(name: str, work: Callable[[], Any]) -> Any:
    """What became of a piece of a long run: as it was kept, or of working for it now.

    Raises:
        SystemExit: The program was changed meanwhile: nobody knows of which the piece is.
    """
    path = OURS / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.json"
    if not path.exists():
        found = work()
        if program() != PROGRAM:
            raise SystemExit("the program was changed meanwhile; run it in a clone")
        path.parent.mkdir(parents=True, exist_ok=True)
        written = path.with_suffix(f".{os.getpid()}")
        written.write_text(json.dumps(found))
        written.replace(path)
    return json.loads(path.read_text())


@contextlib.contextmanager
def ended_after(seconds: float) -> Iterator[None]:
    """End this process where the block takes longer."""
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.fixture
def piece(request, record_property):
    """A function that keeps what `work` returns as a piece of this test, and fails with its `faults`.

    Beside these it may say its `case`, `counts` that are added up over pieces of a case, and `figures` that vary.
    """

    def of(work: Callable[[], dict[str, Any]]) -> None:
        def timed() -> dict[str, Any]:
            began = time.monotonic()
            return {**work(), "wall_s": time.monotonic() - began}

        found = kept(request.node.nodeid, timed)
        record_property("piece", found)
        assert not found["faults"], "\n".join(found["faults"])

    return of


def pytest_addoption(parser):
    parser.addoption("--amount", type=int, default=1, help="how many inputs, runs, seeds or plans (default 1)")
    parser.addoption("--page", type=Path, help="the folder of the result's page")


def amount(config: pytest.Config) -> int:
    """How much is asked for; one where this plugin is not loaded."""
    return config.getoption("amount", 1)


def pytest_terminal_summary(terminalreporter, config):
    """Write the page of the test file that ran: its docstring, tables of what its pieces tell, and faults."""
    folder, reports = config.getoption("page"), terminalreporter.stats
    done = [report for key in ("passed", "failed", "error") for report in reports.get(key, [])]
    if folder is None or not done:
        return
    path = config.rootpath / done[0].nodeid.partition("::")[0]
    title, _, about = (ast.get_docstring(ast.parse(path.read_text())) or path.stem).partition("\n")
    pieces = [value for report in done for name, value in report.user_properties if name == "piece"]
    faults = [
        f"- `{report.nodeid}`: {fault}"
        for report in done
        if report.failed
        for fault in (dict(report.user_properties).get("piece") or {"faults": [str(report.longrepr)[-300:]]})["faults"]
    ]
    seconds = sum(one["wall_s"] for one in pieces)
    command = f"pytest {' '.join(config.args)} --amount {config.getoption('amount')}"
    said = [heading(title.rstrip("."), command), f"{seconds:.0f} s of one process.", about.strip()]
    page = folder / f"{path.stem}-{datetime.datetime.now(datetime.UTC).date()}.md"
    write_page(page, [*said, *_tables(pieces), "## Faults", "\n".join(faults) or "None."])
    terminalreporter.write_line(f"{page}: {len(faults)} faults")


def _tables(pieces: Sequence[dict[str, Any]]) -> Iterator[str]:
    """What is counted by case, and how far what is measured varies."""
    cases: dict[str, list[dict[str, Any]]] = {}
    for piece in pieces:
        cases.setdefault(piece.get("case", "all"), []).append(piece)
    names = dict.fromkeys(name for one in pieces for name in one.get("counts", {}))
    rows = [
        (case, *(sum(one.get("counts", {}).get(name, 0) for one in own) for name in names), len(own),
         sum(bool(one["faults"]) for one in own))
        for case, own in [*sorted(cases.items()), *([("together", pieces)] if len(cases) > 1 else [])]
    ]  # fmt: skip
    yield table(("", *names, "pieces", "pieces with faults"), rows)
    rows = []
    for case, own in sorted(cases.items()):
        for figure in dict.fromkeys(name for one in own for name in one.get("figures", {})):
            values = [one["figures"][figure] for one in own if figure in one.get("figures", {})]
            rows.append((case, figure, *(f"{v:.3g}" for v in (min(values), statistics.median(values), max(values)))))
    if rows:
        yield table(("", "figure", "least", "median", "most"), rows)


def heading(title: str, command: str) -> str:
    """A page's title, and what was run when, where and with which version."""
    # not at the top: mutants are to meet a process that has imported nothing of the program
    from lidardesign.run.manifest import versions

    found = versions()
    libraries = ", ".join(f"{name} {found[name]}" for name in ("numpy", "torch", "zuko") if name in found)
    when = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    machine = f"{os.cpu_count()} cores ({_processor()})"
    return f"# {title}\n\n" + paragraph(
        f"`{command}` on {when}, commit {PROGRAM}, {machine}, Python {found['python']}, {libraries}."
    )


def _processor() -> str:
    """The processor's name, where the system tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.machine()


def paragraph(text: str) -> str:
    """Text folded to the page's width."""
    return textwrap.fill(" ".join(text.split()), WIDTH, break_long_words=False, break_on_hyphens=False)


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [columns, ["---"] * len(columns), *([str(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def write_page(path: Path, parts: Sequence[str]) -> None:
    """Write a page of parts that are apart by an empty line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
