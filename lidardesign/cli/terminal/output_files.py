"""Files that a command will write: pages, devices, and folders that are not there yet."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from shlex import quote

from lidardesign.cli.terminal.output import STDOUT, Output
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.files import write_atomic
from lidardesign.run.outputs import check_outputs

PAGE_SUFFIXES = (".html", ".htm")


@contextlib.contextmanager
def written_file(path: Path, suffix: str = "") -> Iterator[Path]:
    """The file to write for a path: for a pipe or a device one that is copied there when it is whole.

    Raises:
        DataError: It is a folder, or cannot be written.
    """
    if path.is_file() or path.is_dir() or not path.exists():
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
        staged = Path(folder) / f"file{suffix}"
        yield staged
        if staged.is_dir():
            raise DataError(
                "is not a folder, and this is a folder of files", where=str(path), hint="give a folder's name"
            )
        write_atomic(path, staged.read_bytes())


def claim_outputs(output: Output, *, csv: Path | None = None, report: Path | None = None) -> None:
    """Claim what a command will write: a page for the report, and places that can be written.

    Raises:
        ConfigError: As of `check_outputs`, or a report whose name says that it is no page.
        DataError: As of `check_outputs`.
    """
    check_outputs({"--csv": csv, "--report": report})
    # pipes and devices have any name
    is_page = report is not None and (report.is_file() or not report.exists())
    if is_page and report.suffix.lower() not in ("", *PAGE_SUFFIXES):
        raise ConfigError(
            f"{report.name} is not a name of an HTML page",
            where="--report",
            allowed=", ".join(PAGE_SUFFIXES),
            hint=f"--report {quote(str(report.with_suffix('.html')))}; a browser prints it as PDF",
        )
    announce([path for path in (csv, report) if path is not None], output)


def announce(paths: Sequence[Path], output: Output) -> None:
    """Say which folders are made for files, so that a misspelt one is seen; each once, by its topmost new part.

    Where one of the files is standard output, people read everything else on standard error.
    """
    if not output.json and any(map(_is_stdout, paths)):
        output.stream = sys.stderr
    new: dict[Path, Path] = {}
    for path in paths:
        missing = [parent for parent in path.parents if not parent.exists()]
        if missing:
            new.setdefault(missing[-1], path)
    for folder, path in new.items():
        output.note(f"note: the folder {folder} does not exist yet; it is created for {path}")


def _is_stdout(path: Path) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(STDOUT))
    except OSError:
        return False
