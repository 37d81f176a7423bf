"""`--set KEY=VALUE`: dotted paths into a document of plain values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lidardesign.errors import ConfigError
from lidardesign.run.yaml import KeyPath, parse_yaml, resolve_scalar

STRUCTURE_MARKS = ("[", "{", '"', "'")


@dataclass(frozen=True)
class Override:
    """One `--set`.

    Arguments:
        path: The dotted key, split.
        value: The value, read as YAML.
        where: The option as the user wrote it, for messages.
    """

    path: KeyPath
    value: Any
    where: str


def parse_override(text: str, option: str = "--set") -> Override:
    """Read `KEY=VALUE`; the value is a YAML scalar, or a list or mapping in brackets, and else text.

    Raises:
        ConfigError: There is no key or no equals sign, or the brackets do not close.
    """
    key, equals, value = text.partition("=")
    where = f"{option} {text}"
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError("is not of the form KEY=VALUE", where=where, allowed="a dotted key, as density.sigma_m=0.005")
    return Override(tuple(parts), _value(value.strip(), where), where)


def _value(text: str, where: str) -> Any:
    if text.startswith(STRUCTURE_MARKS):
        return parse_yaml(text, where=where).value
    try:
        return resolve_scalar(text)
    except ValueError as error:
        raise ConfigError(str(error), where=where, allowed="a finite number") from None


def apply_override(values: dict[str, Any], override: Override) -> KeyPath:
    """Set a value in a document, in place; missing mappings are made, list items are named by their index.

    Returns:
        The path that was set, with list indices as numbers.

    Raises:
        ConfigError: The path goes through a value that holds nothing, or past the end of a list.
    """
    node: Any = values
    done: list[str | int] = []
    for position, part in enumerate(override.path):
        last = position == len(override.path) - 1
        key = _key(node, str(part), done, override)
        done.append(key)
        if last:
            node[key] = override.value
        else:
            if isinstance(node, dict) and node.get(key) is None:
                node[key] = {}
            node = node[key]
    return tuple(done)


def _key(node: Any, part: str, done: list[str | int], override: Override) -> str | int:
    parent = ".".join(map(str, done))
    if isinstance(node, dict):
        return part
    if isinstance(node, list):
        if part.isdecimal() and int(part) < len(node):
            return int(part)
        allowed = f"0 to {len(node) - 1}" if node else "nothing: the list is empty"
        raise ConfigError(f"{parent} has no item {part!r}", where=override.where, allowed=allowed)
    raise ConfigError(f"{parent} is {node!r} and holds no key {part!r}", where=override.where)
