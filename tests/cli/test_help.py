"""`--help` of every command fits 80 columns, loses no word, and keeps what few need apart."""

from __future__ import annotations

import shlex

import pytest
import typer
from support.tables import each_row

from lidardesign.cli.help import COMMON_OPTIONS, FURTHER_OPTIONS
from lidardesign.cli.main import app
from lidardesign.cli.manual import MANUALS

ROOT = typer.main.get_command(app)
GROUPS = {name: command for name, command in ROOT.commands.items() if hasattr(command, "commands")}
COMMANDS = {
    **{name: command for name, command in ROOT.commands.items() if name not in GROUPS},
    **{f"{group} {name}": one for group, held in GROUPS.items() for name, one in held.commands.items()},
}
NARROW = 80


@pytest.fixture
def helped(lidardesign, monkeypatch):
    """What a command's help says, so wide."""

    def call(name, columns=NARROW):
        monkeypatch.setenv("COLUMNS", str(columns))
        return lidardesign(*name.split(), "--help").out

    return call


@each_row("name", ["", *GROUPS, *COMMANDS])
def test_help_fits_80_columns_and_nothing_is_cut(helped, name):
    shown = helped(name)
    assert max(map(len, shown.splitlines())) < NARROW
    assert "\N{HORIZONTAL ELLIPSIS}" not in shown
    assert "..." not in shown.replace("DESIGN...", "")


@each_row("name", list(COMMANDS))
def test_help_has_every_word_of_what_is_said_at_any_width(helped, name):
    words = " ".join(helped(name).replace("\\\n", "").split())
    assert words == " ".join(helped(name, 100).replace("\\\n", "").split())
    for parameter in COMMANDS[name].params:
        assert " ".join((parameter.help or "").split()) in words
        for option in parameter.opts if parameter.param_type_name == "option" else ():
            assert f" {option}" in words


@each_row("name", list(COMMANDS))
def test_examples_can_be_copied(helped, name):
    pasted = [shlex.split(line) for line in helped(name).replace("\\\n", "").splitlines() if "lidardesign" in line]
    for example in MANUALS[name].examples:
        assert shlex.split(example) in pasted


def sections(shown):
    """The lines below each heading."""
    found, heading = {}, ""
    for line in shown.splitlines():
        if line.endswith(":") and not line.startswith(" "):
            heading = line[:-1]
        found.setdefault(heading, []).append(line)
    return found


def offered(lines):
    """The options of definitions, by their long names."""
    terms = [line.split() for line in lines if line.startswith("  -")]
    return {next(word for word in term if word.startswith("--")) for term in terms}


@each_row("name", list(COMMANDS))
def test_options_that_few_need_come_after_the_others(helped, name):
    shown = sections(helped(name, 100))
    assert offered(shown.get("Options", [])).isdisjoint({*FURTHER_OPTIONS, *COMMON_OPTIONS})
    assert offered(shown.get("Further options", [])) <= FURTHER_OPTIONS
    assert offered(shown["Common options"]) <= set(COMMON_OPTIONS)
    named = [name for name in shown if name.endswith("ptions")]
    assert named == [name for name in ("Options", "Further options", "Common options") if name in shown]


def test_every_option_that_few_need_is_one_of_some_command():
    offered_by_any = {option for command in COMMANDS.values() for one in command.params for option in one.opts}
    assert offered_by_any >= FURTHER_OPTIONS
