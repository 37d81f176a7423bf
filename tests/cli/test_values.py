"""Values that nobody writes on purpose: nothing behind an option, and text that only Python takes for a number."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from support.command_line import make_run
from support.mistakes import check_one_clear_message

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


@pytest.mark.parametrize(("command", "option"), PARAMETERS)
def test_no_option_and_no_argument_may_be_empty(command, option):
    for value in ("", " ", "\t\n"):
        for given in ([value],) if option is None else ([option, value], [f"{option}={value}"]):
            with pytest.raises(ConfigError, match="is empty") as caught:
                command.make_context(command.name, given)
            assert option in (None, caught.value.where)


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


@pytest.mark.parametrize(("command", "option"), NUMBERS, ids=" ".join)
def test_numbers_are_decimal_digits_as_in_files(lidardesign, command, option):
    if not Path("run").exists():
        make_run(Path("run"), count=1000)
    first = NUMBERS.index((command, option))
    for text in (WRITTEN[(4 * first + step) % len(WRITTEN)] for step in range(4)):
        value = AROUND.get(option, "{}").format(text)
        result = lidardesign(*command.split(), *FIRST[command], f"{option}={value}", "--json")
        check_one_clear_message(result, 2, option.partition("=")[0])
    assert not Path("runs").exists()


HEADER = (
    "sensor,origin_x_m,origin_y_m,origin_z_m,direction_x,direction_y,direction_z,azimuth_rad,elevation_rad,"
    "gate_start_m,gate_end_m,time_s"
)
RAY = {"sensor": "0", "direction_x": "1", "gate_start_m": "0.2", "gate_end_m": "0.4"}
RAYS = [
    ({"sensor": "-1"}, "sensor is '-1'"),
    ({"sensor": "1e18"}, "sensor is '1e18'"),
    ({"sensor": "0.5"}, "a whole number from 0 to 999999, or a name"),
    ({"gate_end_m": "0.2"}, "an end beyond the start"),
    ({"gate_start_m": "0", "gate_end_m": "0"}, "an end beyond the start"),
    ({"gate_end_m": "1e18"}, "1e+18 m"),
    ({"azimuth_rad": "3.1_4"}, "a finite number"),
    ({"azimuth_rad": "３.14"}, "a finite number"),
    ({"azimuth_rad": ""}, "a finite number"),
    *(
        ({name: text}, "a finite number")
        for name, text in (("gate_end_m", "inf"), ("time_s", "nan"), ("direction_x", "nan"))
    ),
    ({"origin_x_m": "1e300"}, "1e+300"),
]


@pytest.mark.parametrize(("changed", "words"), RAYS)
def test_a_ray_whose_numbers_mean_nothing_is_refused(lidardesign, changed, words):
    row = [{**RAY, **changed}.get(name, "0") for name in HEADER.split(",")]
    Path("rays.csv").write_text(f"{HEADER}\n{','.join(row)}\n", encoding="utf-8")
    check_one_clear_message(lidardesign("show", "rays.csv", "--json"), 3, words)
