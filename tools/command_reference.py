"""Write docs/commands.md from the program itself, or say whether it is up to date.

python tools/command_reference.py           # writes it
python tools/command_reference.py --check   # exit 1 where it would be another
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from lidardesign.cli.main import app
from lidardesign.cli.manual import COMMON_EXITS, DOCS, MANUALS, Manual

PAGE = Path(__file__).parents[1] / "docs" / "commands.md"
HEAD = """\
# Commands

Written by `tools/command_reference.py` from the program: what `lidardesign COMMAND --help` says, on one page. How they
behave in a shell, and all exit codes: [shell.md](shell.md).
"""
# Every command has these; they are described once.
COMMON = ("--seed", "--json", "--quiet", "--debug", "--help")
COMMON_HEAD = "## Options of every command"


def reference() -> str:
    """The page."""
    root = typer.main.get_command(app)
    commands = list(_commands(root))
    lines = [HEAD, "| command | what it does |", "|---|---|"]
    lines += [f"| [`{path}`](#{_anchor(path)}) | {_first_line(command)} |" for path, command in commands]
    lines += ["", COMMON_HEAD, "", *_option_table(_common_options(commands[0][1]))]
    for path, command in commands:
        lines += ["", *_section(path, command)]
    return "\n".join(lines) + "\n"


def _commands(root: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for name, command in root.commands.items():
        if command.hidden:
            continue
        if hasattr(command, "commands"):
            yield from _commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


def _section(path: str, command: Any) -> Iterator[str]:
    manual = MANUALS.get(path, Manual({}))
    yield f"## {path}"
    yield ""
    yield _plain(inspect.cleandoc(command.help or "").partition("\f")[0])
    if manual.about:
        yield f"\n{manual.about}"
    yield f"\n```text\nlidardesign {path} {_usage(command)}\n```\n"
    own = [one for one in command.params if _name(one) not in COMMON]
    yield from _option_table(own)
    if manual.files:
        yield ""
        yield from (f"- {entry}" for entry in manual.files)
    if manual.examples:
        yield ""
        yield "```sh"
        yield from (line for example, words in manual.examples.items() for line in _example(example, words))
        yield "```"
    codes = {**COMMON_EXITS, **(manual.exits or {})}
    yield ""
    yield f"Exit codes: {'; '.join(f'{code} {words}' for code, words in sorted(codes.items()))}."
    if manual.see:
        yield f"See {', '.join(f'[{page}]({page})' for page in manual.see)}."


def _example(example: str, words: str) -> list[str]:
    return [f"# {words}", example] if words else [example]


def _usage(command: Any) -> str:
    arguments = [_argument(one) for one in command.params if one.param_type_name == "argument"]
    return " ".join([*arguments, "[OPTIONS]"])


def _argument(parameter: Any) -> str:
    name = f"{parameter.metavar}..." if parameter.nargs == -1 else str(parameter.metavar)
    return name if parameter.required else f"[{name}]"


def _option_table(parameters: list[Any]) -> Iterator[str]:
    yield "| | |"
    yield "|---|---|"
    for one in parameters:
        yield f"| {_shown(one)} | {_described(one)} |"


def _shown(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{_cell(_argument(parameter))}`"
    value = "" if parameter.is_flag or parameter.metavar is None else f" {parameter.metavar}"
    return ", ".join(f"`{name}{_cell(value)}`" for name in parameter.opts)


def _described(parameter: Any) -> str:
    text = _cell(" ".join((parameter.help or "").split()))
    default = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
    if parameter.required or default in (None, False) or parameter.show_default is False:
        return text
    return f"{text} Default: {_cell(str(default))}."


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def _common_options(command: Any) -> list[Any]:
    return [one for one in command.params if _name(one) in COMMON]


def _name(parameter: Any) -> str:
    return next((name for name in parameter.opts if name.startswith("--")), parameter.opts[0])


def _first_line(command: Any) -> str:
    return _cell(" ".join(inspect.cleandoc(command.help or "").partition("\n\n")[0].split()))


def _plain(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def _anchor(path: str) -> str:
    return path.replace(" ", "-")


def main() -> int:
    """Write the page, or compare it; the exit code."""
    text = reference()
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text, encoding="utf-8")
        return 0
    if PAGE.read_text(encoding="utf-8") == text:
        return 0
    print(f"{DOCS}{PAGE.name} is not what the program says: python tools/command_reference.py", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
