"""Damage inside containers: their parts are changed and wrapped again, so that it reaches what reads the parts."""

from __future__ import annotations

import io
import json
import pickle
import random
import struct
import zipfile
from collections.abc import Sequence

import h5py
import numpy as np
from scipy.io import loadmat, savemat

from fuzz.mutators import LARGEST_INPUT, SPECIAL, mutate_bytes, mutate_tree

KINDS = ("<f8", "<f4", "<f2", ">f8", "<i8", "<i4", "|i1", "|u1", "<u2", "<u8", "|b1", "<c16", "<U3", "|S4", "<M8[s]")
NUMERIC_KINDS = ("<f8", "<f4", "<i8", "<i4", "|i1", "|u1", "<u2", "<u8")
SHAPES = ((), (0,), (1,), (3,), (2, 3), (1, 1), (0, 3), (3, 0), (4, 4, 4), (1, 3, 1, 1), (12,), (36, 3))


class Executed:
    """What a pickle of this does when it is loaded: a file named EXECUTED, which the run looks for."""

    def __reduce__(self) -> tuple[object, ...]:
        return (open, ("EXECUTED", "w"))


# an array of objects: a pickle, as numpy writes it when it may
_HEADER = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n"
PICKLED_ARRAY = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(_HEADER)) + _HEADER + pickle.dumps(Executed())


def mutate_array(array: np.ndarray, source: random.Random, kinds: Sequence[str] = KINDS) -> np.ndarray:
    """An array with other values, another shape or another type."""
    array, special = np.array(array), source.choice(SPECIAL)
    with np.errstate(all="ignore"):
        if array.size and source.random() < 0.45:
            for _ in range(source.choice((1, 1, 2, 50))):
                array.flat[source.randrange(array.size)] = np.array(source.choice(SPECIAL)).astype(array.dtype)
            return array
        return source.choice(
            (
                array.astype(source.choice(kinds)),
                np.full(source.choice(SHAPES), special).astype(source.choice(kinds)),
                array[: source.randrange(len(array) + 1)] if array.ndim else array.reshape(1),
                array.reshape(-1),
                array[None],
                array.T,
            )
        )


def mutate_arrays(
    arrays: dict[str, np.ndarray], source: random.Random, kinds: Sequence[str] = KINDS
) -> dict[str, np.ndarray]:
    """Named arrays of which a few are changed, dropped, renamed or doubled."""
    arrays = dict(arrays)
    for _ in range(source.choice((1, 1, 2, 3))):
        name = source.choice(list(arrays) or ["x"])
        array = arrays.get(name, np.zeros(3))
        if source.random() < 0.2:
            del arrays[name]
        else:
            new = source.choice((name, name, name, "x", name + "_ns", "a" * 60, *arrays))
            arrays[new] = mutate_array(array, source, kinds) if new == name else array
    return arrays


def mutate_npz(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """Other arrays, other headers of arrays, other members of the archive, or damaged bytes."""
    if source.random() < 0.25:
        return mutate_bytes(content, source, others)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if source.random() < 0.5:
        arrays = {name[:-4]: np.load(io.BytesIO(data), allow_pickle=False) for name, data in members.items()}
        members = {f"{name}.npy": _npy(array) for name, array in mutate_arrays(arrays, source).items()}
    else:
        name = source.choice(list(members))
        data = members.pop(name)
        others = (*(_other_header(data, source) for _ in range(3)), PICKLED_ARRAY, mutate_bytes(data, source, [data]))
        names = ("../../outside.npy", "/absolute.npy", "x.txt", "", "é.npy", ".npy", "a/b.npy", "x" * 300)
        members[source.choice((name, name, name, name, source.choice(names)))] = source.choice(others)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", source.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in members.items():
            archive.writestr(name or "x", data)
    return packed.getvalue()[:LARGEST_INPUT]


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _other_header(data: bytes, source: random.Random) -> bytes:
    """A header whose shape, type or order was changed, of the right length."""
    length = struct.unpack("<H", data[8:10])[0]
    header = data[10 : 10 + length].decode("latin-1")
    shapes = ("()", "(10,)", "(1000000000000,)", "(0,)", "(-1,)", "(4294967296, 4294967296)", "(2, 3)", "[3]", "'x'")
    kinds = ("'|O'", "'<f8'", "'<c16'", "[('a', '<f8')]", "'<U1000000'", "'|V0'", "'<f99'", "__import__('os')", "5")
    others = ("", "{}", "{" * 300, "nonsense", header.replace("False", "True"), header + header)
    shaped = header[: header.find("'shape': ") + 9] + source.choice(shapes) + ", }"
    typed = header.replace(header[header.find("'descr': ") + 9 : header.find(", 'fortran")], source.choice(kinds))
    header = source.choice((shaped, shaped, typed, typed, source.choice(others))) + "\n"
    return data[:8] + struct.pack("<H", len(header) % 65536) + header.encode("latin-1") + data[10 + length :]


def mutate_matlab(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """MATLAB 5: other arrays, structures and cells, or damaged bytes.

    Arrays are of the good files alone: SciPy's reader ends the process on some damaged ones.
    """
    if source.random() < 0.5:
        return mutate_bytes(content, source, others)
    good = {name: array for name, array in loadmat(io.BytesIO(source.choice(others))).items() if name[:2] != "__"}
    arrays: dict[str, object] = dict(mutate_arrays(good, source, (*NUMERIC_KINDS, "<c16", "<U3", "|b1")))
    if source.random() < 0.1:
        odd = np.empty((1, 2), dtype=object)
        odd[0, 0], odd[0, 1] = np.zeros(2), "text"
        arrays[source.choice(list(arrays) or ["x"])] = source.choice(({"a": 1}, odd, "text", np.zeros((2, 0))))
    buffer = io.BytesIO()
    savemat(buffer, {name[:31]: value for name, value in arrays.items()}, do_compression=source.random() < 0.5)
    return buffer.getvalue()[:LARGEST_INPUT]


def mutate_hdf5(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """HDF5: other datasets, attributes and links, or damaged bytes."""
    if source.random() < 0.5:
        return mutate_bytes(content, source, others)
    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        for _ in range(source.choice((1, 1, 2))):
            _change_item(file, source.choice(names), source)
    return buffer.getvalue()[:LARGEST_INPUT]


def _change_item(file: h5py.File, name: str, source: random.Random) -> None:
    if name not in file:
        return
    item, kind = file[name], source.random()
    if kind < 0.15:
        values = ("mm", "lightyear", 5, b"\xff", "cell")
        item.attrs[source.choice(("unit", "MATLAB_class", "x"))] = source.choice(values)
        return
    attributes, huge = dict(item.attrs), {"shape": (1 << 40,), "dtype": "f8", "chunks": (1 << 10,)}
    links = (h5py.ExternalLink("/etc/passwd", "/x"), h5py.SoftLink("/" + name), h5py.SoftLink("/nowhere"))
    others = (*links, np.bytes_("text"), "text", np.zeros(3), h5py.Empty("f8"))
    is_array = isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf"
    array = mutate_array(item[()], source, (*NUMERIC_KINDS, "|b1", "|S4", ">f8", "<c16")) if is_array else None
    del file[name]
    if is_array and kind < 0.65:
        file.create_dataset(name, data=array).attrs.update(attributes)
    elif kind < 0.9:
        file[name] = source.choice(others)
    elif kind < 0.97:
        file.create_dataset(name, **huge)
    else:
        file.create_group(name)


def mutate_safetensors(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A changed header of the right length, changed numbers behind it, or damaged bytes."""
    if source.random() < 0.3:
        return mutate_bytes(content, source, others)
    length = struct.unpack("<Q", content[:8])[0]
    header, payload = json.loads(content[8 : 8 + length]), content[8 + length :]
    if source.random() < 0.3:
        state = header.get("__metadata__", {})
        for key, text in state.items():
            state[key] = json.dumps(mutate_tree(json.loads(text), source))
    elif source.random() < 0.5:
        header = mutate_tree(header, source)
    else:
        payload = mutate_bytes(payload, source, [payload])
    written = json.dumps(header).encode()
    declared = len(written) if source.random() < 0.9 else source.choice((0, 1 << 40, (1 << 64) - 1, len(written) * 2))
    return (struct.pack("<Q", declared) + written + payload)[: 5 * LARGEST_INPUT]


def mutate_glb(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A changed JSON chunk, a changed binary chunk, or damaged bytes; the lengths are right mostly."""
    if source.random() < 0.3:
        return mutate_bytes(content, source, others)
    length = struct.unpack("<I", content[12:16])[0]
    document, binary = json.loads(content[20 : 20 + length]), content[20 + length :]
    if source.random() < 0.7:
        document = mutate_tree(document, source)
    else:
        binary = mutate_bytes(binary, source, [binary])
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    total = 20 + len(text) + len(binary)
    return content[:8] + struct.pack("<II", total, len(text)) + content[16:20] + text + binary


def mutate_gltf(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """The JSON of a .gltf as a tree, now and then with a buffer from elsewhere."""
    document = mutate_tree(json.loads(content), source)
    if source.random() < 0.2 and isinstance(document, dict):
        places = ("../outside.bin", "/etc/passwd", "file:///etc/passwd", "http://localhost/", "data:,x", "input.gltf")
        document["buffers"] = [{"uri": source.choice(places), "byteLength": 100}]
    return json.dumps(document).encode()
