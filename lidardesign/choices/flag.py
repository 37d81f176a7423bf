"""A choice of users: its option, its meaning and its limits; and the Python functions that take tables of them."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar, cast

from lidardesign.errors import LidardesignError, check_choice, check_number, with_arguments

Choices = TypeVar("Choices")
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
# A docstring's line that stands for a table.
CHOICES = re.compile(r"^( *)choices: .*\n", re.MULTILINE)


@dataclass(frozen=True)
class Flag:
    """A choice: a key of a table, an option of commands, and an argument of functions.

    Arguments:
        names: The option as `--rays`, and a short form as in `--quiet -q`.
        metavar: What stands for its value in help; empty for a switch, or where `words` do.
        help: Its meaning.
        shown: The default that help shows, where `default` does not say it; empty for none.
        default: Its value where it is not given.
        kind: What a text of the command line is read as.
        low, high: Limits of a number, both allowed.
        words: What it may be, which a shell is offered.
        offers: What else a shell is offered: a function of `cli.terminal.options`.
        is_repeated: Whether it may be given several times.
        is_open: Whether it may be something else than `words`.
        is_required: Whether it has to be given.
    """

    names: str
    metavar: str
    help: str
    shown: str | None = None
    default: Any = None
    kind: type = str
    low: float | None = None
    high: float | None = None
    words: tuple[str, ...] = ()
    offers: str = ""
    is_repeated: bool = False
    is_open: bool = False
    is_required: bool = False

    @property
    def option(self) -> str:
        """The option without its short form."""
        return self.names.split()[0]

    def check(self, value: Any) -> None:
        """Refuse a value that is none of its words or outside of its limits.

        Raises:
            ConfigError: Such a value.
        """
        for each in value if self.is_repeated else (value,):
            if self.words and not self.is_open:
                check_choice(each, self.option, self.words)
            if self.low is not None:
                check_number(each, self.option, self.low, cast(float, self.high), whole=self.kind is int)


def flags_of(table: type) -> dict[str, Flag]:
    """The flags of a table by its keys; types of values are not looked up, since that would import them."""
    return {key: hint.__metadata__[0] for key, hint in table.__annotations__.items()}


def complete(table: type[Choices], given: Mapping[str, Any]) -> Choices:
    """All choices of a table: those that are given, within their limits, and the defaults of the others.

    Raises:
        ConfigError: One is out of its limits.
        TypeError: One is no key of the table.
    """
    flags = flags_of(table)
    if unknown := [key for key in given if key not in flags]:
        raise TypeError(f"{table.__name__} has no {unknown[0]!r}")
    chosen = {key: flag.default if given.get(key) is None else given[key] for key, flag in flags.items()}
    for key, flag in flags.items():
        if given.get(key) is not None:
            flag.check(chosen[key])
    return cast(Choices, chosen)


def takes(table: type) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Decorate a function of the Python interface that takes a table as `**choices`.

    Its signature and its help list the table's keys, and its errors name arguments instead of options.
    """

    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        flags, signature = flags_of(table), inspect.signature(function)
        own = [one for one in signature.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        keys = [
            inspect.Parameter(
                key, inspect.Parameter.KEYWORD_ONLY, default=flag.default, annotation=_type_of(table, key)
            )
            for key, flag in flags.items()
        ]
        whole = signature.replace(parameters=sorted([*keys, *own], key=lambda one: one.kind))

        @functools.wraps(function)
        def called(*arguments: Parameters.args, **given: Parameters.kwargs) -> Result:
            whole.bind(*arguments, **given)
            try:
                return function(*arguments, **given)
            except LidardesignError as error:
                error.name_arguments()
                raise

        lines = "".join(f"\\g<1>{key}: {with_arguments(flag.help)}\n" for key, flag in flags.items())
        called.__doc__ = CHOICES.sub(lines, function.__doc__ or "")
        called.__signature__ = whole  # type: ignore[attr-defined]
        return called

    return decorate


def _type_of(table: type, key: str) -> object:
    """The type of a key; as a text where it is of a module that is not imported."""
    found = table.__annotations__[key].__origin__
    return getattr(found, "__forward_arg__", found)
