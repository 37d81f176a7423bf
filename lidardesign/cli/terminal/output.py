"""Output of commands: one JSON document or text for people, messages, exit codes, and the files that they write.

Threads, streams and signals of the process are here too: they are set before anything heavy is imported.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer

from lidardesign.cli.terminal.grids import ProgressDisplay, duration
from lidardesign.cli.terminal.score_tables import show_times
from lidardesign.errors import (
    LONGEST_TEXT,
    BackgroundNote,
    ConfigError,
    DataError,
    LidardesignError,
    NumericalError,
    escaped,
    lacks_memory,
    pasted,
    text_of,
)
from lidardesign.run.clock import Clock, peak_memory_bytes, running
from lidardesign.run.files import write_atomic
from lidardesign.run.manifest import keep_timings
from lidardesign.run.outputs import check_outputs
from lidardesign.run.processes import DEBUG, ENDING, EXIT_INTERNAL, EXIT_WORDS, code_of_interruption

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

SCHEMA_VERSION = 1
EXIT_SYSTEM = 3
EXIT_BROKEN_PIPE = 141
PLAIN_WIDTH = 120
NUMBA_CACHE = "numba/core/caching.py"
DISK_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
STDOUT, STDERR = 1, 2
# Commands that only read a run wait for its writer no longer than this.
SHORT_WAIT_S = 0.5
# One thread each: two thread pools that spin on shared cores make each other 8 to 40 times slower. These must
# be set before torch and numpy are imported; whoever sets one of them in the environment keeps it.
THREAD_DEFAULTS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
}
# Numbers in the environment that libraries fail on if they are none, or too small for a table.
NUMBERS = {
    "COLUMNS": "[2-9][0-9]|[1-9][0-9]{2,3}",
    "LINES": "[1-9][0-9]{0,3}",
    "NUMBA_NUM_THREADS": "[1-9][0-9]{0,3}",
}
PAGE_SUFFIXES = (".html", ".htm")  # of reports


def plain_json(value: Any) -> Any:
    """Values as JSON has them: numpy becomes lists and numbers, paths text, NaN and infinity null."""
    if isinstance(value, dict):
        return {str(key): plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(item) for item in value]
    if hasattr(value, "tolist"):
        return plain_json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


@dataclass
class Output:
    """The output of a command.

    Arguments:
        json: Print one JSON document on stdout and nothing else there.
        quiet: No progress and no notes, and of a result its files alone.
        verbose: Everything: all tables, and notes on what was decided.
        stream: Where the result goes: the program's stdout.
        when_interrupted: What to say to the user after Ctrl-C or SIGTERM.
        answered: Whether the one JSON document was printed; an error after it adds none.
        clock: Where the command's time goes.
    """

    json: bool = False
    quiet: bool = False
    verbose: bool = False
    stream: TextIO = field(default_factory=lambda: sys.stdout)
    when_interrupted: Callable[[], str | None] = field(default=lambda: None)
    answered: bool = False
    clock: Clock = field(default_factory=Clock)

    def rich(self, *, stderr: bool = False) -> RichConsole:
        """A rich console; it honours NO_COLOR, prints plain text where there is no terminal, and text as it is."""
        from rich.console import Console as RichConsole

        class Console(RichConsole):
            def render_str(self, text: str, **options: Any) -> Any:
                return super().render_str(escaped(text, LONGEST_TEXT), **options)

        file = sys.stderr if stderr else self.stream
        width = None if file.isatty() or "COLUMNS" in os.environ else PLAIN_WIDTH
        return Console(file=file, highlight=False, markup=False, width=width)

    def note(self, text: str) -> None:
        """Print a note on stderr, unless --quiet."""
        if not self.quiet:
            print_message(text)

    def says(self, note: str) -> bool:
        """True where a note is printed."""
        return not self.quiet and (self.verbose or not isinstance(note, BackgroundNote))

    def remark(self, text: str) -> None:
        """Print what the program has to remark, marked as a note."""
        if self.says(text):
            self.note(f"note: {text}")

    def result(
        self,
        document: dict[str, Any],
        show: Callable[[RichConsole], None],
        *,
        files: Mapping[str, Path] | None = None,
        show_costs: bool = True,
        says_time: bool = False,
    ) -> None:
        """Give the result, as JSON or shown for people, with the time that it took and the files that it is in.

        Arguments:
            document: The JSON form; `timings` and `peak_memory_bytes` are added.
            show: Prints the result for people.
            files: Paths that were written, by what they are; with --quiet they are all that is printed. None where the
                result is in no file by its nature.
            show_costs: Whether people are shown the time, and the result is kept where it cannot be shown: not by
                commands that only look something up.
            says_time: Whether `show` says the time.

        Raises:
            OSError: Standard output is full, or was closed.
        """
        document = {**document, "timings": self.clock.timings(), "peak_memory_bytes": peak_memory_bytes()}
        try:
            if self.json:
                self.answered = True
                print_json(document, self.stream)
            else:
                self._show(document, show, files, show_costs, says_time)
                self.stream.flush()
        except (OSError, SystemExit) as error:
            if show_costs:  # it was worked for
                self.keep(f"{json_text(document)}\n", ".json")
            # rich ends the process by itself where nobody reads
            raise error if isinstance(error, OSError) else BrokenPipeError from None

    def _show(
        self,
        document: dict[str, Any],
        show: Callable[[RichConsole], None],
        files: Mapping[str, Path] | None,
        show_costs: bool,
        says_time: bool,
    ) -> None:
        rich, timings = self.rich(), document["timings"]
        if self.quiet and files is not None:
            for path in files.values():
                rich.print(str(path), soft_wrap=True)
            return
        show(rich)
        if show_costs and self.verbose:
            show_times(timings, document["peak_memory_bytes"], rich)
        elif show_costs and not (says_time or self.quiet):
            rich.print(f"took {duration(self.clock.seconds)}")
        for label, path in (files or {}).items():
            rich.print(f"{label}: {path}", soft_wrap=True)

    def keep(self, content: str, suffix: str) -> None:
        """Write content that could not be delivered to a temporary file and print its path; else print the content."""
        try:
            descriptor, place = tempfile.mkstemp(prefix="lidardesign-", suffix=suffix)
            with open(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(content)
        except OSError:
            print_message(content)
        else:
            print_message(f"what could not be written is kept in {place}")

    def progress(self, label: str) -> ProgressDisplay:
        """A bar of progress on a terminal, elsewhere a line now and then; nothing with --quiet."""
        on_terminal = not self.quiet and sys.stderr.isatty()
        return ProgressDisplay(label, self.note, self.rich(stderr=True) if on_terminal else None)


def print_message(text: str) -> None:
    """Print on stderr; a closed stderr is replaced by the null device."""
    try:
        print(escaped(text, LONGEST_TEXT), file=sys.stderr, flush=True)
    except (OSError, ValueError):
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - lives as long as the process


def print_json(document: dict[str, Any], output: TextIO | None = None) -> None:
    """Print the one JSON document of a command, on stdout."""
    print(json_text(document), file=output or sys.stdout, flush=True)


def json_text(document: dict[str, Any]) -> str:
    """The one JSON document of a command."""
    return json.dumps({"schema_version": SCHEMA_VERSION, **plain_json(document)}, allow_nan=False, indent=2)


@contextlib.contextmanager
def command(*, json: bool, quiet: bool, verbose: bool = False) -> Iterator[Output]:
    """Run a command's body: its errors become one message and an exit code.

    With `--json`, whatever plugins and libraries print meanwhile goes to stderr, also by processes of their own.
    """
    output = Output(json=json, quiet=quiet, verbose=verbose and not quiet, stream=sys.stdout)
    try:
        with _guarded_stdout(output) if json else contextlib.nullcontext(), running(output.clock):
            yield output
        output.stream.flush()
    except typer.Exit:
        raise
    except BrokenPipeError:
        forget_stdout()
        raise typer.Exit(EXIT_BROKEN_PIPE) from None
    except BaseException as error:
        code = report_error(error, output)
        try:
            output.stream.flush()
        except OSError:  # a full disk, which was reported: the last flush would fail once more
            forget_stdout()
        raise typer.Exit(code) from None


@contextlib.contextmanager
def _guarded_stdout(output: Output) -> Iterator[None]:
    """Keep standard output for the one document; plugins, compiled code and their processes print on stderr."""
    stdout = output.stream
    with contextlib.redirect_stdout(sys.stderr):
        if not _is_of_process(stdout):
            yield
            return
        stdout.flush()
        copy = os.dup(STDOUT)
        os.dup2(STDERR, STDOUT)
        try:
            with open(os.dup(copy), "w", encoding=stdout.encoding, errors=stdout.errors) as output.stream:
                yield
        finally:
            output.stream = stdout
            os.dup2(copy, STDOUT)
            os.close(copy)


def close_stdout_guard() -> None:
    """Redirect later prints of plugins' threads and exit handlers from stdout to stderr."""
    if _is_of_process(sys.stdout):
        sys.stdout.flush()
        os.dup2(STDERR, STDOUT)


def _is_of_process(stream: TextIO) -> bool:
    try:
        return stream.fileno() == STDOUT
    except (AttributeError, OSError, ValueError):
        return False


def forget_stdout() -> None:
    """Point stdout nowhere once it was closed, so that the interpreter's last flush is quiet."""
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - lives as long as the process


def report_error(error: BaseException, output: Output) -> int:
    """Print what went wrong, once, and return the exit code."""
    ENDING.arrived = True
    document, code, text = describe_error(error, output)
    if output.json and not output.answered:
        print_json({"error": document, "exit_code": code}, output.stream)
    print_message(text)
    if os.environ.get(DEBUG):
        traceback.print_exception(error)
    return code


def describe_error(error: BaseException, output: Output) -> tuple[dict[str, Any], int, str]:
    """The JSON form of an error, its exit code, and its text for people."""
    # compiled kernels that return into an interruption make it a SystemError, and half of a module is an ImportError
    code = ENDING.signalled or code_of_interruption(error)
    # what could not be written while tidying up is lost, and must be told
    if code and not isinstance(error, DataError):
        kind, further = EXIT_WORDS[code], output.when_interrupted()
        text = f"{kind}: {further}" if further else kind
        return {"kind": kind, "message": text}, code, text
    try:
        os.getcwd()
    except OSError:  # whatever it was that failed there
        error = DataError("the working folder no longer exists", hint="change to a folder that does")
    if isinstance(error, LidardesignError):
        return error.as_dict(), code or error.exit_code, f"{error.kind} error: {error}"
    if lacks_memory(error):
        text = "the computer ran out of memory; a smaller batch, field_resolution or preset needs less"
        return {"kind": "memory", "message": text}, NumericalError.exit_code, f"memory error: {text}"
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop"):  # of `Path.resolve`
        error = OSError(errno.ELOOP, str(error))
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        document = {"kind": "system", "message": f"{name}{error.strerror or error}"}
        if error.errno in DISK_FULL and not error.filename:
            document["hint"] = "make room where the output, the temporary files or numba's cache (NUMBA_CACHE_DIR) go"
    elif folder := _damaged_cache(error):
        document = {
            "kind": "system",
            "message": f"{folder}: the cache of compiled code is damaged",
            "hint": "remove its files *.nbi and *.nbc",
        }
    else:
        text = f"{type(error).__name__}: {text_of(error)}"
        hint = "this is a bug in lidardesign: please report it; LIDARDESIGN_DEBUG=1 shows where"
        document = {"kind": "internal", "message": text, "hint": hint}
        return document, EXIT_INTERNAL, f"internal error: {text}\n  {hint}"
    attempt = f"\n  try: {document['hint']}" if "hint" in document else ""
    return document, EXIT_SYSTEM, f"system error: {document['message']}{attempt}"


def _damaged_cache(error: BaseException) -> str | None:
    """The folder of numba's cache where an error came from reading a damaged file in it; else None."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_filename.replace(os.sep, "/").endswith(NUMBA_CACHE):
            folder = getattr(frame.f_locals.get("self"), "_cache_path", None)
            if folder is not None:
                return str(folder)
    return None


def keep_times(run: Path, name: str, output: Output, *, wait_s: float = SHORT_WAIT_S, **further: Any) -> None:
    """Enter the times of a command in the manifest of its run; `further` as of `keep_timings`.

    The work is done by then, so a failure to write is a note, not an error; that the run is gone is one.
    """
    try:
        keep_timings(run, name, output.clock, wait_s=wait_s, **further)
    except (ConfigError, DataError, OSError) as error:
        if "created" in further and isinstance(error, DataError) and not isinstance(error.__cause__, OSError):
            raise
        message = error.message if isinstance(error, ConfigError | DataError) else error.strerror or error
        output.note(f"note: the times of {name} are not kept in {run}: {message}")


def set_defaults() -> None:
    """One thread per numerical library unless the user chose otherwise; other numbers than these must be some."""
    for name, value in THREAD_DEFAULTS.items():
        os.environ.setdefault(name, value)
    for name, allowed in NUMBERS.items():
        if not re.fullmatch(allowed, os.environ.get(name, "")):
            os.environ.pop(name, None)


def make_streams_tolerant() -> None:
    """Escape characters that the terminal lacks; a stream that was closed swallows its output."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: else the next file that is opened takes its place, and what is printed there
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - lives as long as the process
        with contextlib.suppress(AttributeError, ValueError):
            getattr(sys, name).reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def written_file(path: Path, suffix: str = "") -> Iterator[Path]:
    """A context with the file to write for a path; for a pipe or device a temporary file, copied there at the end.

    Raises:
        DataError: It is a folder, or cannot be written.
    """
    if path.is_file() or path.is_dir() or not path.exists():
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
        staged = Path(folder) / f"file{suffix}"
        yield staged
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
            f"{report.name} is not the name of an HTML page",
            where="--report",
            allowed=", ".join(PAGE_SUFFIXES),
            hint=f"--report {pasted(report.with_suffix('.html'))}; a browser prints it as PDF",
        )
    announce([path for path in (csv, report) if path is not None], output)


def announce(paths: Sequence[Path], output: Output) -> None:
    """Note each folder that will be created for output files, by its topmost new part.

    Where one of the files is standard output, the output of the command goes to standard error.
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
