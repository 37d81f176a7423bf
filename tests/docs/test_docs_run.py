"""Every command of the README and of the docs runs and prints what the page says."""

from __future__ import annotations

import shlex

import pytest
import typer
from support.docs_output import difference
from support.docs_pages import PAGES, ROOT, Block, Command, blocks_of, commands_of
from support.docs_session import COLUMNS, Library, Session, is_installed

from lidardesign.cli.main import app

# Blocks that no test runs, by page: installing, other machines, measurements on paper. Few, and each says why.
MOST_NOT_RUN = 26
KINDS = {"", "small", "not", "if"}


TABLE = """\
┏━━━━━━┳━━━━━━━━━━━┓
┃ rays ┃ value     ┃
┡━━━━━━╇━━━━━━━━━━━┩
│   36 │ 1.5 - 2.5 │
└──────┴───────────┘
wrote rays.csv (36 rays)
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return Library(tmp_path_factory.mktemp("learned"))


def all_blocks() -> list[Block]:
    return [block for page in PAGES for block in blocks_of(page)]


def named(page) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize(
    ("shown", "agrees"),
    [
        (TABLE, True),
        (TABLE.replace("36", "576").replace("1.5 - 2.5", "-10 - 1e-05"), True),  # any numbers
        (TABLE.replace("value", "score"), False),  # another column
        (TABLE.replace("rays.csv", "beams.csv"), False),
        (TABLE.replace("│   36 │ 1.5 - 2.5 │\n", ""), False),  # a row less
        (TABLE.replace("│   36 │ 1.5 - 2.5 │\n", "...\n"), True),
        ("...\nwrote rays.csv (36 rays)", True),
        ("wrote rays.csv (36 rays)", False),
        ("...\nwrote rays.csv", False),  # cut within a line
        (TABLE + "done", False),
        ("note: 3 rays are lost\n" + TABLE, True),
        ("note: 3 sensors are lost\n" + TABLE, False),
    ],
)
def test_an_output_agrees_where_all_but_numbers_is_the_same(shown, agrees):
    times = "where the time went\n│ other │ 0.1 │\n"
    found = difference(shown.splitlines(), TABLE + times, "note: 12 rays are lost\n", small=False)
    assert (found is None) == agrees


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_can_be_followed_in_an_empty_folder(page, tmp_path, monkeypatch, library):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    session = Session(tmp_path, library)
    for block in blocks_of(page):
        kind, reason = block.run
        if kind == "not" or (kind == "if" and not all(map(is_installed, shlex.split(reason.replace(",", " "))))):
            continue
        if block.language in ("console", "before"):
            session.console(block, commands_of(block))
        else:
            session.follow(block)


def test_what_is_not_run_says_why_and_is_little():
    left_out = []
    for block in all_blocks():
        kind, reason = block.run
        assert kind in KINDS, f"{block.where}: {kind}"
        assert kind != "not" or len(reason.split()) >= 3, f"{block.where}: says no reason"
        left_out += [block.where] if kind == "not" and block.language == "console" else []
    assert len(left_out) <= MOST_NOT_RUN, left_out


def test_only_the_pages_on_commands_have_some_that_are_parsed_and_not_run():
    assert {block.page.name for block in all_blocks() if block.language in ("sh", "bash", "shell")} <= {
        "commands.md",
        "shell.md",
    }


def program_commands() -> list[tuple[str, Command]]:
    return [
        (block.where, command)
        for block in all_blocks()
        if block.language in ("console", "sh") and 0 in block.exits
        for command in commands_of(block)
        if command.words[:1] == ["lidardesign"]
    ]


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_the_program_understands_every_command_of_a_page(page):
    root = typer.main.get_command(app)
    for where, command in program_commands():
        if not where.startswith(f"{named(page)}:"):
            continue
        words = command.words[1:]
        # what a shell does with the output is its own
        ends = [words.index(sign) for sign in ("|", ">", "<", "&&", "||") if sign in words]
        parse(root, words[: min(ends, default=len(words))], where)


def parse(command, words: list[str], where: str, parent=None) -> None:
    """Parse a command line as the program does, without doing anything."""
    while hasattr(command, "commands"):
        context = command.make_context(command.name, words, parent=parent)
        if not (context._protected_args or context.args):
            return  # a group that does something by itself
        name, *words = (*context._protected_args, *context.args)
        assert name in command.commands, f"{where}: there is no command {name!r}"
        command, parent = command.commands[name], context
    command.make_context(command.name, words, parent=parent)
