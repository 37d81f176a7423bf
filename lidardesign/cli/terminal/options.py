"""Commands of the command line from the tables of `choices`, and values for shell completion.

Files are completed by the shell.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_origin

import typer
from typer.core import TyperCommand

from lidardesign.choices.flag import Flag, flags_of
from lidardesign.cli.terminal.output import command
from lidardesign.errors import UNSET_HINT, ConfigError

if TYPE_CHECKING:
    from pydantic import BaseModel

PACKAGE = Path(__file__).parents[2]
MOST_SHOWN = 10**9  # larger limits of whole numbers mean nothing to people


def tasks() -> list[str]:
    """Installed tasks; none of them is imported."""
    return _plugins("lidardesign.tasks")


def formats() -> list[str]:
    """Installed formats of exports; none of them is imported."""
    return _plugins("lidardesign.formats")


def _plugins(group: str) -> list[str]:
    from importlib.metadata import entry_points

    return sorted({entry.name for entry in entry_points(group=group)})


def methods() -> list[str]:
    """Installed methods; none of them is imported."""
    return _plugins("lidardesign.methods")


def parts() -> list[str]:
    """Parts of the catalogue."""
    return sorted(path.stem for path in (PACKAGE / "parts" / "files").glob("*.yaml"))


def detectors() -> list[str]:
    """Detectors that are shipped."""
    return sorted({"ideal", *(path.stem for path in (PACKAGE / "simulate" / "detector" / "presets").glob("*.yaml"))})


def configuration_keys(context: typer.Context) -> list[tuple[str, str]]:
    """Keys of the configuration of the task that is on the command line."""
    from lidardesign.config import DensitySettings, LearningSettings
    from lidardesign.task import load_task

    # typer leaves arguments in args while the last option waits for its value
    name = context.params.get("task") or context.params.get("name") or context.args[0]
    sections = {"": load_task(name).Config, "density.": DensitySettings, "learning.": LearningSettings}
    return [item for prefix, model in sections.items() for item in _keys(model, prefix)]


def constraint_keys() -> list[tuple[str, str]]:
    """Keys of constraints."""
    from lidardesign.constraints.document import Constraints

    return list(_keys(Constraints, ""))


def _keys(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str]]:
    """The dotted keys of a model, each with =, and their descriptions."""
    from lidardesign.run.validation import nested_model

    for name, info in model.model_fields.items():
        nested = nested_model(info.annotation)
        if nested is not None and get_origin(info.annotation) is not list:
            yield from _keys(nested, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}=", info.description or ""


def typer_option(flag: Flag, **more: Any) -> Any:
    """The type of a parameter that typer reads a flag from."""
    kind: Any = list[flag.kind] | None if flag.is_repeated else flag.kind | None  # type: ignore[name-defined]
    if isinstance(flag.default, bool):
        kind = bool
    offered = (lambda: list(flag.words)) if flag.words else globals()[flag.offers] if flag.offers else None
    limits = f" {flag.low:,} to {flag.high:,}." if flag.kind is int and 1 < (flag.high or 0) <= MOST_SHOWN else ""
    shown = flag.shown or (isinstance(flag.default, str | float | int) and not isinstance(flag.default, bool))
    return Annotated[
        kind,
        typer.Option(
            *flag.names.split(),
            metavar=flag.metavar or "|".join(flag.words) or None,
            help=flag.help + limits,
            show_default=shown,
            autocompletion=offered,
            readable=False,
            **more,
        ),
    ]


def command_line(*tables: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command: it has the options of tables, of which the first that has a key counts.

    The command takes its `output`, its arguments, and the options that are given.
    """
    flags = {key: flag for table in reversed(tables) for key, flag in flags_of(table).items()}
    order = dict.fromkeys(key for table in tables for key in flags_of(table))

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(function, eval_str=True)
        plain = inspect.Parameter.POSITIONAL_OR_KEYWORD
        parameters = [one for one in signature.parameters.values() if one.kind is plain and one.name != "output"]
        for key in order:
            default = inspect.Parameter.empty if flags[key].is_required else flags[key].default or None
            kind = inspect.Parameter.KEYWORD_ONLY
            parameters.append(inspect.Parameter(key, kind, default=default, annotation=typer_option(flags[key])))

        @functools.wraps(function)
        def called(**values: Any) -> None:
            given = {key: value for key, value in values.items() if value is not None}
            printed = {key: given.pop(key, False) for key in ("json", "quiet", "verbose")}
            with command(**printed) as output:
                for key, value in given.items():
                    if key in flags:
                        flags[key].check(value)
                function(output, **given)

        called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in parameters}
        return called

    return decorate


class StrictCommand(TyperCommand):
    """A command that refuses option values that are likely typing errors."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; values that are empty or -, and numbers such as `1_0`, are refused.

        Raises:
            ConfigError: At the option or argument.
        """
        given = {} if ctx.resilient_parsing else self.make_parser(ctx).parse_args(args=list(args))[0]
        texts = [(parameter, text) for parameter in self.get_params(ctx) for text in _texts(given.get(parameter.name))]
        for parameter, text in texts:
            if not text.strip():
                raise ConfigError("is empty", where=_name(parameter), allowed="a value", hint=UNSET_HINT)
            if text == "-":
                raise ConfigError(
                    "'-' is not a value", where=_name(parameter), hint="give the name of a file; /dev/stdout is one"
                )
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


def _texts(given: Any) -> list[str]:
    """The values of a parameter that are texts of the command line, as a list."""
    return [text for text in (given if isinstance(given, list | tuple) else [given]) if isinstance(text, str)]


def _name(parameter: Any) -> str:
    """The name of a parameter on the command line."""
    return parameter.opts[0] if parameter.param_type_name == "option" else parameter.metavar or parameter.name
