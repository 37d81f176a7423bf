"""Damage to files, by a seeded generator: of bytes, of text, and of documents as trees.

Every mutator takes the content of one file, a `random.Random`, and other files of the same kind to splice with.
"""

from __future__ import annotations

import copy
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
SPECIAL = (0.0, 1.0, -1.0, 0.5, 2.0, 255.0, 1e9, 1e30, -1e30, 1e-40, float("nan"), float("inf"), float("-inf"))
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
NUMBER = re.compile(r"[-+]?(?:\.\d+|\d+(?:\.\d*)?)(?:[eE][-+]?\d+)?")
TOKEN = re.compile(r"[A-Za-z_][\w.]*|[^\w\s]|[ \t]+")

Mutator = Callable[[bytes, random.Random, Sequence[bytes]], bytes]


def mutate_bytes(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A few stretches are gone, or are chance, themselves again, a special number or of another file."""
    data = bytearray(content)
    for _ in range(source.choice((1, 1, 1, 2, 3, 8))):
        at, other = source.randrange(len(data) + 1), source.choice(others)
        end = min(at + source.choice((0, 1, 1, 1, 1, 4, 8, 64, len(data))), len(data))
        start = source.randrange(len(other) + 1)
        new = (
            b"",
            source.randbytes(end - at or source.choice((1, 4, 32))),
            bytes(byte ^ 1 << source.randrange(8) for byte in data[at:end]),
            bytes(data[at : min(end, at + 200)]) * source.choice((2, 20)),
            struct.pack(source.choice("<>") + source.choice("BHIQ"), source.choice((0, 1, 127, 128, 255))),
            struct.pack(source.choice("<>") + "q", source.choice((-1, 1 - (1 << 63), 1 << 31, source.getrandbits(40)))),
            struct.pack(source.choice("<>") + source.choice("fd"), source.choice(SPECIAL)),
            other[start : start + source.choice((8, 64, len(other)))],
        )
        data[at:end] = source.choice(new)
    return bytes(data[:LARGEST_INPUT])


def mutate_text(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A few tokens are others, gone or doubled; lines are gone, moved, indented, repeated or of another file."""
    text = content.decode("utf-8", errors="replace")
    for _ in range(source.choice((1, 1, 1, 2, 3, 6))):
        text = source.choice((_other_token, _other_token, _other_lines))(text, source, others)
    if source.random() < 0.05:
        return mutate_bytes(text.encode("utf-8", errors="replace"), source, others)
    return text[:LARGEST_INPUT].encode("utf-8", errors="replace")


def _other_token(text: str, source: random.Random, _: Sequence[bytes]) -> str:
    tokens = source.choice((NUMBER, TOKEN))
    found = [match.span() for match in tokens.finditer(text)] or [(len(text), len(text))]
    (start, end), (first, last) = source.choice(found), source.choice(found)
    new = source.choice((source.choice(NUMBERS), source.choice(NUMBERS), source.choice(WORDS), text[first:last], ""))
    return text[: source.choice((start, start, end))] + new + text[end:]


def _other_lines(text: str, source: random.Random, others: Sequence[bytes]) -> str:
    lines = text.split("\n")
    other = source.choice(others).decode("utf-8", errors="replace").split("\n")
    at, to = source.randrange(len(lines)), source.randrange(len(lines) + 1)
    end = at + source.choice((1, 1, 2, 10))
    taken, indent = lines[at:end], source.choice(("", " ", "\t", "      "))
    del lines[at : source.choice((at, end))]
    some = other[source.randrange(len(other)) :]
    indented = [indent + line.lstrip() for line in taken]
    lines[to:to] = source.choice(([], taken, taken * source.choice((2, 50)), indented, ["".join(taken)], some))
    return "\n".join(lines)


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
        holder, other = source.choice(holders), source.choice(holders)
        elsewhere = source.choice(list(other.values() if isinstance(other, dict) else other))
        new = copy.deepcopy(source.choice((*[source.choice(VALUES)] * 3, elsewhere)))
        kind = source.random()
        if isinstance(holder, dict):
            key = source.choice(list(holder))
            if 0.6 < kind < 0.85:
                taken = holder.pop(key)
                new, key = taken, source.choice(("x", "", "rays", "name", key + "_m", key[:-1]))
            elif kind > 0.85:
                key = source.choice([name for one in holders if isinstance(one, dict) for name in one])
            if not 0.6 < kind < 0.75:
                holder[key] = new
        else:
            at = source.randrange(len(holder))
            end = at + (kind < 0.75)
            holder[at:end] = [] if 0.6 < kind < 0.75 else [new] * source.choice((1, 1, 1, 2, 40))
    return document


def _holders(node: object) -> list[dict | list]:
    """Every mapping and list in a document that holds something."""
    if not isinstance(node, dict | list):
        return []
    items = node.values() if isinstance(node, dict) else node
    return ([node] if node else []) + [holder for item in items for holder in _holders(item)]


def either(*mutators: Mutator) -> Mutator:
    """A mutator that is one of several, each time anew."""
    return lambda content, source, others: source.choice(mutators)(content, source, others)
