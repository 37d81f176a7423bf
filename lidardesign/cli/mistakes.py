"""What to try after a command line that cannot be understood."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Sequence
from typing import Any

PROGRAM = "lidardesign"
HELP_WORDS = ("help", "man", "usage")
# Options that belong to commands, and are often written before them.
COMMON = ("--json", "--quiet", "-q", "--debug", "--seed")


def hint_of(arguments: Sequence[str], error: Any, root: Any) -> str:
    """What would have been understood, or where to read on.

    Arguments:
        arguments: The command line, without the program's name.
        error: What the parser says; it may know the command that it happened in.
        root: The program's command.
    """
    context = getattr(error, "ctx", None)
    path = context.command_path if context else PROGRAM
    return _understood(list(arguments), root) or f"{path} --help"


def _understood(words: list[str], root: Any) -> str | None:
    """A command line close to the given one that would be understood better, if there is one."""
    commands = root.commands
    if not words:
        return None
    first = words[0]
    split = first.split()
    if len(split) > 1 and split[0] in commands:
        return _line([*split, *words[1:]])
    if first in HELP_WORDS:
        named = [word for word in words[1:] if not word.startswith("-")]
        return _line([*named[:1], "--help"]) if not named or named[0] in commands else _line(["--help"])
    if first in COMMON:
        rest = _behind_common(words)
        return _line(rest) if rest and rest[0] in commands else None
    if first.startswith("-") or first in commands:
        group = commands.get(first)
        return _close(words, 1, getattr(group, "commands", None), root) if group is not None else None
    return _close(words, 0, commands, root)


def _behind_common(words: list[str]) -> list[str]:
    """A command line with common options moved behind what they stand before."""
    taken, rest = [], list(words)
    while rest and rest[0] in COMMON:
        count = 2 if rest[0] == "--seed" else 1
        taken, rest = taken + rest[:count], rest[count:]
    return [*rest, *taken] if rest else []


def _close(words: list[str], index: int, commands: Any, root: Any) -> str | None:
    """The command line with the word at a place replaced by the command that it is most like."""
    if not commands or len(words) <= index or words[index] in commands:
        return None
    names = [name for name, command in commands.items() if not command.hidden]
    close = difflib.get_close_matches(words[index], names, n=1)
    if close:
        return _line([*words[:index], close[0], *words[index + 1 :]])
    return None


def _line(words: Sequence[str]) -> str:
    return shlex.join([PROGRAM, *words])
