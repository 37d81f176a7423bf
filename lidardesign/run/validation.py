"""Validation of values of files and of `--set KEY=VALUE`: errors have the place, the value and the allowed values.

Booleans and quoted text are no numbers, and names hold no control characters.
"""

from __future__ import annotations

import difflib
import itertools
import os
import typing
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lidardesign.errors import UNSET_HINT, ConfigError
from lidardesign.run.yaml import MAX_DEPTH, KeyPath, parse_yaml, resolve_scalar

LIKE_TEXT = (str, bytes, Path)
Model = TypeVar("Model", bound=BaseModel)


def placed_at(where: str) -> Callable[..., str]:
    """The position of every key path of a document that is no file: its name."""
    return lambda path, key=False: where


def is_name(value: Any) -> bool:
    """True for text that is not blank and has no control characters."""
    shown = isinstance(value, str) and bool(value.strip())
    return shown and not any(unicodedata.category(letter) == "Cc" for letter in value)


def parts(annotation: Any) -> list[Any]:
    """The types inside unions, lists, tuples and annotated forms of an annotation, or itself."""
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, UnionType, list, tuple, typing.Annotated):
        return [part for argument in typing.get_args(annotation) for part in parts(argument)]
    return [annotation] if origin in (None, typing.Literal) else []


def nested_model(annotation: Any) -> type[BaseModel] | None:
    """The first pydantic model that an annotation admits; None without one."""
    models = [part for part in parts(annotation) if isinstance(part, type) and issubclass(part, BaseModel)]
    return models[0] if models else None


def scalars(model: type[BaseModel], values: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any, list[Any]]]:
    """Path, value, and types that a model admits there, of every scalar among the values of its keys."""
    if not isinstance(values, dict):
        return
    for name, value in values.items():
        info = model.model_fields.get(name) if isinstance(name, str) else None
        if info is None:
            continue
        nested = nested_model(info.annotation)
        if nested is not None and isinstance(value, dict):
            yield from scalars(nested, value, (*path, name))
        else:
            yield from _items(value, parts(info.annotation), (*path, name))


def _items(value: Any, admitted: list[Any], path: KeyPath) -> Iterator[tuple[KeyPath, Any, list[Any]]]:
    if not isinstance(value, list | tuple):
        yield path, value, admitted
        return
    for index, item in enumerate(value):
        yield from _items(item, admitted, (*path, index))


def _is_no_number(value: Any, admitted: list[Any]) -> bool:
    """True for a boolean or text where a model has numbers."""
    if not {int, float} & {part for part in admitted if isinstance(part, type)}:
        return False
    words = any(typing.get_origin(part) is typing.Literal or part in LIKE_TEXT for part in admitted)
    return (isinstance(value, bool) and bool not in admitted) or (isinstance(value, str) and not words)


def check_model(model: type[Model], values: Any, locate: Callable[..., str], section: str = "") -> Model:
    """Validate values with a pydantic model; the first error becomes a ConfigError at its position.

    Arguments:
        model: The section's model.
        values: Plain values.
        locate: The position of the value, or with `key=True` of the key, of a path (section in front).
        section: Name of the section in messages.
    """
    try:
        checked = model.model_validate(values)
    except ValidationError as error:
        raise _explain(model, values, error, locate, section) from None
    for path, value, admitted in scalars(model, values):
        if _is_no_number(value, admitted):
            path = (section, *path) if section else path
            name, allowed = ".".join(map(str, path)), "a number, without quotes"
            raise ConfigError(f"{name}: found {_short(value)}", where=locate(path), allowed=allowed)
    return checked


def keep_texts(values: dict[str, Any], model: type[BaseModel], texts: Mapping[KeyPath, str], base: Path) -> None:
    """Make values of keys for text the text that was written, and of keys for paths absolute paths; in place.

    Arguments:
        values: Plain values of a model's keys.
        model: The model.
        texts: What was written, by path, where YAML reads something else in it, such as a boolean or a number.
        base: The folder of relative paths.
    """
    for path, value, admitted in list(scalars(model, values)):
        kinds = {part for part in admitted if isinstance(part, type)}
        is_text = kinds & {*LIKE_TEXT} and not kinds & {bool, int, float, type(value)}
        text = texts.get(path, value) if is_text else value
        words = [
            word for part in admitted if typing.get_origin(part) is typing.Literal for word in typing.get_args(part)
        ]
        if any(issubclass(kind, Path) for kind in kinds) and isinstance(text, str) and text and text not in words:
            text = os.path.abspath(base / os.path.expanduser(text))
        apply_override(values, Override(path, text, ""))


def _explain(
    model: type[BaseModel],
    values: Any,
    error: ValidationError,
    locate: Callable[..., str],
    section: str,
) -> ConfigError:
    """The ConfigError of a pydantic error; unknown keys come first, since they often explain the others."""
    details = sorted(error.errors(), key=lambda detail: detail["type"] != "extra_forbidden")
    detail = details[0]
    path = _real_path(detail["loc"], values)
    prefix = (section,) if section else ()
    name = ".".join(map(str, (*prefix, *path))) or section
    where = locate((*prefix, *path), key=detail["type"] == "extra_forbidden")
    if detail["type"] == "extra_forbidden":
        allowed = _fields_at(model, path[:-1])
        return ConfigError(
            f"unknown key {name!r}",
            where=where,
            allowed=", ".join(allowed),
            hint=suggest(str(path[-1]), allowed) or _elsewhere(model, str(path[-1])),
        )
    if detail["type"] == "missing":
        if isinstance(detail["loc"][-1], int):
            length = 1 + max(other["loc"][-1] for other in details if other["loc"][:-1] == detail["loc"][:-1])
            found = _short(detail["input"])
            return ConfigError(f"{name}: found {found}", where=where, allowed=f"a list of {length} values")
        # sections are those of runs, whose values can be set beside files
        hint = f"--set {name.removeprefix('task.')}=VALUE" if section else None
        return ConfigError(f"{name} is missing", where=where, hint=hint)
    text = detail["msg"].removeprefix("Value error, ")
    found = f": found {_short(detail['input'])}"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 and len(detail["loc"]) == len(path) else ""
    if detail["type"] in ("value_error", "assertion_error"):
        # the text describes a mapping already
        found = "" if not path or isinstance(detail["input"], Mapping) else found
        return ConfigError(f"{name}: {text}{found}{more}" if name else f"{text}{more}", where=where)
    return ConfigError(f"{name}{found}{more}".removeprefix(": "), where=where, allowed=_allowed(detail["type"], text))


ALLOWED = {
    "list_type": "a list, such as [a, b]",
    "model_type": "keys and values, such as `{key: value}`",
    "path_type": "a path",
    "tuple_type": "a list, such as [a, b]",
}


def _allowed(kind: str, text: str) -> str:
    words = text.removeprefix("Input should be ")
    return ALLOWED.get(kind) or words[:1].lower() + words[1:]


def _real_path(location: tuple[Any, ...], values: Any) -> KeyPath:
    """The keys of a pydantic location that are in the values, without names of union members."""
    path: list[str | int] = []
    for index, key in enumerate(location):
        last = index == len(location) - 1
        in_list = isinstance(values, list | tuple) and isinstance(key, int) and key < len(values)
        if in_list or (isinstance(values, Mapping) and key in values):
            path.append(key)
            values = values[key]
        elif last and isinstance(values, Mapping):
            path.append(key)
    return tuple(path)


def _fields_at(model: type[BaseModel], path: KeyPath) -> list[str]:
    for key in path:
        info = model.model_fields.get(str(key))
        model = (nested_model(info.annotation) if info else None) or model
    return list(model.model_fields)


def suggest(key: str, allowed: Iterable[str]) -> str | None:
    """A hint at the allowed name closest to an unknown one; None where none is close."""
    close = difflib.get_close_matches(key, list(allowed), n=1)
    return f"did you mean {close[0]!r}?" if close else None


def _elsewhere(model: type[BaseModel], key: str) -> str | None:
    """A hint at the section of a model that has a misplaced key; None without one."""
    sections = {name: nested_model(info.annotation) for name, info in model.model_fields.items()}
    found = [f"{name}.{key}" for name, nested in sections.items() if nested and key in nested.model_fields]
    return f"did you mean {found[0]!r}?" if found else None


def _short(value: Any, limit: int = 60) -> str:
    text = repr(value)
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


@dataclass(frozen=True)
class Override:
    """One `--set`.

    Arguments:
        path: The dotted key, split.
        value: The value, read as YAML.
        where: The option as the user wrote it, for messages.
        texts: Numbers, booleans and nulls in the value as they were written, by their paths in it.
    """

    path: KeyPath
    value: Any
    where: str
    texts: Mapping[KeyPath, str] = field(default_factory=dict)


def parse_override(text: str, option: str = "--set") -> Override:
    """Read `KEY=VALUE`; the value is a YAML scalar, or a list or mapping in brackets, and else text.

    Raises:
        ConfigError: There is no key or no equals sign, or the brackets do not close.
    """
    key, equals, value = text.partition("=")
    where = f"{option} {text}"
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(
            "is not of the form KEY=VALUE", where=where, allowed="a dotted key, such as density.sigma_m=0.005"
        )
    if len(parts) > MAX_DEPTH:
        raise ConfigError(f"the key has {len(parts)} parts", where=where, allowed=f"at most {MAX_DEPTH}")
    value = value.strip()
    if not value:
        raise ConfigError(f"{key.strip()} has no value", where=where, allowed="a value", hint=UNSET_HINT)
    if value.startswith(("[", "{", '"', "'")):
        document = parse_yaml(value, where=where)
        return Override(tuple(parts), document.value, where, document.texts)
    try:
        return Override(tuple(parts), resolve_scalar(value), where, {(): value})
    except ValueError as error:
        raise ConfigError(str(error), where=where, allowed="a finite number") from None


def parse_overrides(texts: Iterable[str], option: str = "--set") -> list[Override]:
    """Read several `KEY=VALUE`; a key before which the section `task` is left out is the same.

    Raises:
        ConfigError: One cannot be read, or sets a key, or one inside of it, that another sets to something else.
    """
    overrides = [parse_override(text, option) for text in texts]
    for one, other in itertools.combinations(overrides, 2):
        keys = sorted(f"{'.'.join(map(str, each.path)).removeprefix('task.')}." for each in (one, other))
        if keys[1].startswith(keys[0]) and one.value != other.value:
            raise ConfigError(f"{keys[0][:-1]} is already set by {one.where}", where=other.where, hint="remove one")
    return overrides


def apply_override(values: dict[str, Any], override: Override) -> KeyPath:
    """Set a value in a document, in place; missing mappings are made, list items are named by their index.

    Returns:
        The path that was set, with list indices as numbers.

    Raises:
        ConfigError: The path goes through a value that holds nothing, or past the end of a list.
    """
    node: Any = values
    done: list[str | int] = []
    for part in override.path[:-1]:
        done.append(_key(node, str(part), done, override))
        if isinstance(node, dict) and node.get(done[-1]) is None:
            node[done[-1]] = {}
        node = node[done[-1]]
    done.append(_key(node, str(override.path[-1]), done, override))
    node[done[-1]] = override.value
    return tuple(done)


def _key(node: Any, part: str, done: list[str | int], override: Override) -> str | int:
    parent = ".".join(map(str, done))
    if isinstance(node, dict):
        return part
    if isinstance(node, list):
        if part.isdecimal() and int(part) < len(node):
            return int(part)
        raise ConfigError(
            f"{parent} has no item {part!r}",
            where=override.where,
            allowed=f"0 to {len(node) - 1}" if node else "nothing: the list is empty",
        )
    raise ConfigError(f"{parent} is {node!r} and holds no key {part!r}", where=override.where)
