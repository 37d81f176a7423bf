"""With `--json`, standard output is for one document: whatever else prints there is heard on stderr."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from lidardesign.cli.output import Console

STDOUT, STDERR = 1, 2


@contextlib.contextmanager
def printing_aside(console: Console) -> Iterator[None]:
    """Keep standard output for the console's document; plugins, compiled code and their processes print on stderr."""
    output = console.output
    with contextlib.redirect_stdout(sys.stderr):
        if not _is_of_process(output):
            yield
            return
        output.flush()
        kept = os.dup(STDOUT)
        os.dup2(STDERR, STDOUT)
        try:
            with open(os.dup(kept), "w", encoding=output.encoding, errors=output.errors) as console.output:
                yield
        finally:
            console.output = output
            os.dup2(kept, STDOUT)
            os.close(kept)


def print_aside_from_now_on() -> None:
    """Give what threads and exit handlers of plugins still print to stderr, once the program has answered."""
    if _is_of_process(sys.stdout):
        sys.stdout.flush()
        os.dup2(STDERR, STDOUT)


def _is_of_process(stream: TextIO) -> bool:
    """Whether a stream is the standard output that other processes and compiled code print on, too."""
    try:
        return stream.fileno() == STDOUT
    except (AttributeError, OSError, ValueError):
        return False
