"""What may stand where the cursor is, on a command line of this program.

The command line is walked as the parser would: groups to their commands, options with their values, arguments by
their place. What a value can be follows from its metavar (see `completion_values`).
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

# Candidates that more is to follow on, without a space.
OPEN_ENDS = ("=", ":", ",")
# What bash takes words apart at, beside spaces.
BASH_BREAKS = "=:"
BASH_QUOTED = frozenset(" \t'\"\\$`!&;|<>()*?[]{}#~")
# Marks the place of the cursor in a line that is split.
CURSOR = "\x01"
NOTHING, WORDS, PATHS, FILES, FOLDERS = "nothing", "words", "paths", "files", "folders"


@dataclass(frozen=True)
class Answer:
    """What may stand there.

    Arguments:
        kind: nothing, words or paths that are listed; files or folders, which the shell lists itself.
        items: The candidates and what they are, whole words with what is typed already in front.
    """

    kind: str = NOTHING
    items: Sequence[tuple[str, str]] = ()


@dataclass
class Line:
    """A command line up to the cursor.

    Arguments:
        path: The names of the commands, as ("catalog", "show").
        command: The command that the words belong to.
        given: Values that were given so far: of options by their first long name, of arguments by their metavar.
        current: The word at the cursor, as far as it is typed.
        waiting: The option whose value comes next.
        only_arguments: Whether `--` was given.
    """

    path: tuple[str, ...]
    command: Any
    given: dict[str, list[str]] = field(default_factory=dict)
    arguments: int = 0
    current: str = ""
    waiting: Any = None
    only_arguments: bool = False

    @property
    def name(self) -> str:
        """The command as it is typed."""
        return " ".join(self.path)

    def take(self, word: str) -> None:
        """Go past a whole word."""
        if self.waiting is not None:
            self._give(name_of(self.waiting), word)
            self.waiting = None
        elif word == "--" and not self.only_arguments:
            self.only_arguments = True
        elif word.startswith("-") and len(word) > 1 and not self.only_arguments:
            self._take_option(word)
        elif word in getattr(self.command, "commands", {}):
            self.path, self.command, self.arguments = (*self.path, word), self.command.commands[word], 0
        else:
            parameter = self.argument()
            if parameter is not None:
                self._give(str(parameter.metavar), word)
            self.arguments += 1

    def _take_option(self, word: str) -> None:
        name, equals, value = word.partition("=")
        parameter = next((one for one in options_of(self.command) if name in one.opts), None)
        if parameter is None:
            return
        if equals or is_switch(parameter):
            self._give(name_of(parameter), value)
        else:
            self.waiting = parameter

    def _give(self, name: str, value: str) -> None:
        self.given.setdefault(name, []).append(value)

    def argument(self) -> Any:
        """The argument that comes next; the last one may take any number of words."""
        found = [one for one in self.command.params if one.param_type_name == "argument"]
        if self.arguments < len(found):
            return found[self.arguments]
        return found[-1] if found and found[-1].nargs == -1 else None


def options_of(command: Any) -> list[Any]:
    """The options of a command that help shows."""
    return [one for one in command.params if one.param_type_name == "option" and not one.hidden]


def is_switch(option: Any) -> bool:
    """Whether an option takes no value."""
    return bool(option.is_flag or option.count)


def name_of(option: Any) -> str:
    """The long name of an option."""
    return next((name for name in option.opts if name.startswith("--")), option.opts[0])


def answer_of(words: Sequence[str], root: Any) -> Answer:
    """What may stand at the end of a command line.

    Arguments:
        words: Behind the program's name; the last one is the one at the cursor.
        root: The program's command.
    """
    from lidardesign.cli.completion_values import values_of

    line = Line((), root, current=words[-1] if words else "")
    for word in words[:-1]:
        line.take(word)
    if line.waiting is not None:
        return values_of(line, line.waiting, line.current)
    if line.current.startswith("-") and not line.only_arguments:
        return _options(line)
    commands = getattr(line.command, "commands", None)
    if commands:
        shown = {name: one for name, one in commands.items() if not one.hidden}
        return _beginning(line.current, [(name, one.get_short_help_str(80)) for name, one in shown.items()])
    parameter = line.argument()
    return Answer() if parameter is None else values_of(line, parameter, line.current)


def _options(line: Line) -> Answer:
    """Names of options, or behind an = the values of one."""
    from lidardesign.cli.completion_values import values_of

    name, equals, value = line.current.partition("=")
    if equals:
        parameter = next((one for one in options_of(line.command) if name in one.opts), None)
        if parameter is None or is_switch(parameter):
            return Answer()
        found = values_of(line, parameter, value)
        return Answer(found.kind, [(f"{name}={item}", words) for item, words in found.items])
    items = [
        (name, _first_sentence(one.help))
        for one in options_of(line.command)
        if one.multiple or name_of(one) not in line.given
        for name in one.opts
        if name.startswith("--")
    ]
    return _beginning(line.current, [*items, ("--help", "Show the help.")])


def _first_sentence(text: str | None) -> str:
    return " ".join((text or "").split()).partition(". ")[0].rstrip(".")


def _beginning(current: str, items: Sequence[tuple[str, str]]) -> Answer:
    return Answer(WORDS, [item for item in items if item[0].startswith(current)])


def words_of_line(line: str, point: int) -> tuple[list[str], bool]:
    """The words of a line up to the cursor, the last one as far as it is typed, and whether it is in open quotes."""
    for closing in ("", '"', "'"):
        try:
            words = shlex.split(line[:point] + CURSOR + closing)
        except ValueError:
            continue
        return [*words[:-1], words[-1].removesuffix(CURSOR)], bool(closing)
    return [""], False


def respond(shell: str, arguments: Sequence[str], environment: Mapping[str, str], root: Any) -> list[str]:
    """The lines that a shell's script reads: the kind, then candidates, with a tab and what they are where it can.

    Arguments:
        shell: bash, zsh or fish.
        arguments: The words behind the program's name; bash gives its line by COMP_LINE and COMP_POINT.
        environment: Of the process.
        root: The program's command.
    """
    if shell != "bash":
        found = answer_of(arguments, root)
        return [found.kind, *(f"{value}\t{words}" for value, words in _printable(found.items))]
    line = environment.get("COMP_LINE", "")
    point = environment.get("COMP_POINT", "")
    words, quoted = words_of_line(line, int(point) if point.isdecimal() else len(line))
    found = answer_of(words[1:] or [""], root)
    values = [value for value, _ in _printable(found.items)]
    kind = (
        "open" if found.kind == WORDS and values and all(value.endswith(OPEN_ENDS) for value in values) else found.kind
    )
    # within quotes bash takes no words apart, and reads what it is given as it is
    cut = 0 if quoted else 1 + max(words[-1].rfind(mark) for mark in BASH_BREAKS)
    values = [value[cut:] for value in values]
    return [kind, *(values if kind == PATHS or quoted else map(_bash_quoted, values))]


def _printable(items: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Candidates that fit on a line; what they are on one."""
    return [(value, " ".join(words.split())) for value, words in items if value.isprintable()]


def _bash_quoted(value: str) -> str:
    return "".join(f"\\{character}" if character in BASH_QUOTED else character for character in value)


def print_response(shell: str, root: Any) -> None:
    """Answer a shell that asks by its script; what plugins print meanwhile goes nowhere."""
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        output, sys.stdout = sys.stdout, nowhere
        try:
            lines = respond(shell, sys.argv[1:], os.environ, root)
        finally:
            sys.stdout = output
    print("\n".join(lines))
