"""Values of files, checked: errors name file, line and column, what was found and what is allowed.

Booleans and quoted text are no numbers, and names do not steer terminals.
"""

from __future__ import annotations

import difflib
import math
import os
import typing
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from lidardesign.errors import ConfigError
from lidardesign.run.yaml import KeyPath

LIKE_TEXT = (str, bytes, Path)


def is_name(value: Any) -> bool:
    """Whether a value is text that may be shown: not blank, and without characters that steer a terminal."""
    shown = isinstance(value, str) and bool(value.strip())
    return shown and not any(unicodedata.category(letter) == "Cc" for letter in value)


def parts(annotation: Any) -> list[Any]:
    """An annotation and everything that it is a union, list or annotated form of."""
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, UnionType, list, tuple, typing.Annotated):
        return [part for argument in typing.get_args(annotation) for part in parts(argument)]
    return [annotation] if origin in (None, typing.Literal) else []


def nested_model(annotation: Any) -> type[BaseModel] | None:
    """The model that an annotation admits, if it admits one."""
    models = [part for part in parts(annotation) if isinstance(part, type) and issubclass(part, BaseModel)]
    return models[0] if models else None


def wrong_kinds(model: type[BaseModel], values: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Where values are booleans or text although a model asks for numbers, with what stands there."""
    if not isinstance(values, dict):
        return
    for name, value in values.items():
        info = model.model_fields.get(name) if isinstance(name, str) else None
        if info is None:
            continue
        nested = nested_model(info.annotation)
        if nested is not None and isinstance(value, dict):
            yield from wrong_kinds(nested, value, (*path, name))
        else:
            yield from _wrong_values(parts(info.annotation), value, (*path, name))


def _wrong_values(admitted: list[Any], value: Any, path: KeyPath) -> Iterator[tuple[KeyPath, Any]]:
    if isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _wrong_values(admitted, item, (*path, index))
    if not {int, float} & {part for part in admitted if isinstance(part, type)}:
        return
    words = any(typing.get_origin(part) is typing.Literal or part in LIKE_TEXT for part in admitted)
    if (isinstance(value, bool) and bool not in admitted) or (isinstance(value, str) and not words):
        yield path, value


Model = TypeVar("Model", bound=BaseModel)


def check_model(model: type[Model], values: Any, locate: Callable[..., str], section: str = "") -> Model:
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
        elif any(isinstance(part, type) and issubclass(part, Path) for part in parts(info.annotation)):
            words = [part for part in parts(info.annotation) if typing.get_origin(part) is typing.Literal]
            if not any(values[name] in typing.get_args(part) for part in words):
                values[name] = _absolute(values[name], base)


def _absolute(value: Any, base: Path) -> Any:
    if isinstance(value, str) and value:
        return os.path.abspath(base / os.path.expanduser(value))
    if isinstance(value, list):
        return [_absolute(item, base) for item in value]
    return value


def _explain(
    model: type[BaseModel],
    values: Any,
    error: ValidationError,
    locate: Callable[..., str],
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
        return ConfigError(f"{name} is missing", where=where, hint=f"--set {name.removeprefix('task.')}=VALUE")
    text = detail["msg"].removeprefix("Value error, ")
    found = "" if detail["type"] == "value_error" and not path else f": found {_short(detail['input'])}"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 and len(detail["loc"]) == len(path) else ""
    if detail["type"] in ("value_error", "assertion_error"):
        return ConfigError(f"{name}: {text}{found if path else ''}{more}", where=where)
    return ConfigError(f"{name}{found}{more}", where=where, allowed=_allowed(detail["type"], text))


def _allowed(kind: str, text: str) -> str:
    if kind == "model_type":
        return "keys and values, such as `{key: value}`"
    words = text.removeprefix("Input should be ")
    return words[:1].lower() + words[1:]


def _real_path(location: tuple[Any, ...], values: Any) -> KeyPath:
    """The part of a pydantic location that is in the values (it also names the members of unions)."""
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


LocateKey = Callable[[KeyPath], str]
LONGEST_QUOTE = 40


@dataclass(frozen=True)
class Node:
    """One value of a document.

    Arguments:
        value: Plain values: mappings, lists, text, numbers, booleans, None.
        path: Keys and indices from the document's root.
        locate: The position of a path, as `file:line:column`.
    """

    value: Any
    path: KeyPath
    locate: LocateKey

    @property
    def name(self) -> str:
        """The key path for people, as `sensors[0].gate_m.end`."""
        text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.path)
        return text.lstrip(".") or "the document"

    def error(self, message: str, *, allowed: str | None = None, hint: str | None = None) -> ConfigError:
        """An error about this value."""
        return ConfigError(f"{self.name} {message}", where=self.locate(self.path), allowed=allowed, hint=hint)

    def wrong(self, allowed: str) -> ConfigError:
        """The error that this value is not of the allowed kind."""
        return self.error(f"is {_short(self.value, LONGEST_QUOTE)}", allowed=allowed)

    def child(self, key: str | int) -> Node:
        """The value under a key or index."""
        return Node(self.value[key], (*self.path, key), self.locate)

    def mapping(self, required: Iterable[str], optional: Iterable[str] = ()) -> dict[str, Node]:
        """The values of a mapping by key; an optional key that is null counts as absent."""
        required, optional = tuple(required), tuple(optional)
        known = (*required, *optional)
        if not isinstance(self.value, dict):
            raise self.wrong(f"a mapping with the keys {', '.join(known)}")
        for key in self.value:
            if key not in known:
                near = difflib.get_close_matches(str(key), known, 1)
                raise self.child(key).error(
                    "is an unknown key", allowed=", ".join(known), hint=f"{near[0]}" if near else None
                )
        for key in required:
            if key not in self.value:
                raise self.error(f"has no key `{key}`", allowed=", ".join(known))
        return {key: self.child(key) for key in known if self.value.get(key) is not None or key in required}

    def items(self) -> list[Node]:
        """The values of a list."""
        if not isinstance(self.value, list):
            raise self.wrong("a list")
        return [self.child(index) for index in range(len(self.value))]

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number from low to high, both included."""
        value = self.value
        plain = isinstance(value, int | float) and not isinstance(value, bool)
        if not (plain and math.isfinite(value) and low <= value <= high):
            raise self.wrong(f"a number{_between(low, high)}")
        return float(value)

    def integer(self, low: int, high: int | None = None) -> int:
        """A whole number of at least `low`."""
        value = self.value
        top = math.inf if high is None else high
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= top:
            between = f" of at least {low}" if high is None else f" from {low} to {high}"
            raise self.wrong(f"a whole number{between}")
        return value

    def text(self) -> str:
        """Text that is not empty, without characters that steer a terminal."""
        if not is_name(self.value):
            raise self.wrong("text without control characters")
        return self.value

    def choice(self, options: Iterable[str]) -> str:
        """One of several words."""
        options = tuple(options)
        if self.value not in options:
            raise self.wrong(" or ".join(options))
        return self.value

    def numbers(self, count: int | None = None, low: float = -math.inf, high: float = math.inf) -> np.ndarray:
        """A list of finite numbers, shape (count,)."""
        values = [item.number(low, high) for item in self.items()]
        if count is not None and len(values) != count:
            raise self.error(f"has {len(values)} numbers", allowed=f"{count}")
        return np.array(values, dtype=np.float64)

    def plain(self) -> dict[str, Any]:
        """A mapping of anything."""
        if not isinstance(self.value, dict):
            raise self.wrong("a mapping")
        return self.value


def _between(low: float, high: float) -> str:
    if math.isinf(high):
        return "" if math.isinf(low) else f" of at least {low:g}"
    return f" from {low:.6g} to {high:.6g}" if math.isfinite(low) else f" of at most {high:.6g}"
