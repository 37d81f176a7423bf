"""Result pages in Markdown, with the date, the machine and the version that they are of."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

from lidardesign.run.manifest import versions

ROOT = Path(__file__).resolve().parents[2]
WIDTH = 120


def heading(title: str, command: str) -> str:
    """A page's title, and what was run when, where and with which version."""
    found = versions()
    libraries = ", ".join(f"{name} {found[name]}" for name in ("numpy", "torch", "zuko") if name in found)
    when = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    said = (
        f"`{command}` on {when}, commit {commit()}, {os.cpu_count()} cores ({processor()}), Python {found['python']}, "
    )
    return f"# {title}\n\n{paragraph(said + libraries + '.')}"


def commit() -> str:
    """The commit of the working tree, and whether the program differs from it."""
    try:
        number = _git("rev-parse", "--short", "HEAD")
        changed = _git("status", "--porcelain", "--", "lidardesign", "tasks")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{number} with changes" if changed else number


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def processor() -> str:
    """The processor's name, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.machine()


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
