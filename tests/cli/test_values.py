"""Values that nobody writes on purpose: nothing behind an option, and text that only Python takes for a number."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from support.command_line import make_run
from support.mistakes import check_one_clear_message
from support.tables import each_row

from lidardesign.cli.main import app
from lidardesign.errors import ConfigError


def commands(group):
    """Every command of the program."""
    for command in group.commands.values():
        yield from commands(command) if hasattr(command, "commands") else [command]


PARAMETERS = [
    (command, parameter.opts[0] if parameter.param_type_name == "option" else None)
    for command in commands(typer.main.get_command(app))
    for parameter in command.params
    if not getattr(parameter, "is_flag", False)
]


@each_row(("command", "option"), PARAMETERS)
def test_no_option_and_no_argument_may_be_empty(command, option):
    for value in ("", " ", "\t\n"):
        for given in ([value],) if option is None else ([option, value], [f"{option}={value}"]):
            with pytest.raises(ConfigError, match="is empty") as caught:
                command.make_context(command.name, given)
            assert option in (None, caught.value.where)


@each_row("line", ["learn", "constrain run --set", "evaluate run --csv", "export", "catalog show"])
def test_an_empty_value_is_one_clear_message(lidardesign, line):
    check_one_clear_message(lidardesign(*line.split(), "", "--json"), 2, "is empty")


WRITTEN = ("1_0", "nan", "inf", "-inf", "0x10", "1e400", "1:30", "yes", "true", "１０", "٣", "1,5", "null", "1e", "--1")
NUMBERS = [
    ("fit", "--rays"),
    ("fit", "--seed"),
    ("fit", "--level"),
    ("fit", "--channels"),
    ("fit", "--sensors"),
    ("fit", "--at=x_m"),
    ("learn", "--time-budget"),
    ("learn", "--tolerance"),
    ("learn", "--seed"),
    ("evaluate", "--rays"),
    ("evaluate", "--fail-above"),
    ("evaluate", "--cma-seconds"),
    ("evaluate", "--range-tolerance-mm"),
    ("evaluate", "--return-tolerance"),
    ("evaluate", "--scenes-seed"),
    ("evaluate", "--workers"),
    ("evaluate", "--mount-error"),
    ("export", "--rate-hz"),
    ("catalog show", "--azimuth-deg"),
    ("catalog show", "--at-origin"),
    ("catalog show", "--parts"),
    ("catalog list", "--klux"),
    ("tasks check", "--seconds"),
]
FIRST = {
    "fit": ["run"],
    "learn": ["flatland"],
    "evaluate": ["run"],
    "export": ["run"],
    "catalog show": ["vl53l8cx", "--out", "part.yaml"],
    "catalog list": [],
    "tasks check": ["flatland"],
}
# What stands around a number in options that hold more than one
AROUND = {"--mount-error": "{}mm", "--at-origin": "0,0,{}", "--at=x_m": "{}"}


@each_row(("command", "option"), NUMBERS, ids=" ".join)
def test_numbers_are_decimal_digits_as_in_files(lidardesign, command, option):
    if not Path("run").exists():
        make_run(Path("run"), count=1000)
    first = NUMBERS.index((command, option))
    for text in (WRITTEN[(4 * first + step) % len(WRITTEN)] for step in range(4)):
        value = AROUND.get(option, "{}").format(text)
        result = lidardesign(*command.split(), *FIRST[command], f"{option}={value}", "--json")
        check_one_clear_message(result, 2, option.partition("=")[0])
    assert not Path("runs").exists()
