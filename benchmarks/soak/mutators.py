"""Damage to files, by a seeded generator: of bytes, of text, and of documents and archives as trees.

Every mutator takes the content of one file, a `random.Random`, and other files of the same kind to splice with. What
an archive holds is changed and wrapped again, so that damage reaches what reads the parts.
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import h5py
import numpy as np
import yaml
from scipy.io import loadmat, savemat

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
    "|O", "c16", "U1000000", "__import__('os')",
)  # fmt: skip
# What tree mutations put in the place of values: numbers beyond every limit, other kinds, nothing.
VALUES = (
    None, True, False, 0, 1, -1, 2, 7, 1000, 10**6, 10**9, 2**31, 2**63, 2**64, 10**30, 0.0, -0.0, 0.5, 1e-9, 1e-320,
    1e6, 1e12, 1e154, 1e308, -1e308, float("nan"), float("inf"), "", " ", "x", "nan", "1", "../..", "/dev/full", [], {},
    [0], [0, 0, 0], [1e308, 1e308, 1e308], [None], [[]], {"a": 1}, {"min": 1, "max": 0}, {"": {}}, 90, 360, -90, 3.1416,
    b"", b"\0" * 100, "file:///etc/passwd", "data:,x",
)  # fmt: skip
KEYS = ("x", "", "rays", "name", "../../outside.npy", "/absolute.npy", "x" * 300)
KINDS = ("<f8", "<f4", "<f2", ">f8", "<i8", "<i4", "|i1", "|u1", "<u2", "<u8", "|b1", "<c16", "<U3", "|S4", "<M8[s]")
SHAPES = ((), (0,), (1,), (3,), (2, 3), (1, 1), (0, 3), (3, 0), (4, 4, 4), (1, 3, 1, 1), (12,), (36, 3))
# What a place in an HDF5 file may hold instead; a mapping is what `create_dataset` takes.
HDF5_VALUES = (
    h5py.ExternalLink("/etc/passwd", "/x"), h5py.SoftLink("/nowhere"), h5py.Empty("f8"), "text", "lightyear", 5,
    np.zeros(3), {"shape": (1 << 40,), "dtype": "f8", "chunks": (1 << 10,)},
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


def mutate_tree(document: object, source: random.Random, values: Sequence[object] = VALUES) -> object:
    """A document with a few values, keys or items changed, replaced, dropped, repeated or moved; works in place."""
    for _ in range(source.choice((1, 1, 1, 2, 3))):
        holders = list(_holders(document))
        if not holders or source.random() < 0.01:
            return source.choice(values)
        holder, other = source.choice(holders), source.choice(holders)
        key = source.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        changed = _changed(holder[key], str(key), source)
        elsewhere = source.choice(list(other.values() if isinstance(other, dict) else other))
        new = copy.deepcopy(source.choice((source.choice(values), elsewhere, changed, changed)))
        kind = source.random()
        if kind < 0.6:
            holder[key] = new
        elif kind < 0.75:
            del holder[key]
        elif isinstance(holder, dict):
            known = [name for one in holders if isinstance(one, dict) for name in one]
            moved = holder.pop(key) if kind < 0.9 else new
            holder[source.choice((source.choice(KEYS), f"{key}_m", str(key)[:-1], source.choice(known)))] = moved
        else:
            holder[key : key + source.choice((0, 1))] = [new] * source.choice((1, 1, 1, 2, 40))
    return document


def _holders(node: object) -> Iterator[dict | list]:
    """Every mapping and list in a document that holds something."""
    if isinstance(node, dict | list) and node:
        yield node
        for item in node.values() if isinstance(node, dict) else node:
            yield from _holders(item)


def _changed(value: object, key: str, source: random.Random) -> object:
    """Something like a value; files by the ending of their name."""
    if isinstance(value, np.ndarray):
        return _changed_array(value, source)
    if isinstance(value, bytes):
        return damaged(BY_ENDING.get(Path(key).suffix, mutate_bytes), value, source, [value])
    if isinstance(value, str):
        content = value.encode("utf-8", errors="replace")
        return mutate_text(content, source, [content]).decode("utf-8", errors="replace")
    return source.choice(VALUES)


def _changed_array(array: np.ndarray, source: random.Random) -> np.ndarray:
    """An array with other values, another shape or another type."""
    array, special = np.array(array), source.choice(SPECIAL)
    with np.errstate(all="ignore"):
        if array.size and source.random() < 0.45:
            for _ in range(source.choice((1, 1, 2, 50))):
                array.flat[source.randrange(array.size)] = np.array(source.choice(SPECIAL)).astype(array.dtype)
            return array
        shaped = np.full(source.choice(SHAPES), special).astype(source.choice(KINDS))
        cut = array[: source.randrange(len(array) + 1)] if array.ndim else array.reshape(1)
        return source.choice((array.astype(source.choice(KINDS)), shaped, cut, array.reshape(-1), array[None], array.T))


def damaged(mutate: Mutator, content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A damaged content; damage that a mutator cannot do to what is damaged already is done to its bytes."""
    try:
        return mutate(content, source, others)
    # mutators parse what they change; a damaged file may not be what they parse
    except Exception:
        return mutate_bytes(content, source, others)


def either(*mutators: Mutator) -> Mutator:
    """A mutator that is one of several, each time anew."""
    return lambda content, source, others: source.choice(mutators)(content, source, others)


def _of_tree(
    load: Callable[[bytes], object],
    dump: Callable[[object, random.Random], bytes],
    plain: Mutator = mutate_bytes,
    values: Sequence[object] = VALUES,
) -> Mutator:
    """A change of a file as a tree, or a plain one."""

    def mutate(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
        if source.random() < 0.4:
            return plain(content, source, others)
        return dump(mutate_tree(load(content), source, values), source)[: 5 * LARGEST_INPUT]

    return mutate


def _dump_yaml(document: object, source: random.Random) -> bytes:
    return yaml.dump(document, Dumper=Dumper, sort_keys=False, default_flow_style=source.random() < 0.5).encode()


def unpacked(content: bytes) -> dict[str, bytes]:
    """The files of an archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name or "x", content)
    return buffer.getvalue()


def _dump_arrays(arrays: dict[str, object], source: random.Random) -> bytes:
    files = {}
    for name, array in arrays.items():
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        files[f"{name}.npy"] = buffer.getvalue()
    return packed(files, source.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


def _load_members(content: bytes) -> object:
    """The arrays of an archive by their headers and their bytes."""
    found = {}
    for name, data in unpacked(content).items():
        end = 10 + struct.unpack("<H", data[8:10])[0]
        found[name] = {"begin": data[:8], "header": data[10:end].decode("latin-1"), "data": data[end:]}
    return found


def _dump_members(members: dict[str, dict], _: random.Random) -> bytes:
    """What was changed, behind lengths and checksums that are right."""
    files = {}
    for name, parts in members.items():
        header = parts["header"].encode("latin-1", errors="replace")
        files[name] = parts["begin"] + struct.pack("<H", len(header) % 65536) + header + parts["data"]
    return packed(files)


def mutate_matlab(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """MATLAB 5; trees are of good files alone: SciPy's reader ends the process on some damaged ones."""
    if source.random() < 0.5:
        return mutate_bytes(content, source, others)
    good = {name: array for name, array in loadmat(io.BytesIO(source.choice(others))).items() if name[:2] != "__"}
    buffer = io.BytesIO()
    arrays = {str(name)[:31]: value for name, value in mutate_tree(good, source).items()}
    savemat(buffer, arrays, do_compression=source.random() < 0.5)
    return buffer.getvalue()[:LARGEST_INPUT]


def _load_hdf5(content: bytes) -> object:
    """Datasets by their place, attributes by place and name with @ between."""
    found = {}

    def visit(place: str, item: h5py.Dataset | h5py.Group) -> None:
        found.update({f"{place}@{name}": value for name, value in item.attrs.items()})
        if isinstance(item, h5py.Dataset):
            found[place] = item[()]

    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(visit)
    return found


def _dump_hdf5(tree: dict[str, object], _: random.Random) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for key in sorted(tree):
            (place, _, name), value = key.partition("@"), tree[key]
            if name:
                (file[place] if place in file else file.require_group(place)).attrs[name] = value
            elif isinstance(value, dict):
                file.create_dataset(place, **value)
            else:
                file[place] = value
    return buffer.getvalue()


def _load_safetensors(content: bytes) -> object:
    """Header, what its notes say, the bytes behind it, and by how much the length of the header is wrong."""
    end = 8 + struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8:end])
    state = {key: json.loads(text) for key, text in header.pop("__metadata__", {}).items()}
    return {"header": header, "state": state, "payload": content[end:], "wrong": 0}


def _dump_safetensors(tree: dict, _: random.Random) -> bytes:
    notes = {"__metadata__": {key: json.dumps(value) for key, value in tree["state"].items()}}
    header = json.dumps({**notes, **tree["header"]}).encode()
    return struct.pack("<Q", len(header) + tree["wrong"]) + header + tree["payload"]


def _load_glb(content: bytes) -> object:
    end = 20 + struct.unpack("<I", content[12:16])[0]
    return {"begin": content[:8], "document": json.loads(content[20:end]), "binary": content[end:]}


def _dump_glb(tree: dict, _: random.Random) -> bytes:
    text = json.dumps(tree["document"]).encode()
    text += b" " * (-len(text) % 4)
    lengths = struct.pack("<II", 20 + len(text) + len(tree["binary"]), len(text))
    return tree["begin"] + lengths + b"JSON" + text + tree["binary"]


def mutate_folder(content: bytes, source: random.Random, _: Sequence[bytes]) -> bytes:
    """A packed run of which files are damaged, gone or swapped, with the hashes that they had or with right ones."""
    tree = mutate_tree(unpacked(content), source)
    files = {str(name): value for name, value in tree.items() if isinstance(value, bytes)} if tree else {}
    return packed(_recorded(files) if source.random() < 0.5 else files)


def _recorded(files: dict[str, bytes]) -> dict[str, bytes]:
    """Files with the hashes of what they hold in their manifest, where it is one."""
    try:
        manifest = json.loads(files["manifest.json"])
        for name in manifest["files"]:
            content = files.get(name, b"")
            manifest["files"][name] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    except (ValueError, TypeError, KeyError):
        return files
    return {**files, "manifest.json": json.dumps(manifest).encode()}


mutate_yaml = _of_tree(lambda content: yaml.load(content, Loader=Loader), _dump_yaml, mutate_text)
mutate_json = _of_tree(json.loads, lambda document, _: json.dumps(document).encode(), mutate_text)
mutate_npz = either(
    _of_tree(lambda content: dict(np.load(io.BytesIO(content), allow_pickle=False)), _dump_arrays),
    _of_tree(_load_members, _dump_members),
)
mutate_hdf5 = _of_tree(_load_hdf5, _dump_hdf5, values=HDF5_VALUES)
mutate_safetensors = _of_tree(_load_safetensors, _dump_safetensors)
mutate_glb = _of_tree(_load_glb, _dump_glb)
BY_ENDING = {
    ".yaml": mutate_yaml, ".json": mutate_json, ".jsonl": mutate_text, ".npz": mutate_npz,
    ".safetensors": mutate_safetensors,
}  # fmt: skip
