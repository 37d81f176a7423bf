"""Values that nobody writes on purpose: nothing behind an option, and text that only Python takes for a number."""

from __future__ import annotations

import pytest
import typer

from lidardesign.cli.main import app
from lidardesign.errors import ConfigError


def commands(group):
    """Every command of the program."""
    for command in group.commands.values():
        yield from commands(command) if hasattr(command, "commands") else [command]


NUMERIC = (int, float, list[int])
PARAMETERS = [
    (command, parameter)
    for command in commands(typer.main.get_command(app))
    for parameter in command.params
    if not getattr(parameter, "is_flag", False)
]
NUMBERS = [(command, one) for command, one in PARAMETERS if one.type_descriptor.annotation in NUMERIC]
WRITTEN = ("1_0", "nan", "inf", "-inf", "0x10", "1e400", "1:30", "yes", "true", "１０", "٣", "1,5", "null", "1e", "--1")


@pytest.mark.parametrize(("command", "parameter"), PARAMETERS)
def test_no_option_and_no_argument_may_be_empty(command, parameter):
    option = parameter.opts[0] if parameter.param_type_name == "option" else None
    for value in ("", " ", "\t\n"):
        for given in ([value],) if option is None else ([option, value], [f"{option}={value}"]):
            with pytest.raises(ConfigError, match="is empty") as caught:
                command.make_context(command.name, given)
            assert option in (None, caught.value.where)


@pytest.mark.parametrize(("command", "parameter"), NUMBERS)
def test_numbers_are_decimal_digits_as_in_files(command, parameter):
    needed = [one for one in command.params if one.required]
    first = [word for one in needed for word in ([*one.opts, "x"] if one.param_type_name == "option" else ["x"])]
    for text in WRITTEN:
        with pytest.raises((ConfigError, typer.BadParameter)) as refused:
            command.make_context(command.name, [*first, f"{parameter.opts[0]}={text}"])
        where = refused.value.where if isinstance(refused.value, ConfigError) else refused.value.param.opts[0]
        assert where == parameter.opts[0]
