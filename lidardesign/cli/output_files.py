"""Files that a command will write: `-` for standard output, pages, and folders that are not there yet."""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from shlex import quote

from lidardesign.cli.output import Output
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.files import STDIO, write_atomic
from lidardesign.run.outputs import check_outputs


def claim_stdout(output: Output, *, dry_run: bool = False, **files: Path | None) -> None:
    """Give standard output to the file that is `-`, if one is; people then read all else on stderr, or nowhere with
    --quiet.

    Arguments:
        output: The command's.
        dry_run: Whether the files are only spoken of, so that standard output stays with the result.
        files: What would be written, by the option that says so, with _ for -.

    Raises:
        ConfigError: Several want standard output, or --json has it.
    """
    asking = ["--" + name.replace("_", "-") for name, path in files.items() if path is not None and str(path) == STDIO]
    if not asking:
        return
    if output.json:
        asking.append("--json")
    if len(asking) > 1:
        problem = f"{' and '.join(asking)} both write to standard output"
        raise ConfigError(problem, where=asking[0], hint=f"give {asking[0]} a file")
    if not dry_run:
        output.stream = io.StringIO() if output.quiet else sys.stderr


def is_output(path: Path | None) -> bool:
    """Whether what is written there goes to standard output."""
    return str(path) == STDIO


@contextlib.contextmanager
def written_file(path: Path, suffix: str = "") -> Iterator[Path]:
    """The file to write for a path: for `-`, a pipe or a device one that is copied there when it is whole.

    Raises:
        ConfigError: What was written is no text, and standard output is a terminal.
        DataError: It is a folder, or cannot be written.
    """
    if not is_output(path) and (path.is_file() or path.is_dir() or not path.exists()):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
        staged = Path(folder) / f"stdout{suffix}"
        yield staged
        if staged.is_dir():
            raise DataError(
                "is not a folder, and this is a folder of files", where=str(path), hint="give a folder's name"
            )
        content = staged.read_bytes()
    if is_output(path):
        put_on_stdout(content)
    else:
        write_atomic(path, content)


def put_on_stdout(content: bytes) -> None:
    """Write bytes to standard output.

    Raises:
        ConfigError: They are no text, and it is a terminal.
    """
    if sys.stdout.isatty() and b"\0" in content:
        raise ConfigError("is not text, so a terminal cannot show it", where=STDIO, hint="send it to a file: > FILE")
    sys.stdout.flush()
    stream = getattr(sys.stdout, "buffer", None)
    if stream is None:
        sys.stdout.write(content.decode(errors="backslashreplace"))
    else:
        stream.write(content)
        stream.flush()


PAGE_SUFFIXES = (".html", ".htm")


def claim_outputs(
    output: Output,
    *,
    dry_run: bool = False,
    csv: Path | None = None,
    report: Path | None = None,
) -> None:
    """Claim what a command will write: standard output for `-`, a page for the report, places that can be written.

    Raises:
        ConfigError: As of `claim_stdout` and `check_outputs`, or a report whose name says that it is no page.
        DataError: As of `check_outputs`.
    """
    claim_stdout(output, dry_run=dry_run, csv=csv, report=report)
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
    note_new_folders([path for path in (csv, report) if path is not None], output)


def note_new_folders(paths: Iterable[Path], output: Output) -> None:
    """Say which folders are made for files, so that a misspelt one is seen; each once, by its topmost new part."""
    new: dict[Path, Path] = {}
    for path in paths:
        missing = [parent for parent in path.parents if not parent.exists()]
        if missing and not is_output(path):
            new.setdefault(missing[-1], path)
    for folder, path in new.items():
        output.note(f"note: the folder {folder} does not exist yet; it is created for {path}")
