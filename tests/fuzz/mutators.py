"""Damage to files, by a seeded generator: of bytes, of text, and of documents as trees.

Every mutator takes the content of one file, a `random.Random`, and other files of the same kind to splice with.
"""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable, Sequence

import yaml

LARGEST_INPUT = 200_000
NUMBERS = (
    "0", "-0.0", "1", "-1", "3", "1e-9", "1e308", "-1e308", "5e-324", "1e400", "nan", "inf", "-inf", ".nan", ".inf",
    "65536", "2147483648", "-2147483649", "4294967295", "9223372036854775807", "9223372036854775808", "1e6", "1e9",
    "1e12", "1e22", "1e154", "1e-300", "18446744073709551616", "9" * 101, "0x10", "1_000", "010", "1:30",
    "90", "180", "360", "-90", "6.283185307179586", "1.5707963267948966", "0.1", "0.999999999999", "1e5", "1e-4",
)  # fmt: skip
WORDS = (
    "", "null", "~", "true", "no", "''", '""', "[]", "{}", "[1]", "[[]]", "{a: 1}", "&a [1, 2]", "*a", "<<: *a", "<<",
    "!!python/object/apply:os.system ['touch EXECUTED']", "!!str", "2020-01-01", "---", "...", "\x00", "\ufeff",
    "\u202e", "é", "\U0001f600", "../../etc/passwd", "/dev/zero", "x" * 300, "<script>alert(1)</script>", "%TAG",
    "#", "\t", "\r", "\n", ":", ": ", ",", "- ", "{", "}", "[", "]", '"', "'", "|", ">", "=", "<", "&lt;", "\\",
)  # fmt: skip
# What tree mutations put in the place of values: numbers beyond every limit, other kinds, nothing.
VALUES = (
    None, True, False, 0, 1, -1, 2, 7, 1000, 10**6, 10**9, 2**31, 2**63, 2**64, 10**30, 0.0, -0.0, 0.5, 1e-9, 1e-320,
    1e6, 1e12, 1e154, 1e308, -1e308, float("nan"), float("inf"), "", " ", "x", "nan", "1", "../..", "/dev/full", [], {},
    [0], [0, 0, 0], [1e308, 1e308, 1e308], [None], [[]], {"a": 1}, {"min": 1, "max": 0}, {"": {}}, 90, 360, -90, 3.1416,
)  # fmt: skip
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_NUMBER = re.compile(r"[-+]?(?:\.\d+|\d+(?:\.\d*)?)(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_][\w.]*")

Mutator = Callable[[bytes, random.Random, Sequence[bytes]], bytes]


def mutate_bytes(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A few changes that know nothing of the format."""
    data = bytearray(content)
    for _ in range(source.choice((1, 1, 1, 2, 3, 8))):
        source.choice(_BYTE_CHANGES)(data, source, others)
    return bytes(data[:LARGEST_INPUT])


def _flip(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    if data:
        data[source.randrange(len(data))] ^= 1 << source.randrange(8)


def _set(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    if data:
        data[source.randrange(len(data))] = source.choice((0, 1, 9, 10, 13, 32, 44, 58, 127, 128, 255))


def _set_number(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    """A whole number or a float of two to eight bytes, of either byte order."""
    order, kind = source.choice("<>"), source.choice("HIQfd")
    if kind in "fd":
        packed = struct.pack(order + kind, source.choice((float("nan"), float("inf"), -1.0, 1e30, 0.0, 1e-40)))
    else:
        size = struct.calcsize(kind)
        top = 1 << 8 * size
        packed = (source.choice((0, 1, 2, 255, top // 2 - 1, top // 2, top - 1, source.randrange(top))) % top).to_bytes(
            size, "little" if order == "<" else "big"
        )
    at = source.randrange(len(data) + 1)
    data[at : at + len(packed)] = packed


def _cut(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    at = source.randrange(len(data) + 1)
    del data[at : at + source.choice((1, 2, 4, 16, 64, 256))]


def _truncate(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    del data[source.randrange(len(data) + 1) :]


def _insert(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    at = source.randrange(len(data) + 1)
    data[at:at] = source.randbytes(source.choice((1, 2, 4, 8, 32)))


def _repeat(data: bytearray, source: random.Random, _: Sequence[bytes]) -> None:
    at, length = source.randrange(len(data) + 1), source.choice((1, 4, 12, 50, 200))
    data[at:at] = bytes(data[at : at + length]) * source.choice((1, 1, 2, 20))


def _splice(data: bytearray, source: random.Random, others: Sequence[bytes]) -> None:
    other = source.choice(others)
    data[source.randrange(len(data) + 1) :] = other[source.randrange(len(other) + 1) :]


_BYTE_CHANGES = (_flip, _flip, _set, _set_number, _set_number, _cut, _truncate, _insert, _repeat, _splice)


def mutate_text(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A few changes of numbers, words and lines."""
    text = content.decode("utf-8", errors="replace")
    for _ in range(source.choice((1, 1, 1, 2, 3, 6))):
        text = source.choice(_TEXT_CHANGES)(text, source, others)
    return text[:LARGEST_INPUT].encode("utf-8", errors="replace")


def _replaced(text: str, pattern: re.Pattern[str], source: random.Random, new: str) -> str:
    found = [match.span() for match in pattern.finditer(text)]
    if not found:
        return text + new
    start, end = source.choice(found)
    return text[:start] + new + text[end:]


def _other_number(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    return _replaced(text, _NUMBER, source, source.choice(NUMBERS))


def _other_word(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    own = _WORD.findall(text)
    return _replaced(text, _WORD, source, source.choice(own if own and source.random() < 0.5 else WORDS))


def _word_for_number(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    return _replaced(text, _NUMBER, source, source.choice(WORDS))


def _inserted_word(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    at = source.randrange(len(text) + 1)
    return text[:at] + source.choice(WORDS + NUMBERS) + text[at:]


def _without_line(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    lines = text.split("\n")
    del lines[source.randrange(len(lines))]
    return "\n".join(lines)


def _line_again(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    lines = text.split("\n")
    line = source.choice(lines)
    lines[source.randrange(len(lines)) : 0] = [line] * source.choice((1, 1, 2, 50))
    return "\n".join(lines)


def _line_moved(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    lines = text.split("\n")
    line = lines.pop(source.randrange(len(lines)))
    lines.insert(source.randrange(len(lines) + 1), line)
    return "\n".join(lines)


def _other_indent(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    lines = text.split("\n")
    at = source.randrange(len(lines))
    lines[at] = source.choice(("", " ", "  ", "\t", "      ")) + lines[at].lstrip()
    return "\n".join(lines)


def _without_span(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    at = source.randrange(len(text) + 1)
    return text[:at] + text[at + source.choice((1, 2, 5, 20, 100)) :]


def _joined(text: str, source: random.Random, others: Sequence[bytes]) -> str:
    other = source.choice(others).decode("utf-8", errors="replace").split("\n")
    lines = text.split("\n")
    return "\n".join([*lines[: source.randrange(len(lines) + 1)], *other[source.randrange(len(other)) :]])


def _damaged_bytes(text: str, source: random.Random, others: Sequence[bytes]) -> str:
    return mutate_bytes(text.encode("utf-8", errors="replace"), source, others).decode("latin-1")


_TEXT_CHANGES = (
    _other_number, _other_number, _other_number, _other_word, _other_word, _word_for_number, _inserted_word,
    _without_line, _line_again, _line_moved, _other_indent, _without_span, _joined, _damaged_bytes,
)  # fmt: skip


def _of_tree(load: Callable[[bytes], object], dump: Callable[[object, random.Random], str]) -> Mutator:
    """A change of a document as a tree, or of its text."""

    def mutate(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
        if source.random() < 0.4:
            return mutate_text(content, source, others)
        return dump(mutate_tree(load(content), source), source).encode()

    return mutate


def _dump_yaml(document: object, source: random.Random) -> str:
    return yaml.dump(document, Dumper=Dumper, sort_keys=False, default_flow_style=source.random() < 0.5)


mutate_yaml = _of_tree(lambda content: yaml.load(content, Loader=Loader), _dump_yaml)
mutate_json = _of_tree(json.loads, lambda document, _: json.dumps(document))


def mutate_tree(document: object, source: random.Random) -> object:
    """A document with a few values, keys or items replaced, dropped, repeated or moved; works in place."""
    for _ in range(source.choice((1, 1, 1, 2, 3))):
        holders = list(_holders(document))
        if not holders or source.random() < 0.01:
            return source.choice(VALUES)
        holder = source.choice(holders)
        if isinstance(holder, dict):
            _change_mapping(holder, source, holders)
        else:
            _change_list(holder, source, holders)
    return document


def _holders(node: object) -> list[dict | list]:
    """Every mapping and list in a document that holds something."""
    if not isinstance(node, dict | list):
        return []
    items = node.values() if isinstance(node, dict) else node
    return ([node] if node else []) + [holder for item in items for holder in _holders(item)]


def _value(source: random.Random, holders: list[dict | list]) -> object:
    """A special value, or a copy of one from elsewhere in the document."""
    if source.random() < 0.75:
        return json.loads(json.dumps(source.choice(VALUES)))
    holder = source.choice(holders)
    return json.loads(json.dumps(source.choice(list(holder.values()) if isinstance(holder, dict) else holder)))


def _change_mapping(holder: dict, source: random.Random, holders: list[dict | list]) -> None:
    key = source.choice(list(holder))
    kind = source.random()
    if kind < 0.6:
        holder[key] = _value(source, holders)
    elif kind < 0.75:
        del holder[key]
    elif kind < 0.85:
        holder[source.choice(("x", "", "rays", "name", key + "_m", key[:-1]))] = holder.pop(key)
    else:
        other = source.choice([one for one in holders if isinstance(one, dict)])
        holder[source.choice(list(other))] = _value(source, holders)


def _change_list(holder: list, source: random.Random, holders: list[dict | list]) -> None:
    at = source.randrange(len(holder))
    kind = source.random()
    if kind < 0.6:
        holder[at] = _value(source, holders)
    elif kind < 0.75:
        del holder[at]
    elif kind < 0.9:
        holder.insert(at, _value(source, holders))
    else:
        holder.extend([holder[at]] * source.choice((1, 2, 40)))


def either(*mutators: Mutator) -> Mutator:
    """A mutator that is one of several, each time anew."""

    def mutate(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
        return source.choice(mutators)(content, source, others)

    return mutate
