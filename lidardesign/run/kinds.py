"""What values of files are: booleans and quoted text are no numbers, and names do not steer terminals."""

from __future__ import annotations

import typing
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Any

from pydantic import BaseModel

from lidardesign.run.yaml import KeyPath

LIKE_TEXT = (str, bytes, Path)


def is_name(value: Any) -> bool:
    """Whether a value is text that may be shown: not blank, and without characters that steer a terminal."""
    if not isinstance(value, str) or not value.strip():
        return False
    return not any(unicodedata.category(letter) == "Cc" for letter in value)


def parts(annotation: Any) -> list[Any]:
    """An annotation and everything that it is a union, list or annotated form of."""
    origin = typing.get_origin(annotation)
    if origin is None:
        return [annotation]
    if origin in (typing.Union, UnionType, list, tuple, typing.Annotated):
        return [part for argument in typing.get_args(annotation) for part in parts(argument)]
    return [annotation] if origin is typing.Literal else []


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
