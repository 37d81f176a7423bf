"""Single values that are given beside files, as `--set KEY=VALUE`: read, and set in a document."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lidardesign.errors import UNSET_HINT, ConfigError
from lidardesign.run.yaml import MAX_DEPTH, KeyPath, parse_yaml, resolve_scalar


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
        raise ConfigError(
            "is not of the form KEY=VALUE", where=where, allowed="a dotted key, such as density.sigma_m=0.005"
        )
    if len(parts) > MAX_DEPTH:
        raise ConfigError(f"the key has {len(parts)} parts", where=where, allowed=f"at most {MAX_DEPTH}")
    value = value.strip()
    if not value:
        raise ConfigError(f"{key.strip()} has no value", where=where, allowed="a value", hint=UNSET_HINT)
    if value.startswith(("[", "{", '"', "'")):
        return Override(tuple(parts), parse_yaml(value, where=where).value, where)
    try:
        return Override(tuple(parts), resolve_scalar(value), where)
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
