"""What `--help` prints: options in groups, then the manual, as plain text that fits a terminal of 80 columns."""

from __future__ import annotations

import inspect
import os
import re
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from lidardesign.cli.manual import COMMON_EXITS, MANUALS, Manual
from lidardesign.errors import UNSET_HINT, ConfigError, page

WIDEST = 100
# Terms up to this width have their explanation beside them, longer ones below.
TERM_WIDTH = 22
OPTION_GAP = re.compile(r"(?<=\s)(--[a-z-]+) (?=[^-])")
OPTIONS, FURTHER, COMMON = "Options", "Further options", "Common options"
COMMON_OPTIONS = ("--seed", "--json", "--verbose", "--quiet", "--debug", "--help")
# What few need, of all commands.
FURTHER_OPTIONS = frozenset(
    (
        "--accuracy", "--arrange", "--at", "--channels", "--cma-seconds", "--device", "--effects", "--false-alarm",
        "--gates", "--level", "--mount-error", "--outlier-mm", "--range-tolerance-mm", "--rate-hz",
        "--return-tolerance", "--scenes-seed", "--seconds", "--weight", "--within-deg", "--workers",
    )
)  # fmt: skip


def group_of(parameter: Any) -> str:
    """The heading that an option is explained under."""
    if FURTHER_OPTIONS.intersection(parameter.opts):
        return FURTHER
    return COMMON if set(COMMON_OPTIONS).intersection(parameter.opts) else OPTIONS


class ManualCommand(TyperCommand):
    """A command whose help ends with its manual, and that takes no values which nobody writes on purpose."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; a value that is empty, or `1_0` where a number is asked for, is a mistake.

        Raises:
            ConfigError: At the option or argument.
        """
        rest = list(args)
        given = {} if ctx.resilient_parsing else self.make_parser(ctx).parse_args(args=rest)[0]
        texts = [(parameter, text) for parameter in self.get_params(ctx) for text in _texts(given.get(parameter.name))]
        for parameter, text in texts:
            if not text.strip():
                raise ConfigError("is empty", where=_name(parameter), allowed="a value", hint=UNSET_HINT)
        left = super().parse_args(ctx, args)
        from lidardesign.run.yaml import plain_number

        for parameter, text in texts:
            value = ctx.params.get(parameter.name)
            values = value if isinstance(value, list | tuple) else [value]
            if all(isinstance(each, int | float) and not isinstance(each, bool) for each in values):
                try:
                    plain_number(text)
                except ValueError:
                    raise ConfigError(repr(text), where=_name(parameter), allowed="a finite number") from None
        return left

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the options, then the manual."""
        path = " ".join(ctx.command_path.split()[1:])
        formatter.write(_help_text(self, ctx, _manual_sections(MANUALS.get(path, Manual({})), formatter.width)))


class ManualGroup(TyperGroup):
    """A group of commands, each with what it does on a line."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the commands, then of the options."""
        named = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, one.get_short_help_str(WIDEST * WIDEST)) for name, one in named if one and not one.hidden]
        formatter.write(_help_text(self, ctx, {"Commands": _definitions(rows, formatter.width)}))


def _help_text(command: Any, ctx: Any, sections: dict[str, list[str]]) -> str:
    """The help of a command: how it is called, what it does, its parameters, and further sections."""
    width = ctx.make_formatter().width
    parameters = [one for one in command.get_params(ctx) if not getattr(one, "hidden", False)]
    arguments = [one for one in parameters if one.param_type_name == "argument"]
    offered = [one for one in parameters if one.param_type_name == "option"]
    usage = " ".join(
        [ctx.command_path, *map(_argument, arguments), "[OPTIONS]"] + ["COMMAND"] * ("Commands" in sections)
    )
    groups = {"Arguments": _definitions([(_argument(one), _explained(one)) for one in arguments], width)}
    column = _column(map(_option, offered))
    for heading in (OPTIONS, FURTHER, COMMON):
        rows = [(_option(one), _explained(one)) for one in offered if group_of(one) == heading]
        groups[heading] = _definitions(rows, width, column)
    about = textwrap.wrap(inspect.cleandoc(command.help or "").partition("\f")[0], width)
    first = {"Commands": sections.pop("Commands", [])}
    blocks = [[f"{_heading('Usage:')} {usage}"], about]
    blocks += [[_heading(f"{heading}:"), *lines] for heading, lines in {**first, **groups, **sections}.items() if lines]
    blocks += [textwrap.wrap(inspect.cleandoc(command.epilog), width)] if command.epilog else []
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def _manual_sections(manual: Manual, width: int) -> dict[str, list[str]]:
    """The manual by headings, so wide; longer examples go on behind a backslash, so that they can be copied."""
    codes = sorted({**COMMON_EXITS, **(manual.exits or {})}.items())
    return {
        "About": _wrapped(manual.about, width, 2),
        "Files": [line for entry in manual.files for line in _wrapped(entry, width, 2, 4)],
        "Examples": [
            line
            for example, words in manual.examples.items()
            for line in (*_continued(example, width), *_wrapped(words, width, 6))
        ],
        "Exit codes": _wrapped("; ".join(f"{code} {words}" for code, words in codes), width, 2),
        "See also": [*_wrapped(", ".join(manual.see), width, 2), f"  in {_docs_folder()}"] if manual.see else [],
    }


def _docs_folder() -> Path:
    """Where the documentation is, from the current folder where it is below it."""
    folder = page("commands.md").parent
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def _continued(example: str, width: int) -> list[str]:
    # options stay with their values
    *lines, last = _wrapped(OPTION_GAP.sub("\\1\0", example), width - 2, 2, 6)
    return [line.replace("\0", " ") for line in (*(f"{line} \\" for line in lines), last)]


def _column(terms: Iterable[str]) -> int:
    """Where explanations begin."""
    return max((len(term) for term in terms if len(term) <= TERM_WIDTH), default=TERM_WIDTH) + 4


def _definitions(rows: Sequence[tuple[str, str]], width: int, column: int | None = None) -> list[str]:
    """Terms and their explanations in two columns; below each other where a term is long."""
    first = _column(term for term, _ in rows) if column is None else column
    lines = []
    for term, words in rows:
        explained = _wrapped(words, width, first)
        if len(term) <= TERM_WIDTH and explained:
            lines += [f"  {term}".ljust(first) + explained[0].lstrip(), *explained[1:]]
        else:
            lines += [f"  {term}", *explained]
    return lines


def _wrapped(text: str, width: int, indent: int, further: int | None = None) -> list[str]:
    return textwrap.wrap(
        text,
        width,
        initial_indent=" " * indent,
        subsequent_indent=" " * (indent if further is None else further),
        break_long_words=False,
        break_on_hyphens=False,
    )


def _option(parameter: Any) -> str:
    """An option as it is written, short form first, with what its value is called."""
    names = ", ".join(sorted(parameter.opts, key=len))
    return names if parameter.is_flag else f"{names} {parameter.metavar}"


def _argument(parameter: Any) -> str:
    name = f"{parameter.metavar}..." if parameter.nargs == -1 else str(parameter.metavar)
    return name if parameter.required else f"[{name}]"


def _explained(parameter: Any) -> str:
    """What a parameter is, and its default where it has one."""
    words, shown, default = " ".join((parameter.help or "").split()), parameter.show_default, parameter.default
    text = shown if isinstance(shown, str) else default
    if parameter.required or shown is False or text in (None, False) or callable(text):
        return words
    return f"{words} [default: {text:g}]" if isinstance(text, float) else f"{words} [default: {text}]"


def _heading(text: str) -> str:
    """A heading, in colour on a terminal that has some, where they are not declined."""
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return typer.style(text, fg="green", bold=True)


def _texts(given: Any) -> list[str]:
    """What a command line gives for a parameter: nothing, one text, or several."""
    return [text for text in (given if isinstance(given, list | tuple) else [given]) if isinstance(text, str)]


def _name(parameter: Any) -> str:
    """A parameter as the command line calls it."""
    return parameter.opts[0] if parameter.param_type_name == "option" else parameter.metavar or parameter.name
