"""Files that a command will write: what is wrong or new about their names, said before anything takes time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from lidardesign.cli.streams import claim_stdout, is_output
from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from lidardesign.cli.console import Console

PAGE_SUFFIXES = (".html", ".htm")


def claim_outputs(
    console: Console,
    *,
    dry_run: bool = False,
    csv: Path | None = None,
    report: Path | None = None,
    plots: Path | None = None,
) -> None:
    """Claim what a command will write: standard output for `-`, a page for the report, folders that are not there.

    Raises:
        ConfigError: As of `claim_stdout` and `check_page`.
    """
    claim_stdout(console, dry_run=dry_run, csv=csv, report=report)
    check_page(report)
    tell_new_folders([path for path in (csv, report, plots) if path is not None], console)


def check_page(report: Path | None) -> None:
    """Refuse a report whose name says that it is something else than a page; pipes and devices have any name.

    Raises:
        ConfigError: So it is.
    """
    if report is None or is_output(report) or report.suffix.lower() in ("", *PAGE_SUFFIXES):
        return
    if report.exists() and not report.is_file():
        return
    raise ConfigError(
        f"{report.name} is no name of an HTML page",
        where="--report",
        allowed=", ".join(PAGE_SUFFIXES),
        hint=f"--report {report.with_suffix('.html')}; a browser prints it as PDF",
    )


def tell_new_folders(paths: Iterable[Path], console: Console) -> None:
    """Say which folders are made for files, so that a misspelt one is seen; each once, by its topmost new part."""
    new: dict[Path, Path] = {}
    for path in paths:
        missing = [] if is_output(path) else [parent for parent in path.parents if not parent.exists()]
        if missing:
            new.setdefault(missing[-1], path)
    for folder, path in new.items():
        console.note(f"note: there is no folder {folder} yet; it is made for {path}")
