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

from fuzz.mutators import LARGEST_INPUT, mutate_bytes, mutate_tree

KINDS = ("<f8", "<f4", "<f2", ">f8", "<i8", "<i4", "|i1", "|u1", "<u2", "<u8", "|b1", "<c16", "<U3", "|S4", "<M8[s]")
NUMERIC_KINDS = ("<f8", "<f4", "<i8", "<i4", "|i1", "|u1", "<u2", "<u8")
SPECIAL = (0.0, 1.0, -1.0, 0.5, 2.0, 255.0, 1e9, 1e30, -1e30, 1e300, np.nan, np.inf, -np.inf, 1e-300)
SHAPES = ((), (0,), (1,), (3,), (2, 3), (1, 1), (0, 3), (3, 0), (4, 4, 4), (1, 3, 1, 1), (12,), (36, 3))


class Executed:
    """What a pickle of this does when it is loaded: a file named EXECUTED, which the run looks for."""

    def __reduce__(self) -> tuple[object, ...]:
        return (open, ("EXECUTED", "w"))


PICKLED = pickle.dumps(Executed())


def mutate_array(array: np.ndarray, source: random.Random, kinds: Sequence[str] = KINDS) -> np.ndarray:
    """An array with other values, another shape or another type."""
    array = np.array(array)
    kind = source.random()
    if kind < 0.45 and array.size:
        flat = array.reshape(-1).copy()
        count = source.choice((1, 1, 2, flat.size))
        values = np.array([source.choice(SPECIAL) for _ in range(min(count, 50))])
        with np.errstate(all="ignore"):
            flat[[source.randrange(flat.size) for _ in values]] = values.astype(flat.dtype)
        return flat.reshape(array.shape)
    if kind < 0.6:
        with np.errstate(all="ignore"):
            return array.astype(source.choice(kinds))
    if kind < 0.8:
        with np.errstate(all="ignore"):
            return np.full(source.choice(SHAPES), source.choice(SPECIAL)).astype(source.choice(kinds))
    if kind < 0.9:
        return array[: source.randrange(len(array) + 1)] if array.ndim else array.reshape(1)
    return source.choice((array.reshape(-1), array[None], np.moveaxis(array, 0, -1) if array.ndim > 1 else array))


def mutate_arrays(
    arrays: dict[str, np.ndarray], source: random.Random, kinds: Sequence[str] = KINDS
) -> dict[str, np.ndarray]:
    """Named arrays of which a few are changed, dropped, renamed or doubled."""
    arrays = dict(arrays)
    for _ in range(source.choice((1, 1, 2, 3))):
        name = source.choice(list(arrays) or ["x"])
        kind = source.random()
        if kind < 0.7:
            arrays[name] = mutate_array(arrays.get(name, np.zeros(3)), source, kinds)
        elif kind < 0.8:
            arrays.pop(name, None)
        elif kind < 0.9:
            arrays[source.choice(("x", name + "_ns", "a" * 60))] = arrays.pop(name, np.zeros(3))
        else:
            arrays[name] = arrays[source.choice(list(arrays))] if arrays else np.zeros(1)
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
        change = source.choice((_other_header, _other_header, _pickled, _damaged, _renamed))
        change(members, name, source)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", source.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in members.items():
            archive.writestr(name or "x", data)
    return packed.getvalue()[:LARGEST_INPUT]


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _other_header(members: dict[str, bytes], name: str, source: random.Random) -> None:
    """A header whose shape, type or order was changed, of the right length."""
    data = members[name]
    length = struct.unpack("<H", data[8:10])[0]
    header = data[10 : 10 + length].decode("latin-1")
    shapes = ("()", "(10,)", "(1000000000000,)", "(0,)", "(-1,)", "(4294967296, 4294967296)", "(2, 3)", "[3]", "'x'")
    kinds = ("'|O'", "'<f8'", "'<c16'", "[('a', '<f8')]", "'<U1000000'", "'|V0'", "'<f99'", "__import__('os')", "5")
    at = source.random()
    if at < 0.4:
        header = header[: header.find("'shape': ") + 9] + source.choice(shapes) + ", }"
    elif at < 0.8:
        header = header.replace(header[header.find("'descr': ") + 9 : header.find(", 'fortran")], source.choice(kinds))
    else:
        header = source.choice(("", "{}", "{" * 300, "nonsense", header.replace("False", "True"), header + header))
    header += "\n"
    members[name] = data[:8] + struct.pack("<H", len(header) % 65536) + header.encode("latin-1") + data[10 + length :]


def _pickled(members: dict[str, bytes], name: str, _: random.Random) -> None:
    """An array of objects: a pickle, as numpy writes it when it may."""
    header = "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n"
    members[name] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + PICKLED


def _damaged(members: dict[str, bytes], name: str, source: random.Random) -> None:
    members[name] = mutate_bytes(members[name], source, list(members.values()))


def _renamed(members: dict[str, bytes], name: str, source: random.Random) -> None:
    names = ("../../outside.npy", "/absolute.npy", "x.txt", "", "é.npy", ".npy", "a/b.npy", "x" * 300)
    members[source.choice(names)] = members.pop(name)


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
    if kind < 0.5 and isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf":
        array = mutate_array(item[()], source, (*NUMERIC_KINDS, "|b1", "|S4", ">f8", "<c16"))
        attributes = dict(item.attrs)
        del file[name]
        made = file.create_dataset(name, data=array)
        made.attrs.update(attributes)
    elif kind < 0.65:
        del file[name]
        links = (h5py.ExternalLink("/etc/passwd", "/x"), h5py.SoftLink("/" + name), h5py.SoftLink("/nowhere"))
        file[name] = source.choice(links)
    elif kind < 0.75:
        del file[name]
        file[name] = source.choice((np.bytes_("text"), "text", np.zeros(3), h5py.Empty("f8")))
    elif kind < 0.85:
        name = source.choice(("unit", "MATLAB_class", "x"))
        item.attrs[name] = source.choice(("mm", "lightyear", 5, b"\xff", "cell"))
    elif kind < 0.95:
        del file[name]
        file.create_dataset(name, shape=(1 << 40,), dtype="f8", chunks=(1 << 10,))
    else:
        del file[name]
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
