"""YAML with positions and without surprises.

The readable subset of YAML 1.2: plain scalars are null, true, false, decimal numbers (`1e-3` is one, `010` is
ten) or text (`no`, `on`, `1:30` and dates stay text). Tags, aliases, merge keys, duplicate keys, numbers that are not
finite, and deep nesting are errors that name file, line and column.
Nothing in a file is ever executed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.run.inputs import YAML, Kind, read_file

MAX_DEPTH = 32
MAX_NODES = 500_000
MAX_DIGITS = 100
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BaseDumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
QUOTE_HINT = 'quote text that begins with a sign or has a colon in it, such as "*hand"'
# Messages of libyaml and its Python twin about text without quotes.
UNQUOTED = ("found character", "mapping values", "did not find expected alphabetic")

_NULL = re.compile(r"~|null|Null|NULL|")
_BOOLEAN = re.compile(r"true|True|TRUE|false|False|FALSE")
_INTEGER = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")

KeyPath = tuple[str | int, ...]
Position = tuple[int, int]


@dataclass(frozen=True)
class Document:
    """A parsed YAML document that knows where each of its keys and values stands.

    Arguments:
        value: Mappings, lists, text, numbers, booleans and None.
        where: The file's name (or option) for messages.
        keys: Line and column of the key of each path, from 1.
        values: Line and column of the value of each path.
        texts: Numbers, booleans and nulls as they were written, by path.
    """

    value: Any
    where: str
    keys: dict[KeyPath, Position] = field(default_factory=dict)
    values: dict[KeyPath, Position] = field(default_factory=dict)
    texts: dict[KeyPath, str] = field(default_factory=dict)

    def locate(self, path: KeyPath, *, key: bool = False) -> str:
        """The position `file:line:column` of a path, or of its nearest known parent.

        A value that is a mapping or a list is found by its key, as is every path when `key` is true.
        """
        path = tuple(path)
        while path and path not in self.values:
            path, key = path[:-1], True
        position = self.values.get(path, (1, 1))
        if path in self.keys and (key or self.keys[path][0] != position[0]):
            position = self.keys[path]
        return f"{self.where}:{position[0]}:{position[1]}"

    @property
    def mapping(self) -> dict[str, Any]:
        """The value as a mapping; an empty document is an empty one.

        Raises:
            ConfigError: The document is a list or a single value.
        """
        if self.value is None:
            return {}
        if not isinstance(self.value, dict):
            raise ConfigError(
                f"found one {type(self.value).__name__}",
                where=f"{self.where}:1:1",
                allowed="keys and values, such as `key: value`",
            )
        return self.value


def load_yaml(path: Path, kind: Kind = YAML, *, empty_sections: bool = False) -> Document:
    """Read a YAML file.

    Arguments:
        path: The file.
        kind: The kind of file, which limits its size.
        empty_sections: Whether a key of the first level may have nothing behind it, as a section all of whose keys
            are comments.

    Raises:
        ConfigError: The file cannot be read, is too large, is not UTF-8, or is not in the accepted subset.
    """
    path = Path(path)
    content = read_file(path, kind)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ConfigError("is not UTF-8 text", where=f"{path}:{line}:1", hint="save it as UTF-8") from None
    return parse_yaml(text, where=str(path), empty_sections=empty_sections)


def parse_yaml(text: str, *, where: str, empty_sections: bool = False) -> Document:
    """Parse YAML text; `where` names it in messages."""
    builder = _Builder(where, empty_sections)
    try:
        for event in yaml.parse(text, Loader=_Loader):
            builder.take(event)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ConfigError(
            f"is not YAML: {error.problem or error.context}",
            where=f"{where}:{mark.line + 1}:{mark.column + 1}" if mark else where,
            hint=QUOTE_HINT if error.problem and error.problem.startswith(UNQUOTED) else None,
        ) from None
    except yaml.YAMLError as error:
        raise ConfigError(f"is not YAML: {' '.join(str(error).split())}", where=where) from None
    return Document(builder.root, where, builder.keys, builder.values, builder.texts)


def resolve_scalar(text: str) -> Any:
    """The value of a plain scalar: None, a boolean, a number, or the text itself.

    Raises:
        ValueError: A number that is not finite or too long.
    """
    if _NULL.fullmatch(text):
        return None
    if _BOOLEAN.fullmatch(text):
        return text.lower() == "true"
    if _INTEGER.fullmatch(text):
        if len(text) > MAX_DIGITS:
            raise ValueError(f"a number of {len(text)} digits is too long")
        return int(text)
    if _NOT_FINITE.fullmatch(text):
        raise ValueError(f"{text} is not a finite number")
    if _FLOAT.fullmatch(text):
        number = float(text)
        if not math.isfinite(number):
            raise ValueError(f"{text} is too large for a number")
        return number
    return text


def plain_number(text: str) -> float:
    """The number of a text in options and tables: decimal digits, as in files.

    `1_0`, digits of other scripts, `nan` and `inf`, which Python reads, are refused.

    Raises:
        ValueError: No number, or not finite.
    """
    number = float(text) if _FLOAT.fullmatch(text.strip()) else math.nan
    if not math.isfinite(number):
        raise ValueError(f"{text!r} is not a finite number")
    return number


@dataclass
class _Frame:
    """A collection that is being read."""

    value: Any
    path: KeyPath
    key: str | None = None


class _Builder:
    """Turns parser events into values: one pass, no recursion, so that depth cannot exhaust the stack."""

    def __init__(self, where: str, empty_sections: bool) -> None:
        self.where, self.empty_sections = where, empty_sections
        self.root: Any = None
        self.keys: dict[KeyPath, Position] = {}
        self.values: dict[KeyPath, Position] = {}
        self.texts: dict[KeyPath, str] = {}
        self._stack: list[_Frame] = []
        self._nodes = 0
        self._documents = 0

    def take(self, event: yaml.Event) -> None:
        if isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise self._error(event, "a second document starts here", "one document per file")
        elif isinstance(event, yaml.AliasEvent):
            raise self._error(event, f"the alias *{event.anchor} is not supported", "the value itself", QUOTE_HINT)
        elif isinstance(event, yaml.ScalarEvent):
            self._scalar(event)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._open(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._stack.pop()

    def _scalar(self, event: yaml.ScalarEvent) -> None:
        self._check(event)
        plain = not event.style and event.implicit[0]
        if self._expects_key():
            key, frame = event.value, self._stack[-1]
            if not event.style:
                try:
                    text = isinstance(resolve_scalar(key), str)
                except ValueError:
                    text = False
                if not text:
                    raise self._error(
                        event, f"the key {key or 'null'!r} is not text", "names as keys; quote it to make it text"
                    )
                if key == "<<":
                    raise self._error(event, "merge keys are not supported", hint="write the keys out")
            if key in frame.value:
                first = self.keys[(*frame.path, key)]
                raise self._error(event, f"the key {key!r} was given before, in line {first[0]}", "each key once")
            frame.key = key
            self.keys[(*frame.path, key)] = _position(event)
            return
        try:
            value = resolve_scalar(event.value) if plain else event.value
        except ValueError as error:
            name = ".".join(map(str, self._next_path()))
            raise self._error(event, f"{name}: {error}" if name else str(error)) from None
        path = self._put(value, event)
        if not isinstance(value, str):
            self.texts[path] = event.value
        if plain and not event.value and len(path) > self.empty_sections:
            name = ".".join(map(str, path))
            raise self._error(event, f"{name} has no value", "a value, or null for none", "leave the key out")

    def _open(self, event: yaml.CollectionStartEvent) -> None:
        self._check(event)
        if self._expects_key():
            raise self._error(event, "a list or mapping cannot be a key", "names as keys")
        if len(self._stack) >= MAX_DEPTH:
            raise self._error(event, "nested too deeply", f"at most {MAX_DEPTH} levels")
        value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
        self._stack.append(_Frame(value, self._put(value, event)))

    def _expects_key(self) -> bool:
        return bool(self._stack) and isinstance(self._stack[-1].value, dict) and self._stack[-1].key is None

    def _next_path(self) -> KeyPath:
        if not self._stack:
            return ()
        frame = self._stack[-1]
        return (*frame.path, (frame.key or "") if isinstance(frame.value, dict) else len(frame.value))

    def _put(self, value: Any, event: yaml.Event) -> KeyPath:
        path = self._next_path()
        if not self._stack:
            self.root = value
        elif isinstance(self._stack[-1].value, dict):
            self._stack[-1].value[self._stack[-1].key], self._stack[-1].key = value, None
        else:
            self._stack[-1].value.append(value)
        self.values[path] = _position(event)
        return path

    def _check(self, event: Any) -> None:
        """Refuse a tag, and more values than a document may have."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise self._error(event, "has too many values", f"at most {MAX_NODES}")
        if event.tag is not None:
            raise self._error(event, f"the tag {event.tag!r} is not supported", hint="remove it; quotes make text")

    def _error(
        self, event: yaml.Event, message: str, allowed: str | None = None, hint: str | None = None
    ) -> ConfigError:
        line, column = _position(event)
        return ConfigError(message, where=f"{self.where}:{line}:{column}", allowed=allowed, hint=hint)


def _position(event: yaml.Event) -> Position:
    return event.start_mark.line + 1, event.start_mark.column + 1


class _Dumper(_BaseDumper):  # type: ignore[misc, valid-type]
    """A dumper that quotes text which YAML 1.1 or this module would read as another type, and writes no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        """True, so that repeated values are written out each time."""
        return True


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(f"^(?:{_FLOAT.pattern})$"), list("-+.0123456789"))
_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(f"^(?:{_INTEGER.pattern})$"), list("-+0123456789"))


def dump_yaml(value: Any) -> str:
    """Readable YAML text of plain values; keys keep their order, innermost lists and mappings stay on a line.

    numpy scalars and arrays become numbers and lists, paths become text.

    Raises:
        NumericalError: A number is not finite.
        ConfigError: Text that is not valid Unicode, as a file name that is not UTF-8.
    """
    return yaml.dump(
        _plain(value), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
    )


def _plain(value: Any, path: KeyPath = ()) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item, (*path, str(key))) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, (*path, index)) for index, item in enumerate(value)]
    if hasattr(value, "tolist"):
        return _plain(value.tolist(), path)
    if isinstance(value, float) and not math.isfinite(value):
        raise NumericalError(f"{value} cannot be written to a file", where=".".join(map(str, path)))
    if isinstance(value, Path):
        return _plain(str(value), path)
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:  # bytes of a file name or an argument that are no UTF-8
            where = ".".join(map(str, path))
            raise ConfigError(f"{value!r} cannot be written to a file", where=where, allowed="UTF-8") from None
    return value


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values overridden by others, key by key at every depth; neither is changed."""
    result = dict(base)
    for key, value in over.items():
        under = result.get(key) if isinstance(result.get(key), Mapping) else {}
        result[key] = merged(under, value) if isinstance(value, Mapping) else value
    return result


def leaves(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Every path of a document that ends in a scalar or in an empty collection, with its value."""
    if not isinstance(value, dict | list) or not value:
        yield path, value
        return
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        yield from leaves(item, (*path, key))
