"""The manual page behind `--help`: what a command reads and writes, examples, exit codes, where to read on."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import typer
from typer.core import TyperCommand

WIDEST = 100
DOCS = "docs/"


@dataclass(frozen=True)
class Manual:
    """What `--help` says below the options.

    Arguments:
        examples: Command lines that work, and what each is for.
        about: What should be known before, in sentences.
        files: What is read and written, one line each.
        exits: Exit codes beside those that every command has.
        see: Pages of the documentation.
    """

    examples: Mapping[str, str]
    about: str = ""
    files: Sequence[str] = ()
    exits: Mapping[int, str] | None = None
    see: Sequence[str] = ()


COMMON_EXITS = {0: "done", 2: "wrong usage or configuration", 3: "bad input data"}
FROM_A_RUN = {4: "constraints that no design satisfies", 5: "a numerical failure", 6: "the task's plugin failed"}


class ManualCommand(TyperCommand):
    """A command whose help ends with its manual."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help of the options, then the manual."""
        super().format_help(ctx, formatter)
        manual = MANUALS.get(" ".join(ctx.command_path.split()[1:]))
        if manual is not None:
            print(manual_text(manual, min(WIDEST, shutil.get_terminal_size().columns)))


MANUALS: dict[str, Manual] = {}


def add_manuals(groups: Mapping[str, typer.Typer], pages: Mapping[str, Manual]) -> None:
    """Give every command of the program its manual.

    Arguments:
        groups: The program, by "", and its groups of commands by name.
        pages: Manuals by the words of the command.
    """
    for group, application in groups.items():
        for information in application.registered_commands:
            own = information.name or str(getattr(information.callback, "__name__", "")).strip("_").replace("_", "-")
            path = f"{group} {own}".strip()
            if path in pages:
                MANUALS[path], information.cls = pages[path], ManualCommand


def manual_text(manual: Manual, width: int) -> str:
    """The manual as text; examples stay on one line, so that they can be copied.

    Arguments:
        manual: What to say.
        width: Columns of the terminal.
    """
    sections: list[tuple[str, list[str]]] = []
    if manual.about:
        sections.append(("About", _wrapped(manual.about, width)))
    if manual.files:
        sections.append(("Files", [line for entry in manual.files for line in _wrapped(entry, width)]))
    if manual.examples:
        sections.append(("Examples", _example_lines(manual.examples, width)))
    codes = {**COMMON_EXITS, **(manual.exits or {})}
    exits = "; ".join(f"{code} {words}" for code, words in sorted(codes.items()))
    sections.append(("Exit codes", _wrapped(exits, width)))
    if manual.see:
        sections.append(("See", [f"   {', '.join(DOCS + page for page in manual.see)}"]))
    return "\n".join(line for title, lines in sections for line in (f" {title}", *lines, ""))


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(
        text, width - 1, initial_indent="   ", subsequent_indent="     ", break_long_words=False, break_on_hyphens=False
    )


def _example_lines(examples: Mapping[str, str], width: int) -> list[str]:
    lines = []
    for example, words in examples.items():
        lines.append(f"   {example}")
        lines += textwrap.wrap(words, width - 1, initial_indent=" " * 7, subsequent_indent=" " * 7)
    return lines
