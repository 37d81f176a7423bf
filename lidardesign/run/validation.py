"""From pydantic's errors to messages that name file, line and column, what was found and what is allowed."""

from __future__ import annotations

import difflib
import os
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lidardesign.errors import ConfigError
from lidardesign.run.kinds import nested_model, parts, wrong_kinds
from lidardesign.run.yaml import KeyPath

Model = TypeVar("Model", bound=BaseModel)


class Locate(typing.Protocol):
    """Where a value or its key stands, as `Document.locate`."""

    def __call__(self, path: KeyPath, *, key: bool = False) -> str:
        """The position, for messages."""
        ...


def check_model(model: type[Model], values: Any, locate: typing.Callable[[KeyPath], str], section: str = "") -> Model:
    """Validate values with a pydantic model; the first error becomes a ConfigError at its position.

    Arguments:
        model: The section's model.
        values: Plain values.
        locate: Where the value, or with `key=True` the key, of a path (section in front) came from.
        section: Name of the section in messages.
    """
    try:
        checked = model.model_validate(values)
    except ValidationError as error:
        raise _explain(model, values, error, locate, section) from None
    for path, value in wrong_kinds(model, values):
        path = (section, *path) if section else path
        name, allowed = ".".join(map(str, path)), "a number, without quotes"
        raise ConfigError(f"{name}: found {_short(value)}", where=locate(path), allowed=allowed)
    return checked


def anchor_paths(values: Any, given: Any, model: type[BaseModel], base: Path) -> None:
    """Make the relative paths among the given values absolute, where the model says that they are paths."""
    if not isinstance(values, dict) or not isinstance(given, dict):
        return
    for name, value in given.items():
        info = model.model_fields.get(name) if isinstance(name, str) else None
        if info is None or name not in values:
            continue
        nested = nested_model(info.annotation)
        if isinstance(value, dict) and nested:
            anchor_paths(values[name], value, nested, base)
        elif _holds_path(info.annotation):
            values[name] = _absolute(values[name], base)


def _absolute(value: Any, base: Path) -> Any:
    if isinstance(value, str) and value:
        return os.path.abspath(base / Path(value).expanduser())
    if isinstance(value, list):
        return [_absolute(item, base) for item in value]
    return value


def _holds_path(annotation: Any) -> bool:
    return any(isinstance(part, type) and issubclass(part, Path) for part in parts(annotation))


def _explain(
    model: type[BaseModel],
    values: Any,
    error: ValidationError,
    locate: Locate,
    section: str,
) -> ConfigError:
    """The ConfigError of a pydantic error: unknown keys first, since they often explain the others."""
    details = sorted(error.errors(), key=lambda detail: detail["type"] != "extra_forbidden")
    detail = details[0]
    path = _real_path(detail["loc"], values)
    prefix = (section,) if section else ()
    name = ".".join(map(str, (*prefix, *path))) or section or model.__name__
    where = locate((*prefix, *path), key=detail["type"] == "extra_forbidden")
    if detail["type"] == "extra_forbidden":
        allowed = _fields_at(model, path[:-1])
        hint = suggest(str(path[-1]), allowed) or _elsewhere(model, str(path[-1]))
        return ConfigError(f"unknown key {name!r}", where=where, allowed=", ".join(allowed), hint=hint)
    if detail["type"] == "missing":
        if isinstance(detail["loc"][-1], int):
            length = 1 + max(other["loc"][-1] for other in details if other["loc"][:-1] == detail["loc"][:-1])
            found = _short(detail["input"])
            return ConfigError(f"{name}: found {found}", where=where, allowed=f"a list of {length} values")
        return ConfigError(f"{name} is missing", where=where, hint=f"--set {name.removeprefix('task.')}=VALUE")
    text = detail["msg"].removeprefix("Value error, ")
    found = "" if detail["type"] == "value_error" and not path else f": found {_short(detail['input'])}"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 and not _is_union(detail["loc"], path) else ""
    if detail["type"] in ("value_error", "assertion_error"):
        return ConfigError(f"{name}: {text}{found if path else ''}{more}", where=where)
    return ConfigError(f"{name}{found}{more}", where=where, allowed=_allowed(detail["type"], text))


def _allowed(kind: str, text: str) -> str:
    """What pydantic would have taken, in the words of YAML."""
    if kind == "model_type":
        return "keys and values, as `{key: value}`"
    return _lower(text.removeprefix("Input should be "))


def _real_path(location: tuple[Any, ...], values: Any) -> KeyPath:
    """The part of a pydantic location that is in the values (it also names the members of unions)."""
    path: list[str | int] = []
    for index, key in enumerate(location):
        last = index == len(location) - 1
        inside = isinstance(values, Mapping) and key in values
        inside = inside or (isinstance(values, list | tuple) and isinstance(key, int) and key < len(values))
        if inside:
            path.append(key)
            values = values[key]
        elif last and isinstance(values, Mapping):
            path.append(key)
    return tuple(path)


def _is_union(location: tuple[Any, ...], path: KeyPath) -> bool:
    return len(location) != len(path)


def _fields_at(model: type[BaseModel], path: KeyPath) -> list[str]:
    for key in path:
        info = model.model_fields.get(str(key))
        nested = nested_model(info.annotation) if info else None
        model = nested or model
    return list(model.model_fields)


def suggest(key: str, allowed: Iterable[str]) -> str | None:
    """A hint at the allowed name that an unknown one is most like, if any is."""
    close = difflib.get_close_matches(key, list(allowed), n=1)
    return f"did you mean {close[0]!r}?" if close else None


def _elsewhere(model: type[BaseModel], key: str) -> str | None:
    """A hint at the section of a model that has a key which was given outside of it, if one has."""
    sections = {name: nested_model(info.annotation) for name, info in model.model_fields.items()}
    found = [f"{name}.{key}" for name, nested in sections.items() if nested and key in nested.model_fields]
    return f"did you mean {found[0]!r}?" if found else None


def _short(value: Any, limit: int = 60) -> str:
    text = repr(value)
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
