"""Write docs/commands.md from the program itself, or say whether it is up to date.

python tools/command_reference.py           # writes it
python tools/command_reference.py --check   # exit 1 where it would be another
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from lidardesign.cli.main import app

PAGE = Path(__file__).parents[1] / "docs" / "commands.md"
HEAD = """\
# Commands

After this page you know what every command does, and which options it has. `lidardesign COMMAND --help` adds
examples; [in the shell](shell.md) is what holds for all commands.
`tools/command_reference.py` writes this page.
"""
# Most commands have these; they are described once.
COMMON = ("--seed", "--json", "--quiet", "--verbose", "--help")
COMMON_HEAD = "## Options of most commands"
# Groups whose commands are those of `tasks`, for other plugins.
OTHER_PLUGINS = ("formats", "methods")
OTHERS = """
## formats, methods

`list`, `show NAME` and `check NAME` are those of `tasks`, for [formats](formats.md) and [methods](baselines.md).
"""


def reference() -> str:
    """The page."""
    root = typer.main.get_command(app)
    commands = list(_commands(root))
    lines = [HEAD, COMMON_HEAD, "", *_option_list(_common_options(commands[0][1]))]
    described: dict[tuple[str, str], str] = {}
    for path, command in commands:
        lines += ["", *_section(path, command, described)]
    return "\n".join(lines) + "\n" + OTHERS


def _commands(root: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for name, command in root.commands.items():
        if command.hidden or name in OTHER_PLUGINS:
            continue
        if hasattr(command, "commands"):
            yield from _commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


def _section(path: str, command: Any, described: dict[tuple[str, str], str]) -> Iterator[str]:
    """A command; `described` has options of earlier commands, which are not described again."""
    yield f"## {path}"
    yield ""
    yield _plain(inspect.cleandoc(command.help or "").partition("\f")[0])
    yield f"\n```text\nlidardesign {path} {_usage(command)}\n```\n"
    own = [one for one in command.params if _name(one) not in COMMON]
    known = [one for one in own if (_shown(one), _described(one)) in described]
    if len(known) < len(own):
        yield from _option_list([one for one in own if one not in known])
    for earlier in dict.fromkeys(described[_shown(one), _described(one)] for one in known):
        same = [f"`{_name(one)}`" for one in known if described[_shown(one), _described(one)] == earlier]
        yield f"\nAs for `{earlier}`: {', '.join(same)}."
    described |= {(_shown(one), _described(one)): path for one in own if one not in known}


def _usage(command: Any) -> str:
    arguments = [_argument(one) for one in command.params if one.param_type_name == "argument"]
    return " ".join([*arguments, "[OPTIONS]"])


def _argument(parameter: Any) -> str:
    name = f"{parameter.metavar}..." if parameter.nargs == -1 else str(parameter.metavar)
    return name if parameter.required else f"[{name}]"


def _option_list(parameters: list[Any]) -> Iterator[str]:
    yield from (f"- {_shown(one)}: {_described(one)}" for one in parameters)


def _shown(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{_cell(_argument(parameter))}`"
    value = "" if parameter.is_flag or parameter.metavar is None else f" {parameter.metavar}"
    return ", ".join(f"`{name}{_cell(value)}`" for name in parameter.opts)


def _described(parameter: Any) -> str:
    text = _cell(_first_sentence(" ".join((parameter.help or "").split())))
    default = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
    if parameter.required or default in (None, False) or parameter.show_default is False:
        return text
    return f"{text} Default: {_cell(str(default))}."


def _first_sentence(text: str) -> str:
    return re.split(r"(?<=[a-z\d)])\. (?=[A-Z])", text)[0].removesuffix(".") + "." if text else ""


def _cell(text: str) -> str:
    return text.replace("<", "&lt;")


def _common_options(command: Any) -> list[Any]:
    return [one for one in command.params if _name(one) in COMMON]


def _name(parameter: Any) -> str:
    return next((name for name in parameter.opts if name.startswith("--")), parameter.opts[0])


def _plain(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def main() -> int:
    """Write the page, or compare it; the exit code."""
    text = reference()
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text, encoding="utf-8")
        return 0
    if PAGE.read_text(encoding="utf-8") == text:
        return 0
    print(f"docs/{PAGE.name} is not what the program says: python tools/command_reference.py", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
