"""Standard input where a command is given `-` for a file: read once, whoever asks for it again."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from lidardesign.errors import ConfigError

# What stands for standard input where a file is read, and for standard output where one is written.
STDIO = "-"
HINT = "give one of them as a file; a file that is called - is given by its whole path"


class Input:
    """What standard input holds, for one kind of content."""

    def __init__(self) -> None:
        self._content: bytes | None = None
        self._kind = ""

    def read(self, kind: str, most_bytes: int) -> bytes:
        """All of it.

        Arguments:
            kind: What it is read as, for messages.
            most_bytes: More is refused.

        Raises:
            ConfigError: It is too much, there is none, or it was read as something else already.
        """
        if self._content is None:
            if sys.stdin is None:
                raise ConfigError("standard input is closed", where=STDIO, hint="give a file")
            self._content, self._kind = sys.stdin.buffer.read(most_bytes + 1), kind
        if kind != self._kind:
            raise ConfigError(f"is {self._kind} already, and cannot be {kind} too", where=STDIO, hint=HINT)
        if len(self._content) > most_bytes:
            raise ConfigError("standard input is too large", where=STDIO, allowed=f"at most {most_bytes} bytes")
        return self._content


_OFFERED: ContextVar[Input | None] = ContextVar("standard input", default=None)


@contextlib.contextmanager
def offered_input() -> Iterator[Input]:
    """Let `-` mean standard input inside; elsewhere, as for who uses the library, it is the name of a file."""
    offered = Input()
    token = _OFFERED.set(offered)
    try:
        yield offered
    finally:
        _OFFERED.reset(token)


def is_input(path: Path | str) -> bool:
    """Whether a path stands for standard input here."""
    return str(path) == STDIO and _OFFERED.get() is not None


def is_there(path: Path) -> bool:
    """Whether a path can be read: standard input, or one that exists."""
    return is_input(path) or path.exists()


def read_input(kind: str, most_bytes: int) -> bytes:
    """What standard input holds; see `Input.read`.

    Raises:
        ConfigError: As there, or it stands for nothing here.
    """
    offered = _OFFERED.get()
    if offered is None:
        raise ConfigError("stands for standard input in commands only", where=STDIO, hint="give a file")
    return offered.read(kind, most_bytes)
